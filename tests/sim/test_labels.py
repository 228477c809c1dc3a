"""What each ray hit, against an oracle that casts each ray at each body; and what the robot touched."""

import sys
from pathlib import Path

import numpy as np
import pytest

from navrep_data.schema import CONTACT_HUMAN, CONTACT_STATIC, LABEL_HUMAN, LABEL_ROBOT, LABEL_STATIC
from navrep_data.sim import (
    RolloutSettings,
    ScriptedMapRollout,
    ScriptedPolicy,
    ScriptedRollout,
    load_map,
    make_config,
    map_names,
)
from navrep_data.sim import _layout as lay
from navrep_data.sim._ian_scan import other_bodies
from navrep_data.sim._step import fill_circles

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))
from oracles_lidar import brute_force
from oracles_maps import walk_ranges
from test_sensors import ellipse_oracle

LENGTHS = (1, 7, 30)
"""The last row of each is compared: the world stands as it was seen there."""
LABELS = {"rings": False, "labels": True}


def nearest_body(agents, bodies, config, pose, angles):
    """Return ranges of rays to people and robots, and whose body is nearest (its owner, -1: nobody's)."""
    if config.rendering == "ellipse":
        headings = np.arctan2(bodies[:, 6], bodies[:, 5])
        shapes = np.column_stack([bodies[:, :2], 0.5 * bodies[:, 2], bodies[:, 2], headings])
        ranges, nearest = ellipse_oracle(shapes, pose, angles)
    else:
        ranges, nearest = brute_force(np.empty((0, 4)), bodies[:, :3], pose, angles, np.inf)
    return ranges, np.where(nearest >= 0, bodies[nearest, 3], -1)


def expected_labels(people, owner, walls, n_humans, range_max):
    nearest = np.where(owner < n_humans, LABEL_HUMAN + owner, LABEL_ROBOT)
    label = np.where(walls < range_max, LABEL_STATIC, 0)
    return np.where((owner >= 0) & (people < np.minimum(walls, range_max)), nearest, label)


def check(found, people, owner, walls, n_humans, range_max):
    """Compare but where two bodies are equally far, or a ray grazes one: there is no single right answer there."""
    expected = expected_labels(people, owner, walls, n_humans, range_max)
    wrong = found != expected
    assert wrong.sum() <= 3, (np.flatnonzero(wrong), found[wrong], expected[wrong])
    return set(np.unique(expected).tolist())


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"rendering": "trunk"},
        {"rendering": "ellipse"},
        {"robots": 3, "rendering": "trunk", "humans": 5},
        {"scan_noise": 0.05, "scan_dropout": 0.2},
        {"physics": "original"},
    ],
    ids=lambda fields: "-".join(map(str, fields.values())) or "legs",
)
def test_labels_in_worlds_of_polygons(fields):
    config = make_config("soadrl", **fields)
    seen = set()
    for length in LENGTHS:
        rollout = ScriptedRollout(config, RolloutSettings(length=length, **LABELS), ScriptedPolicy("orca"), 4)
        columns, _ = rollout.run([length])[0]
        a = rollout.arrays
        agents, n_humans = a.agents[0], int(a.scalars[0, lay.S_HUMANS])
        bodies = np.zeros_like(a.circles)
        bodies = bodies[: fill_circles(0, agents, config.robots, n_humans, a.flags, bodies)]
        pose = agents[0, [lay.A_X, lay.A_Y, lay.A_HEADING]]
        sensor = config.sensor
        angles = sensor.angle_min + np.arange(sensor.n_rays) * sensor.angle_increment
        edges = a.edges[0][: a.polygon_start[0][int(a.scalars[0, lay.S_POLYGONS])]]
        walls, _ = brute_force(edges, np.empty((0, 3)), pose, angles, np.inf)
        people, owner = nearest_body(agents, bodies, config, pose, angles)
        if config.physics == "original":  # its renderer loses some people: who is labelled is there, and nearest
            label = columns["scan_label"][-1]
            named = label >= LABEL_HUMAN
            assert (label[named] == LABEL_HUMAN + owner[named]).sum() >= named.sum() - 3
            continue
        seen |= check(columns["scan_label"][-1], people, owner, walls, n_humans, sensor.range_max)
    assert config.physics == "original" or {LABEL_STATIC, LABEL_HUMAN} <= seen
    assert config.robots == 1 or LABEL_ROBOT in seen


