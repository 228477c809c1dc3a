"""Named environments: one kebab-case registry for the command line, the generators and gymnasium."""

from __future__ import annotations

from typing import Any

from navrep_data.errors import ConfigError, UnknownNameError, check_whole, did_you_mean
from navrep_data.registration import VERSION, camel_case, spelled
from navrep_data.sim.config import SimConfig
from navrep_data.sim.map_environments import MAP_ENVIRONMENTS, original_fields

_ENVIRONMENTS: dict[str, tuple[str, dict[str, Any]]] = {
    "soadrl": (
        "the dataset variant of the training environment: procedural polygons, about 20 ORCA humans on a circle",
        {"crossing": "circle", "humans": 20, "obstacles": 10, "polygon_scale": 1.25},
    ),
    "navrep-train": (
        "the training environment: procedural polygons, about 5 ORCA humans on a circle, adaptive curriculum",
        {"crossing": "circle", "humans": 5, "obstacles": 10, "polygon_scale": 1.25, "curriculum": "adaptive"},
    ),
    "navrep-val": (
        "as navrep-train, with 50 numbered episodes",
        {"crossing": "circle", "humans": 5, "obstacles": 10, "polygon_scale": 1.25},
    ),
    "navrep-test": (
        "the training environment's test: humans cross a square, polygons at true size, 500 numbered episodes",
        {"crossing": "square", "humans": 5, "obstacles": 10, "polygon_scale": 1.0},
    ),
    "cadrl": (
        "humans only: about 10 ORCA humans on a circle, seen as trunks; nothing static, no border",
        {"world": "empty", "crossing": "circle", "humans": 10, "obstacles": 0, "rendering": "trunk"},
    ),
    "empty": (
        "the robot alone with its goal: nothing static, nobody else",
        {"world": "empty", "humans": 0, "obstacles": 0},
    ),
}

_ENVIRONMENTS |= MAP_ENVIRONMENTS

# crowd_sim.py: numpy is seeded with an offset plus the case counter, which wraps at the phase's size
_NUMBERED: dict[str, tuple[int, int]] = {"navrep-val": (0, 50), "navrep-test": (1000, 500)}


def environment_names() -> list[str]:
    """Return the names of all environments, sorted."""
    return sorted(_ENVIRONMENTS)


def describe_environment(name: str) -> str:
    """Return one line on what an environment is."""
    return _ENVIRONMENTS[environment_name(name)][0]


def numpy_seed(env: str, episode: int) -> int:
    """Return the numpy seed of an environment's numbered episode, for :meth:`Simulator.reset_seeded`.

    Parameters
    ----------
    env : str
        ``"navrep-test"`` (500 episodes, seeds from 1000) or ``"navrep-val"`` (50 episodes, seeds from 0).
    episode : int
        Number of the episode; beyond the last it starts again, as in the original.

    Raises
    ------
    UnknownNameError
        If there is no such environment.
    ConfigError
        If the environment has no numbered episodes, or `episode` is no whole number from 0.

    Notes
    -----
    The original places obstacles without asking whether a way to the goal is left. Of its worlds of ``navrep-val`` with
    numpy seeds 0 to 199, that of 167 has none by small steps, neither between the cells that the robot collides with
    nor between the obstacles that the lidar and ORCA see, which are larger by a quarter; those of 15 and 198 have none
    between the obstacles that are seen, but one between the cells.
    """
    env = environment_name(env)
    if env not in _NUMBERED:
        raise ConfigError(f"Environment {env!r} has no numbered episodes; those that do: {', '.join(_NUMBERED)}.")
    episode = check_whole("episode", episode, 0)
    first, count = _NUMBERED[env]
    return first + episode % count


def gymnasium_id(name: str) -> str:
    """Return the gymnasium id of an environment: ``navrep-train`` -> ``NavRepTrain-v0``.

    Raises
    ------
    UnknownNameError
        If there is no such environment.
    """
    return f"{camel_case(environment_name(name))}-v{VERSION}"


def environment_name(name: str) -> str:
    """Return an environment's name as it is stored, in whatever spelling it is given.

    Parameters
    ----------
    name : str
        ``navrep-test``, ``navreptest``, ``NavRepTest-v0`` or ``navrep_data:NavRepTest-v0``.

    Raises
    ------
    UnknownNameError
        If there is no such environment.
    """
    found = spelled(name, _ENVIRONMENTS)
    if found is None:
        raise UnknownNameError(
            f"Unknown environment {name!r}.{did_you_mean(name, _ENVIRONMENTS)} Known: {', '.join(environment_names())}."
        )
    return found


def make_config(env: str = "soadrl", **changes: Any) -> SimConfig:
    """Return the config of a named environment.

    Parameters
    ----------
    env : str
        Name in the registry, see :func:`environment_names`.
    **changes
        Fields of :class:`SimConfig` that differ; None means unchanged.

    Raises
    ------
    UnknownNameError
        If there is no such environment.
    ConfigError
        If a field is unknown or has a wrong value.
    """
    env = environment_name(env)
    fields = _ENVIRONMENTS[env][1]
    if changes.get("physics") == "original":
        fields = fields | original_fields(env)
    wanted = {name: value for name, value in changes.items() if value is not None}
    return SimConfig(env=env, **fields).replace(**wanted)
