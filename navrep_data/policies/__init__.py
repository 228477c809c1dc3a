"""What drives robots: one protocol for benchmarks, data, films and play, the baselines, and names for all of them."""

from navrep_data.policies.baselines import BASELINES, DwaPolicy, GoalPolicy, OrcaPolicy, RandomPolicy, to_goal
from navrep_data.policies.driver import Driver, observe
from navrep_data.policies.functions import FunctionPolicy, PolicyFunction
from navrep_data.policies.networks import NetworkPolicy
from navrep_data.policies.protocol import BasePolicy, Context, Observation
from navrep_data.policies.spec import AnyPolicy, PolicySpec, resolve_policy

__all__ = [
    "BASELINES",
    "AnyPolicy",
    "BasePolicy",
    "Context",
    "Driver",
    "DwaPolicy",
    "FunctionPolicy",
    "GoalPolicy",
    "NetworkPolicy",
    "Observation",
    "OrcaPolicy",
    "PolicyFunction",
    "PolicySpec",
    "RandomPolicy",
    "observe",
    "resolve_policy",
    "to_goal",
]
