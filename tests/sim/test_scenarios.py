"""The 27 scenarios as data."""

from __future__ import annotations

import numpy as np
import pytest
from recorded import reference

from navrep_data.errors import ConfigError, UnknownNameError
from navrep_data.sim import MAP_GROUPS, get_scenario, make_config, scenario_names


def test_scenarios_are_the_originals() -> None:
    wanted = reference("scenarios.json")["scenarios"]
    assert scenario_names() == [entry["name"] for entry in wanted]
    for entry in wanted:
        scenario = get_scenario(entry["name"])
        assert scenario.map == entry["map"]
        assert scenario.humans == entry["n_humans"]
        starts = [[*agent["start_xy"], agent["start_theta"]] for agent in entry["agents"]]
        np.testing.assert_allclose(scenario.starts, starts, rtol=1e-15)  # arctan2 may differ in the last digit
        np.testing.assert_array_equal(scenario.goals, [agent["goal_xy"] for agent in entry["agents"]])
        np.testing.assert_array_equal(scenario.permissivity, [agent["permissivity"] for agent in entry["agents"]])


def test_every_scenario_belongs_to_a_group() -> None:
    assert len(scenario_names()) == 27
    assert {get_scenario(name).map for name in scenario_names()} == set(MAP_GROUPS)


def test_unknown_scenario_names_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'rlasl3'"):
        get_scenario("rlasl33")
    with pytest.raises(UnknownNameError, match="Did you mean 'rlasl3'"):
        make_config("ian", scenarios=("rlasl33",))


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"humans": 5}, "scenarios say who is there"),
        ({"maps": ("asl",)}, "scenarios name their maps"),
        ({"robots": 2}, "scenarios have one robot"),
        ({"obstacles": 3}, "map's obstacles only"),
        ({"physics": "original", "human_policy": "orca"}, "are planned"),
    ],
)
def test_refused_combinations(fields: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        make_config("ian", **fields)
