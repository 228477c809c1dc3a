# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""Start episodes on maps: from a scenario, or with random starts and goals.

Source: ianenv.py, markenv.py, jointenv.py of NavRep, pepper_2d_simulator.py (SIM_FACTS d.1, d.7, d.8, e.1, e.2).
"""

import numpy as np

from navrep_data.kernels import kernel
from navrep_data.sim._fast_marching import UPWIND_ORIGINAL, march
from navrep_data.sim._ian_layout import (
    C_CAST,
    C_HUMANS,
    C_MAP,
    K_FIELD,
    K_GX,
    K_GY,
    K_HEADING,
    K_PERMISSIVITY,
    K_X,
    K_Y,
    M_HAS_FIELD,
    M_MAP,
    M_SCENARIO,
    R_HUMANS,
    R_MAX_VX,
    R_ORIGINAL,
    R_RADIUS,
    R_REDRAWS,
    R_ROBOTS,
    R_SPEED_HIGH,
    R_SPEED_LOW,
    R_WANT_FIELD,
    T_PLAN_BEGIN,
    T_PLAN_CELLS,
    T_PLAN_HEIGHT,
    T_PLAN_RESOLUTION,
    T_PLAN_WIDTH,
    T_POOL,
    T_POOL_END,
    T_SPOTS,
    T_SPOTS_END,
    T_X0,
    T_Y0,
    W_CMD_X,
    W_CMD_Y,
    W_FIELD,
    W_LAST_GAIT_T,
    W_LAST_X,
    W_PERMISSIVITY,
    W_SEEN_GAIT_T,
    W_SEEN_X,
    W_START_HEADING,
    W_START_X,
    W_START_Y,
)
from navrep_data.sim._ian_motion import remember, show
from navrep_data.sim._ian_plan import cell_index
from navrep_data.sim._layout import (
    A_GX,
    A_GY,
    A_HEADING,
    A_RADIUS,
    A_SEES,
    A_VPREF,
    A_X,
    A_Y,
    F_NOISE,
    S_EPISODE,
    S_HUMANS,
    S_NOISE_HIGH,
    S_NOISE_LOW,
)
from navrep_data.sim._noise import noise_key
from navrep_data.sim._rng import integer, uniform

# pepper_2d_simulator.py: random goals are farther than this from the start [m]
LEAST_WAY = 3.0
# ours: random humans start this much clear of everybody else [m]; draws that find no place give up
START_GAP = 0.4
MAX_TRIES = 200
TWO_PI = 2.0 * np.pi
CHANCE = 0.75  # permissivity of humans that no scenario describes


@kernel
def _put(agents, walkers, i, x, y, heading, gx, gy, radius):
    """Put agent i at its start, at rest."""
    agents[i, :] = 0.0
    walkers[i, :] = 0.0
    agents[i, A_X], agents[i, A_Y], agents[i, A_HEADING] = x, y, heading
    agents[i, A_GX], agents[i, A_GY] = gx, gy
    agents[i, A_RADIUS] = radius
    agents[i, A_SEES] = 1.0
    walkers[i, W_START_X], walkers[i, W_START_Y], walkers[i, W_START_HEADING] = x, y, heading
    walkers[i, W_PERMISSIVITY] = CHANCE
    walkers[i, W_FIELD] = -1.0


@kernel
def _begin_scenario(agents, walkers, scalars, place, maps, rules, rng, scenario, heading):
    """Put everybody where the scenario says; the robot's heading is drawn where `heading` is NaN."""
    row = maps.scenarios[scenario]
    place[M_MAP], place[M_SCENARIO] = row[C_MAP], scenario
    scalars[S_HUMANS] = row[C_HUMANS]
    if np.isnan(heading):
        heading = uniform(rng) * 2.0 * np.pi
    for i in range(int(row[C_HUMANS]) + 1):
        k = maps.cast[int(row[C_CAST]) + i]
        theta = heading if i == 0 else k[K_HEADING]
        _put(agents, walkers, i, k[K_X], k[K_Y], theta, k[K_GX], k[K_GY], rules[R_RADIUS])
        walkers[i, W_PERMISSIVITY] = k[K_PERMISSIVITY]
        walkers[i, W_FIELD] = k[K_FIELD]
        agents[i, A_VPREF] = rules[R_MAX_VX] if i == 0 else 0.5 * (rules[R_SPEED_LOW] + rules[R_SPEED_HIGH])


