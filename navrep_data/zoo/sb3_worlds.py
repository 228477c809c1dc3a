"""Worlds as a policy's controller sees them: for training a controller of the zoo further with stable-baselines3."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper

from navrep_data.envs.sb3 import NavRepSB3VecEnv, make_sb3_vec
from navrep_data.errors import ConfigError
from navrep_data.models.controllers import N_ACTIONS
from navrep_data.observations import Lidar, ScanAdapter
from navrep_data.schema import ACTION_SIZE, SensorContract
from navrep_data.sim import SimConfig, velocity_commands
from navrep_data.zoo.policy import Policy

F32 = NDArray[np.float32]
# Angles [rad], ranges [m] and times [s] of sensors that agree to this are the same.
_SAME = 1e-4


def shorten(actions: F32, max_speed: float) -> F32:
    """Return actions (W, 2) clipped to [-1, 1] and no longer than `max_speed` [m/s]; 0 = no limit."""
    clipped = np.clip(actions, -1.0, 1.0)
    if max_speed > 0.0:
        length = np.linalg.norm(clipped, axis=1, keepdims=True)
        clipped = clipped * (max_speed / np.maximum(length, max_speed))
    return np.asarray(clipped, np.float32)


def eyes(config: SimConfig, policy: Policy | None = None) -> Callable[[F32], F32]:
    """Return what turns an environment's scans (W, n_rays) into those that a policy, or a V, takes.

    Raises
    ------
    ConfigError
        If the policy has a memory, and the environment another time step than it was trained with.
    """
    sensor, wanted = config.sensor, SensorContract() if policy is None else policy.sensor
    if policy is not None and policy.world_model is not None and abs(sensor.dt - wanted.dt) > _SAME:
        raise ConfigError(
            f"sensor.dt is {sensor.dt}, but {policy.name or 'this memory'} was trained with steps of {wanted.dt} s: "
            "leave it, or take features z."
        )
    mine, theirs = sensor.to_dict(), wanted.to_dict()
    if any(abs(float(mine[name]) - float(theirs[name])) > _SAME for name in mine if name != "dt"):
        return ScanAdapter(Lidar.of(sensor), contract=wanted)
    if config.world == "map":  # whose lidar reaches farther than networks have seen
        return lambda scan: np.minimum(scan, np.float32(wanted.range_max))
    return lambda scan: scan


class Encoded:
    """What a controller takes of a batch of worlds, row after row: encoder and memory of a policy.

    Parameters
    ----------
    policy : Policy
        Whose encoder and memory; its controller is not used.
    n_worlds : int
        Rows.
    config : SimConfig
        The environment, whose sensor may be another than the policy's.
    """

    def __init__(self, policy: Policy, n_worlds: int, config: SimConfig) -> None:
        self.policy, self.n_worlds, self._eyes = policy, n_worlds, eyes(config, policy)
        self.last: F32 = np.zeros((n_worlds, policy.n_inputs), np.float32)

    def start(self, scan: F32, state: F32) -> F32:
        """Return the features (W, F) of first rows: scans (W, n_rays) [m] and robot states (W, 5)."""
        self.policy.reset(batch_size=self.n_worlds)
        self.last = self.policy.encode(self._eyes(scan), state)
        return self.last.copy()

    def ends(self, scan: F32, state: F32, worlds: NDArray[np.int64]) -> F32:
        """Return the features of the rows that episodes of these worlds ended with, of the memory before them."""
        fresh, _ = self.policy.look(self._eyes(scan), state)
        n_memory = self.policy.world_model.h_size if self.policy.world_model is not None else 0
        before = self.last[worlds]
        return np.concatenate([fresh, before[:, before.shape[1] - n_memory :]], axis=1) if n_memory else fresh

    def step(self, executed: NDArray[Any], done: NDArray[np.bool_], scan: F32, state: F32) -> F32:
        """Return the features after a step in which robots did `executed`, (W, 2) or (W, 3) [m/s, m/s, rad/s]."""
        self.policy.observe(executed)
        if done.any():
            self.policy.reset(mask=done)
        self.last = self.policy.encode(self._eyes(scan), state)
        return self.last.copy()


class ControllerWorlds(VecEnvWrapper):
    """A VecEnv of NavRep worlds with a controller's features as observations and two velocities as actions.

    Parameters
    ----------
    venv : VecEnv
        Observations Dict(scan, robot_state), and actions (3,): shares of the robot's largest velocities.
    policy : Policy
        Whose encoder and memory make the features.

    Notes
    -----
    Actions are clipped to [-1, 1] and shortened to the controller's `max_speed`: they are shares of the robot's largest
    velocities. A differential drive turns to where they point (:func:`navrep_data.sim.velocity_commands`). Memories are
    told what the robot did, scans of other sensors go through :class:`navrep_data.observations.ScanAdapter`. A robot
    that is slower or larger than the policy's is not shown in proportion, as it is where the policy drives: it is what
    the controller is to learn.
    """

    def __init__(self, venv: VecEnv, policy: Policy) -> None:
        self.config: SimConfig = venv.get_attr("config", [0])[0]
        self.encoded = Encoded(policy, venv.num_envs, self.config)
        self._executed = np.zeros((venv.num_envs, ACTION_SIZE))
        super().__init__(
            venv,
            spaces.Box(-np.inf, np.inf, (policy.n_inputs,), np.float32),
            spaces.Box(-1.0, 1.0, (N_ACTIONS,), np.float32),
        )

    def reset(self) -> F32:
        """Start an episode in every world."""
        seen: Any = self.venv.reset()
        return self.encoded.start(seen["scan"], seen["robot_state"])

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the actions of the next step, (W, 2)."""
        wanted = shorten(actions, self.encoded.policy.network.config.max_speed)
        self._executed = velocity_commands(self.config, wanted)
        self.venv.step_async((self._executed / self.config.max_velocity).astype(np.float32))

    def step_wait(self) -> tuple[F32, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Step all worlds; those whose episode ends start the next one."""
        seen: Any
        seen, rewards, done, infos = self.venv.step_wait()
        over = np.flatnonzero(done)
        if len(over):
            last = [infos[i]["terminal_observation"] for i in over]
            scans, states = (np.stack([one[name] for one in last]) for name in ("scan", "robot_state"))
            for i, features in zip(over, self.encoded.ends(scans, states, over), strict=True):
                infos[i] = {**infos[i], "terminal_observation": features}
        return self.encoded.step(self._executed, done, seen["scan"], seen["robot_state"]), rewards, done, infos


def controller_worlds(policy: Policy, env: Any, n_envs: int) -> VecEnv:
    """Return what a policy's controller can be trained in, from whatever names or holds an environment.

    Parameters
    ----------
    policy : Policy
        Whose controller is to be trained.
    env : str, SimConfig, gymnasium.Env, gymnasium.vector.VectorEnv or VecEnv
        A name such as ``"navrep-train"`` or a config, of which `n_envs` worlds are made; a NavRep environment, single
        or vectorised, with observations Dict(scan, robot_state); or one that has features and actions already.
    n_envs : int
        Worlds to make.

    Raises
    ------
    ConfigError
        If observations and actions are others, or the sensor is not the policy's.
    """
    if isinstance(env, str | SimConfig):
        env = make_sb3_vec(env, n_envs)
    elif isinstance(env, gymnasium.vector.VectorEnv):
        env = NavRepSB3VecEnv(env)
    elif isinstance(env, gymnasium.Env):
        single = env
        env = DummyVecEnv([lambda: Monitor(single)])
    if not isinstance(env, VecEnv):
        raise ConfigError(f"env is a {type(env).__name__}, expected a name, a SimConfig or an environment.")
    seen, acts = env.observation_space, env.action_space
    if seen.shape == (policy.n_inputs,) and acts.shape == (N_ACTIONS,):
        return env
    if isinstance(seen, spaces.Dict) and set(seen.spaces) == {"scan", "robot_state"} and acts.shape == (ACTION_SIZE,):
        return ControllerWorlds(env, policy)
    raise ConfigError(
        f"{policy.name or 'This policy'} cannot be trained in an environment with observations {seen} and "
        f"actions {acts.shape}: expected Dict(scan, robot_state) and (3,), as make_sb3_vec('navrep-train') has, or "
        f"({policy.n_inputs},) and ({N_ACTIONS},)."
    )
