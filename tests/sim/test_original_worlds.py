"""Worlds of the original physics: order of draws, grid, border, streams; against a slow recipe on numpy's generator."""

import numba
import numpy as np
import pytest
from scipy import ndimage

from navrep_data.errors import ConfigError, SimulationError, UnknownNameError
from navrep_data.sim import Simulator, _original, environment_names, make_config, numpy_seed
from navrep_data.sim import _layout as lay
from navrep_data.sim._original import CELLS, set_cells, window_hits

SEEDS = 10 if numba.config.DISABLE_JIT else 50


def recipe(seed, square, scale):
    """Draw an episode with numpy's legacy generator; returns robot, humans before the hidden step, polygons, cells."""
    r = np.random.RandomState(seed)
    v_pref, radius = r.uniform(0.8, 1.2), r.uniform(0.3, 0.5)
    ring = min(9.0, 4.0 * (1 + 2 * r.random_sample()))
    agents = [(0.0, -ring, 0.0, ring, radius, v_pref, True)]
    n_humans = round(5 * (0.5 + r.random_sample()))
    r.random_sample()

    def free(x, y, a, b, size):
        return all(np.hypot(x - other[a], y - other[b]) >= size + other[4] + 0.2 for other in agents)

    for _ in range(n_humans):
        v, size = r.uniform(0.8, 1.2), r.uniform(0.3, 0.5)
        if square:
            side = -1 if r.random_sample() > 0.5 else 1
            while not free(x := r.random_sample() * 5 * side, y := (r.random_sample() - 0.5) * 10, 0, 1, size):
                pass
            while not free(gx := r.random_sample() * -5 * side, gy := (r.random_sample() - 0.5) * 10, 2, 3, size):
                pass
        else:
            while True:
                angle, *noise, far = r.random_sample(4)
                x = 4 * (1 + 1.5 * far) * np.cos(2 * np.pi * angle) + (noise[0] - 0.5) * v
                y = 4 * (1 + 1.5 * far) * np.sin(2 * np.pi * angle) + (noise[1] - 0.5) * v
                gx, gy = -x, -y
                if free(x, y, 0, 1, size) and free(x, y, 2, 3, size):
                    break
        agents.append((x, y, gx, gy, size, v, r.random_sample() > 0.5))
    counts = [round(10 * r.random_sample()) for _ in range(2)]
    polygons, grid = [], np.zeros((140, 140), bool)
    for kind in [0] * counts[0] + [1] * counts[1]:
        while True:
            ix, iy = r.randint(-70, 70), r.randint(-70, 70)
            cx, cy = ix * 0.1, iy * 0.1
            if kind == 0:
                w = h = 1.4 * (r.random_sample() + 0.5)
                taken = any(np.hypot(cx, cy - end) < w / 2 + radius + 0.2 for end in (-ring, ring))
            else:
                along_x = r.random_sample() > 0.5
                w, h = (r.randint(2, 4), 1) if along_x else (1, r.randint(2, 4))
                grow = radius + 0.2
                taken = any(abs(cx) < w / 2 + grow and abs(cy - end) < h / 2 + grow for end in (-ring, ring))
            if not taken:
                break
        signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
        polygons.append([cx, cy] + scale * signs * [w / 2, h / 2])
        paint(grid, ix + 70, iy + 70, round(w / 0.1), round(h / 0.1))
    heading = (np.pi / 2 + 10 * (r.random_sample() - 0.5)) % (2 * np.pi)
    return heading, np.array(agents, float), polygons, grid


def paint(grid, ix, iy, w, h):
    """Occupy an obstacle's cells one by one, as the original does."""
    whole = w / 2 < ix < 140 - w / 2 and h / 2 < iy < 140 - h / 2
    for a in range(w):
        for b in range(h):
            if whole:
                grid[round(ix - w / 2) + a, round(iy - h / 2) + b] = True
            else:
                x, y = round(ix + a - w / 2), round(iy + b - h / 2)
                if 0 < x < 140 and 0 < y < 140:
                    grid[x, y] = True


