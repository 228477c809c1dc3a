from __future__ import annotations

import numpy as np
import pytest
from numba import config
from scipy import ndimage

from navrep_data.errors import ConfigError, MissingExtraError
from navrep_data.sim._map_contours import outlines
from navrep_data.sim._orca import make_orca_work, orca_velocity
from navrep_data.sim.map_obstacles import orca_table, orca_tables
from navrep_data.sim.maps import GridMap, load_map

PURE_PYTHON = bool(config.DISABLE_JIT)


def area(polygon):
    x, y = polygon.T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


def blobs(seed, shape=(40, 30), smooth=1.5):
    rng = np.random.default_rng(seed)
    return ndimage.gaussian_filter(rng.random(shape), smooth) > 0.53


def along(polygon, step=0.1):
    """Points along a closed polygon."""
    out = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        n = max(2, int(np.hypot(*(b - a)) / step) + 1)
        out.append(a + np.linspace(0, 1, n)[:, None] * (b - a))
    return np.concatenate(out)


def farthest(points, polygons):
    """Return the largest distance of the points from the nearest edge."""
    best = np.full(len(points), np.inf)
    for polygon in polygons:
        for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
            e = b - a
            share = np.clip((points - a) @ e / max(e @ e, 1e-12), 0, 1)
            best = np.minimum(best, np.hypot(*(points - a - share[:, None] * e).T))
    return best.max()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_exact_outlines_enclose_the_solid_cells(seed):
    solid = np.random.default_rng(seed).random((25, 19)) < 0.4 if seed % 2 else blobs(seed)
    lines = outlines(solid, 0.0)
    assert sum(map(area, lines)) == solid.sum()
    # cells that touch at corners are one: as many outer lines as pieces, inner lines as pieces of enclosed ground
    pieces = ndimage.label(solid, np.ones((3, 3)))[1]
    ground = ndimage.label(np.pad(~solid, 1, constant_values=True))[1]
    assert sum(area(line) > 0 for line in lines) == pieces
    assert sum(area(line) < 0 for line in lines) == ground - 1
    sides = np.abs(np.diff(np.pad(solid, 1).astype(int), axis=0)).sum()
    sides += np.abs(np.diff(np.pad(solid, 1).astype(int), axis=1)).sum()
    assert sum(np.hypot(*(np.roll(line, -1, axis=0) - line).T).sum() for line in lines) == sides
    for line in lines:
        before, after = line - np.roll(line, 1, axis=0), np.roll(line, -1, axis=0) - line
        assert (np.abs(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]) > 0).all(), (
            "a corner on a straight line"
        )


@pytest.mark.slow
@pytest.mark.parametrize("tolerance", [0.3, 0.5, 1.0, 2.5])
def test_simplified_outlines_stay_within_the_tolerance(tolerance):
    for seed in range(1 if PURE_PYTHON else 4):
        solid = blobs(seed)
        exact, simple = outlines(solid, 0.0), outlines(solid, tolerance)
        assert tolerance < 0.5 or sum(map(len, simple)) < sum(map(len, exact))
        assert farthest(np.concatenate([along(line) for line in simple]), exact) <= tolerance + 1e-9
        assert farthest(np.concatenate([along(line) for line in exact]), simple) <= tolerance + 1e-9
        assert min(map(len, simple)) >= 2


def test_stairs_become_a_slope():
    i, j = np.indices((30, 30))
    (line,) = outlines(i > j, 0.5)
    assert len(line) <= 6


def test_contours_are_in_the_world_frame():
    occupancy = np.zeros((6, 5), np.float32)
    occupancy[2, 1:3] = 1.0
    occupancy[4, 4] = 0.3
    grid = GridMap("x", occupancy, 0.5, (-1.0, 2.0))
    (line,) = grid.contours()
    assert sorted(map(tuple, line.tolist())) == [(0.0, 2.5), (0.0, 3.5), (0.5, 2.5), (0.5, 3.5)]
    assert area(line) == pytest.approx(0.5)
    assert len(grid.contours(unknown_is_solid=True)) == 2
    assert grid.contours() is grid.contours(0.0)
    # with a radius the end of the map is a wall, seen from inside: clockwise
    bare = GridMap("y", np.zeros((40, 40)), 0.1, (0.0, 0.0)).contours(0.05, radius=0.3)
    assert len(bare) == 1
    assert area(bare[0]) == pytest.approx(-16.0, abs=0.5)


