from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numba import config

from navrep_data.errors import MissingExtraError
from navrep_data.sim import _fast_marching as marching
from navrep_data.sim._layout import RNG_WORDS
from navrep_data.sim._rng import seed_mt
from navrep_data.sim.maps import GridMap, goal_field, load_map, planning_map, planning_speeds

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from oracles_maps import arrival_times, original_path, original_times

PURE_PYTHON = bool(config.DISABLE_JIT)
SEEDS = range(2 if PURE_PYTHON else 10)


def random_speeds(seed, shape=(31, 24), closed=0.15):
    rng = np.random.default_rng(seed)
    speeds = rng.uniform(0.05, 2.0, shape).astype(np.float32)
    speeds[rng.random(shape) < closed] = rng.choice([0.0, -1.0])
    return speeds


def solve(speeds, goal, upwind=marching.UPWIND_FINAL):
    field = np.empty(speeds.shape, np.float32)
    marching.march(np.asarray(speeds, np.float32), *goal, upwind, field)
    return field


def walk(field, start, ties=marching.TIE_FIRST, corners=marching.CORNERS_CLOSED, seed=0, most=10000):
    rng = np.zeros(RNG_WORDS, np.uint64)
    seed_mt(rng, seed)
    path = np.empty((most, 2), np.int64)
    count = marching.descend(field, *start, ties, corners, rng, path)
    return [tuple(int(k) for k in cell) for cell in path[:count]]


@pytest.mark.parametrize("seed", SEEDS)
def test_arrival_times_match_a_plain_solver(seed):
    speeds = random_speeds(seed)
    goal = tuple(int(k) for k in np.argwhere(speeds > 0)[seed * 7])
    found, expected = solve(speeds, goal), arrival_times(speeds, goal)
    np.testing.assert_array_equal(np.isinf(found), np.isinf(expected))
    reached = np.isfinite(expected)
    assert reached.sum() > 100
    np.testing.assert_allclose(found[reached], expected[reached], rtol=3e-6)


@pytest.mark.parametrize("seed", SEEDS)
def test_arrival_times_of_the_original_to_the_bit(seed):
    """It takes times that are not final into account, and cells of equal time from the last to the first."""
    speeds = random_speeds(seed)
    if seed % 2:
        speeds[speeds > 0] = 0.5
    goal = tuple(int(k) for k in np.argwhere(speeds > 0)[seed * 11])
    found = solve(speeds, goal, marching.UPWIND_ORIGINAL)
    np.testing.assert_array_equal(found, original_times(speeds, goal))
    proper = solve(speeds, goal)
    reached = np.isfinite(proper)
    assert (found[reached] <= proper[reached] * 1.00001).all()
    assert seed % 2 or (found[reached] < proper[reached] * 0.999).any()


def test_times_that_are_known():
    field = solve(np.full((1, 9), 0.5), (0, 2))
    np.testing.assert_allclose(field[0], 2.0 * np.abs(np.arange(9) - 2))
    open_field = solve(np.ones((201, 201)), (100, 100))
    i, j = np.indices((201, 201)) - 100
    far = np.hypot(i, j) > 20
    # first order: exact along the axes, up to some per cent too long in between
    ratio = open_field[far] / np.hypot(i, j)[far]
    assert ratio.min() > 0.999
    assert ratio.max() < 1.05
    np.testing.assert_array_equal(open_field, open_field.T)
    np.testing.assert_array_equal(open_field, open_field[::-1])


def test_a_closed_goal_starts_all_the_same():
    speeds = np.ones((5, 5), np.float32)
    speeds[2, 2] = 0.0
    field = solve(speeds, (2, 2))
    assert field[2, 2] == 0.0
    assert np.isfinite(field).all()
    speeds[:] = 0.0
    assert np.isfinite(solve(speeds, (2, 2))).sum() == 1


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("uniform", [False, True])
def test_paths_follow_the_originals_rules(seed, uniform):
    """Every cell of every path, ties drawn as numpy draws them; uniform speeds have many ties."""
    speeds = random_speeds(seed)
    if uniform:
        speeds[speeds > 0] = 1.0
    rng = np.random.default_rng(seed)
    goal = tuple(int(k) for k in rng.permutation(np.argwhere(speeds > 0))[0])
    field = solve(speeds, goal)
    ends = []
    for start in rng.integers(0, speeds.shape, (40, 2)).tolist():
        ends.append(walk(field, start, marching.TIE_RANDOM, marching.CORNERS_ORIGINAL, seed + 5))
        assert ends[-1] == original_path(field, tuple(start), np.random.RandomState(seed + 5))
        assert walk(field, start, corners=marching.CORNERS_ORIGINAL) == original_path(field, tuple(start))
    assert max(map(len, ends)) > 15


