# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""What the benchmark reads from batches of worlds on maps."""

from navrep_data.evaluate._polygons import human_gap
from navrep_data.kernels import kernel
from navrep_data.sim._ian_contact import CLEARANCE_REACH, swept_cells
from navrep_data.sim._ian_layout import M_MAP
from navrep_data.sim._ian_orca import guided_velocity, pack_agents
from navrep_data.sim._layout import A_RADIUS, A_X, A_Y, S_HUMANS


@kernel
def start_gaps(mask, agents, scalars, place, maps, to_human, to_static):
    """Fill to_human and to_static (W,) with the gaps around the robots in the worlds of `mask` [m].

    The gap to obstacles is exact up to a metre, beyond that a lower bound, as in the simulator's steps.
    """
    for w in range(agents.shape[0]):
        if mask[w]:
            to_human[w] = human_gap(agents[w], int(scalars[w, S_HUMANS]))
            x, y, radius = agents[w, 0, A_X], agents[w, 0, A_Y], agents[w, 0, A_RADIUS]
            map_row = maps.table[int(place[w, M_MAP])]
            to_static[w] = swept_cells(maps, map_row, x, y, x, y, radius + CLEARANCE_REACH) - radius


@kernel
def guided_robots(agents, walkers, scalars, place, own_field, rng, maps, orca, path, out):
    """Fill out (W, 2) with the velocity [m/s], map frame, that ORCA chooses for robots that follow the planned way."""
    for w in range(agents.shape[0]):
        n = 1 + int(scalars[w, S_HUMANS])
        pack_agents(agents[w], n, orca)
        map_row = maps.table[int(place[w, M_MAP])]
        out[w, 0], out[w, 1] = guided_velocity(
            agents[w], walkers[w], 0, 1, n, -1, place[w], own_field[w], maps, map_row, orca, rng[w], path
        )
