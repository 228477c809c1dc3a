"""Hundreds of worlds as one stable-baselines3 VecEnv: stepped in one call per thread, encoded in one batch each."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor

from navrep_data.envs.sb3 import WorldBatch
from navrep_data.models.checkpoint import one_thread
from navrep_data.models.controllers import N_ACTIONS
from navrep_data.schema import Event
from navrep_data.sim import SimConfig, Simulator, velocity_commands
from navrep_data.zoo.policy import Policy
from navrep_data.zoo.sb3_worlds import Encoded, eyes, shorten

F32 = NDArray[np.float32]


def _distance(state: F32) -> NDArray[np.float64]:
    """Return the distances (W,) [m] to the goals of robot states (W, 5)."""
    return np.hypot(state[:, 0].astype(np.float64), state[:, 1].astype(np.float64))


class Stepped(NamedTuple):
    """What a step of W worlds brought.

    Attributes
    ----------
    obs : ndarray of shape (W, F)
        Features after it; of the next episode where one ended.
    rewards, done : ndarray of shape (W,)
        Scaled rewards, and whether an episode ended.
    finished : tuple of ndarray
        Of the episodes that ended: worlds, events, sums of the simulator's rewards, lengths in steps.
    cut : ndarray of int
        Worlds whose episode was truncated.
    ends : ndarray of shape (len(cut), F)
        The features they ended with.
    """

    obs: F32
    rewards: F32
    done: NDArray[np.bool_]
    finished: tuple[NDArray[np.int64], NDArray[np.uint8], NDArray[np.float64], NDArray[np.int64]]
    cut: NDArray[np.int64]
    ends: F32


class TrainingWorlds(WorldBatch):
    """Worlds of one environment, seen through a policy's encoder and memory.

    Parameters
    ----------
    config : SimConfig
        The environment; ``curriculum="adaptive"`` makes each world harder or easier by its own episodes.
    policy : Policy
        Whose encoder and memory make the observations; its controller is not used.
    n_worlds : int
        Worlds that step together.
    seed, first_sequence : int
        Of the worlds, see :class:`navrep_data.sim.Simulator`.
    max_speed : float
        As in :class:`ControllerConfig`.
    reward_scale : float
        Factor on the simulator's rewards.
    progress : float
        Added to them, before the factor, per metre that a step which ends nothing brings the robot nearer to its goal.
    truncate : bool
        Whether timeouts are told to the learner as truncations, so that it bootstraps; the authors' software did not.

    Notes
    -----
    With features h and zh the observation that a truncated episode ends with holds the memory of the row before it.
    """

    def __init__(
        self,
        config: SimConfig,
        policy: Policy,
        n_worlds: int,
        *,
        seed: int = 0,
        first_sequence: int = 0,
        max_speed: float = 0.0,
        reward_scale: float = 1.0,
        progress: float = 0.0,
        truncate: bool = True,
    ) -> None:
        self.config = config
        self.simulator = Simulator(config, n_worlds, seed=seed, first_sequence=first_sequence)
        self.first_sequence = first_sequence
        self.policy, self.max_speed, self.reward_scale, self.truncate = policy, max_speed, reward_scale, truncate
        self.progress = progress
        self._to_go = np.zeros(n_worlds)
        self._actions = np.zeros((n_worlds, N_ACTIONS), np.float32)
        self._returns, self._lengths = np.zeros(n_worlds), np.zeros(n_worlds, np.int64)
        self._encoded = Encoded(policy, n_worlds, config)
        self._start = time.time()
        self.outcomes: list[Event] = []
        self.seconds = {"simulate": 0.0, "encode": 0.0}
        super().__init__(
            n_worlds,
            spaces.Box(-np.inf, np.inf, (policy.n_inputs,), np.float32),
            spaces.Box(-1.0, 1.0, (N_ACTIONS,), np.float32),
            {"config": config},
        )

    def reset(self) -> F32:
        """Start an episode in every world."""
        self.simulator.reset()
        self._returns[:], self._lengths[:] = 0.0, 0
        scan, state = self.simulator.observe()
        self._to_go = _distance(state)
        return self._encoded.start(scan, state)

    def restart(self, seed: int, difficulty: NDArray[np.int64]) -> None:
        """Go on in worlds from another stream, as difficult as given; call :meth:`reset` next."""
        self.simulator = Simulator(self.config, self.num_envs, seed=seed, first_sequence=self.first_sequence)
        self.set_difficulty(difficulty)
        self.outcomes = []

    def difficulty(self) -> NDArray[np.int64]:
        """Return the present numbers of humans and obstacles (W, 2)."""
        return self.simulator.difficulty()

    def set_difficulty(self, difficulty: NDArray[np.int64]) -> None:
        """Set it for the episodes that start from now on."""
        self.simulator.set_difficulty(difficulty)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the actions of the next step."""
        self._actions = np.asarray(actions, np.float32)

    def step_wait(self) -> tuple[F32, F32, NDArray[np.bool_], list[dict[str, Any]]]:
        """Step all worlds; those whose episode ends start the next one."""
        before = self._encoded.last
        found = self.advance(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        now = round(time.time() - self._start, 6)
        for world, event, total, length in zip(*found.finished, strict=True):
            infos[world]["episode"] = {"r": float(total), "l": int(length), "t": now}
            infos[world]["event"] = Event(int(event)).label
            # stable-baselines3 wants one for every end, and looks at those of truncated episodes only
            infos[world]["terminal_observation"] = before[world]
        for world, features in zip(found.cut, found.ends, strict=True):
            infos[world]["terminal_observation"] = features
            infos[world]["TimeLimit.truncated"] = True
        return found.obs, found.rewards, found.done, infos

    def advance(self, actions: F32) -> Stepped:
        """Step all worlds by actions (W, 2); those whose episode ends start the next one."""
        began = time.perf_counter()
        velocity = shorten(actions, self.max_speed)
        commands = velocity_commands(self.config, velocity)
        rewards, events = self.simulator.step(commands)
        done = events != Event.NONE
        self._returns += rewards
        self._lengths += 1
        over = np.flatnonzero(done)
        finished = over, events[over], self._returns[over], self._lengths[over]
        cut = np.flatnonzero(events == Event.TIMEOUT) if self.truncate else np.zeros(0, np.int64)
        ends = np.zeros((0, self.policy.n_inputs), np.float32)
        last_seen = self.simulator.observe() if len(cut) else None
        if len(over):
            self.outcomes += [Event(int(event)) for event in events[over]]
            self._returns[over], self._lengths[over] = 0.0, 0
            self.simulator.reset(done)
        scan, state = self.simulator.observe()
        to_go = _distance(state)
        shaped = rewards + self.progress * np.where(done, 0.0, self._to_go - to_go)
        self._to_go = to_go
        middle = time.perf_counter()
        if last_seen is not None:
            ends = self._encoded.ends(last_seen[0][cut], last_seen[1][cut], cut)
        features = self._encoded.step(commands, done, scan, state)
        self.seconds["simulate"] += middle - began
        self.seconds["encode"] += time.perf_counter() - middle
        scaled = (shaped * self.reward_scale).astype(np.float32)
        return Stepped(features, scaled, done, finished, cut, ends)

    def take_outcomes(self) -> list[Event]:
        """Return how episodes ended since the last call, and forget it."""
        events, self.outcomes = self.outcomes, []
        return events


class WorldGroups(WorldBatch):
    """Training worlds in groups that step and encode at the same time, each in a thread of its own.

    Parameters
    ----------
    make : callable
        Takes the number of a group's worlds and its first sequence, returns its :class:`TrainingWorlds`.
    n_worlds : int
        Worlds in all.
    n_groups : int
        At most as many as worlds.

    Notes
    -----
    World w is the same whatever the number of groups. Two halves side by side take all of two cores; one batch leaves
    the second one idle while kernels and Python run.
    """

    def __init__(self, make: Callable[[int, int], TrainingWorlds], n_worlds: int, n_groups: int) -> None:
        firsts = [n_worlds * k // n_groups for k in range(n_groups + 1)]
        self.groups = [make(stop - first, first) for first, stop in pairwise(firsts)]
        self._slices = [slice(first, stop) for first, stop in pairwise(firsts)]
        self._pool = ThreadPoolExecutor(n_groups, "navrep-data-worlds", lambda: torch.set_num_threads(1))
        first = self.groups[0]
        super().__init__(n_worlds, first.observation_space, first.action_space, {"config": first.config})

    def each(self, work: Callable[[TrainingWorlds, slice], Any]) -> list[Any]:
        """Do something with every group and its worlds' slice, side by side; each on one thread of torch's."""
        if len(self.groups) == 1:
            return [work(self.groups[0], self._slices[0])]
        with one_thread():  # of all threads: matrix products have one number for the whole process
            return list(self._pool.map(work, self.groups, self._slices))

    def reset(self) -> F32:
        """Start an episode in every world."""
        return np.concatenate(self.each(lambda group, _: group.reset()))

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the actions of the next step."""
        for group, worlds in zip(self.groups, self._slices, strict=True):
            group.step_async(actions[worlds])

    def step_wait(self) -> tuple[F32, F32, NDArray[np.bool_], list[dict[str, Any]]]:
        """Step all worlds; those whose episode ends start the next one."""
        found = self.each(lambda group, _: group.step_wait())
        seen, rewards, done = (np.concatenate([one[k] for one in found]) for k in range(3))
        return seen, rewards, done, [info for one in found for info in one[3]]

    def restart(self, seed: int, difficulty: NDArray[np.int64]) -> None:
        """Go on in worlds from another stream, as difficult as given; call :meth:`reset` next."""
        self.each(lambda group, worlds: group.restart(seed, difficulty[worlds]))

    def difficulty(self) -> NDArray[np.int64]:
        """Return the present numbers of humans and obstacles (W, 2)."""
        return np.concatenate([group.difficulty() for group in self.groups])

    def set_difficulty(self, difficulty: NDArray[np.int64]) -> None:
        """Set it for the episodes that start from now on."""
        for group, worlds in zip(self.groups, self._slices, strict=True):
            group.set_difficulty(difficulty[worlds])

    def take_outcomes(self) -> dict[str, float]:
        """Return the shares of the outcomes since the last call, and forget them; no shares where no episode ended."""
        events = [event for group in self.groups for event in group.take_outcomes()]
        n = len(events)
        if n == 0:
            return {"episodes": 0.0}
        return {
            "episodes": float(n),
            "success": sum(e == Event.GOAL for e in events) / n,
            "collision": sum(e in (Event.COLLISION_HUMAN, Event.COLLISION_OBSTACLE) for e in events) / n,
            "timeout": sum(e == Event.TIMEOUT for e in events) / n,
        }

    def close(self) -> None:
        """End the threads."""
        self._pool.shutdown()


class Ending(NamedTuple):
    """How an episode ended.

    Attributes
    ----------
    event : Event
        By the rules of the environment; in original physics a goal outranks a collision of the same step.
    touched : bool
        Whether the robot touched anybody or anything on the way, see :meth:`navrep_data.sim.Simulator.touches`.
    """

    event: Event
    touched: bool


def play(policy: Policy, config: SimConfig, numpy_seeds: Sequence[int]) -> list[Ending]:
    """Let a policy drive numbered episodes, side by side, each to its end.

    Parameters
    ----------
    policy : Policy
        Acts deterministically.
    config : SimConfig
        Environment.
    numpy_seeds : sequence of int
        One per episode, see :meth:`Simulator.reset_seeded`.

    Returns
    -------
    list of Ending
        How each ended.
    """
    n = len(numpy_seeds)
    simulator = Simulator(config, n)
    simulator.reset_seeded(np.asarray(numpy_seeds))
    policy.reset(batch_size=n)
    see = eyes(config, policy)
    ended, touched = np.zeros(n, np.uint8), np.zeros(n, np.bool_)
    most = int(np.ceil(config.time_limit / config.sensor.dt)) + 2
    for _ in range(most):
        scan, state = simulator.observe()
        action: Any = policy.act(see(scan), state)
        command = velocity_commands(config, (action.numpy() if isinstance(action, Tensor) else action)[:, :N_ACTIONS])
        policy.observe(command)
        _, events = simulator.step(np.where((ended == 0)[:, None], command, 0.0))
        touches = simulator.touches()
        touched |= (ended == 0) & (touches.agents.any(axis=1) | touches.matter)
        ended = np.where(ended == 0, events, ended)
        if (ended != 0).all():
            break
    return [Ending(Event(int(e)), bool(t)) for e, t in zip(ended, touched, strict=True)]
