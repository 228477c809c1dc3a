"""ORCA against RVO2 itself (pyrvo 0.4.3 wraps RVO2 2.0.3) and against a slow implementation of our own."""

from __future__ import annotations

import os
import platform
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from navrep_data.errors import ConfigError
from navrep_data.sim import Simulator, make_config
from navrep_data.sim._obstacles import build_obstacles, make_obstacles
from navrep_data.sim._orca import make_orca_work, orca_velocity
from navrep_data.sim._orca_lp import program2, program3
from navrep_data.sim._orca_neighbors import WORK_EDGE, WORK_LINE, WORK_PROJ, obstacle_neighbors
from navrep_data.sim.config import orca_params
from navrep_data.sim.orca import obstacle_arrays, orca_velocities

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import oracles_orca

JIT = os.environ.get("NUMBA_DISABLE_JIT", "0") != "1"
# Compilers may fuse multiply and add on other machines, so that RVO2 itself rounds differently there.
BITS = platform.machine() in ("x86_64", "AMD64")
SETTINGS = (10.0, 10, 5.0, 5.0, 0.2)


def box(x, y, hx, hy):
    return np.array([[x + hx, y + hy], [x - hx, y + hy], [x - hx, y - hy], [x + hx, y - hy]])


def border(half):
    return np.array([[half, half], [half, -half], [-half, -half], [-half, half]])


def scene(rng, spread=10.0, agents=None, obstacles=None, edge=True):
    """Draw a world as the training environment does, its agents within `spread` metres of the centre."""
    n = int(rng.integers(10, 31)) if agents is None else agents
    count = int(rng.integers(0, 21)) if obstacles is None else obstacles
    polygons = []
    for k in range(count):
        x, y = rng.integers(-70, 70, 2) * 0.1
        if k % 2:
            hx, hy = 0.5, rng.integers(2, 4) / 2
            hx, hy = (hx, hy) if rng.random() < 0.5 else (hy, hx)
            polygons.append(box(x, y, 1.25 * hx, 1.25 * hy))
        else:
            c = rng.uniform(0.35, 1.05)
            polygons.append(box(x, y, c, c))
    if edge:
        polygons.append(border(11.5))
    position = rng.uniform(-spread, spread, (n, 2))
    heading = rng.uniform(0, 2 * np.pi, n)
    velocity = np.stack([np.cos(heading), np.sin(heading)], 1) * rng.random((n, 1))
    goal = rng.uniform(-10, 10, (n, 2))
    radius, speed = rng.uniform(0.3, 0.5, n) + 0.01, rng.uniform(0.8, 1.2, n)
    return SimpleNamespace(
        position=position, velocity=velocity, radius=radius, speed=speed, goal=goal, polygons=polygons,
        preferred=toward(goal, position),
    )  # fmt: skip


def toward(goal, position):
    way = goal - position
    distance = np.linalg.norm(way, axis=1, keepdims=True)
    return np.where(distance > 1, way / np.maximum(distance, 1), way)


def ours(s, settings=SETTINGS):
    names = ("neighbor_dist", "max_neighbors", "time_horizon", "time_horizon_obst", "time_step")
    with np.errstate(all="ignore"):  # without the compiler, RVO2's own divisions by zero would warn
        keywords = dict(zip(names, settings, strict=True))
        return orca_velocities(s.position, s.velocity, s.radius, s.speed, s.preferred, s.polygons, **keywords)


def slow(s, settings=SETTINGS):
    return oracles_orca.orca_velocities(
        s.position, s.velocity, s.radius, s.speed, s.preferred, s.polygons, settings=settings
    )  # fmt: skip


def pair(v):
    return float(v[0]), float(v[1])


def rvo2(s, settings=SETTINGS):
    pyrvo = pytest.importorskip("pyrvo")
    distance, most, tau, tau_obst, dt = settings
    sim = pyrvo.RVOSimulator(dt, distance, most, tau, tau_obst, 0.3, 1.0)
    for p, v, r, m in zip(s.position, s.velocity, s.radius, s.speed, strict=True):
        sim.add_agent(pair(p), distance, most, tau, tau_obst, float(r), float(m), pair(v))
    for polygon in s.polygons:
        sim.add_obstacle([pair(p) for p in polygon])
    if len(s.polygons):
        sim.process_obstacles()
    for i, v in enumerate(s.preferred):
        sim.set_agent_pref_velocity(i, pair(v))
    sim.do_step()
    return np.array([sim.get_agent_velocity(i).to_tuple() for i in range(len(s.position))], np.float32), sim


