"""What the lidar sees: ellipses, other sensors, noise and dropout."""

import dataclasses
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from numba import config as numba_config

from navrep_data.errors import ConfigError
from navrep_data.observations import Lidar, ScanAdapter
from navrep_data.schema import SensorContract
from navrep_data.sim import RolloutSettings, ScriptedPolicy, ScriptedRollout, Simulator, make_config
from navrep_data.sim import _layout as lay
from navrep_data.sim._ellipse import ELLIPSE_COLUMNS, body_ellipse, scan_ellipses
from navrep_data.sim.lidar import polygon_edges, ray_directions

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from oracles_lidar import INSIDE_RANGE, brute_force

PURE_PYTHON = bool(numba_config.DISABLE_JIT)
DEGREE = math.pi / 180
SENSORS = {
    "180 degrees": SensorContract(n_rays=181, angle_min=-90 * DEGREE, angle_increment=DEGREE),
    "240 degrees": SensorContract(n_rays=683, angle_min=-120 * DEGREE, angle_increment=0.00614, range_max=5.6),
    "64 rays": SensorContract(n_rays=64, angle_increment=2 * math.pi / 64),
    "one ray back": SensorContract(n_rays=1, angle_min=math.pi, angle_increment=1.0),
}  # fmt: skip


def angles_of(sensor):
    return sensor.angle_min + np.arange(sensor.n_rays) * sensor.angle_increment


# --- ellipses -------------------------------------------------------------------------------------------------------


def ellipse_oracle(ellipses, pose, angles):
    """Return the range of every ray to the nearest ellipse (x, y, along, across, heading), by the quadratic formula."""
    x, y, theta = pose
    ranges = np.full(len(angles), np.inf)
    nearest = np.full(len(angles), -1)
    for k, (ex, ey, along, across, heading) in enumerate(ellipses):
        to_body = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
        scale = np.array([1.0 / along, 1.0 / across])
        origin = scale * (to_body @ [x - ex, y - ey])
        rays = scale[:, None] * (to_body @ np.stack([np.cos(angles + theta), np.sin(angles + theta)]))
        a = (rays**2).sum(axis=0)
        b = 2.0 * origin @ rays
        c = origin @ origin - 1.0
        if c <= 0.0:
            distance = np.full(len(angles), INSIDE_RANGE)
        else:
            inner = b * b - 4.0 * a * c
            with np.errstate(invalid="ignore"):
                distance = (-b - np.sqrt(inner)) / (2.0 * a)
            distance = np.where((inner >= 0.0) & (distance > 0.0), distance, np.inf)
        nearest[distance < ranges] = k
        ranges = np.minimum(ranges, distance)
    return ranges, nearest


def scan_of(ellipses, polygons, pose, sensor):
    rows = np.zeros((len(ellipses), ELLIPSE_COLUMNS))
    for k, (x, y, _, across, heading) in enumerate(ellipses):
        body_ellipse(x, y, heading, across, k, rows[k])
    edges, start = polygon_edges(polygons)
    n = sensor.n_rays
    out, owner, hits = np.zeros(n, np.float32), np.zeros(n, np.int32), np.zeros(max(1, len(ellipses)), np.int32)
    scan_ellipses(
        edges, start, len(polygons), rows, len(ellipses), *pose, ray_directions(sensor), sensor.angle_min,
        sensor.angle_increment, sensor.range_max, np.zeros(n), owner, hits, out,
    )  # fmt: skip
    return out, owner, hits