@kernel
def _clear_of(agents, n, x, y, gap):
    """Return whether (x, y) is farther than `gap` from agents 0 .. n - 1."""
    for j in range(n):
        if np.hypot(x - agents[j, A_X], y - agents[j, A_Y]) <= gap:
            return False
    return True


@kernel
def _nth_spot(agents, n, maps, map_row, gap, x, y, least, rng):
    """Draw a spot off agents 0 .. n - 1 by `gap`, farther than `least` from (x, y); returns its row, -1: there is none.

    The original's way: one draw among those that are left.
    """
    first, last = int(map_row[T_SPOTS]), int(map_row[T_SPOTS_END])
    count = 0
    for k in range(first, last):
        sx, sy = maps.spots[k, 0], maps.spots[k, 1]
        if np.hypot(sx - x, sy - y) > least and _clear_of(agents, n, sx, sy, gap):
            count += 1
    if count == 0:
        return -1
    pick = integer(rng, 0, count)
    for k in range(first, last):
        sx, sy = maps.spots[k, 0], maps.spots[k, 1]
        if np.hypot(sx - x, sy - y) > least and _clear_of(agents, n, sx, sy, gap):
            if pick == 0:
                return k
            pick -= 1
    return -1


@kernel
def _draw_robots(agents, walkers, maps, map_row, rules, rng):
    """Draw starts of all robots, then their goals; returns False where one finds no place."""
    robots = int(rules[R_ROBOTS])
    for i in range(robots):
        k = _nth_spot(agents, i, maps, map_row, 2.0 * rules[R_RADIUS], 0.0, 0.0, -1.0, rng)
        if k < 0:
            return False
        heading = uniform(rng) * 2.0 * np.pi
        _put(agents, walkers, i, maps.spots[k, 0], maps.spots[k, 1], heading, 0.0, 0.0, rules[R_RADIUS])
        agents[i, A_VPREF] = rules[R_MAX_VX]
    for i in range(robots):
        k = _nth_spot(agents, 0, maps, map_row, 0.0, agents[i, A_X], agents[i, A_Y], LEAST_WAY, rng)
        if k < 0:
            return False
        agents[i, A_GX], agents[i, A_GY] = maps.spots[k, 0], maps.spots[k, 1]
        uniform(rng)  # the goal's heading, which nothing uses
    return True


@kernel
def _draw_humans(agents, walkers, scalars, maps, map_row, rules, rng):
    """Draw humans: starts off everybody, goals from the map's pool; those that find no place are left out."""
    robots = int(rules[R_ROBOTS])
    first, pool = int(map_row[T_POOL]), int(map_row[T_POOL_END]) - int(map_row[T_POOL])
    spots, n_spots = int(map_row[T_SPOTS]), int(map_row[T_SPOTS_END]) - int(map_row[T_SPOTS])
    wanted = min(int(np.rint(rules[R_HUMANS] * (0.5 + uniform(rng)))), agents.shape[0] - robots)
    n = robots
    gap = 2.0 * rules[R_RADIUS] + START_GAP
    for _ in range(wanted):
        for _try in range(MAX_TRIES):
            k = spots + integer(rng, 0, n_spots)
            x, y = maps.spots[k, 0], maps.spots[k, 1]
            index = maps.pool[first + integer(rng, 0, pool)]
            gx, gy = maps.field_goal[index, 0], maps.field_goal[index, 1]
            if np.hypot(gx - x, gy - y) > LEAST_WAY and _clear_of(agents, n, x, y, gap):
                _put(agents, walkers, n, x, y, np.arctan2(gy - y, gx - x), gx, gy, rules[R_RADIUS])
                walkers[n, W_FIELD] = index
                low, high = rules[R_SPEED_LOW], rules[R_SPEED_HIGH]
                agents[n, A_VPREF] = low + (high - low) * uniform(rng)
                n += 1
                break
    scalars[S_HUMANS] = n - robots


