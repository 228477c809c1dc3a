"""NavRepSim: worlds, humans, lidar and robot, for many independent worlds at once."""

from navrep_data.sim.config import SimConfig
from navrep_data.sim.policies import SCRIPTED, ScriptedPolicy
from navrep_data.sim.registry import describe_environment, environment_names, gymnasium_id, make_config, numpy_seed
from navrep_data.sim.rollout import (
    CallableRollout,
    PolicyFunction,
    RolloutSettings,
    ScriptedRollout,
    SequenceRows,
)
from navrep_data.sim.simulator import Simulator, WorldState, check_seed, warm_up

__all__ = [
    "SCRIPTED",
    "CallableRollout",
    "PolicyFunction",
    "RolloutSettings",
    "ScriptedPolicy",
    "ScriptedRollout",
    "SequenceRows",
    "SimConfig",
    "Simulator",
    "WorldState",
    "check_seed",
    "describe_environment",
    "environment_names",
    "gymnasium_id",
    "make_config",
    "numpy_seed",
    "warm_up",
]
