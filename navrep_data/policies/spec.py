"""One parser of what people type for a policy, and what workers are told to make of it."""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

from navrep_data.errors import ConfigError, PolicyError
from navrep_data.io import is_path
from navrep_data.policies.baselines import BASELINES
from navrep_data.policies.functions import BLOCK, FunctionPolicy, load_attribute, source_hash
from navrep_data.policies.networks import NetworkPolicy, knows_robots
from navrep_data.policies.protocol import BasePolicy
from navrep_data.schema import INFERENCE, RANGES, SCALING

LOADERS = {"zoo": "navrep_data.zoo.as_policy:Zoo", "folder": "navrep_data.zoo.as_policy:Folder"}
"""Kind -> ``module:class`` with ``find(name, source, how, more) -> PolicySpec`` and ``load(spec)``. The module is
imported when somebody names such a policy, so that everything else stays without torch."""

AnyPolicy = str | BasePolicy | Callable[[Any, Any], Any]
"""What stands for a policy in Python: a text as on the command line, a policy, or a function."""


@dataclass(frozen=True)
class PolicySpec:
    """A policy as results and datasets record it, and as worker processes are told to make it.

    Attributes
    ----------
    name : str
        Full name.
    sees : str
        See :class:`BasePolicy`.
    variant : str
        What runs of one kind share, such as ``e2e_1d``; the name itself for others.
    kind : str
        baseline, zoo, folder, function (also a :class:`BasePolicy` of somebody's module), or object: a policy that
        knows robots, such as one that the zoo loaded, given as ``module:name`` or as it is.
    source : str or None
        Where files are looked for first; for a folder, the folder.
    inference : str
        deterministic or as_released.
    ranges, scaling : str
        contract or as_released; robot or none. See :func:`navrep_data.evaluate.benchmark`.
    files : dict
        Hashes of what decides its actions, by file.
    given : callable, BasePolicy or None
        The policy itself where one was passed in.
    """

    name: str
    sees: str
    variant: str
    kind: str
    source: str | None = None
    inference: str = "deterministic"
    ranges: str = "contract"
    scaling: str = "robot"
    files: dict[str, str] = field(default_factory=dict)
    given: Any = None

    @property
    def is_network(self) -> bool:
        """Whether inference, ranges and scaling mean something for it."""
        return self.kind in ("zoo", "folder", "object")

    @contextlib.contextmanager
    def in_its_way(self) -> Iterator[None]:
        """Set torch as networks are played: numbers must not depend on how many cores there are.

        Worker processes are the parallelism. What torch was set to is put back at the end of the ``with``.
        """
        if not self.is_network:
            yield
            return
        # torch is imported for networks alone
        with importlib.import_module("navrep_data.models.checkpoint").one_thread():
            yield

    def make(self, rows: int = BLOCK, first_seed: int = 0) -> BasePolicy:
        """Return the policy itself; loads weights.

        Parameters
        ----------
        rows : int
            Rows that functions and networks always see.
        first_seed : int
            Of the noise of networks that run as released, see :class:`NetworkPolicy`.
        """
        if self.kind == "baseline":
            return BASELINES[self.name]()
        if self.kind in LOADERS:
            return NetworkPolicy(_loader(self.kind).load(self), rows, first_seed, self.scaling)
        found = load_attribute(self.name) if self.given is None else self.given
        if self.kind == "object":
            return NetworkPolicy(found, rows, first_seed, self.scaling)
        return found if isinstance(found, BasePolicy) else FunctionPolicy(self.name, found, rows)

    def fed(self, inference: str, ranges: str, scaling: str) -> PolicySpec:
        """Return this policy, run and fed in another way."""
        return replace(self, inference=inference, ranges=ranges, scaling=scaling)

    def settings(self) -> dict[str, str]:
        """Return how a network is fed, as results record it; empty for others, for which it means nothing."""
        return {"ranges": self.ranges, "scaling": self.scaling} if self.is_network else {}

    def found_here(self) -> PolicySpec:
        """Return the same policy as this process finds it, with the hashes of the files that are here."""
        if self.kind == "baseline" or self.given is not None:
            return self
        text = str(self.source) if self.kind == "folder" else self.name
        there = resolve_policy(text, self.source if self.kind == "zoo" else None)
        return replace(self, files=there.files)

    def content(self) -> str:
        """Return a SHA-256 of what decides its actions beside this package; empty where that cannot be told."""
        if set(self.files) <= {"source"}:
            return self.files.get("source", "")
        return hashlib.sha256("".join(f"{k} {v}\n" for k, v in sorted(self.files.items())).encode()).hexdigest()