@pytest.mark.parametrize("seed", SEEDS)
def test_paths_lead_to_the_goal_and_cut_no_corners(seed):
    speeds = random_speeds(seed)
    goal = tuple(int(k) for k in np.argwhere(speeds > 0)[100])
    field = solve(speeds, goal)
    for start in np.argwhere(np.isfinite(field))[::9].tolist():
        path = walk(field, start)
        assert path[-1] == goal
        values = [field[cell] for cell in path]
        assert all(b < a for a, b in pairwise(values))
        for (i, j), (k, m) in pairwise(path):
            assert max(abs(i - k), abs(j - m)) == 1
            assert np.isfinite(field[i, m])
            assert np.isfinite(field[k, j])


def test_a_path_ends_where_its_array_is_full_and_where_nothing_falls():
    field = solve(np.ones((20, 20)), (0, 0))
    assert len(walk(field, (19, 19), most=5)) == 5
    assert walk(field, (0, 0)) == [(0, 0)]
    assert walk(np.full((3, 3), np.inf, np.float32), (1, 1)) == [(1, 1)]


def test_random_ties_take_every_way():
    field = solve(np.ones((15, 15)), (7, 7))
    ways = {tuple(walk(field, (0, 7), marching.TIE_RANDOM, seed=seed)) for seed in range(5)}
    assert len(ways) == 1  # straight on: no tie
    field = np.array([[1.0, 9.0, 1.0], [9.0, 2.0, 9.0], [1.0, 9.0, 1.0]], np.float32)
    ends = {walk(field, (1, 1), marching.TIE_RANDOM, seed=seed)[-1] for seed in range(40)}
    assert ends == {(0, 0), (0, 2), (2, 0), (2, 2)}
    assert walk(field, (1, 1))[-1] == (2, 2)  # the first in the order of directions


def test_goal_fields_follow_the_speed_law_and_are_kept():
    occupancy = np.zeros((40, 30), np.float32)
    occupancy[20, :25] = 1.0
    grid = GridMap("wall", occupancy, 0.25, (0.0, 0.0))
    speeds = planning_speeds(grid)
    for cell in ((3, 4), (19, 4), (18, 20), (30, 29)):
        distance = float(grid.distance[cell])
        cost = 0.2 / (1e-5 + distance**2) + (10.0 if distance < 0.3 else 0.0)
        assert speeds[cell] == pytest.approx(1 / (1 + cost), rel=1e-5)
    assert (speeds[occupancy > 0] == 0).all()
    field = goal_field(grid, (1.0, 1.0))
    assert field[grid.cell_of((1.0, 1.0))[0], grid.cell_of((1.0, 1.0))[1]] == 0.0
    assert goal_field(grid, (1.1, 1.1)) is field  # the same cell
    assert not field.flags.writeable
    np.testing.assert_array_equal(field, original_times(speeds, (4, 4)))
    proper = goal_field(grid, (1.0, 1.0), final_only=True)
    np.testing.assert_allclose(proper, arrival_times(speeds, (4, 4)), rtol=1e-5)
    assert (proper != field).any()
    assert np.isinf(field[20, :25]).all()
    path = walk(field, (39, 0))
    assert max(j for _, j in path) > 25  # round the end of the wall


def test_a_goal_out_of_reach_is_infinitely_far():
    occupancy = np.zeros((20, 20), np.float32)
    occupancy[10] = 1.0
    field = goal_field(GridMap("divided", occupancy, 0.5, (0.0, 0.0)), (1.0, 1.0))
    assert np.isinf(field[10:]).all()
    assert np.isfinite(field[:10]).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["asl", "unity_scene_map"])
def test_fields_on_the_papers_maps_match_a_plain_solver(name):
    try:
        grid = planning_map(load_map(name))
    except MissingExtraError as missing:
        pytest.skip(str(missing))
    goal = tuple(int(k) for k in np.argwhere(grid.signed_distance() > 0.5)[50])
    speeds = planning_speeds(grid)
    np.testing.assert_array_equal(goal_field(grid, grid.centre_of(goal)), original_times(speeds, goal))
    field = goal_field(grid, grid.centre_of(goal), final_only=True)
    expected = arrival_times(speeds, goal)
    np.testing.assert_array_equal(np.isinf(field), np.isinf(expected))
    reached = np.isfinite(expected)
    np.testing.assert_allclose(field[reached], expected[reached], rtol=1e-4)
