"""Positions of everything in the packed arrays that the kernels share.

State lives in a few two-dimensional arrays because array arguments are expensive in numba (about 20 ns each per call).
These are names for columns, not configuration.
"""

# --- agents (N, AGENT_FIELDS) float64, world frame; rows 0..R-1 are the robots, then the humans ---------------------
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
# robots only
A_OMEGA = 13  # rotation during the last step, or with inertia that of the next [rad/s]
A_AX = 14  # acceleration, for inertia [m/s2], world frame
A_AY = 15
A_AOMEGA = 16  # [rad/s2]
A_DAMAGE = 17  # taken since reset [m/s]
A_EVENT = 18  # what the last step led to, for this robot
A_CLEAR_HUMAN = 19  # smallest gap to another agent during the last step [m]
A_CLEAR_STATIC = 20  # smallest gap to an obstacle during the last step [m]
# scratch of a step
A_HIT = 21  # the collision's event where this agent is put back
A_TAKEN = 22  # damage taken [m/s]
# all agents: what the first robot touched in the last step, by the rule that decides collisions; row 0: static matter
A_TOUCHED = 23  # 1 where it did
A_TOUCH_SPEED = 24  # how fast they moved against each other then [m/s]; row 0: the robot's own speed
AGENT_FIELDS = 25

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
S_EPISODE = 11  # episodes started since the world was made, minus one
S_CLEAR_HUMAN = 12  # smallest gap of a robot to another agent during the last step [m]
S_CLEAR_STATIC = 13  # smallest gap of a robot to an obstacle during the last step [m]
S_EVENT = 14  # how the episode ended, 0 while it goes on
S_FEWER_HUMANS = 15  # adaptive curriculum: how many fewer than the most difficult setting
S_FEWER_OBSTACLES = 16
S_NOISE_HIGH = 17  # key of the episode's scan noise: the upper and the lower 32 bits
S_NOISE_LOW = 18
SCALAR_FIELDS = 19

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
P_GOAL_RADIUS = 24  # 0: the robot's radius
P_MAX_DAMAGE = 25
P_ACCELERATION = 26  # three: x, y, rotation
P_JERK = 29  # three
P_SCAN_NOISE = 32
P_SCAN_DROPOUT = 33
PARAM_FIELDS = 34

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
F_ELLIPSE = 7  # 1: ellipses in the lidar
F_ROBOTS = 8  # number of robots
F_WORLD = 9  # one of WORLD_*
F_HUMAN_POLICY = 10  # one of HUMANS_*
F_DIFFERENTIAL = 11  # 1: the sideways command is 0
F_INERTIA = 12  # 1: acceleration and jerk are limited
F_DAMAGE = 13  # 1: collisions do damage and put back, 0: they end the episode
F_ADAPTIVE = 14  # 1: adaptive curriculum
F_NOISE = 15  # 1: scans have noise or dropout
F_HIDE_OMEGA = 16  # 1: the robot state shows a rotation of 0
F_WANT_LABELS = 17  # 1: note what static matter each ray hits, and fill the column scan_label
FLAG_FIELDS = 18

# --- owners of rays, beside agents by their place among the others ---------------------------------------------------
RAY_NOTHING = -1  # where labels are not wanted also static matter
RAY_STATIC = -2

WORLD_POLYGONS = 0
WORLD_EMPTY = 1
WORLD_MAP = 2

HUMANS_ORCA = 0
HUMANS_STATIC = 1
HUMANS_CONSTANT_VELOCITY = 2
HUMANS_PLANNED = 3

POLICY_ORCA = 0
POLICY_GOAL_MOMENTUM = 1
POLICY_RANDOM_MOMENTUM = 2
POLICY_CONSTANT_VELOCITY = 3

# --- random streams ------------------------------------------------------------------------------------------------
RNG_WORDS = 632
"""uint64 words per stream: a Mersenne Twister's 624 and its position, or a Philox key, counter and buffer."""

MAX_OBSTACLE_EDGES = 512
"""Room for the edges of a world after RVO2's tree has split them; worlds that need more are drawn again."""
