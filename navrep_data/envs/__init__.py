"""Gymnasium environments over the simulator, single and vectorised (gymnasium and numpy, no torch)."""

from navrep_data.envs.playing import play
from navrep_data.envs.recording import Recording, goal_policy, record
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
    "NavRepVectorEnv",
    "Recording",
    "RingsObservation",
    "Scan1dObservation",
    "VectorFlatObservation",
    "VectorRingsObservation",
    "VectorScan1dObservation",
    "goal_policy",
    "gymnasium_id",
    "play",
    "record",
    "register",
]

register()
