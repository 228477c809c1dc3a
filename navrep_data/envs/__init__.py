"""Gymnasium environments over the simulator, single and vectorised (gymnasium and numpy, no torch)."""

from typing import Any

from navrep_data.envs.playing import play
from navrep_data.envs.recording import Recording, record
from navrep_data.envs.single import NavRepEnv
from navrep_data.envs.vector import NavRepVectorEnv
from navrep_data.envs.wrappers import (
    FlatObservation,
    RingsObservation,
    Scan1dObservation,
    VectorFlatObservation,
    VectorRingsObservation,
    VectorScan1dObservation,
)
from navrep_data.registration import register
from navrep_data.sim import gymnasium_id

__all__ = [
    "FlatObservation",
    "NavRepEnv",
    "NavRepSB3VecEnv",
    "NavRepVectorEnv",
    "Recording",
    "RingsObservation",
    "Scan1dObservation",
    "VectorFlatObservation",
    "VectorRingsObservation",
    "VectorScan1dObservation",
    "gymnasium_id",
    "make_sb3_vec",
    "play",
    "record",
    "register",
]

_WITH_SB3 = ("NavRepSB3VecEnv", "make_sb3_vec")


def __getattr__(name: str) -> Any:
    """Load what needs stable-baselines3 when it is asked for: with it comes torch."""
    if name not in _WITH_SB3:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from navrep_data.envs import sb3

    return getattr(sb3, name)


register()