@pytest.mark.slow
@pytest.mark.parametrize("name", SENSORS)
def test_ellipses_match_the_quadratic_formula(name):
    rng = np.random.default_rng(4)
    sensor = SENSORS[name]
    angles = angles_of(sensor)
    box = [np.array([[6.0, -6.0], [6.0, 6.0], [-6.0, 6.0], [-6.0, -6.0]])]
    inside = 0
    for _ in range(4 if PURE_PYTHON else 120):
        across = rng.choice([0.05, 0.3, 0.5, 2.0], 8)
        bodies = np.column_stack(
            [rng.uniform(-5, 5, (8, 2)), 0.5 * across, across, rng.uniform(-7, 7, 8)],
        )
        pose = np.array([*rng.uniform(-5, 5, 2), rng.uniform(-7, 7)])
        scan, owner, hits = scan_of(bodies, box, pose, sensor)
        answers = []
        for turn in (-1e-9, 1e-9):
            ranges, nearest = ellipse_oracle(bodies, pose, angles + turn)
            edges, _ = polygon_edges(box)
            walls, _ = brute_force(edges, np.empty((0, 3)), pose, angles + turn, sensor.range_max)
            answers.append((np.minimum(walls, ranges), np.where(ranges < walls, nearest, -1)))
        inside += answers[0][0].max() <= INSIDE_RANGE
        (low, first), (high, second) = answers
        spread = np.abs(high - low)
        tangent = spread > 1e-5
        assert tangent.mean() < (0.05 if sensor.n_rays > 1 else 1.1)
        # where a ray grazes a body, the range changes quickly: anything between the answers to either side is right
        good = (scan >= np.minimum(low, high) - 1e-5) & (scan <= np.maximum(low, high) + 1e-5)
        assert good.all()
        same = (owner == first) | (owner == second)
        assert same[~tangent].all()
        np.testing.assert_array_equal(hits, np.bincount(owner[owner >= 0], minlength=8))
    assert inside < 60


def test_a_sensor_beside_a_body_but_within_its_width_sees_past_it():
    """In front of the chest, nearer than the shoulders are wide: the bounding circle says nothing about rays there."""
    body = np.array([[0.0, 0.0, 0.25, 0.5, 0.0]])
    scan, owner, _ = scan_of(body, [], (0.3, 0.0, math.pi), SENSORS["64 rays"])
    expected, _ = ellipse_oracle(body, (0.3, 0.0, math.pi), angles_of(SENSORS["64 rays"]))
    np.testing.assert_allclose(scan, np.minimum(expected, 25.0), atol=1e-6)
    assert scan[0] == pytest.approx(0.05)
    assert 20 < (owner == 0).sum() < 40
    # near the flat side's end the near shoulder is more than a quarter turn from the centre
    pose = (0.16, 0.4, -3.0)
    scan, owner, _ = scan_of(body, [], pose, SENSORS["64 rays"])
    expected, _ = ellipse_oracle(body, pose, angles_of(SENSORS["64 rays"]))
    np.testing.assert_allclose(scan, np.minimum(expected, 25.0), atol=1e-6)
    turned = np.angle(np.exp(1j * (angles_of(SENSORS["64 rays"]) - 3.0 - math.atan2(-0.4, -0.16))))
    assert np.abs(turned[owner == 0]).max() > math.pi / 2
    inside, _, hits = scan_of(body, [], (0.2, 0.0, 0.0), SENSORS["64 rays"])
    assert (inside == np.float32(INSIDE_RANGE)).all()
    assert hits[0] == 64


def test_bodies_stand_across_the_walking_direction():
    sim = Simulator(make_config("cadrl", rendering="ellipse"), seed=0)
    human = sim.arrays.agents[0, 1]
    sim.arrays.scalars[0, lay.S_HUMANS] = 1
    sim.arrays.agents[0, 0, [lay.A_X, lay.A_Y, lay.A_HEADING]] = 0.0
    human[[lay.A_X, lay.A_Y, lay.A_HEADING, lay.A_RADIUS]] = 3.0, 0.0, 0.0, 0.4
    along = sim.observe()[0][0]
    human[lay.A_HEADING] = math.pi / 2
    across = sim.observe()[0][0]
    assert along[0] == pytest.approx(3.0 - 0.2)  # it comes towards the sensor: chest ahead, shoulders to the sides
    assert across[0] == pytest.approx(3.0 - 0.4)
    assert (along < 25).sum() > 1.8 * (across < 25).sum()
    state = sim.state()
    np.testing.assert_allclose(state.ellipses, [[3.0, 0.0, 0.2, 0.4, math.pi / 2]])
    assert Simulator(make_config("cadrl")).state().ellipses.shape == (0, 5)


