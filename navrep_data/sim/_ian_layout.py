"""Positions of everything that worlds on maps hold beside the arrays of ``_layout``.

Names for columns, not configuration. What all worlds of a config share is in a :class:`MapTables`; numba takes a
named tuple of arrays as one argument.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# --- walkers (N, WALKER_FIELDS) float64, per world, beside `agents`: rows 0..R-1 are robots, then humans --------------
W_OMEGA = 0  # rotation of the pose [rad/s]
W_BODY_VX = 1  # velocity along the body's axes as last computed or commanded [m/s]
W_BODY_VY = 2
W_BODY_OMEGA = 3
W_AX = 4  # acceleration, map frame [m/s2]
W_AY = 5
W_AOMEGA = 6
W_LAST_X = 7  # pose and gait at the end of the step before: where a collision puts one back
W_LAST_Y = 8
W_LAST_HEADING = 9
W_LAST_GAIT_X = 10
W_LAST_GAIT_Y = 11
W_LAST_GAIT_T = 12
W_START_X = 13
W_START_Y = 14
W_START_HEADING = 15
W_TASK = 16  # one of TASK_*
W_WAY_X = 17  # waypoint [m]
W_WAY_Y = 18
W_TASK_TIME = 19  # when the task began [s]
W_PERMISSIVITY = 20  # chance to pass through another human
W_FIELD = 21  # index of the goal field, -1: the world's own
W_DAMAGE = 22  # taken since reset [m/s]
W_DAMAGE_STATIC = 23  # the part of it that obstacles did
W_CMD_X = 24  # body command of this step
W_CMD_Y = 25
W_CMD_OMEGA = 26
# what the lidar shows: `original` observes before a collision puts anybody back
W_SEEN_X = 27
W_SEEN_Y = 28
W_SEEN_HEADING = 29
W_SEEN_SPEED = 30
W_SEEN_GAIT_X = 31
W_SEEN_GAIT_Y = 32
W_SEEN_GAIT_T = 33
# what the robot state shows
W_SHOWN_X = 34
W_SHOWN_Y = 35
W_SHOWN_HEADING = 36
W_SHOWN_VX = 37
W_SHOWN_VY = 38
W_SHOWN_OMEGA = 39
W_HIT = 40  # event of this step's collision, 0: none
W_LEFT = 41  # 1 where this agent left the map in this step
WALKER_FIELDS = 42

TASK_NONE = 0.0
TASK_WALK = 1.0
TASK_LOITER = 2.0

# --- places (PLACE_FIELDS,) float64, per world -------------------------------------------------------------------
M_MAP = 0  # index of the map
M_SCENARIO = 1  # index of the scenario in the config's list, -1: random start and goal
M_SEEDED = 2  # 1 while the episode draws from the numpy-seeded stream
M_HAS_FIELD = 3  # 1 where the world's own goal field is that of this episode's goal
PLACE_FIELDS = 4

# --- numbers of one map: MapTables.table (M, MAP_FIELDS) float64 -------------------------------------------------
# The full map is what the lidar sees and what one collides with; the planning map is coarser.
T_CELLS = 0  # where the map's cells begin in `solid` and `distance`
T_WIDTH = 1
T_HEIGHT = 2
T_X0 = 3  # lower left corner [m]
T_Y0 = 4
T_RESOLUTION = 5  # [m]
T_PLAN_CELLS = 6  # number of cells of the planning map
T_PLAN_WIDTH = 7
T_PLAN_HEIGHT = 8
T_PLAN_RESOLUTION = 9
T_WAYPOINT = 10  # how many cells ahead a human walks
T_RANGE_MAX = 11  # largest range of the lidar [m]
T_SPOTS = 12  # where the map's start places begin in `spots`
T_SPOTS_END = 13
T_POOL = 14  # where the humans' goals begin in `pool`
T_POOL_END = 15
T_EDGES = 16  # number of edges for ORCA
T_PLAN_BEGIN = 17  # where the planning map's speeds begin in `pace`
T_SQUARES = 18  # where the lidar's leap tables begin in `squares`
MAP_FIELDS = 19

# --- MapTables.scenarios (S, 3) int64 ----------------------------------------------------------------------------
C_MAP = 0
C_CAST = 1  # row of the robot in `cast`; the humans follow
C_HUMANS = 2
SCENARIO_FIELDS = 3

# --- MapTables.cast (K, CAST_FIELDS) float64 ---------------------------------------------------------------------
K_X = 0
K_Y = 1
K_HEADING = 2
K_GX = 3
K_GY = 4
K_PERMISSIVITY = 5
K_FIELD = 6  # index of the goal's field
CAST_FIELDS = 7


class MapTables(NamedTuple):
    """What all worlds of a config share: maps, goal fields, scenarios; flat arrays, one map after the other."""

    table: NDArray[np.float64]
    solid: NDArray[np.uint8]
    distance: NDArray[np.float32]
    squares: NDArray[np.uint8]
    pace: NDArray[np.float32]
    fields: NDArray[np.float32]
    field_start: NDArray[np.int64]
    field_goal: NDArray[np.float64]
    scenarios: NDArray[np.int64]
    cast: NDArray[np.float64]
    spots: NDArray[np.float64]
    pool: NDArray[np.int64]


class OrcaTables(NamedTuple):
    """ORCA's obstacles, one set per map, its numbers and its scratch arrays."""

    edges_f: NDArray[np.float32]
    edges_i: NDArray[np.int32]
    params: NDArray[np.float32]
    agents: NDArray[np.float32]
    work_f: NDArray[np.float32]
    work_i: NDArray[np.int32]


