"""From the name of a policy to something that rolls out sequences."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from navrep_data.errors import PolicyError, check_whole
from navrep_data.sb3_file import refuse_sb3_file
from navrep_data.sim import (
    SCRIPTED,
    CallableMapRollout,
    CallableRollout,
    PolicyFunction,
    RolloutSettings,
    ScriptedMapRollout,
    ScriptedPolicy,
    ScriptedRollout,
    SimConfig,
)


@dataclass(frozen=True)
class PolicySpec:
    """A policy as the manifest records it.

    Attributes
    ----------
    name : str
        Scripted name, ``module:function``, or the qualified name of a callable that was passed in.
    batch : int
        Sequences per group for Python policies, 1 for scripted ones.
    function : callable or None
        The callable itself where one was passed in.
    """

    name: str = "orca"
    batch: int = 1
    function: PolicyFunction | None = None

    @property
    def scripted(self) -> bool:
        """True for policies that run inside the kernels."""
        return self.function is None and ":" not in self.name

    def to_dict(self) -> dict[str, Any]:
        """Return what the manifest stores."""
        if self.scripted:
            return {**ScriptedPolicy(self.name).to_dict(), "batch": 1}
        return {"name": self.name, "batch": self.batch}


def make_policy(policy: str | PolicyFunction, batch: int) -> PolicySpec:
    """Return the spec of a policy given by name, as ``module:function`` or as a callable.

    Raises
    ------
    UnknownNameError
        If a name is neither scripted nor ``module:function``.
    PolicyError
        If the batch size cannot be used.
    """
    batch = check_whole("policy_batch", batch, 1, 4096, PolicyError)
    if callable(policy):
        kind = policy if hasattr(policy, "__qualname__") else type(policy)
        return PolicySpec(f"{kind.__module__}:{kind.__qualname__}", batch, policy)
    if "/" in policy or policy.startswith("~"):
        refuse_sb3_file(Path(policy).expanduser(), "navrep-data generate --policy")
        raise PolicyError(
            f"policy is {policy!r}, expected one of: {', '.join(SCRIPTED)}, or module:function. A network drives as "
            f"one: a file drive.py with the line `from navrep_data import zoo; policy = zoo.load({policy!r})` is named "
            "drive:policy."
        )
    if ":" in policy:
        return PolicySpec(policy, batch)
    return PolicySpec(ScriptedPolicy(policy).name)


def load_callable(name: str, others: Iterable[str] = SCRIPTED) -> PolicyFunction:
    """Import ``module:attribute``; the current folder is searched first, as ``python -m`` does.

    Parameters
    ----------
    name : str
        ``module:attribute``.
    others : iterable of str
        Names that the error offers instead.

    Raises
    ------
    PolicyError
        If the module or attribute cannot be imported or is not callable.
    """
    module_name, _, attribute = name.partition(":")
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.insert(0, here)
    try:
        found: Any = importlib.import_module(module_name)
        for part in attribute.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError, ValueError) as error:
        raise PolicyError(
            f"Policy {name!r} cannot be imported ({error}). Expected module:function, importable from {here}, or one "
            f"of: {', '.join(others)}."
        ) from error
    if isinstance(found, type):
        found = found()
    if not callable(found):
        raise PolicyError(f"Policy {name!r} is a {type(found).__name__}, expected a callable (scan, robot_state).")
    return found  # type: ignore[no-any-return]


def make_rollout(
    config: SimConfig, settings: RolloutSettings, policy: PolicySpec, seed: int
) -> ScriptedRollout | CallableRollout:
    """Return the object that makes this dataset's sequences."""
    on_map = config.world == "map"
    if policy.scripted:
        scripted = ScriptedMapRollout if on_map else ScriptedRollout
        return scripted(config, settings, ScriptedPolicy(policy.name), seed)
    function = policy.function if policy.function is not None else load_callable(policy.name)
    called = CallableMapRollout if on_map else CallableRollout
    return called(config, settings, function, seed, policy.batch)
