# mypy: allow-untyped-defs, allow-untyped-decorators, no-check-untyped-defs
"""One world on a map: a step, its reward and its event.

Source: pepper_2d_simulator.py, pepper_2d_iarlenv.py, ianenv.py, markenv.py, jointenv.py (SIM_FACTS d, e.1, e.2).
"""

import numpy as np

from navrep_data.kernels import kernel
from navrep_data.sim._ian_contact import (
    CLEARANCE_REACH,
    CONTACT_PASSING,
    body_circles,
    cell_distance,
    swept_cells,
    touches,
    update_contacts,
)
from navrep_data.sim._ian_layout import (
    M_MAP,
    R_ACCELERATION,
    R_BOUNCE,
    R_DAMAGE,
    R_DANGER_DIST,
    R_DIFFERENTIAL,
    R_DT,
    R_GOAL_RADIUS,
    R_HUMAN_ACCELERATION,
    R_HUMAN_JERK,
    R_HUMAN_POLICY,
    R_IAN_REWARD,
    R_INERTIA,
    R_INERTIA_REST,
    R_JERK,
    R_LEGS,
    R_MAX_DAMAGE,
    R_MAX_VX,
    R_ORIGINAL,
    R_REWARD_COLLISION,
    R_REWARD_DANGER,
    R_REWARD_GOAL,
    R_REWARD_PROGRESS,
    R_ROBOTS,
    R_SPIN,
    R_STEPS,
    TASK_NONE,
    W_AX,
    W_CMD_OMEGA,
    W_CMD_X,
    W_CMD_Y,
    W_DAMAGE,
    W_DAMAGE_STATIC,
    W_HIT,
    W_LAST_X,
    W_LAST_Y,
    W_LEFT,
    W_OMEGA,
    W_START_HEADING,
    W_START_X,
    W_START_Y,
    W_TASK,
    WALK_CONSTANT,
    WALK_ORCA,
    WALK_PLANNED,
)
from navrep_data.sim._ian_motion import (
    keep_on_map,
    move_at_once,
    move_to,
    move_with_inertia,
    put_back,
    remember,
    roll_with_inertia,
    show,
    stop,
)
from navrep_data.sim._ian_orca import choose_orca
from navrep_data.sim._ian_plan import at_goal, follow_tasks, give_tasks, limit_command
from navrep_data.sim._judge import COLLISION_HUMAN, COLLISION_OBSTACLE, GOAL, NONE, TIMEOUT, note_touch
from navrep_data.sim._layout import (
    A_CLEAR_HUMAN,
    A_CLEAR_STATIC,
    A_DAMAGE,
    A_EVENT,
    A_GAIT_T,
    A_GAIT_X,
    A_GAIT_Y,
    A_GX,
    A_GY,
    A_HEADING,
    A_OMEGA,
    A_RADIUS,
    A_VX,
    A_VY,
    A_X,
    A_Y,
    S_CLEAR_HUMAN,
    S_CLEAR_STATIC,
    S_EVENT,
    S_HUMANS,
    S_STEP,
    S_TIME,
)

# pepper_2d_simulator.py: each 0.1 of damage, and each minute, costs a tenth of the reward at the goal
REWARD_DECAY = 0.9
DAMAGE_PER_DECAY = 0.1
SECONDS_PER_DECAY = 60.0
# moving along a wall that is nearer than the radius is no collision, moving towards it is [m]
APPROACH = 1e-9


@kernel
def _command_robots(walkers, actions, rules):
    """Write the robots' commands within their largest velocities."""
    for i in range(int(rules[R_ROBOTS])):
        vy = 0.0 if rules[R_DIFFERENTIAL] else actions[i, 1]
        vx, vy, omega = limit_command(
            actions[i, 0], vy, actions[i, 2], rules[R_MAX_VX], rules[R_MAX_VX + 1], rules[R_MAX_VX + 2]
        )
        walkers[i, W_CMD_X], walkers[i, W_CMD_Y], walkers[i, W_CMD_OMEGA] = vx, vy, omega


