"""The simulator's configuration: one frozen dataclass, stored as JSON in every manifest."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from navrep_data.errors import ConfigError, did_you_mean
from navrep_data.schema import SensorContract
from navrep_data.sim import _layout as lay

PHYSICS = ("consistent", "original")
CROSSINGS = ("circle", "square")
RENDERINGS = ("legs", "trunk")
# 1.5 times this many humans stand in a ring of 4 to 11.5 m; more find no place, and the humans column grows with it.
MAX_HUMANS = 60
MAX_OBSTACLES = 20
MAX_RAYS = 16384


@dataclass(frozen=True)
class SimConfig:
    """What a world is like and how it behaves.

    Attributes
    ----------
    env : str
        Name in the registry that this config came from.
    physics : str
        ``"consistent"``: one geometry for lidar, ORCA and collisions, rewards as in the paper.
        ``"original"``: what the released software does, see docs/differences.md.
    crossing : str
        ``"circle"`` (training): humans cross a circle; ``"square"`` (test): a square.
    humans : int
        Mean number of humans; an episode has 0.5 to 1.5 times as many.
    obstacles : int
        Largest number of squares, and of walls; an episode has 0 to this many of each.
    rendering : str
        What the lidar sees of a human: ``"legs"`` or ``"trunk"`` (a circle of its radius).
    polygon_scale : float
        Factor on obstacle sizes; 1.25 as the original's lidar sees them in training, 1.0 in its test. In `original`
        physics it applies to what lidar and ORCA see, never to what the robot collides with.
    time_limit : float
        Longest episode [s].
    sensor : SensorContract
        Rays, angles, largest range [m] and time step [s].
    """

    env: str = "soadrl"
    physics: str = "consistent"
    crossing: str = "circle"
    humans: int = 20
    obstacles: int = 10
    rendering: str = "legs"
    polygon_scale: float = 1.25
    time_limit: float = 35.0
    sensor: SensorContract = field(default_factory=SensorContract)

    def __post_init__(self) -> None:
        """Check every field; see `ConfigError` messages for what is accepted."""
        _one_of("physics", self.physics, PHYSICS)
        _one_of("crossing", self.crossing, CROSSINGS)
        _one_of("rendering", self.rendering, RENDERINGS)
        _whole("humans", self.humans, 0, MAX_HUMANS)
        _whole("obstacles", self.obstacles, 0, MAX_OBSTACLES)
        _number("polygon_scale", self.polygon_scale, 0.1, 4.0)
        _number("time_limit", self.time_limit, self.sensor.dt, 3600.0)
        _whole("sensor.n_rays", self.sensor.n_rays, 1, MAX_RAYS)
        _number("sensor.range_max", self.sensor.range_max, 0.1, 1000.0)
        _number("sensor.dt", self.sensor.dt, 0.01, 1.0)
        _number("sensor.angle_min", self.sensor.angle_min, -2 * math.pi, 2 * math.pi)
        _number("sensor.angle_increment", self.sensor.angle_increment, 1e-6, 2 * math.pi)
        if (self.sensor.n_rays - 1) * self.sensor.angle_increment > 2 * math.pi:
            raise ConfigError(
                f"sensor: {self.sensor.n_rays} rays x {self.sensor.angle_increment} rad are more than a full turn; "
                "expected (n_rays - 1) x angle_increment <= 2 pi."
            )

    @property
    def max_humans(self) -> int:
        """Largest number of humans that an episode can have: round(1.5 x humans)."""
        return round(self.humans * 1.5)

    @property
    def max_polygons(self) -> int:
        """Largest number of polygons that an episode can have, border included."""
        return 2 * self.obstacles + 1

    def replace(self, **changes: Any) -> SimConfig:
        """Return a copy with some fields changed, checked again."""
        known = [f.name for f in dataclasses.fields(self)]
        for name in changes:
            if name not in known:
                raise ConfigError(f"Unknown setting {name!r}.{did_you_mean(name, known)} Known: {', '.join(known)}.")
        return dataclasses.replace(self, **changes)

    def to_dict(self) -> dict[str, Any]:
        """Return the config as plain JSON values."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> SimConfig:
        """Build a config from :meth:`to_dict`'s result.

        Raises
        ------
        ConfigError
            If a field is unknown or has a wrong value.
        """
        try:
            sensor = SensorContract(**values.get("sensor", {}))
            return cls(**{**values, "sensor": sensor})
        except TypeError as error:
            raise ConfigError(f"Config {values!r} does not fit this version: {error}.") from error


def _one_of(name: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise ConfigError(f"{name} is {value!r}, expected one of: {', '.join(known)}.{did_you_mean(str(value), known)}")


def _whole(name: str, value: int, low: int, high: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise ConfigError(f"{name} is {value!r}, expected a whole number from {low} to {high}.")


def _number(name: str, value: float, low: float, high: float) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise ConfigError(f"{name} is {value!r}, expected a number from {low:g} to {high:g}.")


def kernel_params(config: SimConfig) -> NDArray[np.float64]:
    """Return the config's numbers in the order of ``_layout``'s ``P_*``."""
    p = np.zeros(lay.PARAM_FIELDS)
    p[lay.P_DT] = config.sensor.dt
    p[lay.P_TIME_LIMIT] = config.time_limit
    p[lay.P_HUMANS] = config.humans
    p[lay.P_SQUARES] = config.obstacles
    p[lay.P_WALLS] = config.obstacles
    p[lay.P_POLYGON_SCALE] = config.polygon_scale
    p[lay.P_MAP_HALF] = 7.0  # test_soadrl_static.config: map_size_m 14
    p[lay.P_BORDER_GAP] = 1.0  # navreptrainenv.py
    p[lay.P_LEG_RADIUS] = 0.03  # pymap2d's default
    p[lay.P_DANGER_DIST] = 0.2  # discomfort_dist, and the paper's 0.2 m
    p[lay.P_REWARD_GOAL] = 100.0
    p[lay.P_REWARD_COLLISION] = -25.0
    p[lay.P_REWARD_DANGER] = -1.0
    # per metre; navreptrainenv.py pays a tenth of the paper's
    p[lay.P_REWARD_PROGRESS] = 0.1 if config.physics == "original" else 1.0
    p[lay.P_ANGLE_MIN] = config.sensor.angle_min
    p[lay.P_ANGLE_INCREMENT] = config.sensor.angle_increment
    p[lay.P_RANGE_MAX] = config.sensor.range_max
    p[lay.P_RADIUS_LOW], p[lay.P_RADIUS_HIGH] = 0.3, 0.5  # agent.py: sample_random_attributes
    p[lay.P_VPREF_LOW], p[lay.P_VPREF_HIGH] = 0.8, 1.2
    return p


def kernel_flags(config: SimConfig) -> NDArray[np.int64]:
    """Return the config's switches in the order of ``_layout``'s ``F_*``."""
    f = np.zeros(lay.FLAG_FIELDS, np.int64)
    f[lay.F_SQUARE_CROSSING] = config.crossing == "square"
    f[lay.F_LEGS] = config.rendering == "legs"
    f[lay.F_ORIGINAL] = f[lay.F_GAP_QUIRK] = config.physics == "original"
    return f


def orca_params(config: SimConfig) -> NDArray[np.float32]:
    """Return ORCA's numbers (orca.py of the original): neighbours 10 m, 10 of them, horizons 5 s and 5 s, dt."""
    return np.array([10.0, 10.0, 5.0, 5.0, config.sensor.dt], np.float32)
