"""Controllers as stable-baselines3 PPO models, to predict with and to train on."""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.distributions import DiagGaussianDistribution, Distribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn

from navrep_data.errors import CheckpointError, ConfigError
from navrep_data.models.checkpoint import building
from navrep_data.models.config import EndToEndConfig
from navrep_data.models.controllers import LEAST_STD, MOST_STD, ActorCritic, EndToEnd, limit_speed
from navrep_data.schema import ROBOT_STATE_SIZE
from navrep_data.zoo.policy import Policy
from navrep_data.zoo.sb3_worlds import controller_worlds

# Read from the zips: the same in all 53 released runs (paper section III-C). Batch = 128 steps x 6 environments / 4.
N_ENVS = 6
HYPERPARAMETERS: dict[str, Any] = {
    "learning_rate": 2.5e-4,
    "n_steps": 128,
    "batch_size": 192,
    "n_epochs": 4,
    "gamma": 0.99,
    "gae_lambda": 0.95,
    "clip_range": 0.2,
    "clip_range_vf": 0.2,
    "ent_coef": 0.01,
    "vf_coef": 0.5,
    "max_grad_norm": 0.5,
}
ROLLOUT_PARTS = 4
"""Minibatches per rollout."""
# stable-baselines 2's Adam; torch's default is 1e-8
_ADAM_EPS = 1e-5