def cells_of(boxes):
    grid = np.zeros((CELLS, CELLS), bool)
    for x0, x1, y0, y1, step in boxes.astype(int):
        grid[x0:x1:step, y0:y1:step] = True
    return grid


@pytest.mark.parametrize(("env", "square", "scale"), [("navrep-test", True, 1.0), ("navrep-val", False, 1.25)])
def test_worlds_follow_the_order_of_draws(env, square, scale):
    sim = Simulator(make_config(env, physics="original"))
    for k in range(SEEDS):
        seed = numpy_seed(env, k)
        heading, agents, polygons, grid = recipe(seed, square, scale)
        sim.reset_seeded([seed])
        state = sim.state()
        np.testing.assert_allclose(state.robot, [*agents[0, :2], heading, *agents[0, 2:6]], rtol=0, atol=1e-12)
        columns = [5, 6, 7, 8, 9]
        np.testing.assert_allclose(state.humans[:, columns], agents[1:, 2:], rtol=0, atol=1e-12)
        # one hidden step of at most 1.2 m/s lies between the draw and the episode
        assert (np.hypot(*(state.humans[:, :2] - agents[1:, :2]).T) <= 0.2 * 1.2 + 1e-6).all()
        np.testing.assert_allclose(state.humans[:, :2], agents[1:, :2] + 0.2 * state.humans[:, 2:4], rtol=0, atol=1e-12)
        assert len(state.polygons) == len(polygons) + 1
        for mine, theirs in zip(state.polygons, polygons, strict=False):
            np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(cells_of(sim.arrays.boxes[0, : len(polygons)]), grid)
        gait = sim.arrays.agents[0, 1 : len(agents), [lay.A_GAIT_X, lay.A_GAIT_Y, lay.A_GAIT_T]]
        assert (gait == 0.0).all()


def test_obstacles_fill_the_cells_that_the_original_fills():
    """All sizes at all kinds of places: whole, over each edge, over corners; odd sizes over an edge are combs."""
    rng = np.random.default_rng(0)
    places = [-3, 0, 1, 3, 5, 6, 7, 60, 133, 134, 135, 136, 139]
    cases = [(x, y, n, n) for x in places for y in (2, 70, 137) for n in (7, 8, 9, 10, 13, 20, 21)]
    cases += [(x, y, w, h) for x in places for y in (0, 4, 5, 70, 135, 139) for w, h in ((10, 20), (30, 10))]
    combs = 0
    for ix, iy, w, h in cases:
        grid = np.zeros((CELLS, CELLS), bool)
        paint(grid, ix, iy, w, h)
        box = np.zeros((1, lay.BOX_FIELDS))
        set_cells(box[0], ix, iy, w, h)
        np.testing.assert_array_equal(cells_of(box), grid, err_msg=str((ix, iy, w, h)))
        combs += box[0, lay.B_STEP] == 2
        for _ in range(20):
            x, y = rng.uniform(-8, 8, 2) if rng.random() < 0.3 else (np.array([ix, iy]) + rng.normal(0, 12, 2)) / 10 - 7
            half = int(rng.integers(1, 8))
            i, j = round((x + 7) / 0.1), round((y + 7) / 0.1)
            window = grid[max(i - half, 0) : max(i + half, 0), max(j - half, 0) : max(j + half, 0)]
            assert window_hits(box, 1, x, y, half) == window.any(), (ix, iy, w, h, x, y, half)
    assert combs > 20


def test_window_is_one_cell_shorter_on_the_upper_side():
    """A robot at cell 70 with a window of 3 cells sees cells 67 to 72."""
    for cell, hit in ((66, False), (67, True), (72, True), (73, False)):
        along_x, along_y = np.zeros((1, lay.BOX_FIELDS)), np.zeros((1, lay.BOX_FIELDS))
        along_x[0] = cell, cell + 1, 60, 80, 1
        along_y[0] = 60, 80, cell, cell + 1, 1
        assert window_hits(along_x, 1, 0.0, 0.0, 3) == hit
        assert window_hits(along_y, 1, 0.0, 0.0, 3) == hit


