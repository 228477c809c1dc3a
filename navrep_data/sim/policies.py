"""Scripted robot policies that run inside the kernels, and the settings of any policy."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from navrep_data.errors import ConfigError, UnknownNameError, did_you_mean
from navrep_data.sim import _layout as lay

SCRIPTED = {
    "orca": lay.POLICY_ORCA,
    "goal-momentum": lay.POLICY_GOAL_MOMENTUM,
    "random-momentum": lay.POLICY_RANDOM_MOMENTUM,
    "constant-velocity": lay.POLICY_CONSTANT_VELOCITY,
}
"""Name -> code: ORCA with stuck rule; momentum pulled to the goal; random momentum; one velocity per episode."""


@dataclass(frozen=True)
class ScriptedPolicy:
    """A policy that the kernels know.

    Attributes
    ----------
    name : str
        One of :data:`SCRIPTED`.
    stuck_speed : float
        ORCA gives an episode up (event `stuck`) where it would move slower than this [m/s].
    omega_noise : float
        ORCA's rotation command is uniform in +- half of this [rad/s].
    speed : float
        Speed at the goal's side of goal-momentum, largest speed of constant-velocity [m/s].

    Notes
    -----
    Source: make_vae_dataset.py of the original (ORCA, its stuck rule and random momentum).
    """

    name: str = "orca"
    stuck_speed: float = 0.1
    omega_noise: float = 0.1
    speed: float = 1.0

    def __post_init__(self) -> None:
        """Check the name and the ranges."""
        if self.name not in SCRIPTED:
            raise UnknownNameError(
                f"Unknown policy {self.name!r}.{did_you_mean(self.name, SCRIPTED)} Scripted ones: "
                f"{', '.join(SCRIPTED)}; your own: module:function."
            )
        for field in ("stuck_speed", "omega_noise", "speed"):
            value = getattr(self, field)
            if not 0.0 <= value <= 10.0:
                raise ConfigError(f"{field} is {value!r}, expected a number from 0 to 10.")

    def to_dict(self) -> dict[str, Any]:
        """Return the settings as plain JSON values."""
        return asdict(self)
