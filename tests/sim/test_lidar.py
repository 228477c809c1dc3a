from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from numba import config
from recorded import DATA

from navrep_data.errors import ArrayError, ConfigError
from navrep_data.schema import SensorContract
from navrep_data.sim import _lidar
from navrep_data.sim.lidar import polygon_edges, ray_directions, scan_polygons

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from oracles_lidar import brute_force, wrong_rays

GOLDEN = DATA / "golden" / "test_env_traces.npz"
PURE_PYTHON = bool(config.DISABLE_JIT)
WORLDS = 6 if PURE_PYTHON else 150
NO_CIRCLES = np.empty((0, 3))
BORDER = np.array([[-10.0, 10.0], [10.0, 10.0], [10.0, -10.0], [-10.0, -10.0]])  # clockwise, as in the original
COARSE = SensorContract(n_rays=90, angle_increment=2 * math.pi / 90)
SENSORS = {
    "original": SensorContract(),
    "one ray": SensorContract(n_rays=1, angle_increment=0.1),
    "forward quarter": SensorContract(n_rays=91, angle_min=-math.pi / 4, angle_increment=math.pi / 180),
    "both ends of a full turn": SensorContract(n_rays=361, angle_min=-math.pi, angle_increment=math.pi / 180),
    "more than a turn": SensorContract(n_rays=500, angle_min=1.0, angle_increment=math.pi / 180),
    "starts after a turn": SensorContract(n_rays=200, angle_min=7.0, angle_increment=0.03),
    "starts before a turn": SensorContract(n_rays=200, angle_min=-40.0, angle_increment=0.03),
    "short range": SensorContract(n_rays=128, angle_increment=math.pi / 64, range_max=3.3),
    "fine": SensorContract(n_rays=2000, angle_min=-0.01, angle_increment=1e-5),
}


def box(x, y, half_x, half_y, turn=0.0):
    corners = np.array([[half_x, half_y], [-half_x, half_y], [-half_x, -half_y], [half_x, -half_y]])
    c, s = math.cos(turn), math.sin(turn)
    return corners @ np.array([[c, s], [-s, c]]) + [x, y]


def angles_of(contract):
    return contract.angle_min + np.arange(contract.n_rays) * contract.angle_increment


def check(polygons, circles, pose, contract=COARSE, most_ambiguous=0.02):
    """Compare with the oracle; return the scan."""
    scan = scan_polygons(polygons, circles, pose, contract)
    edges, _ = polygon_edges(polygons)
    wrong, ambiguous = wrong_rays(scan, edges, circles, pose, angles_of(contract), contract.range_max)
    assert wrong.size == 0, f"rays {wrong[:5]} at pose {pose}: {scan[wrong[:5]]}"
    assert ambiguous <= most_ambiguous
    assert scan.dtype == np.float32
    assert (scan <= np.float32(contract.range_max)).all()
    assert (scan > 0).all()
    return scan


def random_world(rng, boxes=8, circles=12):
    polygons = [
        box(*rng.uniform(-8, 8, 2), *rng.uniform(0.2, 1.5, 2), rng.choice([0.0, rng.uniform(0, 7)]))
        for _ in range(boxes)
    ]
    discs = np.column_stack([rng.uniform(-8, 8, (circles, 2)), rng.choice([0.001, 0.03, 0.3, 0.6], circles)])
    return [*polygons, BORDER], discs, np.array([*rng.uniform(-8, 8, 2), rng.uniform(-7, 7)])