def test_off_the_grid_nothing_is_hit():
    box = np.zeros((1, lay.BOX_FIELDS))
    box[0] = 0, CELLS, 0, CELLS, 1
    assert window_hits(box, 1, 6.9, -6.9, 3)
    assert not window_hits(box, 1, 7.5, 0.0, 3)
    assert not window_hits(box, 1, 0.0, -7.5, 3)


def test_humans_do_not_know_the_border_and_the_robot_does():
    sim = Simulator(make_config("navrep-train", physics="original", obstacles=0), n_worlds=3, seed=2)
    assert (sim.arrays.scalars[:, lay.S_OBST_HUMAN] == 0).all()
    assert (sim.arrays.scalars[:, lay.S_OBST_ROBOT] == 4).all()
    assert (sim.arrays.scalars[:, lay.S_BORDER] == 1).all()


@pytest.mark.slow
def test_start_headings_are_as_uneven_as_the_originals():
    """Of the 10 rad about pi/2, those that are met twice round the circle come twice as often."""
    n = 40 if numba.config.DISABLE_JIT else 2000
    sim = Simulator(make_config("navrep-train", physics="original", humans=0, obstacles=0), n_worlds=n, seed=5)
    heading = np.array([sim.state(w).robot[2] for w in range(n)])
    # the ends of the window, pi/2 -+ 5, lie at 2.85 and 0.29 rad: between 0.29 and 2.85 headings are met once
    once = np.mean((heading > np.pi / 2 + 5 - 2 * np.pi) & (heading < np.pi / 2 - 5 + 2 * np.pi))
    assert abs(once - (4 * np.pi - 10) / 10) < 5 * np.sqrt(0.26 * 0.74 / n)


def test_seeded_resets_leave_the_worlds_own_streams_alone():
    config = make_config("navrep-test", physics="original")
    sim, other = (Simulator(config, n_worlds=2, seed=7) for _ in range(2))
    sim.reset_seeded([1003, 0], mask=[True, False])
    np.testing.assert_array_equal(sim.state(1).robot, other.state(1).robot)
    alone = Simulator(config)
    alone.reset_seeded([1003])
    np.testing.assert_array_equal(sim.state(0).robot, alone.state(0).robot)
    sim.reset()
    other.reset()
    for w in range(2):
        np.testing.assert_array_equal(sim.state(w).humans, other.state(w).humans)


def test_consistent_worlds_can_be_numpy_seeded_too():
    sim = Simulator(make_config("navrep-test"), n_worlds=2)
    sim.reset_seeded([5, 5])
    np.testing.assert_array_equal(sim.state(0).humans, sim.state(1).humans)


@pytest.mark.parametrize(
    ("seeds", "words"),
    [
        ([1, 2], r"numpy_seeds have shape \(2,\)"),
        ([0.5], "dtype float64, expected"),
        ([-1], r"numpy_seeds are \[-1\], expected whole numbers from 0 to 4294967295"),
        ([2**32], "expected whole numbers from 0 to 4294967295"),
    ],
)
def test_wrong_seeds_are_refused(seeds, words):
    with pytest.raises(ConfigError, match=words):
        Simulator(make_config("navrep-test", humans=0, obstacles=0)).reset_seeded(seeds)


def test_episodes_are_numbered_as_in_the_original():
    assert [numpy_seed("navrep-test", k) for k in (0, 499, 500)] == [1000, 1499, 1000]
    assert [numpy_seed("navrep-val", k) for k in (0, 49, 50)] == [0, 49, 0]
    with pytest.raises(ConfigError, match="no numbered episodes; those that do: navrep-val, navrep-test"):
        numpy_seed("soadrl", 0)
    with pytest.raises(ConfigError, match="episode is -1, expected"):
        numpy_seed("navrep-test", -1)
    with pytest.raises(UnknownNameError, match="Did you mean 'navrep-test'"):
        numpy_seed("navrep-tset", 0)


