"""stable-baselines3's PPO on groups of worlds: whole rollouts side by side, and updates without what nobody reads.

Notes
-----
Same losses, same buffer, same policy. Two things cost more than the learning itself: a step of all worlds that waits
for the slowest group, and an update that makes a distribution object and half a dozen Python numbers per minibatch.
benchmarks/training.py measures both.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.utils import explained_variance
from torch import Tensor, nn

from navrep_data.train.worlds import TrainingWorlds, WorldGroups
from navrep_data.zoo.sb3 import BoundedPolicy

_LOG_2_PI = math.log(2.0 * math.pi)
_TOO_FAR = 1.5


def log_density(actions: Tensor, mean: Tensor, log_width: Tensor) -> Tensor:
    """Return the log densities (N,) of actions (N, A) under normal distributions with one width per axis."""
    off = (actions - mean) * torch.exp(-log_width)
    return -(0.5 * off.square() + log_width + 0.5 * _LOG_2_PI).sum(1)


class GroupedPPO(PPO):
    """PPO on :class:`WorldGroups` with a :class:`BoundedPolicy`; other settings as in stable-baselines3.

    Notes
    -----
    Callbacks hear of starts and ends of rollouts, not of single steps: groups are not at the same one.
    """

    policy: BoundedPolicy

    def collect_rollouts(self, env: Any, callback: Any, rollout_buffer: RolloutBuffer, n_rollout_steps: int) -> bool:
        """Fill the buffer, every group of worlds in its own thread."""
        assert isinstance(env, WorldGroups)
        self.policy.set_training_mode(False)
        rollout_buffer.reset()
        callback.on_rollout_start()
        assert self._last_obs is not None
        assert self._last_episode_starts is not None
        # drawn for all at once, so that a world's noise does not depend on the groups
        noise = torch.randn(n_rollout_steps, *rollout_buffer.actions.shape[1:])
        obs, starts = np.array(self._last_obs), np.array(self._last_episode_starts)
        values = torch.zeros(env.num_envs, dtype=torch.float32)

        def roll(group: TrainingWorlds, worlds: slice) -> None:
            obs[worlds], starts[worlds], values[worlds] = self._roll(
                group, obs[worlds], starts[worlds], noise[:, worlds], rollout_buffer, worlds
            )

        env.each(roll)
        rollout_buffer.pos, rollout_buffer.full = n_rollout_steps, True
        self.num_timesteps += n_rollout_steps * env.num_envs
        self._last_obs, self._last_episode_starts = obs, starts
        rollout_buffer.compute_returns_and_advantage(last_values=values, dones=starts)
        callback.on_rollout_end()
        return True

    @torch.no_grad()
    def _roll(
        self, group: TrainingWorlds, obs: NDArray[Any], starts: NDArray[Any], noise: Tensor, buffer: RolloutBuffer,
        worlds: slice,
    ) -> tuple[NDArray[Any], NDArray[Any], Tensor]:  # fmt: skip
        for step, draw in enumerate(noise):
            mean, log_width, values = self.policy.heads(torch.as_tensor(obs, device=self.device))
            actions = mean + log_width.exp() * draw.to(self.device)
            buffer.observations[step, worlds] = obs
            buffer.episode_starts[step, worlds] = starts
            buffer.actions[step, worlds] = actions.cpu().numpy()
            buffer.values[step, worlds] = values.cpu().numpy()
            buffer.log_probs[step, worlds] = log_density(actions, mean, log_width).cpu().numpy()
            found = group.advance(buffer.actions[step, worlds])
            buffer.rewards[step, worlds] = found.rewards
            if len(found.cut):  # what a truncated episode would still have brought
                rest = self.policy.heads(torch.as_tensor(found.ends, device=self.device))[2]
                buffer.rewards[step, worlds][found.cut] += self.gamma * rest.cpu().numpy()
            obs, starts = found.obs, found.done
        return obs, starts, self.policy.heads(torch.as_tensor(obs, device=self.device))[2].cpu()

    def train(self) -> None:
        """Learn from the buffer."""
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        buffer = self.rollout_buffer
        clip_range = self.clip_range(self._current_progress_remaining)  # type: ignore[operator]
        columns = [buffer.observations, buffer.actions, buffer.log_probs, buffer.advantages, buffer.returns]
        rows = len(buffer.rewards) * self.n_envs
        sizes = [column.reshape(rows, -1).shape[1] for column in columns]
        # one table, so that a minibatch is gathered in one call
        table = torch.from_numpy(np.concatenate([column.reshape(rows, -1) for column in columns], 1)).to(self.device)
        noted: list[Tensor] = []
        for _ in range(self.n_epochs):
            for chosen in torch.split(torch.randperm(rows).to(self.device), self.batch_size):
                obs, actions, before, advantages, returns = torch.split(table[chosen], sizes, 1)
                loss, notes = self._loss(obs, actions, before[:, 0], advantages[:, 0], returns[:, 0], clip_range)
                noted.append(notes)
                if self.target_kl is not None and float(notes[0]) > _TOO_FAR * self.target_kl:
                    break
                self.policy.optimizer.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]
                nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
                self.policy.optimizer.step()
            else:
                self._n_updates += 1
                continue
            break
        means = torch.stack(noted).mean(0).tolist()
        for name, mean in zip(("approx_kl", "policy_gradient_loss", "value_loss", "clip_fraction"), means, strict=True):
            self.logger.record(f"train/{name}", mean)
        explained = explained_variance(buffer.values.flatten(), buffer.returns.flatten())
        self.logger.record("train/explained_variance", float(explained))

    def _loss(
        self, obs: Tensor, actions: Tensor, before: Tensor, advantages: Tensor, returns: Tensor, clip_range: float
    ) -> tuple[Tensor, Tensor]:
        """Return the loss of a minibatch, and (KL, policy loss, value loss, clipped share) without gradient."""
        mean, log_width, values = self.policy.heads(obs)
        log_ratio = log_density(actions, mean, log_width) - before
        ratio = log_ratio.exp()
        if self.normalize_advantage and len(advantages) > 1:
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        clipped = ratio.clamp(1.0 - clip_range, 1.0 + clip_range)
        policy_loss = -torch.minimum(advantages * ratio, advantages * clipped).mean()
        value_loss = (values - returns).square().mean()
        entropy = (log_width + 0.5 * (1.0 + _LOG_2_PI)).sum()
        loss = policy_loss - self.ent_coef * entropy + self.vf_coef * value_loss
        with torch.no_grad():
            kl = (ratio - 1.0 - log_ratio).mean()
            far = (clipped != ratio).float().mean()
        return loss, torch.stack([kl, policy_loss.detach(), value_loss.detach(), far])
