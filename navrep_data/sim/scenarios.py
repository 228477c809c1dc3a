"""NavRep's 27 test scenarios: who stands where on which map, and where they want to go.

The first episodes of the suite ``navrep27`` and the environment ``ian`` play them in this order.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from navrep_data.errors import UnknownNameError, did_you_mean

__all__ = ["MAP_GROUPS", "Scenario", "get_scenario", "scenario_names"]

MAP_GROUPS = {"asl": "simple", "unity_scene_map": "complex", "asl_office_j": "realistic"}
"""What the paper calls the three maps of the scenarios."""


@dataclass(frozen=True)
class Scenario:
    """One test scenario.

    Attributes
    ----------
    name : str
        The original's name.
    map : str
        Name of its map.
    starts : ndarray of shape (1 + n, 3), float64
        x, y [m], heading [rad] of the robot (row 0) and the humans, map frame. Headings point to the goals; the robot's
        is drawn anew in each episode.
    goals : ndarray of shape (1 + n, 2), float64
        x, y [m]. A human whose start is within 0.5 m of its goal only loiters there.
    permissivity : ndarray of shape (1 + n,), float64
        Chance to pass through another human that comes near (the smaller one of a pair counts).

    Notes
    -----
    From the pickles of asl-pepper-2d-sim 0.0.5 (``scenario_list.py`` of NavRep names them). All agents have a radius of
    0.3 m and start at rest.
    """

    name: str
    map: str
    starts: NDArray[np.float64]
    goals: NDArray[np.float64]
    permissivity: NDArray[np.float64]

    @property
    def humans(self) -> int:
        """Number of humans."""
        return len(self.starts) - 1


@cache
def _scenarios() -> dict[str, Scenario]:
    text = files("navrep_data.sim").joinpath("scenarios.json").read_text(encoding="utf-8")
    result = {}
    for entry in json.loads(text)["scenarios"]:
        rows = np.array(entry["agents"], np.float64)
        way = rows[:, 2:4] - rows[:, :2]
        arrays = (
            np.column_stack([rows[:, :2], np.arctan2(way[:, 1], way[:, 0])]),
            rows[:, 2:4].copy(),
            rows[:, 4].copy(),
        )
        for array in arrays:
            array.setflags(write=False)
        result[entry["name"]] = Scenario(entry["name"], entry["map"], *arrays)
    return result


def scenario_names() -> list[str]:
    """Return the names of the 27 scenarios in the original's order."""
    return list(_scenarios())


def get_scenario(name: str) -> Scenario:
    """Return a scenario by name.

    Raises
    ------
    UnknownNameError
        If there is none of that name.
    """
    known = _scenarios()
    if name not in known:
        raise UnknownNameError(f"Unknown scenario {name!r}.{did_you_mean(name, known)} Known: {', '.join(known)}.")
    return known[name]