@pytest.mark.slow
@pytest.mark.parametrize("physics", ["consistent", "original"])
@pytest.mark.parametrize("env", environment_names())
def test_every_environment_runs_in_both_physics(env, physics):
    sim = Simulator(make_config(env, physics=physics), seed=3)
    robots = sim.config.robots
    command = np.array([[0.3, 0.0, 0.1]])
    rewards, events = sim.step(command if robots == 1 else np.tile(command[:, None], (1, robots, 1)))
    scans, states = sim.observe()
    assert np.isfinite([*rewards.ravel(), *states.ravel()]).all()
    assert 0 < scans.min() <= scans.max() <= np.float32(sim.config.sensor.range_max)
    assert events[0] >= 0
    assert repr(sim) == f"Simulator({env}, {physics}, n_worlds=1)"


@pytest.mark.parametrize(
    ("env", "fields", "value"),
    [
        ("navrep-test", [lay.P_RADIUS_LOW, lay.P_RADIUS_HIGH], 12.0),
        ("navrep-val", [lay.P_RADIUS_LOW, lay.P_RADIUS_HIGH], 12.0),
        ("soadrl", [lay.P_DANGER_DIST], 30.0),
    ],
)
def test_worlds_without_room_fail_and_do_not_hang(env, fields, value, monkeypatch):
    if numba.config.DISABLE_JIT:  # where 100,000 draws take minutes
        monkeypatch.setattr(_original, "PLACE_LIMIT", 50)
    sim = Simulator(make_config(env, physics="original"), seed=1)
    sim.arrays.params[fields] = value
    with pytest.raises(SimulationError, match="could be drawn: no free place, or more than 512 obstacle edges"):
        sim.reset()
    with pytest.raises(SimulationError, match=f"No world with humans={sim.config.humans}, obstacles=10 could"):
        sim.reset_seeded([7])


def test_obstacles_without_room_fail(monkeypatch):
    """With nobody about and a robot as large as the map no obstacle finds a place."""
    if numba.config.DISABLE_JIT:
        monkeypatch.setattr(_original, "PLACE_LIMIT", 50)
    sim = Simulator(make_config("soadrl", physics="original", humans=0), seed=1)
    sim.arrays.params[lay.P_DANGER_DIST] = 30.0
    with pytest.raises(SimulationError, match="No world with humans=0"):
        sim.reset()


@pytest.mark.slow
@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="1,100 worlds take long without compilation")
def test_all_numbered_episodes_can_be_drawn():
    """None needs more obstacle edges or draws than there is room for."""
    for env, count in (("navrep-test", 500), ("navrep-val", 50)):
        sim = Simulator(make_config(env, physics="original"))
        for k in range(count):
            sim.reset_seeded([numpy_seed(env, k)])


PAD = 60
LEAP = 0.2 * np.sqrt(2.0)


