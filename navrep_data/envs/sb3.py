"""Many worlds as one stable-baselines3 VecEnv. Needs stable-baselines3, and with it torch: loaded on first use only."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from navrep_data.envs.vector import NavRepVectorEnv
from navrep_data.envs.wrappers import VectorFlatObservation, VectorRingsObservation, VectorScan1dObservation
from navrep_data.errors import ConfigError, check_whole, whole_number
from navrep_data.schema import Event
from navrep_data.sim import SimConfig, WorldState
from navrep_data.sim.simulator import check_seed

LIDARS = {None: None, "scan": None, "rings": VectorRingsObservation, "1d": VectorScan1dObservation}


class World:
    """One world of a batch, as far as it is something by itself: what a VecEnv's attributes and methods are of.

    Parameters
    ----------
    batch : VecEnv
        With `config`, `render_mode` and spaces.
    index : int
        Which world.
    """

    def __init__(self, batch: WorldBatch, index: int) -> None:
        self._batch, self.index = batch, index

    def __getattr__(self, name: str) -> Any:
        """Return what all worlds share: ``config``, ``spec``, ``metadata``, ``render_mode``, the spaces."""
        if name in self._batch.shared:
            return self._batch.shared[name]
        raise AttributeError(
            f"A world of a batch has no attribute {name!r}, expected one of: {', '.join(self._batch.shared)}, index, "
            "frame(), render(), state(), get_wrapper_attr(), or one that set_attr() gave it."
        )

    def get_wrapper_attr(self, name: str) -> Any:
        """Return an attribute, as gymnasium's environments do."""
        return getattr(self, name)

    def frame(self, size: int = 480) -> NDArray[np.uint8]:
        """Return a picture of the world, ndarray of shape (size, size, 3), uint8, whatever the render mode."""
        return self._batch.frame(self.index, size)

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture (480, 480, 3), uint8, in mode ``"rgb_array"``."""
        return self.frame() if self._batch.shared["render_mode"] == "rgb_array" else None

    def state(self) -> WorldState:
        """Return a copy of the world's state."""
        return self._batch.state(self.index)


