# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""Put the robot of a world on a map somewhere else, right after a reset."""

from navrep_data.kernels import kernel
from navrep_data.sim._ian_layout import M_HAS_FIELD, M_MAP, W_FIELD, W_PERMISSIVITY
from navrep_data.sim._ian_motion import remember, show
from navrep_data.sim._ian_reset import _keep_field, _put
from navrep_data.sim._layout import A_GX, A_GY, A_RADIUS, A_VPREF


@kernel
def place_on_map(agents, walkers, place, own_field, maps, x, y, heading, gx, gy):
    """Put robot 0 at rest at (x, y, heading) with the goal (gx, gy); its goal field follows where the goal is new."""
    same_goal = gx == agents[0, A_GX] and gy == agents[0, A_GY]
    speed, permissivity, field = agents[0, A_VPREF], walkers[0, W_PERMISSIVITY], walkers[0, W_FIELD]
    _put(agents, walkers, 0, x, y, heading, gx, gy, agents[0, A_RADIUS])
    agents[0, A_VPREF], walkers[0, W_PERMISSIVITY] = speed, permissivity
    if same_goal:
        walkers[0, W_FIELD] = field
    else:
        place[M_HAS_FIELD] = 0.0
        _keep_field(agents, walkers, place, own_field, maps, maps.table[int(place[M_MAP])])
    remember(agents, walkers, 1)
    show(agents, walkers, 1)
