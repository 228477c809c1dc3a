"""Combinations of settings that cannot work: one table, each refused by the names of its fields."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from navrep_data.errors import ConfigError

if TYPE_CHECKING:
    from navrep_data.sim.config import SimConfig

_Rule = tuple[tuple[str, ...], Callable[["SimConfig"], bool], str]

# the 27 scenarios would fill a screen
_MOST_NAMES = 3

REFUSALS: tuple[_Rule, ...] = (
    (
        ("world", "obstacles"),
        lambda c: c.world == "empty" and c.obstacles > 0,
        "an empty world has no obstacles; set obstacles=0, or world='polygons'",
    ),
    (
        ("world", "maps"),
        lambda c: c.world != "map" and bool(c.maps),
        "maps are used in map worlds only; set world='map', or leave maps empty",
    ),
    (
        ("world", "scenarios"),
        lambda c: c.world != "map" and bool(c.scenarios),
        "scenarios lie on maps; set world='map', or leave scenarios empty",
    ),
    (
        ("world", "maps", "scenarios"),
        lambda c: c.world == "map" and not c.maps and not c.scenarios,
        "a map world needs a map; name one in maps, or a scenario in scenarios",
    ),
    (
        ("maps", "scenarios"),
        lambda c: bool(c.maps) and bool(c.scenarios),
        "scenarios name their maps themselves; leave one of the two empty",
    ),
    (
        ("scenarios", "humans"),
        lambda c: bool(c.scenarios) and c.humans > 0,
        "scenarios say who is there; set humans=0, or leave scenarios empty and name maps",
    ),
    (
        ("scenarios", "robots"),
        lambda c: bool(c.scenarios) and c.robots > 1,
        "scenarios have one robot; set robots=1, or leave scenarios empty and name maps",
    ),
    (
        ("world", "obstacles"),
        lambda c: c.world == "map" and c.obstacles > 0,
        "a map world has its map's obstacles only; set obstacles=0, or world='polygons'",
    ),
    (
        ("physics", "world", "human_policy"),
        lambda c: c.physics == "original" and c.world == "map" and c.human_policy != "planned",
        "the released software's humans on maps are planned; set physics='consistent', or human_policy='planned'",
    ),
    (
        ("physics", "world", "scenarios", "humans"),
        lambda c: c.physics == "original" and c.world == "map" and not c.scenarios and c.humans > 0,
        "the released software has humans on maps only in scenarios; set physics='consistent', or humans=0",
    ),
    (
        ("physics", "world", "robots", "on_collision"),
        lambda c: c.physics == "original" and c.world == "map" and c.robots > 1 and c.on_collision == "damage",
        "every collision of one robot ends the episode of all in the released software; set physics='consistent', or "
        "on_collision='end'",
    ),
    (
        ("world", "human_policy"),
        lambda c: c.world != "map" and c.human_policy == "planned",
        "planned humans walk on a map; set world='map', or human_policy='orca'",
    ),
    (
        ("world", "curriculum"),
        lambda c: c.world == "map" and c.curriculum == "adaptive",
        "a map world has no number of obstacles to adapt; set curriculum='constant'",
    ),
    (
        ("physics", "world", "robots"),
        lambda c: c.physics == "original" and c.world != "map" and c.robots > 1,
        "the released software has one robot there; set physics='consistent', or robots=1",
    ),
    (
        ("physics", "world", "on_collision"),
        lambda c: c.physics == "original" and c.world != "map" and c.on_collision == "damage",
        "every collision ends the episode in the released software there; set physics='consistent', or "
        "on_collision='end'",
    ),
    (
        ("physics", "rendering"),
        lambda c: c.physics == "original" and c.rendering == "ellipse",
        "the released software draws legs or trunks; set physics='consistent', or rendering='legs'",
    ),
)
"""(fields, condition, reason with advice) of every combination that is refused."""


def check_combinations(config: SimConfig) -> None:
    """Refuse the first combination of fields that cannot work.

    Raises
    ------
    ConfigError
        Naming the fields with their values, the reason, and what to change.
    """
    for names, holds, reason in REFUSALS:
        if holds(config):
            seen = ", ".join(f"{name}={_shown(getattr(config, name))}" for name in names)
            raise ConfigError(f"{seen} cannot be combined: {reason}.")


def _shown(value: object) -> str:
    if not isinstance(value, tuple):
        return repr(value)
    if len(value) <= _MOST_NAMES:
        return repr(list(value))
    return f"[{', '.join(map(repr, value[:_MOST_NAMES]))}, ... {len(value)} in all]"
