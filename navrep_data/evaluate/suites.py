"""The benchmark's suites: which numbered episodes, in which worlds."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

from navrep_data.errors import ConfigError, UnknownNameError, check_whole, did_you_mean
from navrep_data.io import json_bytes
from navrep_data.registration import spelled
from navrep_data.sim import SimConfig, make_config
from navrep_data.sim.maps import load_map
from navrep_data.sim.scenarios import MAP_GROUPS, get_scenario, scenario_names


@dataclass(frozen=True)
class SuiteScenario:
    """One recipe for worlds of a suite.

    Attributes
    ----------
    name : str
        As in results.
    map : str
        Name of its map, empty for procedural worlds.
    """

    name: str
    map: str = ""


@dataclass(frozen=True)
class Suite:
    """A numbered list of episodes that every policy plays.

    Attributes
    ----------
    name : str
        ``navreptest`` or ``navrep27``.
    text : str
        One line on what it is.
    physics : str
        Default physics.
    scenarios : tuple of SuiteScenario
        Episode k plays scenario ``k % len(scenarios)``.
    rounds : int
        Default number of episodes per scenario.
    max_rounds : int
        Largest number of episodes per scenario.
    first_seed : int
        Episode k is drawn from numpy seed ``first_seed + k``.
    max_steps : int
        More than any episode has.
    config : callable
        ``config(physics)`` returns the simulator's.
    data_hash : callable
        Returns the hash of scenario data and maps, empty where everything is in the config.
    """

    name: str
    text: str
    physics: str
    scenarios: tuple[SuiteScenario, ...]
    rounds: int
    max_rounds: int
    first_seed: int
    max_steps: int
    config: Callable[[str], SimConfig]
    data_hash: Callable[[], str]

    @property
    def maps(self) -> tuple[str, ...]:
        """The maps of its scenarios, in the paper's order; empty for procedural worlds."""
        return tuple(m for m in MAP_GROUPS if any(s.map == m for s in self.scenarios))

    def seed(self, episode: int) -> int:
        """Return the numpy seed of an episode."""
        return self.first_seed + episode

    def scenario(self, episode: int) -> int:
        """Return the index of the scenario that an episode plays."""
        return episode % len(self.scenarios)

    def total(self, episodes: int | None, first_round: int = 0) -> int:
        """Return how many episodes `episodes` per scenario are (None = the suite's own number).

        Parameters
        ----------
        episodes : int or None
            Rounds: each plays every scenario once.
        first_round : int
            The first of them.

        Raises
        ------
        ConfigError
            If the suite has no so many, or they would go beyond its last round.
        """
        rounds = self.rounds if episodes is None else episodes
        each = "" if len(self.scenarios) == 1 else " per scenario"
        first_round = check_whole(f"{self.name}: first_round", first_round, 0, self.max_rounds - 1)
        rounds = check_whole(f"{self.name}: episodes{each}", rounds, 1, self.max_rounds)
        if first_round + rounds > self.max_rounds:
            raise ConfigError(
                f"Rounds {first_round} to {first_round + rounds - 1} were asked for, {self.name} ends with round "
                f"{self.max_rounds - 1}: expected at most {self.max_rounds - first_round} episodes{each} from there."
            )
        return rounds * len(self.scenarios)

    def folder(self, physics: str, first_round: int = 0) -> str:
        """Return the name of the folder that results lie in; rounds that begin elsewhere lie apart."""
        return f"{self.name}-{physics}" + (f"-round{first_round}" if first_round else "")

    def settings(self, physics: str, first_round: int = 0) -> dict[str, Any]:
        """Return what decides the episodes, as plain JSON values."""
        config = self.config(physics).to_dict()
        return {
            "suite": self.name,
            "physics": physics,
            "first_round": first_round,
            "first_seed": self.first_seed,
            "config_sha256": hashlib.sha256(json_bytes(config)).hexdigest(),
            "data_sha256": self.data_hash(),
        }


def _test_config(physics: str) -> SimConfig:
    return make_config("navrep-test", physics=physics)


NAVREPTEST = Suite(
    name="navreptest",
    text="the training environment's test: square crossing, procedural polygons, numpy seeds 1000 + k",
    physics="original",
    scenarios=(SuiteScenario("navrep-test"),),
    rounds=200,
    max_rounds=500,  # crowd_sim.py: the case counter wraps there
    first_seed=1000,
    max_steps=180,
    config=_test_config,
    data_hash=str,
)


def _ian_config(physics: str) -> SimConfig:
    return make_config("ian", physics=physics)


@cache
def _scenario_hash() -> str:
    """Return the hash of all scenarios and of the maps that they lie on."""
    digest = hashlib.sha256()
    for name in scenario_names():
        scenario = get_scenario(name)
        digest.update(f"{name} {scenario.map} {load_map(scenario.map).hash}".encode())
        for array in (scenario.starts, scenario.goals, scenario.permissivity):
            digest.update(array.tobytes())
    return digest.hexdigest()


NAVREP27 = Suite(
    name="navrep27",
    text="the paper's 27 scenarios on three maps, episode r of scenario i = numpy seed 27 r + i",
    physics="original",
    scenarios=tuple(SuiteScenario(name, get_scenario(name).map) for name in scenario_names()),
    rounds=300,
    max_rounds=100_000,
    first_seed=0,
    max_steps=1001,
    config=_ian_config,
    data_hash=_scenario_hash,
)

_SUITES = {suite.name: suite for suite in (NAVREPTEST, NAVREP27)}


def suite_names() -> list[str]:
    """Return the names of all suites."""
    return list(_SUITES)


def get_suite(name: str) -> Suite:
    """Return a suite by name, in whatever spelling: ``navreptest``, ``navrep-test``, ``NavRepTest-v0``.

    Raises
    ------
    UnknownNameError
        If there is no such suite.
    """
    found = spelled(name, _SUITES)
    if found is None:
        raise UnknownNameError(f"Unknown suite {name!r}.{did_you_mean(name, _SUITES)} Known: {', '.join(_SUITES)}.")
    return _SUITES[found]