def assert_same(got, want):
    assert got.dtype == np.float32
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-5)
    if BITS:
        np.testing.assert_array_equal(got, want)


# --- adversarial scenes -------------------------------------------------------------------------------------


def on_a_grid(rng):
    """Everything on a half-metre grid: equal distances, shared corners, collinear edges, agents on agents."""
    s = scene(rng, agents=10, obstacles=0)
    s.position = rng.integers(-6, 7, (10, 2)) * 0.5
    s.velocity = rng.integers(-1, 2, (10, 2)) * 0.5
    s.preferred = rng.integers(-2, 3, (10, 2)) * 0.5
    s.radius = np.full(10, 0.5)
    s.speed = np.full(10, 1.0)
    s.polygons = [box(*(rng.integers(-6, 7, 2) * 0.5), *(rng.integers(1, 4, 2) * 0.5)) for _ in range(8)] + [
        border(4.0)
    ]
    return s


def inside_obstacles(rng):
    s = scene(rng, spread=6.0, agents=20, obstacles=20)
    for k in range(len(s.position)):
        s.position[k] = rng.permutation(s.polygons[k])[:2].mean(0) if k % 2 else s.polygons[k].mean(0)
    return s


def at_corners(rng):
    s = scene(rng, agents=12, obstacles=12)
    for k in range(12):
        s.position[k] = s.polygons[k][k % 4] + (rng.normal(0, 0.3, 2) if k % 3 else 0.0)
    return s


def touching(rng):
    s = scene(rng, spread=1.0, agents=9, obstacles=2)
    s.position = np.stack(np.meshgrid([-0.8, 0.0, 0.8], [-0.8, 0.0, 0.8]), -1).reshape(-1, 2)
    s.radius = np.full(9, 0.4)
    return s


def coincident(rng):
    s = scene(rng, agents=8, obstacles=4)
    s.position[4:] = s.position[:4]
    s.velocity[4:6] = s.velocity[0:2]
    return s


def standing(rng):
    s = scene(rng)
    s.velocity[:] = 0
    s.preferred[::2] = 0
    return s


def thin_and_concave(rng):
    """Walls without thickness, an L, a star, slivers, and a polygon of many short edges."""
    s = scene(rng, spread=5.0, agents=10, obstacles=3)
    a = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    star = np.stack([np.cos(a), np.sin(a)], 1) * np.where(np.arange(24) % 2, 1.0, 2.5)[:, None]
    s.polygons += [
        np.array([[-4.0, 1.0], [3.0, 1.2]]),
        np.array([[0, 0], [3, 0], [3, 1], [1, 1], [1, 3], [0, 3.0]]) + rng.uniform(-4, 2, 2),
        star + rng.uniform(-4, 4, 2),
        box(*rng.uniform(-5, 5, 2), 0.002, 1.5),
        np.stack([np.cos(2 * a), np.sin(a)], 1)[:23:2] * 0.01 + rng.uniform(-3, 3, 2),
    ]
    return s


ADVERSARIAL = (on_a_grid, inside_obstacles, at_corners, touching, coincident, standing, thin_and_concave)


@pytest.mark.parametrize("spread", [10.0, 3.0, 1.5])
def test_random_scenes_equal_rvo2(spread):
    rng = np.random.default_rng(int(spread * 10))
    for _ in range(150 if JIT else 2):
        s = scene(rng, spread)
        want, sim = rvo2(s)
        assert obstacle_arrays(s.polygons)[2] == sim.get_num_obstacle_vertices()
        assert_same(ours(s), want)


@pytest.mark.slow
@pytest.mark.parametrize("make", ADVERSARIAL, ids=lambda f: f.__name__)
def test_adversarial_scenes_equal_rvo2(make):
    rng = np.random.default_rng(7)
    for _ in range(100 if JIT else 2):
        s = make(rng)
        assert_same(ours(s), rvo2(s)[0])