@pytest.mark.parametrize("rendering", ["legs", "trunk", "ellipse"])
def test_labels_on_maps(rendering):
    if not map_names():
        pytest.skip("needs the paper's maps")
    config = make_config("map", maps=("asl",), rendering=rendering, robots=2, humans=8)
    grid = load_map("asl").local
    seen = set()
    for length in LENGTHS:
        settings = RolloutSettings(length=length, scan_dtype="float32", **LABELS)
        rollout = ScriptedMapRollout(config, settings, ScriptedPolicy("orca"), 2)
        columns, _ = rollout.run([length])[0]
        a = rollout._sequences.maps.arrays
        w, n_humans = a.worlds, int(a.worlds.scalars[0, lay.S_HUMANS])
        bodies = np.zeros_like(a.circles)
        count = other_bodies(0, w.agents[0], w.walkers[0], config.robots, n_humans, a.rules, bodies)
        pose = columns["robot_pose"][-1].astype(float)
        pose[:] = w.agents[0, 0, [lay.A_X, lay.A_Y, lay.A_HEADING]]
        sensor = config.sensor
        angles = sensor.angle_min + np.arange(sensor.n_rays) * sensor.angle_increment
        x, y = pose[:2] / grid.resolution
        walls = walk_ranges(grid.occupied, x, y, angles + pose[2]) * grid.resolution
        people, owner = nearest_body(w.agents[0], bodies[:count], config, pose, angles)
        seen |= check(columns["scan_label"][-1], people, owner, walls, n_humans, sensor.range_max)
    assert LABEL_STATIC in seen
    assert max(seen) >= LABEL_HUMAN


def test_labels_change_nothing_else():
    both = [
        ScriptedRollout(make_config("soadrl"), RolloutSettings(length=40, labels=on), ScriptedPolicy("orca"), 0).run(
            [3]
        )[0][0]
        for on in (False, True)
    ]
    assert set(both[1]) - set(both[0]) == {"scan_label"}
    for name, column in both[0].items():
        np.testing.assert_array_equal(column, both[1][name])


def test_contacts_are_what_does_damage():
    config = make_config("soadrl", on_collision="damage", humans=10)
    settings = RolloutSettings(length=400, rings=False, contact=True)
    rollout = ScriptedRollout(config, settings, ScriptedPolicy("random-momentum"), 1)
    seen = set()
    for sequence in range(6):
        columns, _ = rollout.run([sequence])[0]
        contact = columns["contact"]
        seen |= set(np.unique(contact).tolist())
        assert not contact[columns["is_last"]].any(), "no action is taken from an episode's last row"
        # whoever is touched is put back, and the robot with it
        before, after = columns["robot_pose"][:-1, :2], columns["robot_pose"][1:, :2]
        going = ~columns["is_last"][:-1]
        touching = going & (contact[:-1] > 0)
        np.testing.assert_array_equal(before[touching], after[touching])
        assert (before[going & ~touching] != after[going & ~touching]).any(axis=1).mean() > 0.9
        gaps = np.hypot(columns["humans"][..., 0], columns["humans"][..., 1]) - columns["humans"][..., 4]
        near = np.nanmin(gaps, axis=1)
        assert (near[contact == CONTACT_HUMAN] < columns["robot_radius"][contact == CONTACT_HUMAN] + 0.5).all()
    assert {CONTACT_HUMAN, CONTACT_STATIC} <= seen
