"""The dynamic window: its kernel against a slow search in plain Python, and how it behaves in hand-made places."""

import math

import numpy as np
import pytest

from navrep_data.policies import Context, DwaPolicy, _dwa
from navrep_data.schema import RobotContract, SensorContract

RAYS = 1080
SENSOR = SensorContract()
ANGLES = SENSOR.angle_min + SENSOR.angle_increment * np.arange(RAYS)


def settings(**changes):
    policy = DwaPolicy()
    policy.start(Context(RobotContract(1.0, 0.3), SENSOR))
    s = policy._settings.copy()
    for name, value in changes.items():
        s[getattr(_dwa, name)] = value
    return s


def wall(distance, half_width=90.0):
    """A wall ahead, straight across, as far as half_width [degrees] to both sides."""
    scan = np.full(RAYS, 25.0, np.float32)
    ahead = np.cos(ANGLES) > math.cos(math.radians(half_width)) + 1e-6
    scan[ahead] = np.minimum(25.0, distance / np.cos(ANGLES[ahead]))
    return scan


def chosen(scan, velocity=(0.0, 0.0), target=(5.0, 0.0), radius=0.3, **changes):
    out = np.zeros(2)
    points = np.zeros((RAYS, 2))
    _dwa.choose(scan, *velocity, *target, radius, settings(**changes), points, out)
    return out


def slow_clearance(vx, vy, horizon, radius, points):
    """Forward simulation in a thousand small steps."""
    gap, contact = math.inf, math.inf
    for t in np.linspace(0, horizon, 1001):
        for px, py in points:
            d = math.hypot(px - vx * t, py - vy * t) - radius
            gap = min(gap, d)
            if d < 0:
                contact = min(contact, t)
    return gap, contact


@pytest.mark.parametrize("seed", range(6))
def test_clearance_is_that_of_a_forward_simulation(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-2, 2, (6, 2))
    points = points[np.hypot(*points.T) > 0.45]
    vx, vy = rng.uniform(-1, 1, 2)
    gap, contact = _dwa.clearance_along(vx, vy, 1.5, 0.4, points, len(points))
    slow_gap, slow_contact = slow_clearance(vx, vy, 1.5, 0.4, points.tolist())
    assert gap == pytest.approx(slow_gap, abs=2e-3)
    assert contact == pytest.approx(slow_contact, abs=5e-3)


def test_near_points_are_the_nearest_of_their_rays():
    scan = np.full(RAYS, 25.0, np.float32)
    scan[[6, 8]] = 2.0, 1.5
    scan[40] = 9.0
    scan[80] = 0.0  # invalid
    points = np.zeros((RAYS, 2))
    n = _dwa.near_points(scan, 4.0, settings(), points)
    assert n == 1
    assert points[0] == pytest.approx([1.5 * math.cos(ANGLES[8]), 1.5 * math.sin(ANGLES[8])])


def test_heads_for_the_target_in_the_open_at_the_windows_edge_then_at_full_speed():
    open_space = np.full(RAYS, 25.0, np.float32)
    s = settings()
    change = s[_dwa.D_ACCELERATION] * 0.2
    assert chosen(open_space) == pytest.approx([min(1.0, change), 0.0], abs=0.2)
    assert chosen(open_space, velocity=(1.0, 0.0)) == pytest.approx([1.0, 0.0], abs=0.05)


def test_stays_within_window_and_speed():
    rng = np.random.default_rng(1)
    s = settings()
    for _ in range(50):
        velocity = rng.uniform(-0.7, 0.7, 2)
        out = chosen(rng.uniform(0.5, 6, RAYS).astype(np.float32), velocity, rng.uniform(-3, 3, 2))
        assert np.hypot(*out) <= 1.0 + 1e-6
        if out.any():
            assert np.abs(out - velocity).max() <= s[_dwa.D_ACCELERATION] * 0.2 + 1e-6


def test_never_runs_into_a_wall_with_its_target_behind_it():
    distance, velocity = 3.0, np.zeros(2)
    for _ in range(40):
        velocity = chosen(wall(distance), velocity)
        distance -= 0.2 * velocity[0]
        assert distance > 0.3
    assert distance < 1.5


def disc(x, y, radius):
    """Scan of a disc at (x, y), by the quadratic formula."""
    along = x * np.cos(ANGLES) + y * np.sin(ANGLES)
    root = radius**2 - (x**2 + y**2 - along**2)
    hit = (root > 0) & (along > 0)
    scan = np.full(RAYS, 25.0, np.float32)
    scan[hit] = (along - np.sqrt(np.maximum(root, 0)))[hit]
    return scan


@pytest.mark.parametrize("offset", [0.05, -0.2, 0.3])
def test_goes_round_a_post_to_its_target(offset):
    position, velocity, goal = np.zeros(2), np.zeros(2), np.array([4.0, 0.0])
    post = np.array([2.0, offset])
    for _ in range(60):
        velocity = chosen(disc(*(post - position), 0.25), velocity, goal - position)
        position = position + 0.2 * velocity
        assert np.hypot(*(post - position)) > 0.25 + 0.3
        if np.hypot(*(goal - position)) < 0.3:
            return
    pytest.fail(f"stuck at {position}")


def test_a_robot_that_touches_something_may_leave_it():
    out = chosen(wall(0.25, 60.0), target=(-3.0, 0.0))
    assert out[0] < -0.1


def test_never_chooses_what_it_cannot_stop():
    rng = np.random.default_rng(2)
    s = settings()
    for _ in range(100):
        scan = rng.uniform(0.6, 3.0, RAYS).astype(np.float32)
        out = chosen(scan, rng.uniform(-0.5, 0.5, 2), rng.uniform(-3, 3, 2))
        points = np.zeros((RAYS, 2))
        n = _dwa.near_points(scan, 25.0, s, points)
        _, contact = _dwa.clearance_along(*out, s[_dwa.D_HORIZON], 0.3 + s[_dwa.D_MARGIN], points, n)
        assert not out.any() or contact >= 0.2
        assert np.hypot(*out) <= s[_dwa.D_ACCELERATION] * contact + 1e-9