# --- rules (RULE_FIELDS,) float64, one array per config --------------------------------------------------------------
R_DT = 0
R_STEPS = 1  # longest episode
R_ROBOTS = 2
R_ORIGINAL = 3  # 1: the released software, quirk by quirk
R_LEGS = 4  # 1: legs in the lidar, 0: trunks
R_DAMAGE = 5  # 1: collisions do damage, 0: they end the episode
R_MAX_DAMAGE = 6
R_GOAL_RADIUS = 7
R_IAN_REWARD = 8  # 1: the reward of the original's map environments, 0: the paper's
R_SPIN = 9  # cost of the rotation, squared, as a share of the largest
R_BOUNCE = 10  # 1: a collision puts back
R_INERTIA = 11  # 1: the robots have inertia
R_INERTIA_REST = 12  # 1: all robots but the first have it
R_HUMAN_POLICY = 13  # one of WALK_*
R_DIFFERENTIAL = 14  # 1: the sideways command is 0
R_MAX_VX = 15  # three: largest velocities
R_ACCELERATION = 18  # three: of the robots
R_JERK = 21  # three
R_HUMAN_ACCELERATION = 24  # three
R_HUMAN_JERK = 27  # three
R_REWARD_GOAL = 30
R_REWARD_COLLISION = 31
R_REWARD_DANGER = 32
R_REWARD_PROGRESS = 33
R_DANGER_DIST = 34
R_RADIUS = 35  # of all agents [m]
R_HUMANS = 36  # mean number of humans where no scenario says it
R_WANT_FIELD = 37  # 1: worlds keep the goal field of the first robot, for planner-guided policies
R_REDRAWS = 38  # original: how often start and goal are drawn before they count
R_SPEED_LOW = 39  # preferred speeds of humans that are not planned [m/s]
R_SPEED_HIGH = 40
R_ELLIPSE = 41  # 1: ellipses in the lidar
RULE_FIELDS = 42

WALK_PLANNED = 0
WALK_ORCA = 1
WALK_STATIC = 2
WALK_CONSTANT = 3


class MapWorldState(NamedTuple):
    """The worlds of a batch; every array has a leading world axis."""

    agents: NDArray[np.float64]
    walkers: NDArray[np.float64]
    contacts: NDArray[np.int8]
    scalars: NDArray[np.float64]
    place: NDArray[np.float64]
    own_field: NDArray[np.float32]
    rng: NDArray[np.uint64]
    seeded: NDArray[np.uint64]
