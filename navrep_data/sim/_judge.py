# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""What a step of the robot leads to: clearances, reward, event, in the `consistent` physics.

Reward is the paper's equation, all terms summed: 100 at the goal, -25 on collision, -1 within 0.2 m of an obstacle or
human, and the progress towards the goal in metres (paper, "Learning-based Navigation").
"""

import numpy as np

from navrep_data._kernels import kernel
from navrep_data.schema import Event
from navrep_data.sim._geometry import point_segment_sq, swept_clearance
from navrep_data.sim._layout import (
    A_GX,
    A_GY,
    A_RADIUS,
    A_X,
    A_Y,
    P_DANGER_DIST,
    P_DT,
    P_REWARD_COLLISION,
    P_REWARD_DANGER,
    P_REWARD_GOAL,
    P_REWARD_PROGRESS,
    P_TIME_LIMIT,
    S_CLEAR_HUMAN,
    S_CLEAR_STATIC,
    S_HUMANS,
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
def human_clearance(agents, n_humans, moves, dt):
    """Return the smallest gap between the robot's disc and a human's while all move straight for dt [m].

    `moves` (N, 2) holds everybody's velocity during the step [m/s].
    """
    best = np.inf
    for j in range(1, n_humans + 1):
        rx = agents[j, A_X] - agents[0, A_X]
        ry = agents[j, A_Y] - agents[0, A_Y]
        ex = rx + (moves[j, 0] - moves[0, 0]) * dt
        ey = ry + (moves[j, 1] - moves[0, 1]) * dt
        gap = np.sqrt(point_segment_sq(0.0, 0.0, rx, ry, ex, ey)) - agents[j, A_RADIUS] - agents[0, A_RADIUS]
        if gap < best:
            best = gap
    return best


@kernel
def judge(agents, scalars, edges, polygon_start, moves, params, result):
    """Fill result with (reward, event) of the step that `moves` describes, before anybody has moved.

    A collision outranks the goal, the goal outranks the time limit. Goal: the robot's centre ends nearer to the goal
    than its radius. The time limit ends the episode after round(limit / dt) steps.
    """
    dt = params[P_DT]
    x0, y0 = agents[0, A_X], agents[0, A_Y]
    x1, y1 = x0 + moves[0, 0] * dt, y0 + moves[0, 1] * dt
    radius = agents[0, A_RADIUS]
    to_human = human_clearance(agents, int(scalars[S_HUMANS]), moves, dt)
    to_static = swept_clearance(x0, y0, x1, y1, edges, polygon_start, int(scalars[S_POLYGONS])) - radius
    scalars[S_CLEAR_HUMAN] = to_human
    scalars[S_CLEAR_STATIC] = to_static
    before = np.hypot(agents[0, A_GX] - x0, agents[0, A_GY] - y0)
    after = np.hypot(agents[0, A_GX] - x1, agents[0, A_GY] - y1)
    reward = params[P_REWARD_PROGRESS] * (before - after)
    if min(to_human, to_static) < params[P_DANGER_DIST]:
        reward += params[P_REWARD_DANGER]
    event = NONE
    if to_human < 0.0:
        event = COLLISION_HUMAN
    elif to_static < 0.0:
        event = COLLISION_OBSTACLE
    elif after < radius:
        event = GOAL
    elif scalars[S_STEP] + 1.0 >= np.round(params[P_TIME_LIMIT] / dt):
        event = TIMEOUT
    if event == COLLISION_HUMAN or event == COLLISION_OBSTACLE:
        reward += params[P_REWARD_COLLISION]
    elif event == GOAL:
        reward += params[P_REWARD_GOAL]
    result[0] = reward
    result[1] = event
