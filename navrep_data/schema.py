"""Names, shapes, dtypes and units of everything that is stored: format version 2.

Notes
-----
The on-disk columns follow RLDS step semantics: an episode of T actions has T + 1 rows, and the last row's action and
reward are zero and mean nothing. Difference to the original's npz: there a row holds the action that *led to* it.
"""

from __future__ import annotations

import enum
import math
import numbers
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from navrep_data.errors import ConfigError, SchemaVersionError

FORMAT_NAME = "navrep-data"
FORMAT_VERSION = 2
OLDEST_FORMAT = 2
"""Format 1 was never released; from 2 on, every released format stays readable."""

N_RAYS = 1080
# The original's ray table: linspace(0, 6.27543783188, 1080) (pepper_2d_simulator.py); a hair short of a full turn.
ANGLE_SPAN = 6.27543783188
RANGE_MAX = 25.0
DT = 0.2
RINGS_SHAPE = (64, 64)
ROBOT_STATE_SIZE = 5
ACTION_SIZE = 3
HUMAN_FIELDS = ("x", "y", "vx", "vy", "radius", "visible")

SCAN_SCALE = 0.001
"""Metres per count of a uint16 scan."""
UINT16_RANGE_LIMIT = 65.0
"""Scans with a larger range_max [m] are stored as float32: 65.535 m is the end of uint16 millimetres."""


MAX_COORDINATE = 16384.0
"""World coordinates lie within this distance of 0 along each axis [m]: up to here float32, which stores poses and in
which ORCA reckons, tells a millimetre."""


class Event(enum.IntEnum):
    """Why an episode ended; 0 on every row but the last."""

    NONE = 0
    GOAL = 1
    COLLISION_HUMAN = 2
    COLLISION_OBSTACLE = 3
    TIMEOUT = 4
    STUCK = 5
    CUT = 6

    @property
    def label(self) -> str:
        """Lower-case name as used in attributes, cards and tables."""
        return self.name.lower()

    @property
    def terminal(self) -> bool:
        """True where the task itself ended (goal or collision), False where the episode was only cut short."""
        return self in (Event.GOAL, Event.COLLISION_HUMAN, Event.COLLISION_OBSTACLE)


EVENT_NAMES = tuple(event.label for event in Event)