class WorldBatch(VecEnv):
    """What stable-baselines3 asks of a VecEnv beside steps, for worlds that step together.

    Parameters
    ----------
    num_envs : int
        Worlds.
    observation_space, action_space : gymnasium.Space
        Of one world.
    shared : dict
        Attributes that all worlds have, by name.
    """

    def __init__(
        self, num_envs: int, observation_space: gymnasium.Space[Any], action_space: gymnasium.Space[Any],
        shared: dict[str, Any],
    ) -> None:  # fmt: skip
        spaces = {"observation_space": observation_space, "action_space": action_space}
        self.shared = {"render_mode": None, "spec": None, "metadata": {}, **shared, **spaces}
        self.worlds = [World(self, i) for i in range(num_envs)]
        super().__init__(num_envs, observation_space, action_space)

    def frame(self, index: int, size: int = 480) -> NDArray[np.uint8]:
        """Return a picture of a world."""
        raise ConfigError("These worlds cannot be drawn: make them by navrep_data.envs.make_sb3_vec.")

    def state(self, index: int) -> WorldState:
        """Return a copy of a world's state."""
        raise ConfigError("These worlds do not show their states: make them by navrep_data.envs.make_sb3_vec.")

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Let world i start its next episode with ``seed + i``; without a seed, anywhere."""
        return super().seed(None if seed is None else check_seed(seed))

    def _chosen(self, indices: Any) -> list[World]:
        one = whole_number(indices)
        n, chosen = self.num_envs, self._get_indices(indices if one is None else one)
        try:
            asked: list[Any] = list(chosen)
        except TypeError:  # no number and no list of them
            asked = [chosen]
        return [self.worlds[check_whole("indices", i, -n, n - 1)] for i in asked]

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of each of the worlds asked for; AttributeError where there is none."""
        return [getattr(world, attr_name) for world in self._chosen(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Give worlds an attribute of yours.

        Raises
        ------
        ConfigError
            If it is one that all worlds share, which a new value would not change.
        """
        if attr_name in self.shared or hasattr(World, attr_name) or attr_name.startswith("_"):
            raise ConfigError(
                f"{attr_name!r} is shared by all worlds of a batch and cannot be set: give it to make_sb3_vec."
            )
        for world in self._chosen(indices):
            setattr(world, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method of each of the worlds asked for: ``frame``, ``render``, ``state``, ``get_wrapper_attr``."""
        return [getattr(world, method_name)(*method_args, **method_kwargs) for world in self._chosen(indices)]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Return False for each world asked for: what is around them is around the batch."""
        return [False] * len(self._chosen(indices))

    def get_images(self) -> list[NDArray[np.uint8] | None]:
        """Return a picture of each world in mode ``"rgb_array"``, else None for each."""
        return [world.render() for world in self.worlds]

    def close(self) -> None:
        """Nothing is open."""


class NavRepSB3VecEnv(WorldBatch):
    """A :class:`NavRepVectorEnv`, wrapped or not, as stable-baselines3 wants it.

    Parameters
    ----------
    env : gymnasium.vector.VectorEnv
        Over a :class:`NavRepVectorEnv` that starts episodes in the step that ends the one before (``"SameStep"``).

    Raises
    ------
    ConfigError
        If `env` is another one, or has several robots per world.

    Notes
    -----
    ``infos[i]`` is what :class:`NavRepEnv` says of world i: ``robot``, ``humans`` (n, 4), ``event`` (a label), ``seed``
    and ``scenario`` where there are such, with ``terminal_observation`` where an episode has ended and
    ``TimeLimit.truncated`` in every step, as stable-baselines3's DummyVecEnv does.
    """

    def __init__(self, env: gymnasium.vector.VectorEnv[Any, Any, Any]) -> None:
        base = env.unwrapped
        if not isinstance(base, NavRepVectorEnv) or base.autoreset_mode is not gymnasium.vector.AutoresetMode.SAME_STEP:
            raise ConfigError(f"{env} cannot be a VecEnv: expected a NavRepVectorEnv with autoreset_mode='SameStep'.")
        if base.config.robots > 1:
            raise ConfigError(
                f"robots is {base.config.robots}, expected 1: stable-baselines3 knows one action per world."
            )
        self.env: Any = env
        self._base = base
        self._actions: Any = None
        shared = {"config": base.config, "render_mode": base.render_mode, "spec": base.spec, "metadata": base.metadata}
        super().__init__(base.num_envs, env.single_observation_space, env.single_action_space, shared)

    def reset(self) -> Any:
        """Start an episode in every world, by the seeds and options that :meth:`seed` and :meth:`set_options` left."""
        options = self._options[0]
        if any(other != options for other in self._options):
            raise ConfigError("The options differ from world to world, expected one dictionary for all of them.")
        observations, infos = self.env.reset(seed=self._seeds, options=options or None)
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = self._each(infos)
        return observations

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the actions of the next step."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Step all worlds; those whose episode ends start the next one."""
        observations, rewards, terminations, truncations, vector_infos = self.env.step(self._actions)
        done = terminations | truncations
        fresh = self._each(vector_infos)
        infos = fresh
        if done.any():
            infos, last = list(fresh), self._each(vector_infos["final_info"])
            for over in np.flatnonzero(done).tolist():
                self.reset_infos[over] = fresh[over]
                infos[over] = {**last[over], "terminal_observation": vector_infos["final_obs"][over]}
        for i, info in enumerate(infos):
            info["TimeLimit.truncated"] = bool(truncations[i] and not terminations[i])
        return observations, rewards.astype(np.float32), done, infos

    def _each(self, infos: dict[str, Any]) -> list[dict[str, Any]]:
        """Return the infos of each world."""
        config = self._base.config
        counts = np.isfinite(infos["humans"][:, :, 0]).sum(axis=1)
        each: list[dict[str, Any]] = []
        for i, code in enumerate(infos["event"]):
            info = {
                "robot": infos["robot"][i], "humans": infos["humans"][i, : counts[i]], "event": Event(int(code)).label
            }  # fmt: skip
            if "seed" in infos:
                info["seed"] = int(infos["seed"][i])
            if "scenario" in infos:
                info["scenario"] = config.scenarios[infos["scenario"][i]]
            each.append(info)
        return each

    def frame(self, index: int, size: int = 480) -> NDArray[np.uint8]:
        """Return a picture of a world, ndarray of shape (size, size, 3), uint8."""
        return self._base.frame(index, size)

    def state(self, index: int) -> WorldState:
        """Return a copy of a world's state."""
        return self._base.state(index)

    def close(self) -> None:
        """Close the environment."""
        self.env.close()


def make_sb3_vec(
    env: str | SimConfig = "navrep-train",
    n_envs: int = 64,
    *,
    lidar: str | None = None,
    flat: bool = False,
    seed: int | None = None,
    monitor: bool = True,
    **settings: Any,
) -> VecEnv:
    """Return many worlds as one stable-baselines3 VecEnv, stepped together by the kernels.

    Parameters
    ----------
    env : str or SimConfig
        Name such as ``"navrep-train"`` or ``"NavRepTrain-v0"``, or a config of your own; with one robot.
    n_envs : int
        Number of worlds.
    lidar : str, optional
        ``"rings"`` or ``"1d"``: observations as :class:`RingsObservation` and :class:`Scan1dObservation` make them;
        ``"scan"`` or left out: ranges [m].
    flat : bool
        One vector per world (:class:`FlatObservation`), for ``"MlpPolicy"``; otherwise a dictionary, for
        ``"MultiInputPolicy"``.
    seed : int, optional
        Of the first episodes: world i gets ``seed + i``.
    monitor : bool
        Put stable-baselines3's VecMonitor around it, which tells its logger how episodes went.
    **settings
        As for :class:`NavRepVectorEnv`: ``physics``, ``episode``, ``render_mode``, ``humans``, ``sensor``, ...

    Returns
    -------
    stable_baselines3.common.vec_env.VecEnv
        To be given to ``PPO`` and its like.

    Raises
    ------
    UnknownNameError, ConfigError
        If there is no such environment, or a setting has a wrong value.

    Examples
    --------
    >>> from navrep_data.envs import make_sb3_vec
    >>> worlds = make_sb3_vec("NavRepTrain-v0", n_envs=4, lidar="1d", flat=True, humans=2)
    >>> worlds.observation_space.shape, worlds.reset().shape
    ((1085,), (4, 1085))
    """
    if lidar not in LIDARS:
        raise ConfigError(f"lidar is {str(lidar)!r}, expected one of: scan, rings, 1d.")
    vector: Any = NavRepVectorEnv(n_envs, env, **settings)
    wrapper = LIDARS[lidar]
    if wrapper is not None:
        vector = wrapper(vector)
    if flat:
        vector = VectorFlatObservation(vector)
    worlds: VecEnv = NavRepSB3VecEnv(vector)
    if seed is not None:
        worlds.seed(seed)
    return VecMonitor(worlds) if monitor else worlds