class BoundedPolicy(ActorCriticPolicy):
    """A normal distribution whose mean is within (-1, 1) and whose width stays between `least_std` and 0.6.

    Parameters
    ----------
    observation_space, action_space, *args, **kwargs
        As in stable-baselines3.
    least_std : float
        Smallest width.
    max_speed : float
        ``predict`` shortens velocities to this [m/s]; 0 = no limit. What is sampled for training is left as it is, so
        that its density is known: there the environment limits.

    Notes
    -----
    The released controllers' means and widths had no bounds while the environment clipped what it executed: with an
    entropy bonus both grew into the hundreds, and control became bang-bang (MODEL_FACTS 7).
    """

    def __init__(
        self,
        observation_space: gymnasium.spaces.Space[Any],
        action_space: gymnasium.spaces.Space[Any],
        *args: Any,
        least_std: float = LEAST_STD,
        max_speed: float = 0.0,
        **kwargs: Any,
    ):
        self._bounds = math.log(least_std), math.log(MOST_STD)
        self.max_speed = max_speed
        kwargs.setdefault("log_std_init", math.log(0.4))
        super().__init__(observation_space, action_space, *args, **kwargs)
        self.optimizer.register_step_post_hook(lambda *_: self.bound_width())

    @torch.no_grad()
    def bound_width(self) -> None:
        """Bring the width back within its bounds; happens by itself after every step of the optimiser.

        The parameter itself is moved, since one that lies outside of a clamp has no gradient that would bring it back.
        """
        self.log_std.clamp_(*self._bounds)

    def heads(self, obs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return means (N, A), log widths (A,) and values (N,) of observations (N, F)."""
        latent_pi, latent_vf = self.mlp_extractor(self.extract_features(obs))
        return torch.tanh(self.action_net(latent_pi)), self.log_std, self.value_net(latent_vf).squeeze(1)

    def _get_action_dist_from_latent(self, latent_pi: Tensor) -> Distribution:
        assert isinstance(self.action_dist, DiagGaussianDistribution)
        return self.action_dist.proba_distribution(torch.tanh(self.action_net(latent_pi)), self.log_std)

    def _predict(self, observation: Any, deterministic: bool = False) -> Tensor:
        return limit_speed(super()._predict(observation, deterministic), self.max_speed)


class ControllerPPO(PPO):
    """PPO of a policy's controller, which any NavRep environment can be set for.

    Attributes
    ----------
    driver : Policy or None
        Whose encoder and memory turn scans into features; not saved, so that after ``load`` features come from
        elsewhere, such as a :class:`navrep_data.zoo.sb3_worlds.ControllerWorlds`.
    """

    driver: Policy | None = None

    def set_env(self, env: Any, force_reset: bool = True) -> None:
        """Set the environment to train in, with as many worlds as it has; see :func:`controller_worlds`."""
        if self.driver is not None:
            env = controller_worlds(self.driver, env, self.n_envs)
        if isinstance(env, VecEnv) and env.num_envs != self.n_envs:
            # stable-baselines3 refuses this, since its buffer has a row per world
            self.n_envs = env.num_envs
            self.batch_size = max(1, self.n_steps * self.n_envs // ROLLOUT_PARTS)
            self.rollout_buffer = RolloutBuffer(
                self.n_steps, self.observation_space, self.action_space, device=self.device, gamma=self.gamma,
                gae_lambda=self.gae_lambda, n_envs=self.n_envs,
            )  # fmt: skip
        super().set_env(env, force_reset)

    def learn(self, *args: Any, **kwargs: Any) -> Any:
        """Train, as stable-baselines3 does; refused where there is no environment."""
        if self.env is None:
            raise ConfigError(
                "There is no environment to learn in: load_sb3(NAME, env='navrep-train'), or model.set_env(...) first."
            )
        return super().learn(*args, **kwargs)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "driver"]


class EndToEndExtractor(BaseFeaturesExtractor):
    """The convolutions of an end-to-end network, shared by actor and critic, as a features extractor.

    Parameters
    ----------
    observation_space : gymnasium.spaces.Box
        Of shape (1085,) or (4101,).
    lidar : str
        ``"rings"`` or ``"1d"``.
    """

    def __init__(self, observation_space: gymnasium.spaces.Box, lidar: str) -> None:
        config = EndToEndConfig(lidar)
        super().__init__(observation_space, config.n_features + ROBOT_STATE_SIZE)
        self.network = EndToEnd(config)
        # the perceptrons are stable-baselines3's own
        for name in ("pi", "vf", "mean", "value", "q", "logstd"):
            delattr(self.network, name)
        self.scale = 1.0
        """What observations are multiplied by before the convolutions; the first one's weights are kept for it."""

    def load(self, network: EndToEnd) -> None:
        """Take the convolutions of a network, which reads observations as they are."""
        self.network.encoder.load_state_dict(network.encoder.state_dict())
        self.network.fc.load_state_dict(network.fc.state_dict())
        with torch.no_grad():
            self._first(self.network).weight /= self.scale

    def store(self, network: EndToEnd) -> None:
        """Give the convolutions to a network, which reads observations as they are."""
        network.encoder.load_state_dict(self.network.encoder.state_dict())
        network.fc.load_state_dict(self.network.fc.state_dict())
        with torch.no_grad():
            self._first(network).weight *= self.scale

    @staticmethod
    def _first(network: EndToEnd) -> nn.Conv2d:
        first = network.encoder[0]
        assert isinstance(first, nn.Conv2d)
        return first

    def forward(self, observations: Tensor) -> Tensor:
        """Return features of shape (B, 37)."""
        return self.network.features(observations)


def spaces(policy: Policy) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Return the observation space (unbounded features) and the action space (two velocities in [-1, 1])."""
    return (
        gymnasium.spaces.Box(-np.inf, np.inf, (policy.n_inputs,), np.float32),
        gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32),
    )


def to_sb3(policy: Policy, env: Any = None, **options: Any) -> PPO:
    """Return a PPO model with a policy's weights.

    Parameters
    ----------
    policy : Policy
        From the zoo. Its encoder stays outside: observations are what ``policy.encode`` returns.
    env : str, SimConfig, gymnasium.Env, gymnasium.vector.VectorEnv or VecEnv, optional
        To train in, see :func:`navrep_data.zoo.sb3_worlds.controller_worlds`. Without one the model predicts, and
        learns after ``set_env``, which takes the same and any number of worlds.
    **options
        Instead of the hyper-parameters of the released runs; ``n_envs`` sets the worlds of a named `env`.

    Returns
    -------
    ControllerPPO
        ``predict(features, deterministic=True)`` gives what ``policy.act`` executes: the mean clipped to [-1, 1]; of
        our own controllers (a :class:`BoundedPolicy`) its tanh, shortened to their speed limit.

    Notes
    -----
    Released runs: stable-baselines 2.10 PPO2. The unused state-action value is left out; the optimiser starts anew.
    An environment of features, which is taken as it is, should shorten velocities to
    ``policy.network.config.max_speed`` itself.
    """
    observation_space, action_space = spaces(policy)
    n_envs = options.pop("n_envs", N_ENVS)
    if env is not None:
        env = controller_worlds(policy, env, n_envs)
        rows = options.get("n_steps", HYPERPARAMETERS["n_steps"]) * env.num_envs
        # the released runs' share of a rollout, where the number of worlds or steps is another
        options.setdefault("batch_size", max(1, rows // ROLLOUT_PARTS))
    settings = {**HYPERPARAMETERS, "device": "cpu", **options}
    settings.setdefault("policy_kwargs", _policy_kwargs(policy.network))
    kind = BoundedPolicy if policy.network.config.squash == "tanh" else ActorCriticPolicy
    with building():  # whose weights are drawn and overwritten
        model = ControllerPPO(kind, env, _init_setup_model=False, **settings)
        if env is None:
            model.observation_space, model.action_space, model.n_envs = observation_space, action_space, n_envs
        model._setup_model()
        put_weights(model.policy, policy.network)
    model.driver = policy
    return model


def _policy_kwargs(network: ActorCritic) -> dict[str, Any]:
    hidden = [layer.out_features for layer in network.pi if isinstance(layer, nn.Linear)]
    kwargs: dict[str, Any] = {
        "net_arch": {"pi": hidden, "vf": hidden},
        "activation_fn": nn.Tanh,
        "optimizer_kwargs": {"eps": _ADAM_EPS},
    }
    if network.config.squash == "tanh":
        kwargs["max_speed"] = network.config.max_speed
    if isinstance(network, EndToEnd):
        kwargs |= {
            "activation_fn": nn.ReLU,
            "features_extractor_class": EndToEndExtractor,
            "features_extractor_kwargs": {"lidar": network.config.lidar},
        }
    return kwargs


@torch.no_grad()
def put_weights(target: ActorCriticPolicy, network: ActorCritic) -> None:
    """Copy a controller's weights into a stable-baselines3 policy."""
    pairs: list[tuple[nn.Module, nn.Module]] = [
        (target.mlp_extractor.policy_net, network.pi),
        (target.mlp_extractor.value_net, network.vf),
        (target.action_net, network.mean),
        (target.value_net, network.value),
    ]
    if isinstance(network, EndToEnd):
        extractor = target.features_extractor
        assert isinstance(extractor, EndToEndExtractor)
        extractor.load(network)
    for module, source in pairs:
        module.load_state_dict(source.state_dict())
    target.log_std.copy_(network.logstd)
    if isinstance(target, BoundedPolicy):
        target.bound_width()


def from_sb3(model: PPO, policy: Policy) -> Policy:
    """Return a policy whose controller is what stable-baselines3 trained: the way back from :func:`to_sb3`.

    Parameters
    ----------
    model : PPO
        From ``load_sb3``, or its saved file as ``ControllerPPO.load(FILE)`` gives it.
    policy : Policy
        Loaded by the name that ``load_sb3`` was given. Its encoder and memory are kept, its controller is overwritten.

    Raises
    ------
    CheckpointError
        If the model's controller is another one than the policy's.
    """
    expected, seen = (policy.n_inputs,), model.observation_space.shape
    if seen != expected:
        raise CheckpointError(
            f"The model takes observations {seen}, but the controller of {policy.name or 'this policy'} {expected}: "
            "give the policy that load_sb3 was given."
        )
    take_weights(policy.network, model.policy)
    if isinstance(policy.network, EndToEnd):
        # its encoder is a frozen copy of weights that have changed
        policy._encoder = policy._make_encoder("float32", False)
    return policy


def take_weights(network: ActorCritic, source: ActorCriticPolicy) -> None:
    """Copy the weights of a stable-baselines3 policy back into a controller, for saving it in the package's format."""
    target = source
    pairs: list[tuple[nn.Module, nn.Module]] = [
        (network.pi, target.mlp_extractor.policy_net),
        (network.vf, target.mlp_extractor.value_net),
        (network.mean, target.action_net),
        (network.value, target.value_net),
    ]
    if isinstance(network, EndToEnd):
        extractor = target.features_extractor
        assert isinstance(extractor, EndToEndExtractor)
        extractor.store(network)
    with torch.no_grad():
        for module, origin in pairs:
            module.load_state_dict(origin.state_dict())
        network.logstd.copy_(target.log_std)
