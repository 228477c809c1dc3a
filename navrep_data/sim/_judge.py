# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""What a step of the robot leads to: clearances, reward, event, in the `consistent` physics.

Reward is the paper's equation, all terms summed: 100 at the goal, -25 on collision, -1 within 0.2 m of an obstacle or
human, and the progress towards the goal in metres (paper, "Learning-based Navigation").
"""

import numpy as np

from navrep_data.kernels import kernel
from navrep_data.schema import Event
from navrep_data.sim._geometry import point_segment_sq, swept_clearance
from navrep_data.sim._layout import (
    A_CLEAR_HUMAN,
    A_CLEAR_STATIC,
    A_DAMAGE,
    A_GX,
    A_GY,
    A_HIT,
    A_RADIUS,
    A_TAKEN,
    A_TOUCH_SPEED,
    A_TOUCHED,
    A_X,
    A_Y,
    F_DAMAGE,
    P_DANGER_DIST,
    P_DT,
    P_GOAL_RADIUS,
    P_MAX_DAMAGE,
    P_REWARD_COLLISION,
    P_REWARD_DANGER,
    P_REWARD_GOAL,
    P_REWARD_PROGRESS,
    P_TIME_LIMIT,
    S_POLYGONS,
    S_STEP,
)

NONE = int(Event.NONE)
GOAL = int(Event.GOAL)
COLLISION_HUMAN = int(Event.COLLISION_HUMAN)
COLLISION_OBSTACLE = int(Event.COLLISION_OBSTACLE)
TIMEOUT = int(Event.TIMEOUT)
STUCK = int(Event.STUCK)
CUT = int(Event.CUT)


@kernel
def agent_gap(i, j, agents, moves, dt):
    """Return the smallest gap between two agents' discs while both move straight for dt [m]; see `measure`."""
    rx = agents[j, A_X] - agents[i, A_X]
    ry = agents[j, A_Y] - agents[i, A_Y]
    ex = rx + (moves[j, 0] - moves[i, 0]) * dt
    ey = ry + (moves[j, 1] - moves[i, 1]) * dt
    return np.sqrt(point_segment_sq(0.0, 0.0, rx, ry, ex, ey)) - agents[j, A_RADIUS] - agents[i, A_RADIUS]


@kernel
def measure(r, agents, n_agents, scalars, edges, polygon_start, moves, dt):
    """Write robot r's smallest gaps to other agents and to obstacles during a step, before anybody has moved [m].

    `moves` (N, 3) holds everybody's velocity during the step [m/s].
    """
    best = np.inf
    x, y, radius = agents[r, A_X], agents[r, A_Y], agents[r, A_RADIUS]
    vx, vy = moves[r, 0], moves[r, 1]
    for j in range(n_agents):  # `agent_gap`, written out for speed
        if j == r:
            continue
        rx = agents[j, A_X] - x
        ry = agents[j, A_Y] - y
        ex = rx + (moves[j, 0] - vx) * dt
        ey = ry + (moves[j, 1] - vy) * dt
        gap = np.sqrt(point_segment_sq(0.0, 0.0, rx, ry, ex, ey)) - agents[j, A_RADIUS] - radius
        if gap < best:
            best = gap
    agents[r, A_CLEAR_HUMAN] = best
    x0, y0 = agents[r, A_X], agents[r, A_Y]
    x1, y1 = x0 + moves[r, 0] * dt, y0 + moves[r, 1] * dt
    to_static = swept_clearance(x0, y0, x1, y1, edges, polygon_start, int(scalars[S_POLYGONS]))
    agents[r, A_CLEAR_STATIC] = to_static - agents[r, A_RADIUS]


@kernel
def note_touch(agents, j, touched, vx, vy):
    """Write whether the first robot touches agent j (0: static matter), moving against it with (vx, vy) [m/s]."""
    agents[j, A_TOUCHED] = 1.0 if touched else 0.0
    agents[j, A_TOUCH_SPEED] = np.hypot(vx, vy) if touched else 0.0


@kernel
def reach_of_goal(r, agents, params):
    """Return how near to its goal robot r's centre must come [m]."""
    return params[P_GOAL_RADIUS] if params[P_GOAL_RADIUS] > 0.0 else agents[r, A_RADIUS]


@kernel
def judge(r, agents, scalars, moves, params, flags):
    """Return (reward, event) of robot r's step that `moves` describes, measured and not yet made.

    A collision outranks the goal, the goal outranks the time limit. Goal: the robot's centre ends nearer to the goal
    than the goal radius. The time limit ends the episode after round(limit / dt) steps. Where collisions do damage,
    they cost their share of the damage that ends an episode.
    """
    dt = params[P_DT]
    x0, y0 = agents[r, A_X], agents[r, A_Y]
    x1, y1 = x0 + moves[r, 0] * dt, y0 + moves[r, 1] * dt
    to_human, to_static = agents[r, A_CLEAR_HUMAN], agents[r, A_CLEAR_STATIC]
    before = np.hypot(agents[r, A_GX] - x0, agents[r, A_GY] - y0)
    after = np.hypot(agents[r, A_GX] - x1, agents[r, A_GY] - y1)
    reward = params[P_REWARD_PROGRESS] * (before - after)
    if min(to_human, to_static) < params[P_DANGER_DIST]:
        reward += params[P_REWARD_DANGER]
    event = NONE
    if flags[F_DAMAGE]:
        if agents[r, A_DAMAGE] >= params[P_MAX_DAMAGE]:
            event = int(agents[r, A_HIT])
    elif to_human < 0.0:
        event = COLLISION_HUMAN
    elif to_static < 0.0:
        event = COLLISION_OBSTACLE
    if event == NONE:
        if after < reach_of_goal(r, agents, params):
            event = GOAL
        elif scalars[S_STEP] + 1.0 >= np.round(params[P_TIME_LIMIT] / dt):
            event = TIMEOUT
    if flags[F_DAMAGE]:
        most = params[P_MAX_DAMAGE]
        taken = min(agents[r, A_DAMAGE], most) - min(agents[r, A_DAMAGE] - agents[r, A_TAKEN], most)
        reward += params[P_REWARD_COLLISION] * taken / most
    elif event == COLLISION_HUMAN or event == COLLISION_OBSTACLE:
        reward += params[P_REWARD_COLLISION]
    if event == GOAL:
        reward += params[P_REWARD_GOAL]
    return reward, event