@pytest.mark.slow
@pytest.mark.parametrize("name", SENSORS)
def test_random_worlds_match_brute_force(name):
    # Boxes overlap, the sensor is inside one in about a third of the worlds and inside a circle in some.
    rng = np.random.default_rng(1)
    contract = SENSORS[name]
    for _ in range(max(2, WORLDS // 4)):
        check(*random_world(rng), contract, most_ambiguous=0.02 if contract.n_rays > 1 else 1.0)


@pytest.mark.slow
def test_many_random_worlds_match_brute_force():
    rng = np.random.default_rng(2)
    for _ in range(20 if PURE_PYTHON else 1500):
        check(*random_world(rng), SENSORS["original"], most_ambiguous=0.01)


@pytest.mark.parametrize("gap", [1e-2, 1e-3, 1e-5, 1e-7])
def test_sensor_close_to_a_wall(gap):
    wall = box(3.0, 0.0, 1.0, 4.0)
    for heading in (0.0, 0.3, math.pi / 2, 3.0, -1e-4):
        scan = check([wall, BORDER], NO_CIRCLES, np.array([2.0 - gap, 0.5, heading]), SENSORS["original"])
        assert scan.min() == pytest.approx(gap, rel=1e-3)
        inside = check([wall, BORDER], NO_CIRCLES, np.array([2.0 + gap, 0.5, heading]), SENSORS["original"])
        assert inside.max() < 8.0, "from within a box nothing beyond it is seen"


def test_sensor_on_a_wall_or_corner_gives_a_scan():
    # Degenerate by definition; the scan must still be made of ranges.
    for x, y in ((2.0, 0.5), (2.0, 4.0), (4.0, -4.0)):
        scan = scan_polygons([box(3.0, 0.0, 1.0, 4.0), BORDER], NO_CIRCLES, [x, y, 0.1])
        assert ((scan > 0) & (scan <= 25)).all()


@pytest.mark.parametrize("heading", [0.0, math.pi / 2, math.pi, -math.pi / 2, 0.1])
@pytest.mark.parametrize("offset", [0.0, 1e-12, -1e-12, 1e-8, -1e-8])
def test_sensor_collinear_with_an_edge(heading, offset):
    # The side y = 1 of the box points at the sensor; with heading 0 a ray runs exactly along it.
    polygons = [box(4.0, 0.0, 1.0, 1.0), box(0.0, 5.0, 1.0, 1.0), BORDER]
    scan = check(polygons, NO_CIRCLES, np.array([-1.0, 1.0 + offset, heading]), most_ambiguous=0.05)
    assert scan.max() < math.hypot(11, 11) + 1e-6, "no ray leaves the border"


@pytest.mark.slow
def test_no_ray_slips_between_edges_that_share_a_corner():
    # A closed room whose corners lie on the bearings of rays, as exactly as float64 can say, from many
    # places.
    rng = np.random.default_rng(3)
    contract = SENSORS["original"]
    directions = ray_directions(contract).T
    for _ in range(WORLDS):
        x, y, theta = *rng.uniform(-5, 5, 2), rng.choice([0.0, rng.uniform(-7, 7)])
        rays = np.sort(rng.choice(contract.n_rays, 60, replace=False))
        c, s = math.cos(theta), math.sin(theta)
        local = directions[rays] * rng.uniform(2.0, 9.0, (60, 1))
        if np.diff(rays).max() > contract.n_rays // 3:
            continue
        room = local @ np.array([[c, s], [-s, c]]) + [x, y]
        for polygon in (room, room[::-1]):
            scan = scan_polygons([polygon], NO_CIRCLES, [x, y, theta], contract)
            assert scan.max() < 9.001, "a ray left a closed room"
            edges, _ = polygon_edges([polygon])
            wrong, _ = wrong_rays(scan, edges, NO_CIRCLES, (x, y, theta), angles_of(contract), contract.range_max)
            assert wrong.size == 0


@pytest.mark.slow
@pytest.mark.parametrize("length", [1e-4, 1e-6, 0.9e-6, 3e-8, 1e-9, 1e-11, 1e-14, 0.0])
def test_corners_with_very_short_edges(length):
    # A star-shaped room with clusters of corners next to some rays and the seam: closer than the error of the
    # bearings, so their order cannot be told from the bearings alone.
    rng = np.random.default_rng(9)
    for case in range(max(8, WORLDS // 10)):
        # At odd multiples of 45 degrees the polynomial changes branch: there its errors differ most.
        contract = SensorContract(angle_min=[0.0, math.pi / 4, -math.pi / 4, -0.75 * math.pi][case % 4])
        angles = angles_of(contract)
        pose = np.array([*rng.uniform(-5, 5, 2), rng.choice([0.0, rng.uniform(-7, 7)])])
        rays = angles[[0, 0, 1, *rng.choice(1080, 5), 1079]]
        rays = [*rays, math.pi / 4, -math.pi / 4, 0.75 * math.pi, -0.75 * math.pi]
        clusters = [ray + np.sort(rng.uniform(-2, 2, 4)) * length / 5 for ray in rays]
        near = np.concatenate(clusters) % (2 * math.pi)
        far = np.linspace(0.1, 6.2, 40)
        order = np.argsort(np.concatenate([near, far]))
        bearings = np.concatenate([near, far])[order] + pose[2]
        distance = np.concatenate([np.full(near.size, 5.0), np.full(far.size, 8.0)])[order]
        room = np.column_stack([distance * np.cos(bearings), distance * np.sin(bearings)]) + pose[:2]
        scan = check([room], NO_CIRCLES, pose, contract, most_ambiguous=0.05)
        assert scan.max() < 8.001
        assert scan.min() > 4.9
        outside = np.array([pose[0] + 11, pose[1], pose[2] + 1])
        check([room, BORDER * 3], NO_CIRCLES, outside, contract, most_ambiguous=0.05)


def test_sensor_inside_overlapping_boxes_sees_them_from_within():
    polygons = [box(0, 0, 2, 2), box(1.5, 0, 1, 1), box(0, 0, 3, 3, 0.4), BORDER]
    scan = check(polygons, NO_CIRCLES, np.array([0.1, 0.2, 0.3]), SENSORS["original"])
    assert scan.max() < 3.05  # the diagonal of the box of half-side 2


@pytest.mark.parametrize(
    "pose", [(0.5, 0.5, 0.2), (2.5, 0.5, 1.0), (2.5, 2.5, 4.0), (-1.0, -1.0, 0.0), (0.5, 2.5, 2.0)]
)
def test_concave_polygons_from_within_and_without(pose):
    corner = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 1.0], [1.0, 1.0], [1.0, 3.0], [0.0, 3.0]])
    star = np.array([[math.cos(k * 0.7) * (1 + k % 2), math.sin(k * 0.7) * (1 + k % 2)] for k in range(9)]) - [4, 4]
    for polygons in ([corner, star, BORDER], [corner[::-1], star[::-1], BORDER[::-1]]):
        check(polygons, NO_CIRCLES, np.array(pose), SENSORS["original"])


def test_walls_and_open_lines_are_seen_from_both_sides():
    wall = np.array([[2.0, -1.0], [2.0, 1.0]])
    for x in (0.0, 4.0):
        scan = check([wall], NO_CIRCLES, np.array([x, 0.2, 0.1]))
        assert scan.min() == pytest.approx(2.0, abs=0.01)
    # Edges that do not close, three of them: a fence with a gap.
    edges = np.array([[1.0, -1.0, 1.0, 1.0], [1.0, 1.0, -1.0, 1.0], [-1.0, 1.0, -1.0, -1.0]])
    out = np.empty((1, COARSE.n_rays), np.float32)
    for pose in ((0.0, 0.0, 0.3), (3.0, 0.1, 0.3), (0.2, -4.0, 1.0)):
        _lidar.scan_poses(
            edges, np.array([0, 3]), np.empty((0, 4)), np.array([pose]), ray_directions(COARSE),
            0.0, COARSE.angle_increment, 25.0, 0, out,
        )  # fmt: skip
        wrong, _ = wrong_rays(out[0], edges, NO_CIRCLES, pose, angles_of(COARSE), 25.0)
        assert wrong.size == 0


def test_circles_at_every_bearing_around_the_seam():
    # Across ray 0, across the gap behind the last ray, tangent to either; small and large, near and far.
    contract = SENSORS["original"]
    for radius, distance in ((0.03, 3.0), (0.001, 0.5), (0.3, 0.301), (0.5, 12.0)):
        for bearing in np.linspace(-0.02, 0.02, 5 if PURE_PYTHON else 41):
            theta = 2.0
            circle = [[distance * math.cos(theta + bearing), distance * math.sin(theta + bearing), radius]]
            check([BORDER], np.array(circle), np.array([0.0, 0.0, theta]), contract)


def test_sensor_inside_a_circle_sees_only_it():
    scan = scan_polygons([BORDER], [[0.0, 0.1, 0.3], [2.0, 0.0, 0.3]], [0.0, 0.0, 1.0])
    assert (scan == np.float32(_lidar.INSIDE_RANGE)).all()


def test_sensor_touching_a_circle():
    for x in (0.3, np.nextafter(0.3, 1), np.nextafter(0.3, 0), 0.3 + 1e-12, 0.3 + 1e-6):
        scan = scan_polygons([BORDER], [[0.0, 0.0, 0.3]], [[x, 0.0, h] for h in (0.0, 0.7, math.pi)])
        assert ((scan > 0) & (scan <= 25)).all()
        assert (scan.min(axis=1) < 1e-4).all()
    rng = np.random.default_rng(10)
    circle = [[1.0, 2.0, 0.3]]
    for bearing in rng.uniform(0, 7, 300):
        pose = [1.0 + 0.3 * math.cos(bearing), 2.0 + 0.3 * math.sin(bearing), rng.uniform(-7, 7)]
        scan = scan_polygons([BORDER], circle, pose, COARSE)
        assert ((scan > 0) & (scan <= 25)).all()


def test_far_walls_and_empty_worlds_give_range_max():
    assert (scan_polygons([], NO_CIRCLES, [0, 0, 0]) == 25).all()
    assert (scan_polygons([BORDER * 3], [[28.0, 0, 1.0]], [0, 0, 0]) == 25).all()
    check([BORDER * 2.2], NO_CIRCLES, np.array([3.0, 1.0, 0.0]), SENSORS["original"])
    odd = SensorContract(range_max=10.1)
    assert (scan_polygons([], NO_CIRCLES, [0, 0, 0], odd) == np.float32(10.1)).all()
    # Half way between two float32, where the least error of 1 / (1 / x) would round up.
    between = next(x for k in range(0, 1000, 2) if 1 / (1 / (x := 15 + (k + 0.5) * 2.0**-20)) > x)
    scan = scan_polygons([], NO_CIRCLES, [0, 0, 0], SensorContract(range_max=between))
    assert (scan == np.float32(between)).all()


def test_turning_the_world_with_the_robot_changes_nothing():
    rng = np.random.default_rng(4)
    contract = SENSORS["original"]
    for _ in range(max(3, WORLDS // 5)):
        polygons, circles, pose = random_world(rng)
        turn = rng.uniform(-7, 7)
        c, s = math.cos(turn), math.sin(turn)
        rotate = np.array([[c, s], [-s, c]])
        turned = [np.asarray(p) @ rotate for p in polygons]
        turned_circles = np.column_stack([circles[:, :2] @ rotate, circles[:, 2]])
        turned_pose = np.array([*(pose[:2] @ rotate), pose[2] + turn])
        before = scan_polygons(polygons, circles, pose, contract)
        after = scan_polygons(turned, turned_circles, turned_pose, contract)
        # A ray within rounding of a corner may fall to the other side of it.
        different = np.flatnonzero(np.abs(before - after) > 1e-5)
        edges, _ = polygon_edges(polygons)
        wrong, _ = wrong_rays(after, edges, circles, pose, angles_of(contract), contract.range_max)
        assert wrong.size == 0
        assert different.size <= 1


def test_direction_of_polygons_does_not_matter():
    rng = np.random.default_rng(5)
    for _ in range(max(3, WORLDS // 5)):
        polygons, circles, pose = random_world(rng)
        reverse = scan_polygons([p[::-1] for p in polygons], circles, pose, COARSE)
        np.testing.assert_allclose(scan_polygons(polygons, circles, pose, COARSE), reverse, rtol=1e-6)


def test_hits_name_the_humans_that_are_seen():
    rng = np.random.default_rng(6)
    contract = SENSORS["original"]
    seen = unseen = 0
    for _ in range(max(3, WORLDS // 5)):
        polygons, circles, pose = random_world(rng)
        if (np.hypot(*(circles[:, :2] - pose[:2]).T) <= circles[:, 2]).any():
            continue
        edges, start = polygon_edges(polygons)
        owners = np.arange(len(circles)) // 2  # two circles each, as legs
        owner_of_ray, hits = np.empty(contract.n_rays, np.int32), np.full(8, 77, np.int32)
        _lidar.scan_world(
            edges, start, len(polygons), np.column_stack([circles, owners]), len(circles), *pose,
            ray_directions(contract), 0.0, contract.angle_increment, 25.0, 0, np.empty(contract.n_rays),
            owner_of_ray, hits, np.empty(contract.n_rays, np.float32),
        )  # fmt: skip
        _, nearest = brute_force(edges, circles, pose, angles_of(contract), 25.0)
        expected = np.where(nearest >= 0, nearest // 2, -1)
        assert (owner_of_ray != expected).sum() <= 1  # a tangent ray may go either way
        np.testing.assert_array_equal(hits, np.bincount(owner_of_ray[owner_of_ray >= 0], minlength=8))
        seen += int((hits[:6] > 0).sum())
        unseen += int((hits[:6] == 0).sum())
    assert seen > 3
    assert unseen > 3


def test_bearing_is_as_exact_as_it_says():
    rng = np.random.default_rng(7)
    points = [
        (0.0, 1.0),
        (0.0, -1.0),
        (1.0, 0.0),
        (-1.0, 0.0),
        (1e-300, -1.0),
        (-0.0, 1.0),
        (1e200, 1e200),
        (3.0, -3.0),
    ]
    points += [tuple(p) for p in rng.normal(size=(2000, 2)) * 10.0 ** rng.uniform(-9, 9, (2000, 1))]
    for y, x in points:
        error = abs(_lidar.bearing(y, x) - math.atan2(y, x))
        assert min(error, 2 * math.pi - error) < 3e-7 < _lidar.BEARING_ERROR
    assert _lidar.bearing(0.0, 0.0) == 0.0


def test_legs_of_a_human_who_stands_and_of_one_who_walks():
    rows = np.empty((2, 4))
    _lidar.leg_circles(5.0, 6.0, 0.0, 0.0, 0.0, 0.0, 0.0, 3, rows)
    np.testing.assert_allclose(rows, [[5.01, 6.2, 0.03, 3], [4.99, 5.8, 0.03, 3]])
    # Half a stride (pi * 0.3 / 2 m) further on, at full amplitude, facing +y: the legs have swapped.
    _lidar.leg_circles(5.0, 6.0, math.pi / 2, 1.0, 0.0, 0.0, 0.0, 0, rows)
    np.testing.assert_allclose(rows[:, :2], [[4.8, 6.3], [5.2, 5.7]], atol=1e-12)
    _lidar.leg_circles(5.0, 6.0, math.pi / 2, 1.0, math.pi * 0.15, 0.0, 0.0, 0, rows)
    np.testing.assert_allclose(rows[:, :2], [[4.8, 5.7], [5.2, 6.3]], atol=1e-12)


def test_gap_quirk_hides_what_lies_in_the_world_x_direction():
    legs = [[3.0, 0.02, 0.03], [0.0, 3.0, 0.03]]
    pose = [0.0, 0.0, 1.0]
    assert scan_polygons([BORDER], legs, pose).min() < 3.0
    hidden = scan_polygons([BORDER], legs, pose, gap_quirk=True)
    np.testing.assert_array_equal(hidden, scan_polygons([BORDER], legs[1:], pose))
    # Across ray 0: the first rays keep it, the last ones lose it.
    trunk = [[3.0 * math.cos(1.0), 3.0 * math.sin(1.0), 0.3]]
    whole, cut = (scan_polygons([BORDER], trunk, pose, gap_quirk=q) for q in (False, True))
    np.testing.assert_array_equal(whole[:540], cut[:540])
    assert whole[-5] < 3.1
    np.testing.assert_array_equal(cut[540:], scan_polygons([BORDER], NO_CIRCLES, pose)[540:])


def golden_scenes(data, episodes):
    """Yield episode, step, polygons, legs, pose, the original's scan; gait is rebuilt from the traces."""
    for episode in episodes:
        get = {k[5:]: data[k] for k in data.files if k.startswith(f"e{episode:03}_")}
        start = get["humans0"]
        heading, gait = start[:, 4].copy(), np.zeros((len(start), 3))
        for step in range(get["scan_steps"].max() + 1):
            humans = start[:, :4] if step == 0 else get["humans"][step - 1]
            velocity = humans[:, 2:]
            speed = np.hypot(*velocity.T)
            if step > 0:
                new = np.where(speed > 0, np.arctan2(velocity[:, 1], velocity[:, 0]), 0.0)
                c, s = np.cos(new), np.sin(new)
                gait[:, 0] += 0.2 * (c * velocity[:, 0] + s * velocity[:, 1])
                gait[:, 1] += 0.2 * (c * velocity[:, 1] - s * velocity[:, 0])
                gait[:, 2] += new - heading
                heading = new
            if step not in get["scan_steps"]:
                continue
            legs = np.empty((2 * len(humans), 4))
            for i in range(len(humans)):
                _lidar.leg_circles(*humans[i, :2], heading[i], speed[i], *gait[i], i, legs[2 * i : 2 * i + 2])
            pose = get["robot0"][:3] if step == 0 else get["robot"][step - 1]
            scan = get["scans"][list(get["scan_steps"]).index(step)]
            yield episode, step, get["polygons"], legs[:, :3], pose, scan


def test_scans_of_the_original_environment():
    different, corrected = [], 0
    with np.load(GOLDEN) as data:
        for episode, step, polygons, legs, pose, expected in golden_scenes(data, (6,) if PURE_PYTHON else range(10)):
            scan = scan_polygons(list(polygons), legs, pose, gap_quirk=True)
            different += [(episode, step, int(r)) for r in np.flatnonzero(np.abs(scan - expected) > 1e-3)]
            right = scan_polygons(list(polygons), legs, pose)
            corrected += int((np.abs(right - expected) > 1e-3).sum())
    # 2 rays of 66,960, both float32 rounding of the original: ray 1079 at a leg that reaches past the last
    # ray (it works out the index of the last ray by a division that falls just below 1079), ray 1050 tangent
    # to a leg (inside by 6e-6 rad).
    assert different == [(6, 1, 1079), (6, 2, 1050)]
    assert corrected > len(different), "without the quirk at least one leg more must be seen"


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"polygons": [[[0, 0, 0]]]}, ArrayError, r"Polygon 0 has shape \(1, 3\)"),
        ({"polygons": [BORDER, [[0, 0], [np.nan, 1]]]}, ArrayError, "Polygon 1"),
        ({"circles": [[0, 0]]}, ArrayError, r"expected \(C, 3\)"),
        ({"circles": [[0, 0, -1.0]]}, ArrayError, "radius at least 0"),
        ({"pose": [0, 0]}, ArrayError, r"pose has shape \(2,\)"),
        ({"pose": [0, 0, np.inf]}, ArrayError, "finite"),
        ({"contract": SensorContract(n_rays=0)}, ConfigError, "n_rays is 0"),
        ({"contract": SensorContract(angle_increment=-0.1)}, ConfigError, "angle_increment is -0.1"),
        ({"contract": SensorContract(range_max=math.inf)}, ConfigError, "range_max is inf"),
        ({"contract": SensorContract(angle_min=math.nan)}, ConfigError, "angle_min is nan"),
    ],
)
def test_unusable_input_is_refused(change, error, words):
    arguments = {"polygons": [BORDER], "circles": NO_CIRCLES, "pose": [0, 0, 0], "contract": COARSE} | change
    with pytest.raises(error, match=words):
        scan_polygons(**arguments)


def test_many_poses_equal_one_by_one():
    rng = np.random.default_rng(8)
    polygons, circles, _ = random_world(rng)
    poses = rng.uniform(-8, 8, (2, 3, 3))
    scans = scan_polygons(polygons, circles, poses, COARSE)
    assert scans.shape == (2, 3, 90)
    np.testing.assert_array_equal(scans[1, 2], scan_polygons(polygons, circles, poses[1, 2], COARSE))