@kernel
def _keep_course(walkers, rules, robots, n, moves):
    """Write the velocities of humans that stand, or that walk straight on and turn round where they hit something."""
    for i in range(robots, n):
        moves[i, 0], moves[i, 1] = 0.0, 0.0
        if rules[R_HUMAN_POLICY] == WALK_CONSTANT:
            if walkers[i, W_HIT] != NONE:
                walkers[i, W_CMD_X], walkers[i, W_CMD_Y] = -walkers[i, W_CMD_X], -walkers[i, W_CMD_Y]
            moves[i, 0], moves[i, 1] = walkers[i, W_CMD_X], walkers[i, W_CMD_Y]


@kernel
def _move_all(agents, walkers, moves, n, map_row, rules):
    """Move everybody; `moves` (N, 2) holds the velocities of humans that are not planned."""
    dt = rules[R_DT]
    robots = int(rules[R_ROBOTS])
    for i in range(n):
        if i < robots:
            if rules[R_INERTIA] or (i > 0 and rules[R_INERTIA_REST]):
                limits, jerks = rules[R_ACCELERATION : R_ACCELERATION + 3], rules[R_JERK : R_JERK + 3]
                # in `original` physics a differential drive is a command without vy, and slides in turns
                if rules[R_DIFFERENTIAL] and not rules[R_ORIGINAL]:
                    roll_with_inertia(agents, walkers, i, limits, jerks, dt)
                else:
                    move_with_inertia(agents, walkers, i, limits, jerks, dt)
            else:
                move_at_once(agents, walkers, i, dt)
        elif rules[R_HUMAN_POLICY] == WALK_PLANNED:
            limits = rules[R_HUMAN_ACCELERATION : R_HUMAN_ACCELERATION + 3]
            move_with_inertia(agents, walkers, i, limits, rules[R_HUMAN_JERK : R_HUMAN_JERK + 3], dt)
        else:
            move_to(agents, walkers, i, moves[i, 0], moves[i, 1], dt)
        keep_on_map(agents, walkers, i, map_row)


@kernel
def _hits_wall(agents, walkers, i, maps, map_row, rules):
    """Return whether agent i collides with static matter; its position is that after the step."""
    if rules[R_ORIGINAL] or i >= rules[R_ROBOTS]:
        # humans keep to the rule that their planner knows, in both physics
        return cell_distance(maps, map_row, agents[i, A_X], agents[i, A_Y]) < agents[i, A_RADIUS]
    radius = agents[i, A_RADIUS]
    x0, y0 = walkers[i, W_LAST_X], walkers[i, W_LAST_Y]
    gap = swept_cells(maps, map_row, x0, y0, agents[i, A_X], agents[i, A_Y], radius)
    if gap >= radius:
        return False
    return gap < swept_cells(maps, map_row, x0, y0, x0, y0, radius) - APPROACH


@kernel
def _note_touches(agents, walkers, circles, n, maps, map_row, rules):
    """Write what the first robot touches, before anybody is put back; the map's edge counts as static matter.

    A robot's pairs never pass.
    """
    for j in range(1, n):
        vx, vy = agents[j, A_VX] - agents[0, A_VX], agents[j, A_VY] - agents[0, A_VY]
        note_touch(agents, j, touches(agents, circles, 0, j), vx, vy)
    matter = walkers[0, W_LEFT] != 0.0 or _hits_wall(agents, walkers, 0, maps, map_row, rules)
    note_touch(agents, 0, matter, agents[0, A_VX], agents[0, A_VY])


