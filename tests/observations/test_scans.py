from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest

from navrep_data import observations as obs
from navrep_data.errors import ArrayError, ConfigError


def test_millimetres_round_half_to_even():
    rng = np.random.default_rng(0)
    # Multiples of 1/8192 m include exact halves of a millimetre (k + 1/2) / 1000 only at multiples of 1/16 m.
    halves = np.arange(1, 400, dtype=np.float32) / np.float32(16)
    scan = np.concatenate([rng.uniform(0.001, 25, 2000).astype(np.float32), halves[halves <= 25]])
    expected = [round(Fraction(float(d)) * 1000) for d in scan]  # exact, half to even
    np.testing.assert_array_equal(obs.millimetres_from_metres(scan), expected)
    assert obs.millimetres_from_metres(np.array([0.0625, 0.1875]))[:].tolist() == [62, 188]


def test_millimetres_of_special_ranges():
    scan = np.array([np.nan, -1.0, -np.inf, 0.0, -0.0, 1e-6, 0.0004, 0.0016, np.inf, 25.0, 25.0001, 1e30], np.float32)
    expected = [0, 0, 0, 0, 0, 1, 1, 2, 25000, 25000, 25000, 25000]
    np.testing.assert_array_equal(obs.millimetres_from_metres(scan), expected)
    assert obs.millimetres_from_metres(np.float32([np.inf]), range_max=65.0).tolist() == [65000]
    assert obs.millimetres_from_metres(np.float32([4.5, 3.0]), range_max=4.0).tolist() == [4000, 3000]


def test_millimetres_survive_the_way_there_and_back():
    counts = np.arange(1, 65001).astype(np.uint16).reshape(5, -1)
    metres = obs.metres_from_millimetres(counts)
    assert metres.dtype == np.float32
    np.testing.assert_array_equal(obs.millimetres_from_metres(metres, range_max=65.0), counts)
    np.testing.assert_array_equal(metres[0, :3], np.float32([1, 2, 3]) / np.float32(1000))


def test_one_dimensional_scans():
    scan = np.array([[0.0, 12.5, 25.0, 50.0]], np.float32)
    np.testing.assert_array_equal(obs.scan_to_1d(scan), [[0, 0.5, 1, 2]])
    np.testing.assert_array_equal(obs.scan_to_1d(scan, clip=True), [[0, 0.5, 1, 1]])
    np.testing.assert_array_equal(obs.scan_to_1d(scan.astype(np.float64), range_max=50.0), [[0, 0.25, 0.5, 1]])
    assert obs.scan_to_1d(scan.astype(np.float64)).dtype == np.float32
    assert scan[0, 3] == 50, "the input is left as it was"


def test_robot_state_is_in_the_robot_frame():
    # Facing +y: world +y is forward, world -x is left.
    state = obs.robot_state([1.0, 5.0], [1.0, 2.0, math.pi / 2], [-0.5, 0.25], 0.1)
    np.testing.assert_allclose(state, [3.0, 0.0, 0.25, 0.5, 0.1], atol=1e-7)
    assert state.dtype == np.float32
    rng = np.random.default_rng(1)
    goals, poses, velocities = rng.normal(size=(4, 1, 2)), rng.normal(size=(3, 3)), rng.normal(size=(4, 3, 2))
    many = obs.robot_state(goals, poses, velocities, 0.0)
    assert many.shape == (4, 3, 5)
    np.testing.assert_array_equal(many[2, 1], obs.robot_state(goals[2, 0], poses[1], velocities[2, 1], 0.0))
    # Turning back by the heading gives the world frame.
    theta = poses[1, 2]
    back = np.array([[math.cos(theta), -math.sin(theta)], [math.sin(theta), math.cos(theta)]]) @ many[2, 1, :2]
    np.testing.assert_allclose(back + poses[1, :2], goals[2, 0], atol=1e-6)


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: obs.millimetres_from_metres(np.ones(3), range_max=66.0), ConfigError, "at most 65.0 m"),
        (
            lambda: obs.millimetres_from_metres(np.ones(3), range_max=math.nan),
            ConfigError,
            "range_max is nan",
        ),
        (lambda: obs.scan_to_1d(np.ones(3), range_max=0.0), ConfigError, "range_max is 0.0"),
        (lambda: obs.millimetres_from_metres(np.ones(3, np.uint16)), ArrayError, "dtype uint16"),
        (lambda: obs.metres_from_millimetres(np.ones(3)), ArrayError, "dtype float64"),
        (lambda: obs.scan_to_1d(np.ones(3, np.uint16)), ArrayError, "metres_from_millimetres"),
        (lambda: obs.robot_state([1, 2, 3], [0, 0, 0], [0, 0], 0), ArrayError, r"goal_xy has shape \(3,\)"),
        (lambda: obs.robot_state([1, 2], [0, 0], [0, 0], 0), ArrayError, "robot_pose"),
        (lambda: obs.robot_state([1, 2], [0, 0, 0], 0.0, 0), ArrayError, "velocity_world"),
    ],
)
def test_unusable_input_is_refused(call, error, words):
    with pytest.raises(error, match=words):
        call()