def ways_to_the_goal(sim: Simulator) -> tuple[bool, bool]:
    """Return whether the robot gets to the goal by steps from cell to neighbouring cell, and by the longest leaps.

    Whether a place is a collision depends on its cell alone (SIM_FACTS a.8), off the grid on the border too. The first
    is a way that a robot can drive slowly; where not even leaps lead there, which pass over what lies between as the
    original's steps do, there is none.
    """
    a, scalars = sim.arrays, sim.arrays.scalars[0]
    x, y, gx, gy, radius = a.agents[0, 0, [lay.A_X, lay.A_Y, lay.A_GX, lay.A_GY, lay.A_RADIUS]]
    solid = np.zeros((140, 140), bool)
    for x0, x1, y0, y1, step in a.boxes[0, : int(scalars[lay.S_POLYGONS]) - 1].astype(int):
        columns, rows = (np.arange(low, high) for low, high in ((x0, x1), (y0, y1)))
        solid[np.ix_(columns[columns % step == 0], rows[rows % step == 0])] = True
    half = int(np.ceil(radius / np.sqrt(2.0) / 0.1))
    solid = np.pad(solid, PAD)
    hit = np.zeros_like(solid)
    for i in range(-half, half):
        for j in range(-half, half):
            hit |= np.roll(solid, (-i, -j), (0, 1))
    centre = (np.arange(len(solid)) - PAD) * 0.1 - 7.0
    inside = [
        (centre + 0.05 > scalars[low] + radius) & (centre - 0.05 < scalars[high] - radius)
        for low, high in ((lay.S_XMIN, lay.S_XMAX), (lay.S_YMIN, lay.S_YMAX))
    ]
    free = ~hit & inside[0][:, None] & inside[1]
    start = np.zeros_like(free)
    start[tuple(int(np.rint((v + 7.0) / 0.1)) + PAD for v in (x, y))] = True
    to_goal = [np.maximum(np.abs(centre - g) - 0.05, 0.0) for g in (gx, gy)]
    goal = np.hypot(to_goal[0][:, None], to_goal[1]) < radius
    gaps = np.maximum(np.abs(np.arange(-4, 5)) - 1, 0) * 0.1
    leaps = np.hypot(gaps[:, None], gaps) <= LEAP
    found = [
        bool((ndimage.binary_dilation(start, shape, iterations=-1, mask=free | start) & goal).any())
        for shape in (None, leaps)
    ]
    return found[0], found[1]


def way_between_polygons(sim: Simulator, scale: float = 1.0, cell: float = 0.025) -> bool:
    """Return whether the robot's disc gets to the goal between the polygons, as far as the border lets it.

    They are what lidar and ORCA know; `scale` makes them larger or smaller about their middles. The disc's centre goes
    from a cell's centre to one beside it; its start is free, whatever stands there.
    """
    state, scalars = sim.state(), sim.arrays.scalars[0]
    x, y, _, gx, gy, radius = state.robot[:6]
    sides = [scalars[[low, high]] for low, high in ((lay.S_XMIN, lay.S_XMAX), (lay.S_YMIN, lay.S_YMAX))]
    xs, ys = (np.arange(low, high, cell) + cell / 2 for low, high in sides)
    inside = [(c > low + radius) & (c < high - radius) for c, (low, high) in zip((xs, ys), sides, strict=True)]
    free = inside[0][:, None] & inside[1]
    for corners in state.polygons[:-1]:  # the last is the border
        low, high = corners.min(axis=0), corners.max(axis=0)
        middle, half = (low + high) / 2, scale * (high - low) / 2
        away = [np.maximum(np.abs(c - m) - h, 0.0) for c, m, h in zip((xs, ys), middle, half, strict=True)]
        free &= np.hypot(away[0][:, None], away[1]) >= radius
    start = np.zeros_like(free)
    start[int((x - sides[0][0]) / cell), int((y - sides[1][0]) / cell)] = True
    goal = np.hypot(xs[:, None] - gx, ys - gy) < radius
    return bool((ndimage.binary_propagation(start, mask=free | start) & goal).any())


@pytest.mark.slow
def test_three_worlds_of_val_have_no_way_to_the_goal_or_seem_to():
    """What docs/environments.md says of the seeds 0 to 199; here of the others every eighth."""
    sim = Simulator(make_config("navrep-val", physics="original"))
    driven, leapt, seen, true_size = [], [], [], []
    for seed in sorted({15, 167, 198, *range(0, 200, 8)}):
        sim.reset_seeded([seed])
        by_steps, by_leaps = ways_to_the_goal(sim)
        driven += [] if by_steps else [seed]
        leapt += [] if by_leaps else [seed]
        seen += [] if way_between_polygons(sim) else [seed]
        true_size += [] if way_between_polygons(sim, 1 / 1.25) else [seed]
    assert (driven, leapt, seen, true_size) == ([167], [], [15, 167, 198], [167])
