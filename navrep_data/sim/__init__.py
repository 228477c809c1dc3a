"""NavRepSim: worlds, humans, lidar and robot, for many independent worlds at once."""

from navrep_data.sim.actions import robot_contract, scale_actions, velocity_commands
from navrep_data.sim.config import SimConfig
from navrep_data.sim.gridmap import GridMap
from navrep_data.sim.map_rollout import DrivenMapRollout, ScriptedMapRollout
from navrep_data.sim.maps import load_map, map_names
from navrep_data.sim.policies import SCRIPTED, ScriptedPolicy
from navrep_data.sim.registry import (
    describe_environment,
    environment_name,
    environment_names,
    gymnasium_id,
    make_config,
    numpy_seed,
)
from navrep_data.sim.rollout import (
    DrivenRollout,
    RobotDriver,
    RolloutSettings,
    ScriptedRollout,
    SequenceRows,
)
from navrep_data.sim.scenarios import MAP_GROUPS, Scenario, get_scenario, scenario_names
from navrep_data.sim.simulator import Simulator, Touches, WorldState, check_seed, warm_up

__all__ = [
    "MAP_GROUPS",
    "SCRIPTED",
    "DrivenMapRollout",
    "DrivenRollout",
    "GridMap",
    "RobotDriver",
    "RolloutSettings",
    "Scenario",
    "ScriptedMapRollout",
    "ScriptedPolicy",
    "ScriptedRollout",
    "SequenceRows",
    "SimConfig",
    "Simulator",
    "Touches",
    "WorldState",
    "check_seed",
    "describe_environment",
    "environment_name",
    "environment_names",
    "get_scenario",
    "gymnasium_id",
    "load_map",
    "make_config",
    "map_names",
    "numpy_seed",
    "robot_contract",
    "scale_actions",
    "scenario_names",
    "velocity_commands",
    "warm_up",
]
