"""Named environments: one kebab-case registry for the command line, the generators and gymnasium."""

from __future__ import annotations

from typing import Any

from navrep_data.errors import UnknownNameError, did_you_mean
from navrep_data.sim.config import SimConfig

_ENVIRONMENTS: dict[str, tuple[str, dict[str, Any]]] = {
    "soadrl": (
        "the dataset variant of the training environment: procedural polygons, about 20 ORCA humans on a circle",
        {"crossing": "circle", "humans": 20, "obstacles": 10, "polygon_scale": 1.25},
    ),
}


def environment_names() -> list[str]:
    """Return the names of all environments, sorted."""
    return sorted(_ENVIRONMENTS)


def describe_environment(name: str) -> str:
    """Return one line on what an environment is."""
    return _lookup(name)[0]


def _lookup(name: str) -> tuple[str, dict[str, Any]]:
    try:
        return _ENVIRONMENTS[name]
    except KeyError:
        raise UnknownNameError(
            f"Unknown environment {name!r}.{did_you_mean(name, _ENVIRONMENTS)} Known: {', '.join(environment_names())}."
        ) from None


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
    fields = _lookup(env)[1]
    wanted = {name: value for name, value in changes.items() if value is not None}
    return SimConfig(env=env, **fields).replace(**wanted)