@kernel
def _collide(agents, walkers, contacts, circles, n, maps, map_row, rules):
    """Find the step's collisions in the original's order; those who collide take damage and are put back.

    For each agent in turn: the first other of a higher number whose body it touches, then static matter, where it is
    by then: who was put back from another meets the wall no more.
    """
    robots = int(rules[R_ROBOTS])
    _note_touches(agents, walkers, circles, n, maps, map_row, rules)
    for i in range(n):
        walkers[i, W_HIT] = NONE
    for i in range(n):
        for j in range(i + 1, n):
            if contacts[i, j] == CONTACT_PASSING or not touches(agents, circles, i, j):
                continue
            walkers[i, W_DAMAGE] += np.hypot(agents[i, A_VX], agents[i, A_VY])
            walkers[j, W_DAMAGE] += np.hypot(agents[j, A_VX], agents[j, A_VY])
            walkers[i, W_HIT] = COLLISION_HUMAN
            walkers[j, W_HIT] = COLLISION_HUMAN
            if rules[R_BOUNCE] or i >= robots:  # humans bump into each other and go on
                put_back(agents, walkers, i)
                put_back(agents, walkers, j)
            break
        if _hits_wall(agents, walkers, i, maps, map_row, rules):
            damage = np.hypot(agents[i, A_VX], agents[i, A_VY])
            walkers[i, W_DAMAGE] += damage
            walkers[i, W_DAMAGE_STATIC] += damage
            if walkers[i, W_HIT] == NONE:
                walkers[i, W_HIT] = COLLISION_OBSTACLE
            if rules[R_BOUNCE] or i >= robots:
                put_back(agents, walkers, i)


@kernel
def _clearances(agents, walkers, scalars, n, maps, map_row, rules, i):
    """Return robot i's smallest gaps to another agent's disc and to static matter [m], where everybody is now."""
    human = np.inf
    for j in range(n):
        if j != i:
            dx, dy = agents[j, A_X] - agents[i, A_X], agents[j, A_Y] - agents[i, A_Y]
            human = min(human, np.sqrt(dx * dx + dy * dy) - agents[i, A_RADIUS] - agents[j, A_RADIUS])
    x, y, radius = agents[i, A_X], agents[i, A_Y], agents[i, A_RADIUS]
    static = swept_cells(maps, map_row, x, y, x, y, radius + CLEARANCE_REACH) - radius
    if i == 0 or human < scalars[S_CLEAR_HUMAN]:
        scalars[S_CLEAR_HUMAN] = human
    if i == 0 or static < scalars[S_CLEAR_STATIC]:
        scalars[S_CLEAR_STATIC] = static
    return human, static


@kernel
def _goal_distance(agents, i, x, y):
    return np.hypot(x - agents[i, A_GX], y - agents[i, A_GY])


@kernel
def _event(agents, walkers, scalars, i, rules):
    """Return how the step ended the episode of robot i; S_STEP already counts the step."""
    hit = walkers[i, W_HIT]
    if hit != NONE and not rules[R_DAMAGE] and not rules[R_ORIGINAL]:
        return hit
    if _goal_distance(agents, i, agents[i, A_X], agents[i, A_Y]) < rules[R_GOAL_RADIUS]:
        return GOAL
    if rules[R_DAMAGE]:
        if walkers[i, W_DAMAGE] >= rules[R_MAX_DAMAGE]:
            # what counts is the damage, which may have been done by a step before
            return hit if hit != NONE else COLLISION_OBSTACLE
    elif hit != NONE and (walkers[i, W_DAMAGE] > 0.0 or not rules[R_BOUNCE]):
        return hit  # where the original puts back, only a collision at speed ends the episode
    if walkers[i, W_LEFT]:
        return COLLISION_OBSTACLE
    if scalars[S_STEP] >= rules[R_STEPS]:
        return TIMEOUT
    return NONE


@kernel
def _reward(agents, walkers, scalars, i, event, spin, human, static, rules):
    """Return robot i's reward of the step, see docs/differences.md."""
    progress = _goal_distance(agents, i, walkers[i, W_LAST_X], walkers[i, W_LAST_Y]) - _goal_distance(
        agents, i, agents[i, A_X], agents[i, A_Y]
    )
    if rules[R_IAN_REWARD]:
        if event == GOAL:
            by_damage = REWARD_DECAY ** (walkers[i, W_DAMAGE] / DAMAGE_PER_DECAY)
            by_time = REWARD_DECAY ** (scalars[S_STEP] * rules[R_DT] / SECONDS_PER_DECAY)
            reward = rules[R_REWARD_GOAL] * by_damage * by_time
        else:
            reward = rules[R_REWARD_PROGRESS] * progress
        return reward - rules[R_SPIN] * spin * spin
    reward = rules[R_REWARD_PROGRESS] * progress
    if min(human, static) < rules[R_DANGER_DIST]:
        reward += rules[R_REWARD_DANGER]
    if event == GOAL:
        reward += rules[R_REWARD_GOAL]
    elif event == COLLISION_HUMAN or event == COLLISION_OBSTACLE:
        reward += rules[R_REWARD_COLLISION]
    return reward