@dataclass(frozen=True)
class SensorContract:
    """What a scan means; models refuse scans of another contract.

    Attributes
    ----------
    n_rays : int
        Number of rays.
    angle_min : float
        Angle of ray 0 [rad], robot frame, anticlockwise.
    angle_increment : float
        Angle between neighbouring rays [rad].
    range_max : float
        Range stored where a ray hits nothing [m].
    dt : float
        Time between rows [s].
    """

    n_rays: int = N_RAYS
    angle_min: float = 0.0
    angle_increment: float = ANGLE_SPAN / (N_RAYS - 1)
    range_max: float = RANGE_MAX
    dt: float = DT

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as plain JSON values."""
        return asdict(self)

    def covers_full_turn(self) -> bool:
        """Return whether the rays go once around, to within two increments."""
        return abs(self.n_rays * self.angle_increment - 2.0 * math.pi) < 2.0 * self.angle_increment


# The training environment (agent.py, crowd_sim.py) draws the robot's radius from 0.3 to 0.5 m for every episode, and a
# full action is 1 m/s along each axis. That the smallest radius stands for them was chosen (docs/experiments.md): what
# is at the edge of a robot then looks at least as near as it ever did in training.
TRAINING_SPEED, TRAINING_RADIUS = 1.0, 0.3


@dataclass(frozen=True)
class RobotContract:
    """What a policy takes for granted of the robot that it drives.

    Attributes
    ----------
    max_speed : float
        Velocity along x and y that an action of 1 stands for [m/s]; any real number, numpy's too, kept as a float.
    radius : float
        Radius of the footprint [m]; where it is drawn for every episode (0.3 to 0.5 m in worlds of polygons), the
        smallest.
    """

    max_speed: float = TRAINING_SPEED
    radius: float = TRAINING_RADIUS

    def __post_init__(self) -> None:
        """Check both."""
        for name, value, most in (("max_speed", self.max_speed, 100.0), ("radius", self.radius, 10.0)):
            if isinstance(value, bool) or not isinstance(value, numbers.Real) or not 0.0 < value <= most:
                unit = "m/s" if name == "max_speed" else "m"
                raise ConfigError(f"A robot's {name} is {value!r}, expected more than 0 and at most {most:g} {unit}.")
            object.__setattr__(self, name, float(value))

    def to_dict(self) -> dict[str, float]:
        """Return the fields as plain JSON values."""
        return asdict(self)


@dataclass(frozen=True)
class Column:
    """One column of a shard.

    Attributes
    ----------
    name : str
        HDF5 dataset name.
    shape : tuple of int
        Shape per row; -1 = the dataset's largest number of humans, -2 = the number of rays.
    dtype : str
        numpy dtype; ``"scan"`` = the dataset's scan dtype (uint16 or float32).
    unit : str
        Units, empty if none.
    description : str
        One line for attributes and cards.
    wide : bool
        True for columns stored in row chunks of their own; narrow ones have one chunk per sequence.
    may_be_nan : bool
        True where NaN is a legal value.
    optional : bool
        True where a dataset may lack it.
    """

    name: str
    shape: tuple[int, ...]
    dtype: str
    unit: str
    description: str
    wide: bool = False
    may_be_nan: bool = False
    optional: bool = False


HUMANS_AXIS = -1
RAYS_AXIS = -2

SIMULATED_COLUMNS = ("scan_label", "contact", "humans")
"""Columns that only a simulator can fill: no recording has them."""
LABEL_NOTHING, LABEL_STATIC, LABEL_ROBOT, LABEL_HUMAN = 0, 1, 2, 3
"""Values of the column scan_label; the human in slot k of the column humans is ``LABEL_HUMAN + k``."""
MAX_LABELLED = 256 - LABEL_HUMAN
"""Slots of humans that labels of 8 bits can tell apart."""
CONTACT_NONE, CONTACT_HUMAN, CONTACT_ROBOT, CONTACT_STATIC = 0, 1, 2, 3
"""Values of the column contact."""

COLUMNS: dict[str, Column] = {
    c.name: c
    for c in (
        Column("scan", (RAYS_AXIS,), "scan", "mm or m", "lidar ranges, ray 0 straight ahead, anticlockwise; 0 = invalid", wide=True),
        Column("rings", RINGS_SHAPE, "uint8", "", "polar occupancy, angle x radius: 0 free, 1 unknown, 2 occupied", wide=True, optional=True),
        Column("scan_label", (RAYS_AXIS,), "uint8", "", "what each ray hit, before noise: 0 nothing, 1 static, 2 another robot, 3 + k the human in slot k of humans", wide=True, optional=True),
        Column("robot_state", (ROBOT_STATE_SIZE,), "float32", "m, m, m/s, m/s, rad/s", "goal x, goal y, vx, vy, omega in the robot frame", may_be_nan=True),
        Column("action", (ACTION_SIZE,), "float32", "m/s, m/s, rad/s", "body velocity command taken from this row's observation"),
        Column("reward", (), "float32", "", "result of this row's action"),
        Column("is_first", (), "bool", "", "first row of an episode"),
        Column("is_last", (), "bool", "", "last row of an episode; its action and reward mean nothing"),
        Column("is_terminal", (), "bool", "", "last row of an episode that ended in goal or collision"),
        Column("event", (), "uint8", "", "why the episode ended, 0 except on its last row"),
        Column("contact", (), "uint8", "", "what the robot touched during this row's action, where collisions do damage: 0 nothing, 1 human, 2 robot, 3 static", optional=True),
        Column("sequence", (), "int32", "", "sequence index in the dataset"),
        Column("episode", (), "int32", "", "episode index within the sequence"),
        Column("step", (), "int32", "", "row index within the episode"),
        Column("robot_pose", (3,), "float32", "m, m, rad", "x, y, theta in the world frame; NaN where unknown", may_be_nan=True),
        Column("robot_radius", (), "float32", "m", "robot radius; NaN where unknown", may_be_nan=True),
        Column("humans", (HUMANS_AXIS, len(HUMAN_FIELDS)), "float32", "m, m, m/s, m/s, m, -", "x, y, vx, vy along the robot's axes (rounded to 1/1024), radius, visible; one slot per human per episode, NaN-padded", wide=True, may_be_nan=True, optional=True),
        Column("leading_action", (ACTION_SIZE,), "float64", "m/s, m/s, rad/s", "action that led to this row (imports only)", optional=True),
        Column("leading_reward", (), "float64", "", "reward that came with this row (imports only)", optional=True),
        Column("source_robot_state", (ROBOT_STATE_SIZE,), "float64", "m, m, m/s, m/s, rad/s", "robot_state with the source's precision, so that imports export unchanged", may_be_nan=True, optional=True),
    )
}  # fmt: skip


INFERENCE = ("deterministic", "as_released")
"""How memories run: without noise, or with that of the release."""
RANGES = ("contract", "as_released")
"""How ranges reach a network: cut at its contract's, or as the authors fed them."""
SCALING = ("robot", "none")
"""Whether a network is shown the robot in the proportions of that of its training, or drives as trained."""
RESULTS_FORMAT, RESULTS_VERSION = "navrep-data-benchmark", 2
"""What a results file of a benchmark begins with. 2: contacts, time stopped and the first round."""


def check_results_version(value: Any, path: Path | str) -> None:
    """Refuse a results file of the version that did not record contacts.

    Parameters
    ----------
    value : object
        The file's JSON, whatever it is.
    path : path-like
        The file, for the message.

    Raises
    ------
    SchemaVersionError
        If it is one.
    """
    if isinstance(value, Mapping) and (value.get("format"), value.get("version")) == (RESULTS_FORMAT, 1):
        raise SchemaVersionError(
            f"{path} is of format version 1, which does not say what the robot touched, expected version "
            f"{RESULTS_VERSION}: play it again, navrep-data benchmark NAME --suite SUITE with another --out."
        )


def fed_as(settings: Mapping[str, Any]) -> str:
    """Return in words how a network was fed where that is not the default, from the settings in a results file."""
    if settings.get("ranges") == "as_released":
        return "ranges as the authors fed them"  # their software scales nothing
    return "as trained" if settings.get("scaling") == "none" else ""


def noise_of(settings: Mapping[str, Any]) -> str:
    """Return in words whether memories ran with noise, from the settings in a results file; empty where they did not."""
    return "noise of the release" if settings.get("inference") == "as_released" else ""


def result_name(name: str, settings: Mapping[str, Any]) -> str:
    """Return what results are called: the policy's name, and how it ran where that is not the default."""
    how = ", ".join(word for word in (noise_of(settings), fed_as(settings)) if word)
    return f"{name} ({how})" if how else name
