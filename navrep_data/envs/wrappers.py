"""Observations in the forms that networks are fed: rings, 1d, flat; for one world and for many."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from navrep_data.errors import ConfigError
from navrep_data.observations import fill_blind, rings_to_float, scan_to_1d, scan_to_rings
from navrep_data.schema import RINGS_SHAPE, SensorContract

F32 = NDArray[np.float32]
Transform = Callable[[Any], Any]
"""Turns observations with any number of leading axes."""


def _sensor(env: Any) -> SensorContract:
    config = getattr(env.unwrapped, "config", None)
    if config is None:
        raise ConfigError(f"{env.unwrapped} is no environment of navrep-data: it has no sensor contract.")
    sensor: SensorContract = config.sensor
    return sensor


def _dictionary(space: gymnasium.Space[Any]) -> gymnasium.spaces.Dict:
    if not isinstance(space, gymnasium.spaces.Dict) or "robot_state" not in space.spaces:
        raise ConfigError(
            f"The observation is {space}, expected Dict(scan, robot_state): put rings and 1d around the environment "
            "itself, and flat outermost."
        )
    return space


def _scan_space(env: Any, space: gymnasium.Space[Any]) -> tuple[gymnasium.spaces.Dict, tuple[int, ...]]:
    before = _dictionary(space)
    if "scan" not in before.spaces:
        raise ConfigError(f"The observation has no scan but {', '.join(before.spaces)}: use one of rings and 1d.")
    shape = before["scan"].shape
    assert shape is not None
    return before, shape


@dataclass(frozen=True)
class _ToRings:
    """Makes rings of scans; a class, so that wrapped environments can be pickled."""

    zero_first_bin: bool

    def __call__(self, observation: dict[str, Any]) -> dict[str, Any]:
        rings = rings_to_float(scan_to_rings(observation["scan"]), zero_first_bin=self.zero_first_bin)
        return {"rings": rings, "robot_state": observation["robot_state"]}


@dataclass(frozen=True)
class _To1d:
    """Divides ranges by the largest."""

    range_max: float

    def __call__(self, observation: dict[str, Any]) -> dict[str, Any]:
        scan = scan_to_1d(fill_blind(observation["scan"]), self.range_max)
        return {"1d": scan, "robot_state": observation["robot_state"]}


@dataclass(frozen=True)
class _ToFlat:
    """Puts an observation's parts side by side; `axes`: how many of each part are its own."""

    axes: tuple[tuple[str, int], ...]

    def __call__(self, observation: dict[str, Any]) -> F32:
        parts = []
        for name, own in self.axes:
            values = np.asarray(observation[name], np.float32)
            parts.append(values.reshape(*values.shape[: values.ndim - own], -1))
        return np.concatenate(parts, axis=-1)


def _rings(env: Any, space: gymnasium.Space[Any], zero_first_bin: bool) -> tuple[gymnasium.Space[Any], Transform]:
    before, shape = _scan_space(env, space)
    if not _sensor(env).covers_full_turn():
        raise ConfigError("rings need a scan of a full turn: the sensor's n_rays x angle_increment is not 2 pi.")
    rings_space = gymnasium.spaces.Box(0.0, 1.0, (*shape[:-1], *RINGS_SHAPE), np.float32)
    return gymnasium.spaces.Dict(rings=rings_space, robot_state=before["robot_state"]), _ToRings(zero_first_bin)


def _scan1d(env: Any, space: gymnasium.Space[Any]) -> tuple[gymnasium.Space[Any], Transform]:
    before, shape = _scan_space(env, space)
    scan_space = gymnasium.spaces.Box(0.0, 1.0, shape, np.float32)
    new = gymnasium.spaces.Dict({"1d": scan_space, "robot_state": before["robot_state"]})
    return new, _To1d(_sensor(env).range_max)


def _flat(env: Any, space: gymnasium.Space[Any]) -> tuple[gymnasium.Space[Any], Transform]:
    before = _dictionary(space)
    names = [*(name for name in before.spaces if name != "robot_state"), "robot_state"]
    boxes = [before[name] for name in names]
    low = np.concatenate([box.low.ravel() for box in boxes if isinstance(box, gymnasium.spaces.Box)])
    high = np.concatenate([box.high.ravel() for box in boxes if isinstance(box, gymnasium.spaces.Box)])
    axes = tuple((name, len(before[name].shape or ())) for name in names)
    return gymnasium.spaces.Box(low, high, dtype=np.float32), _ToFlat(axes)