def wide_map(seed=1):
    rng = np.random.default_rng(seed)
    solid = ndimage.gaussian_filter(rng.random((240, 200)), 6.0) > 0.515
    return GridMap("blobs", solid, 0.05, (-3.0, -2.0))


def chosen_velocity(tables, position, others, number=None):
    table = number
    if table is None:
        table = orca_table(*position, tables.x0, tables.y0, tables.bucket, tables.index)
    agents = np.array([[*position, 0.3, 0.4, 0.3, 0.8], *others], np.float32)
    params = np.array([5.0, 10, 5.0, 2.0, 0.2, 0.0], np.float32)
    work_f, work_i = make_orca_work(tables.edges_f.shape[2], 16)
    return orca_velocity(
        0, agents, 0, len(agents), -1, np.float32(0.3), np.float32(0.5), tables.edges_f[table], tables.edges_i[table],
        int(tables.counts[table]), params, work_f, work_i,
    )  # fmt: skip


def test_the_table_of_a_place_gives_the_velocity_of_all_edges():
    grid = wide_map()
    tables = orca_tables(grid, 1.9)
    # one bucket as large as the map: every edge that some agent could see
    everything = orca_tables(grid, 1.9, bucket=100.0)
    assert len(everything.counts) == 2
    assert everything.counts[1] == sum(map(len, grid.contours(0.05, radius=0.25)))
    assert tables.counts.max() < 0.5 * everything.counts[1]
    rng = np.random.default_rng(0)
    ground = np.argwhere(grid.signed_distance() > 0.32)
    different = 0
    for cell in ground[rng.integers(len(ground), size=10 if PURE_PYTHON else 300)]:
        position = grid.centre_of(cell) + rng.uniform(-0.02, 0.02, 2)
        others = [[*(position + rng.uniform(-2, 2, 2)), *rng.uniform(-1, 1, 2), 0.3, 0.8] for _ in range(3)]
        expected = chosen_velocity(everything, position, others)
        assert chosen_velocity(tables, position, others) == expected
        different += chosen_velocity(tables, position, others, 0) != expected
    assert different > (0 if PURE_PYTHON else 30), "walls must matter to some"


def test_agents_keep_off_walls():
    occupancy = np.zeros((80, 60), np.float32)
    occupancy[:, 40:] = 1.0
    tables = orca_tables(GridMap("wall", occupancy, 0.1, (0.0, 0.0)), 1.9)
    x, y = chosen_velocity(tables, (4.0, 3.6), [])
    assert x == pytest.approx(0.3, abs=1e-3)
    # 0.4 m of ground less a radius of 0.3 m, in 2 s; the edge is within 0.05 m of the wall
    assert 0.02 <= y <= 0.08


def test_places_off_the_map_have_an_empty_table():
    tables = orca_tables(wide_map(), 1.9)
    assert orca_table(-50.0, 0.0, tables.x0, tables.y0, tables.bucket, tables.index) == 0
    assert orca_table(0.0, 50.0, tables.x0, tables.y0, tables.bucket, tables.index) == 0
    assert tables.counts[0] == 0


@pytest.mark.parametrize("change", [{"reach": 0.0}, {"reach": np.inf}, {"reach": 1.0, "bucket": -1.0}])
def test_lengths_must_be_positive(change):
    with pytest.raises(ConfigError, match="expected a positive number of metres"):
        orca_tables(wide_map(), **change)


@pytest.mark.slow
def test_tables_of_the_office_are_small():
    try:
        office = load_map("asl_office_j")
    except MissingExtraError as missing:
        pytest.skip(str(missing))
    assert sum(map(len, office.contours())) > 40_000
    assert orca_tables(office, 1.9).counts.max() < 128
