"""The configuration: checks, refusals by name, and what is stored."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest

from navrep_data.errors import ConfigError
from navrep_data.schema import SensorContract
from navrep_data.sim import SimConfig, gymnasium_id, make_config, scale_actions
from navrep_data.sim.refusals import REFUSALS
from navrep_data.sim.registry import camel_case, environment_names

ROOT = Path(__file__).resolve().parents[2]

# what version 1 of the format stored for this environment before there were more fields, to the byte
SOADRL = (
    '{"env": "soadrl", "physics": "consistent", "crossing": "circle", "humans": 20, "obstacles": 10, '
    '"rendering": "legs", "polygon_scale": 1.25, "time_limit": 35.0, "sensor": {"n_rays": 1080, "angle_min": 0.0, '
    '"angle_increment": 0.0058159757478035215, "range_max": 25.0, "dt": 0.2}}'
)
OTHERWISE = {
    "world": "empty", "obstacles": 0, "human_policy": "static", "robots": 4, "drive": "differential",
    "inertia": "limited", "max_velocity": (0.5, 0.4, 2.0), "robot_acceleration": (1.0, 1.0, 2.0),
    "robot_jerk": (3.0, 3.0, 9.0), "on_collision": "damage", "max_damage": 3.0, "goal_radius": 0.5,
    "curriculum": "adaptive", "scan_noise": 0.02, "scan_dropout": 0.1, "rendering": "ellipse",
}  # fmt: skip

# one example for every rule of the table, in its order
ON_MAP = {"world": "map", "maps": ("asl",), "humans": 0, "obstacles": 0, "human_policy": "planned"}
EXAMPLES = [
    {"world": "empty"},
    {"maps": ("asl",)},
    {"scenarios": ("rlasl1",)},
    {"world": "map"},
    {**ON_MAP, "scenarios": ("rlasl1",)},
    {**ON_MAP, "maps": (), "scenarios": ("rlasl1",), "humans": 2},
    {**ON_MAP, "maps": (), "scenarios": ("rlasl1",), "robots": 2},
    {**ON_MAP, "obstacles": 10},
    {**ON_MAP, "physics": "original", "human_policy": "orca"},
    {**ON_MAP, "physics": "original", "humans": 2},
    {**ON_MAP, "physics": "original", "robots": 2, "on_collision": "damage"},
    {"human_policy": "planned"},
    {**ON_MAP, "curriculum": "adaptive"},
    {"physics": "original", "robots": 2},
    {"physics": "original", "on_collision": "damage"},
    {"physics": "original", "rendering": "ellipse"},
]


def test_stored_configs_of_older_settings_have_not_changed():
    assert json.dumps(make_config("soadrl").to_dict()) == SOADRL
    assert json.dumps(make_config("soadrl", curriculum="constant", robots=1).to_dict()) == SOADRL
    assert SimConfig.from_dict(json.loads(SOADRL)) == make_config("soadrl")


def test_configs_survive_json():
    config = make_config("soadrl", **OTHERWISE)
    stored = json.loads(json.dumps(config.to_dict()))
    assert SimConfig.from_dict(stored) == config
    assert {*OTHERWISE} - {*stored} == set()
    assert stored["max_velocity"] == [0.5, 0.4, 2.0]
    assert SimConfig.from_dict(json.loads(json.dumps(config.full_dict()))) == config
    on_map = SimConfig(**{**ON_MAP, "maps": ["asl", "/own/map"]})
    assert SimConfig.from_dict(json.loads(json.dumps(on_map.to_dict()))).maps == ("asl", "/own/map")


@pytest.mark.parametrize("field", [f.name for f in dataclasses.fields(SimConfig) if f.name not in ("env", "sensor")])
def test_every_field_is_checked_by_name(field):
    with pytest.raises(ConfigError, match=f"^{field} is "):
        SimConfig(**{field: object()})


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("world", "maps", "Did you mean 'map'"),
        ("human_policy", "orka", "Did you mean 'orca'"),
        ("robots", 0, "from 1 to 10"),
        ("robots", 11, "from 1 to 10"),
        ("robots", True, "whole number"),
        ("max_velocity", (1.0, 1.0), "three numbers above 0"),
        ("robot_jerk", (1.0, 0.0, 1.0), "three numbers above 0"),
        ("robot_acceleration", (1.0, float("nan"), 1.0), "three numbers above 0"),
        ("max_damage", 0.0, "from 0.001"),
        ("goal_radius", 0.0, "from 0.01"),
        ("scan_dropout", 1.1, "from 0 to 1"),
        ("scan_noise", -0.1, "from 0 to 10"),
        ("maps", "asl", "a list of names"),
        ("scenarios", ("",), "a list of names"),
    ],
)
def test_bad_values_say_what_was_expected(field, value, words):
    with pytest.raises(ConfigError, match=f"^{field} is .*{re.escape(words)}"):
        SimConfig(**{field: value})


@pytest.mark.parametrize(("rule", "example"), list(zip(REFUSALS, EXAMPLES, strict=True)))
def test_refused_combinations_name_their_fields(rule, example):
    names, _, reason = rule
    with pytest.raises(ConfigError) as caught:
        SimConfig(**example)
    text = str(caught.value)
    for name in names:
        assert f"{name}=" in text
    assert reason in text
    assert "\n" not in text
    hits = [r[0] for r in REFUSALS if r[1](_unchecked(**example))]
    assert hits[0] == names


def test_refusals_do_not_list_all_scenarios():
    with pytest.raises(
        ConfigError, match=r"^scenarios=\['irosasl1', 'irosasl2', 'irosasl3', ... 27 in all\], robots=2 "
    ):
        make_config("ian", robots=2)


def _unchecked(**fields):
    config = object.__new__(SimConfig)
    for f in dataclasses.fields(SimConfig):
        object.__setattr__(config, f.name, fields.get(f.name, None if f.name == "sensor" else f.default))
    return config


def test_all_else_can_be_combined():
    """The refusals are a short list: every pair of choices that none of them names is accepted."""
    choices = {
        "physics": ("consistent", "original"), "crossing": ("circle", "square"),
        "rendering": ("legs", "trunk", "ellipse"), "world": ("polygons", "empty"),
        "human_policy": ("orca", "static", "constant-velocity"), "robots": (1, 3),
        "drive": ("holonomic", "differential"), "inertia": ("none", "limited"), "on_collision": ("end", "damage"),
        "curriculum": ("constant", "adaptive"), "scan_noise": (0.0, 0.1), "goal_radius": (None, 0.5),
    }  # fmt: skip
    named = {frozenset(names) for names, _, _ in REFUSALS}
    for a in choices:
        for b in choices:
            for x in choices[a]:
                for y in choices[b] if a != b else ():
                    if any({a, b} <= group or group <= {a, b, "obstacles"} for group in named):
                        continue
                    SimConfig(**{"obstacles": 0, a: x, b: y})


def test_gymnasium_ids():
    expected = {
        "navrep-train": "NavRepTrain-v0", "navrep-val": "NavRepVal-v0", "navrep-test": "NavRepTest-v0",
        "soadrl": "SOADRL-v0", "cadrl": "CADRL-v0", "empty": "Empty-v0",
    }  # fmt: skip
    assert {name: gymnasium_id(name) for name in expected} == expected
    assert len({gymnasium_id(name) for name in environment_names()}) == len(environment_names())
    spelled = {"ian": "IAN", "mark-train-1": "MarkTrain1", "crowdmove-1": "CrowdMove1", "map": "Map"}
    assert {name: camel_case(name) for name in spelled} == spelled


def test_full_actions_mean_the_largest_velocity():
    config = make_config("soadrl", max_velocity=(0.55, 0.5, 2.0))
    np.testing.assert_allclose(scale_actions(config, [[1.0, -0.5, 0.5]]), [[0.55, -0.25, 1.0]])
    np.testing.assert_allclose(scale_actions(config, [3.0, -4.0]), [0.55, -0.5, 0.0])
    on_map = SimConfig(**ON_MAP, max_velocity=(0.55, 0.55, 2.0))
    np.testing.assert_allclose(
        scale_actions(on_map, [[1.0, 1.0, 1.0], [0.3, 0.4, -1.0]]),
        [[0.55 / np.sqrt(2), 0.55 / np.sqrt(2), 2.0], [0.165, 0.22, -2.0]],
    )
    with pytest.raises(ConfigError, match=r"shape \(1,\)"):
        scale_actions(config, [1.0])
    with pytest.raises(ConfigError, match="NaN"):
        scale_actions(config, [np.nan, 0.0, 0.0])


def test_the_table_of_fields_is_complete():
    """docs/environments.md lists every field with its default, in order."""
    text = (ROOT / "docs" / "environments.md").read_text()
    rows = re.findall(r"^\| `(\w+)` \| (.*?) \| `(.*?)` \|", text, re.MULTILINE)
    fields = [f for f in dataclasses.fields(SimConfig) if f.name not in ("env", "sensor")]
    assert [row[0] for row in rows] == [f.name for f in fields] + [
        f"{f.name}" for f in dataclasses.fields(SensorContract)
    ]
    sensor = SensorContract()
    for name, _, default in rows:
        owner = SimConfig() if name in {f.name for f in fields} else sensor
        value = getattr(owner, name)
        shown = value if isinstance(value, str) else repr(list(value) if isinstance(value, tuple) else value)
        assert default == shown or np.isclose(float(default), value), name
    for name in environment_names():
        assert f"`{name}`" in text
        assert f"`{gymnasium_id(name)}`" in text
