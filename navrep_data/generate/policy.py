"""From what people type for a policy to something that rolls out sequences."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from navrep_data.errors import PolicyError, check_whole
from navrep_data.io import HUB_SCHEME, is_path
from navrep_data.policies import AnyPolicy, Driver, PolicySpec, resolve_policy
from navrep_data.sb3_file import refuse_sb3_file
from navrep_data.sim import (
    SCRIPTED,
    DrivenMapRollout,
    DrivenRollout,
    RolloutSettings,
    ScriptedMapRollout,
    ScriptedPolicy,
    ScriptedRollout,
    SimConfig,
)

MAX_BATCH = 4096


@dataclass(frozen=True)
class DatasetPolicy:
    """A policy as the manifest records it.

    Attributes
    ----------
    name : str
        Scripted name, or text for :func:`navrep_data.policies.resolve_policy`.
    batch : int
        Sequences per group for policies that are asked at every row, 1 for scripted ones.
    spec : PolicySpec or None
        What is asked; None for scripted policies, which run inside the kernels.
    """

    name: str = "orca"
    batch: int = 1
    spec: PolicySpec | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return what the manifest stores."""
        if self.spec is None:
            return {**ScriptedPolicy(self.name).to_dict(), "batch": 1}
        return {"name": self.name, "batch": self.batch}

    def content(self) -> str:
        """Return a SHA-256 of what it is beside this package; empty where there is nothing, or it cannot be told."""
        return "" if self.spec is None else self.spec.content()

    def found_here(self) -> DatasetPolicy:
        """Return the same policy as this process finds it: its content may be another on another machine."""
        return self if self.spec is None else replace(self, spec=self.spec.found_here())

    def in_its_way(self) -> AbstractContextManager[None]:
        """Return a context to roll out in, see :meth:`navrep_data.policies.PolicySpec.in_its_way`."""
        return nullcontext() if self.spec is None else self.spec.in_its_way()


def make_policy(policy: AnyPolicy, batch: int) -> DatasetPolicy:
    """Return what a text, a function or a policy stands for in a dataset.

    Scripted names come first: ``orca`` here is ORCA with what the original did where it recorded, see
    :class:`navrep_data.sim.ScriptedPolicy`.

    Raises
    ------
    UnknownNameError
        If there is no such policy.
    PolicyError
        If it cannot be imported, or the batch size cannot be used.
    """
    batch = check_whole("policy_batch", batch, 1, MAX_BATCH, PolicyError)
    if isinstance(policy, str) and policy in SCRIPTED:
        return DatasetPolicy(policy)
    if isinstance(policy, str) and is_path(policy):
        refuse_sb3_file(Path(policy).expanduser(), "navrep-data generate --policy")
    spec = resolve_policy(policy, more=SCRIPTED)
    name = spec.name
    if spec.kind == "folder" and not name.startswith(HUB_SCHEME) and not is_path(name):
        name = f"./{Path(name).as_posix()}"  # a bare word is a name of the zoo
    return DatasetPolicy(name, batch, spec)


def make_rollout(
    config: SimConfig, settings: RolloutSettings, policy: DatasetPolicy, seed: int
) -> ScriptedRollout | DrivenRollout:
    """Return the object that makes this dataset's sequences."""
    on_map = config.world == "map"
    if policy.spec is None:
        scripted = ScriptedMapRollout if on_map else ScriptedRollout
        return scripted(config, settings, ScriptedPolicy(policy.name), seed)
    driven = DrivenMapRollout if on_map else DrivenRollout
    return driven(config, settings, Driver(policy.spec.make(policy.batch)), seed, policy.batch)
