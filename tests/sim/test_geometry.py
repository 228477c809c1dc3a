"""Clearances against dense sampling, and the promise that lidar and collisions see the same world."""

import numpy as np
import pytest

from navrep_data.sim import Simulator, make_config
from navrep_data.sim import _layout as lay
from navrep_data.sim._geometry import box_distance, in_solid, point_segment_sq, swept_clearance


def boxes_as_edges(boxes, border):
    """Anticlockwise boxes (cx, cy, hx, hy) and a clockwise border as kernel arrays."""
    corners = []
    for cx, cy, hx, hy in boxes:
        corners.append([(cx + hx, cy + hy), (cx - hx, cy + hy), (cx - hx, cy - hy), (cx + hx, cy - hy)])
    corners.append([(border, border), (border, -border), (-border, -border), (-border, border)])
    edges = np.array([[*a, *b] for c in corners for a, b in zip(c, c[1:] + c[:1], strict=True)], float)
    return edges, np.arange(len(corners) + 1) * 4


def solid_oracle(points, boxes, border):
    inside = np.zeros(len(points), bool)
    for cx, cy, hx, hy in boxes:
        inside |= (abs(points[:, 0] - cx) < hx) & (abs(points[:, 1] - cy) < hy)
    return inside | (abs(points) > border).any(axis=1)


@pytest.fixture
def scene():
    rng = np.random.default_rng(5)
    boxes = np.column_stack([rng.uniform(-4, 4, (9, 2)), rng.uniform(0.3, 1.2, (9, 2))])
    return boxes, 6.0, *boxes_as_edges(boxes, 6.0)


def test_solid_is_inside_boxes_or_outside_the_border(scene):
    boxes, border, edges, start = scene
    points = np.random.default_rng(0).uniform(-7, 7, (3000, 2))
    got = np.array([in_solid(x, y, edges, start, len(boxes) + 1) for x, y in points])
    np.testing.assert_array_equal(got, solid_oracle(points, boxes, border))
    assert 0.2 < got.mean() < 0.8


@pytest.mark.slow
def test_swept_clearance_is_the_smallest_distance_on_the_way(scene):
    boxes, border, edges, start = scene
    rng = np.random.default_rng(1)
    checked = 0
    for _ in range(300):
        a = rng.uniform(-6, 6, 2)
        b = a + rng.uniform(-0.4, 0.4, 2)
        if solid_oracle(a[None], boxes, border)[0]:
            assert swept_clearance(*a, *b, edges, start, len(boxes) + 1) <= 0  # 0 where it leaves the solid
            continue
        way = a + np.linspace(0, 1, 400)[:, None] * (b - a)
        d = np.full(len(way), np.inf)
        for e in edges:
            for k, p in enumerate(way):
                d[k] = min(d[k], np.sqrt(point_segment_sq(*p, *e)))
        got = swept_clearance(*a, *b, edges, start, len(boxes) + 1)
        assert got == pytest.approx(d.min(), abs=2e-3)
        assert got <= d.min() + 1e-12
        checked += 1
        if checked == 40:
            return
    raise AssertionError("too few free points")


def test_point_segment_distance_by_hand():
    assert point_segment_sq(0.0, 1.0, -1.0, 0.0, 1.0, 0.0) == pytest.approx(1.0)
    assert point_segment_sq(3.0, 0.0, -1.0, 0.0, 1.0, 0.0) == pytest.approx(4.0)
    assert point_segment_sq(3.0, 4.0, 0.0, 0.0, 0.0, 0.0) == pytest.approx(25.0)
    assert box_distance(3.0, 0.5, 0.0, 0.0, 1.0, 1.0) == pytest.approx(2.0)
    assert box_distance(0.2, 0.5, 0.0, 0.0, 1.0, 1.0) == 0.0


def test_lidar_and_collisions_see_one_geometry():
    """Along every ray: free up to the range that the lidar reports, solid right behind it."""
    sim = Simulator(make_config("soadrl", humans=0), n_worlds=6, seed=3)
    contract = sim.config.sensor
    angles = contract.angle_min + contract.angle_increment * np.arange(contract.n_rays)
    scans, _ = sim.observe()
    rng = np.random.default_rng(0)
    for w in range(sim.n_worlds):
        x, y, theta = sim.arrays.agents[w, 0, [lay.A_X, lay.A_Y, lay.A_HEADING]]
        rays = rng.choice(contract.n_rays, 200, replace=False)
        unit = np.column_stack([np.cos(angles[rays] + theta), np.sin(angles[rays] + theta)])
        ranges = scans[w, rays].astype(float)[:, None]
        here = np.array([x, y])
        assert (sim.clearance(here + unit * (ranges - 1e-4), w) > 0).all()
        for share in (0.1, 0.5, 0.9):
            assert (sim.clearance(here + unit * ranges * share, w) > 0).all()
        # a ray may graze a corner and be out again behind it: 1e-4 m further on it must be solid but for those
        assert (sim.clearance(here + unit * (ranges + 1e-4), w) < 0).mean() > 0.99


def test_what_is_solid_for_the_robot_looks_solid():
    """From any free point, no free point in sight is reported solid and no solid point is looked through."""
    sim = Simulator(make_config("soadrl", humans=0), seed=8)
    rng = np.random.default_rng(2)
    a = sim.arrays
    checked = 0
    while checked < 20:
        x, y = rng.uniform(-8, 8, 2)
        if sim.clearance([[x, y]])[0] < 0.05:
            continue
        a.agents[0, 0, [lay.A_X, lay.A_Y]] = x, y
        scan = sim.observe()[0][0]
        ray = int(rng.integers(1080))
        angle = a.agents[0, 0, lay.A_HEADING] + ray * sim.config.sensor.angle_increment
        way = np.array([x, y]) + np.linspace(0, 20, 4001)[:, None] * [np.cos(angle), np.sin(angle)]
        solid = sim.clearance(way) < 0
        assert solid.any()
        assert scan[ray] == pytest.approx(np.argmax(solid) * 0.005, abs=0.0051)
        checked += 1


def test_humans_are_solid_to_lidar_where_they_are_to_the_robot():
    """Trunks: what the lidar sees of a human is exactly its disc. Legs: never outside where the robot would collide."""
    for rendering in ("trunk", "legs"):
        sim = Simulator(make_config("soadrl", obstacles=0, rendering=rendering), n_worlds=4, seed=1)
        for _ in range(10):
            sim.step(np.zeros((4, 3)))
        for w in range(4):
            state = sim.state(w)
            for x, y, r in state.circles:
                gap = np.hypot(state.humans[:, 0] - x, state.humans[:, 1] - y) + r - state.humans[:, 7]
                # a robot of the smallest radius (0.3 m) that stood on any point of the circle would touch the human
                assert gap.min() <= (1e-9 if rendering == "trunk" else 0.3)
            if rendering == "trunk":
                assert len(state.circles) == len(state.humans)
