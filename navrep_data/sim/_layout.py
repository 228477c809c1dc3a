"""Positions of everything in the packed arrays that the kernels share.

State lives in a few two-dimensional arrays because array arguments are expensive in numba (about 20 ns each per call).
These are names for columns, not configuration.
"""

# --- agents (N, AGENT_FIELDS) float64, world frame; row 0 is the robot, rows 1..n the humans -------------------------
A_X = 0
A_Y = 1
A_VX = 2
A_VY = 3
A_HEADING = 4
A_GX = 5
A_GY = 6
A_RADIUS = 7
A_VPREF = 8
A_SEES = 9  # 1 where this human takes the robot for a neighbour
A_GAIT_X = 10  # distance walked forward since the start of the episode [m]
A_GAIT_Y = 11  # distance walked sideways [m]
A_GAIT_T = 12  # heading accumulated [rad]
AGENT_FIELDS = 13

# --- scalars (SCALAR_FIELDS,) float64, per world --------------------------------------------------------------------
S_TIME = 0  # simulated time since reset [s]
S_STEP = 1  # steps since reset
S_HUMANS = 2  # number of humans
S_POLYGONS = 3  # number of polygons, border included
S_BORDER = 4  # 1 where the last polygon is the border
S_XMIN = 5
S_YMIN = 6
S_XMAX = 7
S_YMAX = 8
S_OBST_HUMAN = 9  # post-split obstacle edges known to the humans
S_OBST_ROBOT = 10  # ... to the robot
S_OMEGA = 11  # last rotation command [rad/s], as far as the observation shows it
S_EPISODE = 12  # episodes started since the world was made, minus one
S_CLEAR_HUMAN = 13  # smallest gap to a human during the last step [m]
S_CLEAR_STATIC = 14  # smallest gap to an obstacle during the last step [m]
SCALAR_FIELDS = 15

# --- params (PARAM_FIELDS,) float64, one array per config -----------------------------------------------------------
P_DT = 0
P_TIME_LIMIT = 1
P_HUMANS = 2  # mean number of humans; realised 0.5 to 1.5 times
P_SQUARES = 3  # most squares
P_WALLS = 4  # most walls
P_POLYGON_SCALE = 5
P_MAP_HALF = 6  # obstacle centres lie in +- this [m]
P_BORDER_GAP = 7
P_LEG_RADIUS = 8
P_DANGER_DIST = 9
P_REWARD_GOAL = 10
P_REWARD_COLLISION = 11
P_REWARD_DANGER = 12
P_REWARD_PROGRESS = 13
P_ANGLE_MIN = 14
P_ANGLE_INCREMENT = 15
P_RANGE_MAX = 16
P_STUCK_SPEED = 17
P_OMEGA_NOISE = 18
P_POLICY_SPEED = 19
P_RADIUS_LOW = 20
P_RADIUS_HIGH = 21
P_VPREF_LOW = 22
P_VPREF_HIGH = 23
PARAM_FIELDS = 24

# --- boxes (P, BOX_FIELDS) float64, per world: what the recipe knows of each polygon but the border -------------------
# consistent: centre x, y and half sides [m]. original: the cells of the collision grid that the obstacle fills
B_X0 = 0  # first column
B_X1 = 1  # one after the last column
B_Y0 = 2
B_Y1 = 3
B_STEP = 4  # 2 where only even columns and rows are filled
BOX_FIELDS = 5

# --- flags (FLAG_FIELDS,) int64, one array per config ---------------------------------------------------------------
F_ORIGINAL = 0  # 1: world recipe, rewards, collisions of the released software
F_SQUARE_CROSSING = 1  # 1: humans cross a square (test), 0: a circle (train, val)
F_LEGS = 2  # 1: legs in the lidar, 0: trunks
F_GAP_QUIRK = 3  # 1: the original renderer's invisible agents
F_SCAN_MM = 4  # 1: scans leave the kernel as uint16 millimetres
F_WANT_HUMANS = 5  # 1: fill the humans column
F_POLICY = 6  # one of POLICY_*
FLAG_FIELDS = 7

POLICY_ORCA = 0
POLICY_GOAL_MOMENTUM = 1
POLICY_RANDOM_MOMENTUM = 2
POLICY_CONSTANT_VELOCITY = 3

# --- random streams ------------------------------------------------------------------------------------------------
RNG_WORDS = 632
"""uint64 words per stream: a Mersenne Twister's 624 and its position, or a Philox key, counter and buffer."""

MAX_OBSTACLE_EDGES = 512
"""Room for the edges of a world after RVO2's tree has split them; worlds that need more are drawn again."""