@kernel
def _keep_field(agents, walkers, place, own_field, maps, map_row):
    """Work out the first robot's goal field where it is none of the shared ones."""
    if walkers[0, W_FIELD] >= 0.0:
        return
    width, height = int(map_row[T_PLAN_WIDTH]), int(map_row[T_PLAN_HEIGHT])
    start = int(map_row[T_PLAN_BEGIN])
    size = int(map_row[T_PLAN_CELLS])
    speeds = maps.pace[start : start + size].reshape(width, height)
    i = cell_index(agents[0, A_GX], map_row[T_X0], map_row[T_PLAN_RESOLUTION], width)
    j = cell_index(agents[0, A_GY], map_row[T_Y0], map_row[T_PLAN_RESOLUTION], height)
    march(speeds, i, j, UPWIND_ORIGINAL, own_field[:size].reshape(width, height))
    place[M_HAS_FIELD] = 1.0


@kernel
def reset_map_world(
    agents, walkers, contacts, scalars, place, own_field, rng, maps, rules, flags, scenario, heading
):  # fmt: skip
    """Start an episode; returns False where no start or goal could be found.

    scenario: index, -1: drawn (or random starts and goals where the config has no scenarios). heading: of the robot
    in a scenario [rad], NaN: drawn.
    """
    episode = scalars[S_EPISODE] + 1.0
    scalars[:] = 0.0
    scalars[S_EPISODE] = episode
    if flags[F_NOISE]:
        scalars[S_NOISE_HIGH], scalars[S_NOISE_LOW] = noise_key(rng, episode)
    place[:] = 0.0
    contacts[:, :] = 0
    robots = int(rules[R_ROBOTS])
    original = rules[R_ORIGINAL] != 0.0
    n_scenarios = maps.scenarios.shape[0]
    if n_scenarios > 0:
        if scenario < 0:
            scenario = integer(rng, 0, n_scenarios)
        _begin_scenario(agents, walkers, scalars, place, maps, rules, rng, scenario, heading)
    else:
        place[M_SCENARIO] = -1.0
        n_maps = maps.table.shape[0]
        if n_maps > 1:
            place[M_MAP] = integer(rng, 0, n_maps)
        for _ in range(int(rules[R_REDRAWS])):
            if not _draw_robots(agents, walkers, maps, maps.table[int(place[M_MAP])], rules, rng):
                return False
        if rules[R_HUMANS] > 0.0:
            _draw_humans(agents, walkers, scalars, maps, maps.table[int(place[M_MAP])], rules, rng)
    n = robots + int(scalars[S_HUMANS])
    if rules[R_WANT_FIELD]:
        _keep_field(agents, walkers, place, own_field, maps, maps.table[int(place[M_MAP])])
    for i in range(robots, n):  # the course of humans with a constant velocity
        dx, dy = agents[i, A_GX] - agents[i, A_X], agents[i, A_GY] - agents[i, A_Y]
        scale = agents[i, A_VPREF] / max(np.hypot(dx, dy), 1e-9)
        walkers[i, W_CMD_X], walkers[i, W_CMD_Y] = dx * scale, dy * scale
    remember(agents, walkers, n)
    show(agents, walkers, n)
    if original and n_scenarios > 0:
        # the buffers were filled while everybody was still at (0, 0), looking along x
        for i in range(n):
            walkers[i, W_LAST_X : W_LAST_GAIT_T + 1] = 0.0
            walkers[i, W_SEEN_X : W_SEEN_GAIT_T + 1] = 0.0
    return True