# --- other sensors --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rendering", ["legs", "trunk", "ellipse"])
@pytest.mark.parametrize("name", SENSORS)
def test_the_simulator_scans_with_any_sensor(name, rendering):
    sensor = SENSORS[name]
    sim = Simulator(make_config("soadrl", sensor=sensor, rendering=rendering), n_worlds=2, seed=2)
    for _ in range(5):
        sim.step(np.tile([0.5, 0.2, 0.7], (2, 1)))
    scans, _ = sim.observe()
    assert scans.shape == (2, sensor.n_rays)
    for w in range(2):
        state = sim.state(w)
        edges, _ = polygon_edges(state.polygons)
        circles = np.empty((0, 3)) if rendering == "ellipse" else state.circles
        answers = []
        for turn in (-1e-9, 1e-9):
            ranges, _ = brute_force(edges, circles, state.robot[:3], angles_of(sensor) + turn, sensor.range_max)
            bodies, _ = ellipse_oracle(state.ellipses, state.robot[:3], angles_of(sensor) + turn)
            answers.append(np.minimum(ranges, bodies))
        low, high = np.minimum(*answers), np.maximum(*answers)
        assert ((scans[w] >= low - 1e-5) & (scans[w] <= high + 1e-5)).all()
        assert (high - low < 1e-5).mean() > 0.98


@pytest.mark.parametrize("name", ["180 degrees", "240 degrees"])
def test_a_narrow_scan_becomes_one_of_1080_rays(name):
    """Through ScanAdapter: what a robot with the full sensor would see, where this one looks; 0 elsewhere."""
    sensor = dataclasses.replace(SENSORS[name], range_max=25.0)
    narrow, full = (
        Simulator(make_config("soadrl", sensor=s, rendering="trunk"), seed=5) for s in (sensor, SensorContract())
    )
    adapted = ScanAdapter(Lidar.of(sensor), unknown=0.0)(narrow.observe()[0])[0]
    expected = full.observe()[0][0]
    angles = np.angle(np.exp(1j * angles_of(SensorContract())))
    seen = np.abs(angles) <= -sensor.angle_min
    close = np.abs(adapted - expected) < 0.1
    assert close[seen].mean() > 0.9, "but at the edges of things"
    unseen = np.abs(angles) > -sensor.angle_min + sensor.angle_increment
    assert (adapted[unseen] == 0.0).all()
    assert unseen.mean() > 0.3


def test_rings_need_a_full_turn():
    narrow = make_config("soadrl", sensor=SENSORS["180 degrees"])
    with pytest.raises(ConfigError, match=r"sensor\.n_rays=181 over 181 degrees from sensor\.angle_min=-1\.57"):
        ScriptedRollout(narrow, RolloutSettings(length=5), ScriptedPolicy(), 0)
    columns, _ = ScriptedRollout(narrow, RolloutSettings(length=5, rings=False), ScriptedPolicy(), 0).run([0])[0]
    assert columns["scan"].shape == (5, 181)
    few = make_config("soadrl", sensor=SENSORS["64 rays"])
    columns, _ = ScriptedRollout(few, RolloutSettings(length=5), ScriptedPolicy(), 0).run([0])[0]
    assert columns["rings"].shape == (5, 64, 64)


# --- noise ----------------------------------------------------------------------------------------------------------