@pytest.mark.slow
def test_many_scenes_equal_rvo2():
    rng = np.random.default_rng(1)
    for k in range(3000 if JIT else 10):
        s = scene(rng, (10.0, 4.0, 2.0)[k % 3]) if k % 2 else ADVERSARIAL[k // 2 % len(ADVERSARIAL)](rng)
        assert_same(ours(s), rvo2(s)[0])


@pytest.mark.parametrize(
    "settings",
    [
        (3.0, 3, 2.0, 1.0, 0.1),
        (10.0, 0, 5.0, 5.0, 0.2),
        (100.0, 40, 10.0, 20.0, 0.5),
        (0.5, 2, 0.5, 0.1, 1.0),
    ],
)
def test_other_settings_equal_rvo2(settings):
    rng = np.random.default_rng(3)
    for _ in range(40 if JIT else 1):
        s = scene(rng, 4.0)
        assert_same(ours(s, settings), rvo2(s, settings)[0])


@pytest.mark.slow
def test_rollouts_equal_rvo2():
    rng = np.random.default_rng(5)
    for _ in range(10 if JIT else 1):
        s = scene(rng, 8.0, agents=15)
        for _ in range(50 if JIT else 3):
            v = ours(s)
            assert_same(v, rvo2(s)[0])
            s.position = s.position + 0.2 * v
            s.velocity = v.astype(float)
            s.preferred = toward(s.goal, s.position)


@pytest.mark.slow
def test_neighbours_at_the_end_of_the_range_equal_the_walk():
    """RVO2's walk prunes by distances to lines, which rounding can put beyond the range before the edge itself."""
    rng = np.random.default_rng(11)
    cut = 0
    for k in range(60 if JIT else 4):
        s = thin_and_concave(rng) if k % 3 == 1 else scene(rng, agents=1, obstacles=12)
        if k % 3 == 2:  # specks, whose lines leave the side of other edges open by decimetres
            s.polygons += [box(*rng.uniform(-4, 4, 2), 1e-4, 1e-4) for _ in range(12)]
        edges = oracles_orca.make_edges(s.polygons)
        tree = oracles_orca.build_tree(list(edges), edges)
        index = {id(e): j for j, e in enumerate(edges)}
        f, i, n = obstacle_arrays(s.polygons)
        work_f, work_i = make_orca_work(f.shape[1], 1)
        for _ in range(10):
            corner = edges[rng.integers(n)].point  # straight out from a corner, along an axis
            x, y = np.float32([corner.x, corner.y])
            x, y = (
                (x + np.float32(rng.uniform(-6, 6)), y)
                if rng.random() < 0.5
                else (x, y + np.float32(rng.uniform(-6, 6)))
            )
            p = oracles_orca.V(x, y)
            with np.errstate(all="ignore"):
                all_of_them: list = []
                oracles_orca.walk(tree, p, np.float32(np.inf), all_of_them)
                for d in [d for d, _ in all_of_them if d > 0][:12]:
                    range_sq = np.nextafter(d, np.float32(np.inf))
                    want: list = []
                    oracles_orca.walk(tree, p, range_sq, want)
                    got = obstacle_neighbors(x, y, range_sq, f, i, n, work_f, work_i)
                    assert list(work_i[WORK_EDGE, :got]) == [index[id(e)] for _, e in want]
                    cut += len(want) < sum(other < range_sq for other, _ in all_of_them)
    assert cut > 0 or not JIT, "no scene in which the walk loses an edge: this test would show nothing"


@pytest.mark.parametrize("x", [-0.3, 0.3])
def test_a_speck_of_an_edge_hides_what_sticks_out_behind_it(x):
    """The wall ends 5 cm on the agent's side of the speck's line, which RVO2 forgives, and so prunes the wall."""
    polygons = [np.array([[0.0, 0.0], [1e-4, 0.0]]), np.array([[0.0, -0.05], [0.0, 3.0]])]
    edges = oracles_orca.make_edges(polygons)
    tree = oracles_orca.build_tree(list(edges), edges)
    f, i, n = obstacle_arrays(polygons)
    work_f, work_i = make_orca_work(f.shape[1], 1)
    counts = []
    for range_sq in np.float32([3.95, 4.5]):
        want: list = []
        oracles_orca.walk(tree, oracles_orca.V(x, -2.0), range_sq, want)
        got = obstacle_neighbors(np.float32(x), np.float32(-2.0), range_sq, f, i, n, work_f, work_i)
        assert got == len(want)
        counts.append(got)
    assert counts[0] == 0 < counts[1]


@pytest.mark.slow
@pytest.mark.parametrize("kinds", [3, 8, 1000])
def test_linear_programs_equal_the_slow_ones(kinds):
    """Lines of few directions: parallel ones of both senses, infeasible programs, failures among obstacle lines."""
    rng = np.random.default_rng(kinds)
    work = make_orca_work(16, 16)[0]
    fails = set()
    for _ in range(2000 if JIT else 60):
        n, n_obstacle = int(rng.integers(1, 12)), int(rng.integers(0, 6))
        n_obstacle = min(n, n_obstacle)
        angle = rng.integers(0, kinds, n) * (2 * np.pi / kinds) + rng.choice([0.0, 4e-6], n)  # nearly parallel too
        rows = np.stack([*rng.normal(0, 0.7, (2, n)), np.cos(angle), np.sin(angle)], 1).astype(np.float32)
        work[:] = 7.0  # scratch is never clean
        lines = work[WORK_LINE]
        lines[: 4 * n] = rows.ravel()
        x, y = np.float32(rng.normal(0, 0.7, 2))
        speed = np.float32(rng.uniform(0.5, 1.5))
        slow_lines = [(oracles_orca.V(*r[:2]), oracles_orca.V(*r[2:])) for r in rows]
        with np.errstate(all="ignore"):
            failed, gx, gy = program2(lines, n, speed, x, y, False)
            slow_failed, best = oracles_orca.program2(slow_lines, speed, oracles_orca.V(x, y), False)
            assert (failed, gx, gy) == (slow_failed, best.x, best.y)
            if failed < n:
                fails.add(failed < n_obstacle)
                gx, gy = program3(lines, n_obstacle, n, failed, speed, gx, gy, work[WORK_PROJ])
                best = oracles_orca.program3(slow_lines, n_obstacle, failed, speed, best)
                assert (gx, gy) == (best.x, best.y)
    assert fails == {True, False}


@pytest.mark.slow
@pytest.mark.parametrize("make", [scene, *ADVERSARIAL], ids=lambda f: f.__name__)
def test_equal_to_the_slow_implementation(make):
    rng = np.random.default_rng(13)
    for _ in range(4 if JIT else 1):
        s = make(rng)
        np.testing.assert_array_equal(ours(s), slow(s))


def test_edges_after_splitting_equal_the_slow_tree():
    rng = np.random.default_rng(17)
    for k in range(12 if JIT else 2):
        s = thin_and_concave(rng) if k % 2 else scene(rng, agents=1)
        edges = oracles_orca.make_edges(s.polygons)
        tree = oracles_orca.build_tree(list(edges), edges)
        f, i, n = obstacle_arrays(s.polygons)
        assert n == len(edges)
        index = {id(e): j for j, e in enumerate(edges)}
        np.testing.assert_array_equal(f[0, :n], [e.point.x for e in edges])
        np.testing.assert_array_equal(f[1, :n], [e.point.y for e in edges])
        np.testing.assert_array_equal(i[0, :n], [index[id(e.next)] for e in edges])
        np.testing.assert_array_equal(i[1, :n], [index[id(e.prev)] for e in edges])
        np.testing.assert_array_equal(i[2, :n], [e.convex for e in edges])
        todo = [(tree, -1, 0, 0)]
        while todo:
            node, parent, side, depth = todo.pop()
            j = index[id(node.edge)]
            assert (i[3, j], i[4, j]) == (parent, depth)
            assert parent < 0 or i[5, j] == side
            todo += [(c, j, k, depth + 1) for k, c in enumerate((node.left, node.right)) if c is not None]


def test_too_small_capacity_says_so():
    polygons = [box(0, 0, 1, 1), box(1.5, 0.3, 1, 0.2), box(-1, 2, 0.3, 3)]
    vertices, start = np.concatenate(polygons), np.arange(0, 13, 4)
    n = obstacle_arrays(polygons)[2]
    assert n > 12
    for capacity in range(n):
        assert build_obstacles(vertices, start, *make_obstacles(capacity)) == -1
    assert build_obstacles(vertices, start, *make_obstacles(n)) == n
    assert build_obstacles(vertices, start[:1], *make_obstacles(n)) == 0


@pytest.mark.slow
@pytest.mark.parametrize("extra", [0, -1])
def test_an_agent_sees_its_rows_and_the_extra_one(extra):
    rng = np.random.default_rng(19)
    for _ in range(20 if JIT else 2):
        s = scene(rng, 2.0, agents=8)
        rows = np.column_stack([s.position, s.velocity, s.radius, s.speed]).astype(np.float32)
        f, i, n = obstacle_arrays(s.polygons)
        with np.errstate(all="ignore"):
            got = orca_velocity(
                3, rows, 1, 8, extra, np.float32(s.preferred[3, 0]), np.float32(s.preferred[3, 1]), f, i, n,
                np.array([*SETTINGS, 0.0], np.float32), *make_orca_work(f.shape[1], 8),
            )  # fmt: skip
        # an agent that nobody sees is out of range
        if extra < 0:
            s.position[0] += 1000.0
        np.testing.assert_array_equal(np.float32(got), rvo2(s)[0][3])


def test_the_robot_outside_the_rows_sees_all_of_them():
    s = scene(np.random.default_rng(23), 2.0, agents=6)
    rows = np.column_stack([s.position, s.velocity, s.radius, s.speed]).astype(np.float32)
    f, i, n = obstacle_arrays(s.polygons)
    with np.errstate(all="ignore"):
        got = orca_velocity(
            0, rows, 1, 6, -1, np.float32(s.preferred[0, 0]), np.float32(s.preferred[0, 1]), f, i, n,
            np.array([*SETTINGS, 0.0], np.float32), *make_orca_work(f.shape[1], 6),
        )  # fmt: skip
    np.testing.assert_array_equal(np.float32(got), rvo2(s)[0][0])


@pytest.mark.parametrize("physics", ["consistent", "original"])
def test_the_largest_speed_holds_in_consistent_physics(physics):
    """A crowd in which RVO2 lets a human of this world go 0.076 m/s faster than it can."""
    sim = Simulator(make_config("soadrl"), 1, seed=2, first_sequence=28)
    sim.arrays.orca_params[:] = orca_params(make_config("soadrl", physics=physics))
    excess = []
    for _ in range(49):
        sim.step(np.zeros((1, 3)))
        humans = sim.state().humans
        excess.append(float((np.hypot(humans[:, 2], humans[:, 3]) - humans[:, 8]).max()))
    if physics == "consistent":
        assert max(excess) <= 1.1e-5
    else:
        assert max(excess[:-1]) < 1e-4
        assert excess[-1] > 0.07


def test_no_agents_and_no_obstacles():
    assert orca_velocities([], [], 0.3, 1.0, []).shape == (0, 2)
    v = orca_velocities([[0, 0]], [[0, 0]], 0.3, 1.0, [[3, 4]])
    np.testing.assert_allclose(v, [[0.6, 0.8]], atol=1e-6)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"positions": [[0, 0, 0]]}, r"positions has shape \(1, 3\); expected \(N, 2\)"),
        ({"velocities": [[0, 0], [0, 0]]}, r"velocities has shape \(2, 2\); expected \(1, 2\)"),
        ({"preferred": [[np.nan, 0]]}, "preferred holds NaN or infinity"),
        ({"radii": [0.3, 0.3]}, r"radii has shape \(2,\); expected \(1,\)"),
        ({"max_speeds": -1.0}, "max_speeds holds -1"),
        ({"polygons": [[[0, 0]]]}, r"polygons\[0\] has 1 vertices"),
        ({"polygons": [[[0, 0], [1, np.inf]]]}, r"polygons\[0\] holds NaN"),
        ({"time_horizon": 0.0}, "time_horizon is 0.0"),
        ({"max_neighbors": -1}, "max_neighbors is -1"),
    ],
)
def test_wrong_arguments_are_named(change, words):
    arguments = {
        "positions": [[0, 0]], "velocities": [[0, 0]], "radii": 0.3, "max_speeds": 1.0, "preferred": [[1, 0]],
    }  # fmt: skip
    with pytest.raises(ConfigError, match=words):
        orca_velocities(**{**arguments, **change})