@kernel
def _send_back(agents, walkers, contacts, robots, n, original):
    """Put the humans back to their starts, at rest, where all have arrived.

    The original forgets to tell its memory of positions: who collides in the next step is put to where it arrived.
    """
    for i in range(robots, n):
        if not at_goal(agents, i):
            return
    for i in range(robots, n):
        agents[i, A_X], agents[i, A_Y] = walkers[i, W_START_X], walkers[i, W_START_Y]
        agents[i, A_HEADING] = walkers[i, W_START_HEADING]
        agents[i, A_GAIT_X], agents[i, A_GAIT_Y], agents[i, A_GAIT_T] = 0.0, 0.0, 0.0
        stop(agents, walkers, i)
        walkers[i, W_CMD_X], walkers[i, W_CMD_Y], walkers[i, W_CMD_OMEGA] = 0.0, 0.0, 0.0
        walkers[i, W_AX : W_AX + 3] = 0.0
        walkers[i, W_TASK] = TASK_NONE
    contacts[:, :] = 0
    if not original:
        remember(agents, walkers, n)


@kernel
def joint_event(events, robots):
    """Return how the step ended the episode for all robots: a collision outranks a goal, that the time limit."""
    best = NONE
    for wanted in (TIMEOUT, GOAL, COLLISION_OBSTACLE, COLLISION_HUMAN):
        for i in range(robots):
            if events[i] == wanted:
                best = wanted
    return best


@kernel
def step_map_world(
    agents, walkers, contacts, scalars, place, own_field, rng, maps, rules, circles, path, orca, moves, actions,
    rewards, events,
):  # fmt: skip
    """Advance a world by one step under actions (R, 3); fills rewards (R,) and events (R,)."""
    robots = int(rules[R_ROBOTS])
    n = robots + int(scalars[S_HUMANS])
    original = rules[R_ORIGINAL] != 0.0
    map_row = maps.table[int(place[M_MAP])]
    time = scalars[S_TIME]
    _command_robots(walkers, actions, rules)
    if rules[R_HUMAN_POLICY] == WALK_PLANNED:
        give_tasks(agents, walkers, robots, n, time, maps, own_field, map_row, original, rng, path)
        follow_tasks(agents, walkers, contacts, robots, n, time)
    elif rules[R_HUMAN_POLICY] == WALK_ORCA:
        choose_orca(agents, walkers, place, own_field, maps, map_row, rules, orca, n, rng, path, moves)
    else:
        _keep_course(walkers, rules, robots, n, moves)
    update_contacts(agents, walkers, contacts, robots, n, rng)
    _move_all(agents, walkers, moves, n, map_row, rules)
    show(agents, walkers, n)
    body_circles(agents, walkers, n, rules[R_LEGS] != 0.0, circles)
    scalars[S_STEP] += 1.0
    _collide(agents, walkers, contacts, circles, n, maps, map_row, rules)
    if not original:
        show(agents, walkers, n)
    for i in range(robots):
        human, static = _clearances(agents, walkers, scalars, n, maps, map_row, rules, i)
        event = _event(agents, walkers, scalars, i, rules)
        spin = actions[i, 2] / rules[R_MAX_VX + 2]
        rewards[i] = _reward(agents, walkers, scalars, i, event, spin, human, static, rules)
        events[i] = event
        agents[i, A_EVENT], agents[i, A_DAMAGE] = event, walkers[i, W_DAMAGE]
        agents[i, A_CLEAR_HUMAN], agents[i, A_CLEAR_STATIC] = human, static
        agents[i, A_OMEGA] = walkers[i, W_OMEGA]
    remember(agents, walkers, n)
    scalars[S_TIME] = time + rules[R_DT]
    scalars[S_EVENT] = joint_event(events, robots)
    if rules[R_HUMAN_POLICY] == WALK_PLANNED and n > robots:
        _send_back(agents, walkers, contacts, robots, n, original)