def resolve_policy(
    policy: AnyPolicy,
    source: str | os.PathLike[str] | None = None,
    inference: str = "deterministic",
    on_maps: bool = False,
    ranges: str = "contract",
    scaling: str | None = None,
    more: Iterable[str] = (),
) -> PolicySpec:
    """Return what a text, a function or a policy stands for.

    Parameters
    ----------
    policy : str, callable or BasePolicy
        A baseline's name, a name of the zoo, the folder of a policy (``./folder``, written by
        ``navrep-data train controller`` or :func:`navrep_data.zoo.save_policy`), ``hf://user/name``,
        ``module:function``, a callable (scan, robot_state) -> action, or a policy.
    source : path-like or str, optional
        Folder or address with the zoo's files.
    inference : str
        For the zoo's memories.
    on_maps : bool
        Whether it will drive in worlds on maps, where baselines are given the planned path.
    ranges, scaling : str, optional
        See :func:`navrep_data.evaluate.benchmark`; ignored for what is no network.
    more : iterable of str
        Names that the caller knows beside these, for the refusal of others.

    Raises
    ------
    UnknownNameError
        If there is no such policy.
    ConfigError
        If `inference`, `ranges` or `scaling` is unknown.
    PolicyError
        If it cannot be imported, or the name is that of a network that is no policy.
    ModelNotFoundError, CheckpointError
        If there is no policy in the folder, or it cannot be loaded.
    """
    if inference not in INFERENCE:
        raise ConfigError(f"inference is {inference!r}, expected one of: {', '.join(INFERENCE)}.")
    how = {"inference": inference, "ranges": ranges, "scaling": _scaling(ranges, scaling)}
    if not isinstance(policy, str):
        if not callable(policy) and not hasattr(policy, "act"):
            raise PolicyError(
                f"policy is {policy!r}, expected a name, a function (scan, robot_state) -> action, or an object with "
                "act(scan, robot_state)."
            )
        kind = policy if hasattr(policy, "__qualname__") else type(policy)
        name = f"{kind.__module__}:{kind.__qualname__}"
        return replace(_from_object(name, policy, on_maps, ranges, scaling), given=policy)
    if policy in BASELINES:
        return _from_class(policy, BASELINES[policy], on_maps, "baseline")
    if is_path(policy):
        return _loader("folder").find(policy, None, how, more)
    if ":" in policy:
        return _from_object(policy, load_attribute(policy), on_maps, ranges, scaling)
    return _loader("zoo").find(policy, None if source is None else _from_anywhere(os.fspath(source)), how, more)


class _Loader(Protocol):
    """What :data:`LOADERS` name."""

    @staticmethod
    def find(name: str, source: str | None, how: Mapping[str, str], more: Iterable[str] = ()) -> PolicySpec: ...

    @staticmethod
    def load(spec: PolicySpec) -> Any: ...


def _loader(kind: str) -> _Loader:
    module, _, name = LOADERS[kind].partition(":")
    found: _Loader = getattr(importlib.import_module(module), name)
    return found


def _from_anywhere(source: str) -> str:
    """Return an address as it is and a folder as workers find it, whose working folders may be others."""
    return source if "://" in source else str(Path(source).expanduser().absolute())


def _scaling(ranges: str, scaling: str | None) -> str:
    """Return how networks are scaled: to the robot, but for ranges as the authors fed them, which nobody scaled."""
    if ranges not in RANGES:
        raise ConfigError(f"ranges is {ranges!r}, expected one of: {', '.join(RANGES)}.")
    if scaling is None:
        return "none" if ranges == "as_released" else "robot"
    if scaling not in SCALING:
        raise ConfigError(f"scaling is {scaling!r}, expected one of: {', '.join(SCALING)}.")
    if ranges == "as_released" and scaling == "robot":
        raise ConfigError("ranges as_released are what the authors' software feeds, unscaled: leave scaling out.")
    return scaling


def _from_class(name: str, policy: Any, on_maps: bool, kind: str) -> PolicySpec:
    sees = (on_maps and policy.sees_on_maps) or policy.sees or ", ".join(sorted(policy.needs)) or "goal only"
    return PolicySpec(name, sees, name, kind)


def _from_object(name: str, found: Any, on_maps: bool, ranges: str, scaling: str | None) -> PolicySpec:
    digest = source_hash(found)
    files = {"source": digest} if digest else {}
    if isinstance(found, BasePolicy):
        return replace(_from_class(name, found, on_maps, "function"), files=files)
    spec = PolicySpec(name, "scan", name, "function", files=files)
    if not knows_robots(found):
        return spec
    if ranges != "contract":
        raise ConfigError(f"ranges is {ranges!r}, but {name} is loaded already: give zoo.load the ranges, not here.")
    own = {what: getattr(found, what, getattr(spec, what)) for what in ("inference", "ranges")}
    return replace(spec, kind="object").fed(own["inference"], own["ranges"], _scaling(own["ranges"], scaling))