class _Single(gymnasium.ObservationWrapper[Any, Any, Any], gymnasium.utils.RecordConstructorArgs):
    _transform: Transform

    def observation(self, observation: Any) -> Any:
        """Return the observation in its new form."""
        return self._transform(observation)


class _Vector(gymnasium.vector.VectorWrapper[Any, Any, Any, Any, Any]):
    _transform: Transform

    def _set_space(self, single: gymnasium.Space[Any]) -> None:
        self._single_observation_space = single
        self._observation_space = batch_space(single, self.num_envs)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset, and return the observations in their new form."""
        observations, infos = self.env.reset(seed=seed, options=options)
        return self._transform(observations), infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step, and return the observations, last ones of episodes included, in their new form."""
        observations, rewards, terminations, truncations, infos = self.env.step(actions)
        if "final_obs" in infos:
            final = infos["final_obs"]
            for i in np.flatnonzero(infos["_final_obs"]):
                final[i] = self._transform(final[i])
        return self._transform(observations), rewards, terminations, truncations, infos


class RingsObservation(_Single):
    """Dict(rings (64, 64), robot_state (5,)): polar occupancy 0 free, 0.5 unknown, 1 occupied, float32.

    Parameters
    ----------
    env : gymnasium.Env
        With observations Dict(scan, robot_state).
    zero_first_bin : bool
        As for :func:`navrep_data.observations.rings_to_float`.

    Raises
    ------
    ConfigError
        If the observation is another one, or the scan is less than a full turn.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], zero_first_bin: bool = False) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(self, zero_first_bin=zero_first_bin)
        super().__init__(env)
        self.observation_space, self._transform = _rings(env, env.observation_space, zero_first_bin)


class Scan1dObservation(_Single):
    """Dict(1d (n_rays,), robot_state (5,)): ranges divided by the sensor's range_max, float32.

    Parameters
    ----------
    env : gymnasium.Env
        With observations Dict(scan, robot_state).

    Raises
    ------
    ConfigError
        If the observation is another one.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(self)
        super().__init__(env)
        self.observation_space, self._transform = _scan1d(env, env.observation_space)


class FlatObservation(_Single):
    """One vector: the scan [m] (or rings, or 1d, where a wrapper inside made them) and then the robot state, float32.

    Parameters
    ----------
    env : gymnasium.Env
        With observations Dict(scan or rings or 1d, robot_state).

    Raises
    ------
    ConfigError
        If the observation is another one.

    Notes
    -----
    (1085,) from scans and (4101,) from rings, as NavRep's end-to-end policies take them.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(self)
        super().__init__(env)
        self.observation_space, self._transform = _flat(env, env.observation_space)


class VectorRingsObservation(_Vector):
    """:class:`RingsObservation` for a vector environment; the whole batch at once.

    Parameters
    ----------
    env : gymnasium.vector.VectorEnv
        With single observations Dict(scan, robot_state).
    zero_first_bin : bool
        As for :func:`navrep_data.observations.rings_to_float`.
    """

    def __init__(self, env: gymnasium.vector.VectorEnv[Any, Any, Any], zero_first_bin: bool = False) -> None:
        super().__init__(env)
        space, self._transform = _rings(env, env.single_observation_space, zero_first_bin)
        self._set_space(space)


class VectorScan1dObservation(_Vector):
    """:class:`Scan1dObservation` for a vector environment; the whole batch at once.

    Parameters
    ----------
    env : gymnasium.vector.VectorEnv
        With single observations Dict(scan, robot_state).
    """

    def __init__(self, env: gymnasium.vector.VectorEnv[Any, Any, Any]) -> None:
        super().__init__(env)
        space, self._transform = _scan1d(env, env.single_observation_space)
        self._set_space(space)


class VectorFlatObservation(_Vector):
    """:class:`FlatObservation` for a vector environment; the whole batch at once.

    Parameters
    ----------
    env : gymnasium.vector.VectorEnv
        With single observations Dict(scan or rings or 1d, robot_state).
    """

    def __init__(self, env: gymnasium.vector.VectorEnv[Any, Any, Any]) -> None:
        super().__init__(env)
        space, self._transform = _flat(env, env.single_observation_space)
        self._set_space(space)
