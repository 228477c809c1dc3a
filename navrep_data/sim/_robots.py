# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""Robots: from command to motion, and being put back after a collision."""

import numpy as np

from navrep_data.kernels import kernel
from navrep_data.sim._geometry import swept_clearance
from navrep_data.sim._judge import COLLISION_HUMAN, COLLISION_OBSTACLE, GOAL, NONE, TIMEOUT, agent_gap, note_touch
from navrep_data.sim._layout import (
    A_AOMEGA,
    A_AX,
    A_AY,
    A_CLEAR_HUMAN,
    A_CLEAR_STATIC,
    A_DAMAGE,
    A_GAIT_X,
    A_GAIT_Y,
    A_HEADING,
    A_HIT,
    A_OMEGA,
    A_RADIUS,
    A_TAKEN,
    A_VX,
    A_VY,
    A_X,
    A_Y,
    F_DIFFERENTIAL,
    F_INERTIA,
    F_ROBOTS,
    P_ACCELERATION,
    P_DT,
    P_JERK,
    S_POLYGONS,
)


@kernel
def _limited(acceleration, wanted, most, jerk, dt):
    """Return the next acceleration: as near to the wanted one as largest jerk and acceleration allow."""
    change = min(max(wanted - acceleration, -jerk * dt), jerk * dt)
    return min(max(acceleration + change, -most), most)


@kernel
def _accelerate(r, agents, params, flags, commands, moves):
    """Give robot r the velocity of the next step and let its command act on the acceleration, with limits per axis.

    Holonomic: axes of the world; differential: along the heading. Order of the updates as in the original
    (pepper_2d_simulator.py; SIM_FACTS d.3).
    """
    dt = params[P_DT]
    c, s = np.cos(agents[r, A_HEADING]), np.sin(agents[r, A_HEADING])
    ax, ay, omega = commands[3 * r], commands[3 * r + 1], commands[3 * r + 2]
    most_x, most_y, most_turn = params[P_ACCELERATION], params[P_ACCELERATION + 1], params[P_ACCELERATION + 2]
    jerk_x, jerk_y, jerk_turn = params[P_JERK], params[P_JERK + 1], params[P_JERK + 2]
    if flags[F_DIFFERENTIAL]:
        before = agents[r, A_HEADING] - moves[r, 2] * dt
        speed = np.cos(before) * moves[r, 0] + np.sin(before) * moves[r, 1] + agents[r, A_AX] * dt
        agents[r, A_VX], agents[r, A_VY] = c * speed, s * speed
        agents[r, A_AX] = _limited(agents[r, A_AX], (ax - speed) / dt, most_x, jerk_x, dt)
    else:
        agents[r, A_VX] += agents[r, A_AX] * dt
        agents[r, A_VY] += agents[r, A_AY] * dt
        wanted_x = (c * ax - s * ay - agents[r, A_VX]) / dt
        wanted_y = (s * ax + c * ay - agents[r, A_VY]) / dt
        agents[r, A_AX] = _limited(agents[r, A_AX], wanted_x, most_x, jerk_x, dt)
        agents[r, A_AY] = _limited(agents[r, A_AY], wanted_y, most_y, jerk_y, dt)
    agents[r, A_OMEGA] += agents[r, A_AOMEGA] * dt
    wanted = (omega - agents[r, A_OMEGA]) / dt
    agents[r, A_AOMEGA] = _limited(agents[r, A_AOMEGA], wanted, most_turn, jerk_turn, dt)


@kernel
def go_on(r, before, agents, params, flags, commands, moves):
    """Do the rest of robot r's motion: its legs, where others see them, and its inertia; `before`: its old heading."""
    dt = params[P_DT]
    if flags[F_ROBOTS] > 1:
        c, s = np.cos(before), np.sin(before)
        agents[r, A_GAIT_X] += (c * moves[r, 0] + s * moves[r, 1]) * dt
        agents[r, A_GAIT_Y] += (c * moves[r, 1] - s * moves[r, 0]) * dt
    if flags[F_INERTIA]:
        if agents[r, A_HIT] != NONE:  # put back, it stands
            agents[r, A_AX], agents[r, A_AY], agents[r, A_AOMEGA] = 0.0, 0.0, 0.0
        else:
            _accelerate(r, agents, params, flags, commands, moves)


@kernel
def _nears_obstacle(r, agents, scalars, edges, polygon_start):
    """Return whether robot r, whose gap is measured, overlaps an obstacle more than it did before the step."""
    if agents[r, A_CLEAR_STATIC] >= 0.0:
        return False
    x, y = agents[r, A_X], agents[r, A_Y]
    at_start = swept_clearance(x, y, x, y, edges, polygon_start, int(scalars[S_POLYGONS]))
    return agents[r, A_CLEAR_STATIC] < at_start - agents[r, A_RADIUS]


@kernel
def _nears_agent(r, j, agents, moves, dt):
    """Return whether robot r and agent j overlap during a step more than before it."""
    gap = agent_gap(r, j, agents, moves, dt)
    return gap < 0.0 and gap < agent_gap(r, j, agents, moves, 0.0)


@kernel
def note_touches(agents, n_agents, scalars, edges, polygon_start, moves, dt, damage):
    """Write what the first robot touches in a step that is measured and not yet made, by the rules of collisions."""
    near = agents[0, A_CLEAR_HUMAN] < 0.0
    for j in range(1, n_agents):
        touched = False
        if near:
            touched = _nears_agent(0, j, agents, moves, dt) if damage else agent_gap(0, j, agents, moves, dt) < 0.0
        note_touch(agents, j, touched, moves[j, 0] - moves[0, 0], moves[j, 1] - moves[0, 1])
    if damage:
        touched = _nears_obstacle(0, agents, scalars, edges, polygon_start)
    else:
        touched = agents[0, A_CLEAR_STATIC] < 0.0
    note_touch(agents, 0, touched, moves[0, 0], moves[0, 1])


@kernel
def put_back(agents, n_robots, n_agents, scalars, edges, polygon_start, moves, dt):
    """Let everybody who would collide with a robot, and the robot, stay; robots take damage by their own speed.

    Only what comes nearer than it was collides, so that agents which overlap can get apart. Gaps to obstacles must be
    measured. A robot that stands takes no damage from who runs into it (SIM_FACTS d.5).
    """
    for i in range(n_agents):
        agents[i, A_HIT] = NONE
    for r in range(n_robots):
        agents[r, A_TAKEN] = 0.0
        if _nears_obstacle(r, agents, scalars, edges, polygon_start):
            agents[r, A_HIT] = COLLISION_OBSTACLE
        for j in range(r + 1, n_agents):
            if _nears_agent(r, j, agents, moves, dt):
                agents[r, A_HIT] = COLLISION_HUMAN
                agents[j, A_HIT] = COLLISION_HUMAN
    for i in range(n_agents):
        if agents[i, A_HIT] != NONE:
            if i < n_robots:
                taken = np.hypot(moves[i, 0], moves[i, 1])
                agents[i, A_TAKEN] = taken
                agents[i, A_DAMAGE] += taken
            moves[i, 0], moves[i, 1], moves[i, 2] = 0.0, 0.0, 0.0


@kernel
def first_event(a, b):
    """Return the event of a joint episode that outranks the other: collisions, then the goal, then time."""
    for event in (COLLISION_HUMAN, COLLISION_OBSTACLE, GOAL, TIMEOUT):
        if a == event or b == event:
            return event
    return NONE