def noise_oracle(seed, sequence, episode, step, robot, n_rays, sigma, dropout):
    """Noise [m] and dropped rays by numpy's own Philox generator."""

    def block(key, counter):
        # numpy counts up before it makes a block
        words = [*counter]
        words[0] = (words[0] - 1) % 2**64
        if counter[0] == 0:
            words[1] = (words[1] - 1) % 2**64
            if counter[1] == 0:
                words[2] = (words[2] - 1) % 2**64
                if counter[2] == 0:
                    words[3] -= 1
        return np.random.Philox(key=np.array(key, np.uint64), counter=np.array(words, np.uint64)).random_raw(4)

    key = [block([seed, sequence], [episode, 0, 0, 1])[0], 0]
    noise, dropped = [], []
    for b in range(-(-n_rays // 8)):
        for word in block(key, [b, step, robot, 2]).tolist():
            size = math.sqrt(-2 * math.log(((word >> 32) + 1) / 2**32))
            angle = 2 * math.pi * (word % 2**32) / 2**32
            noise += [sigma * size * math.cos(angle), sigma * size * math.sin(angle)]
        for word in block(key, [b, step, robot, 3]).tolist():
            dropped += [(word >> 32) / 2**32 < dropout, (word % 2**32) / 2**32 < dropout]
    return np.array(noise[:n_rays]), np.array(dropped[:n_rays])


FAR = 6.0


def pair(n=1, seed=3, robots=1, **noise):
    """The same worlds with and without noise, seen as far as 6 m."""
    near = SensorContract(range_max=FAR)
    return [
        Simulator(make_config("soadrl", robots=robots, humans=6, sensor=near, **fields), n, seed=seed, first_sequence=7)
        for fields in ({}, noise)
    ]


@pytest.mark.parametrize("robots", [1, 2])
def test_noise_is_the_documented_function_of_seed_episode_step_robot_and_ray(robots):
    clean, noisy = pair(robots=robots, scan_noise=0.05, scan_dropout=0.2)
    shape = (1, 3) if robots == 1 else (1, robots, 3)
    for episode in range(2):
        for step in range(3):
            before, after = (s.observe()[0].reshape(robots, -1) for s in (clean, noisy))
            for r in range(robots):
                noise, dropped = noise_oracle(3, 7, episode, step, r, 1080, 0.05, 0.2)
                expected = np.where(before[r] < FAR, np.clip(before[r] + noise, 0.001, FAR), FAR)
                expected[dropped] = 0.0
                np.testing.assert_allclose(after[r], expected, atol=2e-6)
            for s in (clean, noisy):
                s.step(np.full(shape, 0.1))
        for s in (clean, noisy):
            s.reset()


def test_noise_has_the_size_and_the_rate_that_were_asked_for():
    clean, noisy = pair(n=20, scan_noise=0.03, scan_dropout=0.1)
    difference, dropped = [], []
    for _ in range(3 if PURE_PYTHON else 20):
        before, after = clean.observe()[0], noisy.observe()[0]
        dropped.append((after == 0.0).ravel())
        hit = (after > 0.0) & (before < FAR) & (before > 0.2)
        difference.append((after - before)[hit])
        assert (before == FAR).mean() > 0.2
        assert (after[(before == FAR) & (after > 0.0)] == FAR).all()
        for s in (clean, noisy):
            s.step(np.full((20, 3), 0.2))
    difference, dropped = np.concatenate(difference).astype(float), np.concatenate(dropped)
    n = len(difference)
    assert abs(difference.mean()) < 4 * 0.03 / math.sqrt(n)
    assert difference.std() == pytest.approx(0.03, rel=4 / math.sqrt(2 * n))
    assert (np.abs(difference) < 0.03).mean() == pytest.approx(0.6827, abs=4 * 0.47 / math.sqrt(n))
    assert dropped.mean() == pytest.approx(0.1, abs=4 * 0.3 / math.sqrt(len(dropped)))
    assert np.corrcoef(difference[:-1], difference[1:])[0, 1] == pytest.approx(0.0, abs=4 / math.sqrt(n))


def test_the_world_takes_no_notice_of_noise():
    clean, noisy = pair(n=3, scan_noise=0.1, scan_dropout=0.5)
    for k in range(12):
        noisy.observe()
        first, again = noisy.observe()[0], noisy.observe()[0]
        np.testing.assert_array_equal(first, again)
        for s in (clean, noisy):
            s.step(np.full((3, 3), 0.3))
            if k == 6:
                s.reset([True, False, True])
        np.testing.assert_array_equal(clean.arrays.agents, noisy.arrays.agents)
        np.testing.assert_array_equal(clean.arrays.rng, noisy.arrays.rng)


def test_noise_of_a_numbered_episode_is_that_of_its_number():
    config = make_config("navrep-test", physics="original", scan_noise=0.1, scan_dropout=0.1)
    a, b = Simulator(config, 1, seed=1), Simulator(config, 3, seed=2, first_sequence=9)
    a.reset_seeded([1004])
    b.reset()
    b.reset_seeded([1000, 1004, 1001])
    np.testing.assert_array_equal(a.observe()[0][0], b.observe()[0][1])
    assert (b.observe()[0][0] != b.observe()[0][1]).mean() > 0.9


@pytest.mark.slow
def test_invalid_rays_are_stored_as_0():
    config = make_config("soadrl", humans=4, scan_noise=2.0, scan_dropout=0.3)
    mm, _ = ScriptedRollout(config, RolloutSettings(length=40), ScriptedPolicy(), 0).run([0])[0]
    metres, _ = ScriptedRollout(config, RolloutSettings(length=40, scan_dtype="float32"), ScriptedPolicy(), 0).run([0])[
        0
    ]
    np.testing.assert_array_equal(mm["scan"] == 0, metres["scan"] == 0.0)
    assert (mm["scan"] == 0).mean() == pytest.approx(0.3, abs=0.01)
    assert metres["scan"][metres["scan"] > 0].min() == np.float32(0.001)
    assert mm["scan"][mm["scan"] > 0].min() == 1
