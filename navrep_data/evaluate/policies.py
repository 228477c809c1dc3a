"""From names on the command line to what drives robots."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from navrep_data.errors import ConfigError, PolicyError, UnknownNameError, did_you_mean
from navrep_data.evaluate.baselines import DwaPilot, GoalPilot, OrcaPilot, RandomPilot
from navrep_data.evaluate.pilots import FunctionPilot, Pilot, ZooPilot
from navrep_data.generate.inputs import source_hash
from navrep_data.generate.policy import load_callable
from navrep_data.io import sha256_file
from navrep_data.schema import INFERENCE, RANGES, SCALING
from navrep_data.sim.driving import knows_robots
from navrep_data.zoo.fetching import HUB_SCHEME
from navrep_data.zoo.folders import place_of, policy_files
from navrep_data.zoo.names import here_hint, is_path

BASELINES: dict[str, type[Pilot]] = {pilot.name: pilot for pilot in (GoalPilot, RandomPilot, OrcaPilot, DwaPilot)}
"""Policies without weights, by name."""

NETWORKS = ("zoo", "folder", "object")
"""Kinds of policies for which inference, ranges and scaling mean something."""


@dataclass(frozen=True)
class PilotSpec:
    """A policy as results record it, and as worker processes are told to make it.

    Attributes
    ----------
    name : str
        Full name.
    sees : str
        See :class:`Pilot`.
    variant : str
        What runs of one kind share, such as ``e2e_1d``; the name itself for others.
    kind : str
        baseline, zoo, folder, function, or object: a policy that knows robots, such as one that the zoo loaded, given
        as ``module:name`` or as it is.
    source : str or None
        Where files are looked for first; for a folder, the folder.
    inference : str
        deterministic or as_released.
    ranges, scaling : str
        contract or as_released; robot or none. See :func:`navrep_data.evaluate.benchmark`.
    files : dict
        Hashes of what decides its actions, by file.
    function : callable or None
        Where one was passed in.
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
    function: Callable[[Any, Any], Any] | None = None

    @contextlib.contextmanager
    def in_its_way(self) -> Iterator[None]:
        """Set torch as networks are played: numbers must not depend on how many cores there are.

        Worker processes are the parallelism. What torch was set to is put back at the end of the ``with``.
        """
        if self.kind not in NETWORKS:
            yield
            return
        from navrep_data.models.checkpoint import one_thread

        with one_thread():
            yield

    def make(self, first_seed: int) -> Pilot:
        """Return the pilot itself; loads weights."""
        if self.kind == "baseline":
            return BASELINES[self.name]()
        if self.kind == "function":
            return FunctionPilot(self.name, self.function or load_callable(self.name, BASELINES))
        from navrep_data.zoo import load

        if self.kind == "object":
            return ZooPilot(self.function or load_callable(self.name, BASELINES), first_seed, self.scaling)
        place, source = (Path(str(self.source)), None) if self.kind == "folder" else (self.name, self.source)
        policy = load(place, source=source, inference=self.inference, ranges=self.ranges)
        return ZooPilot(policy, first_seed, self.scaling)

    def fed(self, inference: str, ranges: str, scaling: str) -> PilotSpec:
        """Return this policy, run and fed in another way."""
        return replace(self, inference=inference, ranges=ranges, scaling=scaling)

    def settings(self) -> dict[str, str]:
        """Return how a network is fed, as results record it; empty for others, for which it means nothing."""
        return {"ranges": self.ranges, "scaling": self.scaling} if self.kind in NETWORKS else {}


def resolve_policy(
    policy: str | Callable[[Any, Any], Any],
    source: str | os.PathLike[str] | None = None,
    inference: str = "deterministic",
    on_maps: bool = False,
    ranges: str = "contract",
    scaling: str | None = None,
) -> PilotSpec:
    """Return what a name stands for.

    Parameters
    ----------
    policy : str or callable
        A baseline's name, a name of the zoo, the folder of a policy (``./folder``, written by
        ``navrep-data train controller`` or :func:`navrep_data.zoo.save_policy`), ``hf://user/name``,
        ``module:function``, or a callable (scan, robot_state) -> action.
    source : path-like or str, optional
        Folder or address with the zoo's files.
    inference : str
        For the zoo's memories.
    on_maps : bool
        Whether it will drive in worlds on maps, where baselines are told the planned way.
    ranges, scaling : str, optional
        See :func:`navrep_data.evaluate.benchmark`; ignored for what is no network.

    Raises
    ------
    UnknownNameError
        If there is no such policy.
    ConfigError
        If `inference` is unknown.
    PolicyError
        If the name is that of a network that is no policy.
    ModelNotFoundError, CheckpointError
        If there is no policy in the folder, or it cannot be loaded.
    """
    if inference not in INFERENCE:
        raise ConfigError(f"inference is {inference!r}, expected one of: {', '.join(INFERENCE)}.")
    how = {"inference": inference, "ranges": ranges, "scaling": _scaling(ranges, scaling)}
    if not isinstance(policy, str):
        kind = policy if hasattr(policy, "__qualname__") else type(policy)
        name = f"{kind.__module__}:{kind.__qualname__}"
        return replace(_from_callable(name, policy, ranges, scaling), function=policy)
    if policy in BASELINES:
        pilot = BASELINES[policy]
        return PilotSpec(policy, (on_maps and pilot.sees_on_maps) or pilot.sees, policy, "baseline")
    if is_path(policy):
        return _from_folder(policy, how)
    if ":" in policy:
        return _from_callable(policy, load_callable(policy, BASELINES), ranges, scaling)
    return _from_zoo(policy, None if source is None else _from_anywhere(os.fspath(source)), how)


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


def _not_released(name: str) -> ConfigError:
    return ConfigError(
        f"ranges as_released means how the authors' software feeds their networks, and {name} is none of them: leave "
        "it out, its ranges are cut as in its training."
    )


def _hashes(function: Callable[..., Any]) -> dict[str, str]:
    digest = source_hash(function)
    return {"source": digest} if digest else {}


def _from_callable(name: str, function: Callable[..., Any], ranges: str, scaling: str | None) -> PilotSpec:
    spec = PilotSpec(name, "scan", name, "function", files=_hashes(function))
    if not knows_robots(function):
        return spec
    if ranges != "contract":
        raise ConfigError(f"ranges is {ranges!r}, but {name} is loaded already: give zoo.load the ranges, not here.")
    own = {what: getattr(function, what, getattr(spec, what)) for what in ("inference", "ranges")}
    return replace(spec, kind="object").fed(own["inference"], own["ranges"], _scaling(own["ranges"], scaling))


def _from_folder(name: str, how: dict[str, str]) -> PilotSpec:
    from navrep_data.zoo import load
    from navrep_data.zoo.policy import Policy

    place = place_of(name)
    assert place is not None
    folder = place.resolve()
    if not name.startswith(HUB_SCHEME):
        name = os.path.normpath(name)
    if how["ranges"] == "as_released":
        raise _not_released(name)
    loaded = load(folder)  # told before the first episode is played
    if not isinstance(loaded, Policy):
        raise PolicyError(
            f"{name} holds a {type(loaded).__name__}, expected a policy, for example what navrep-data train controller "
            "wrote."
        )
    files = {part: sha256_file(path) for part, path in policy_files(folder).items()}
    return PilotSpec(name, "scan", name, "folder", str(folder), files=files).fed(**how)


def _from_zoo(name: str, source: str | None, how: dict[str, str]) -> PilotSpec:
    from navrep_data.zoo import registry

    if name.partition(".")[0] not in registry.variants():
        known = [*BASELINES, *registry.full_names(), *registry.variants()]
        raise UnknownNameError(
            f"Unknown policy {name!r}.{did_you_mean(name, known)}{here_hint(name)} Baselines: {', '.join(BASELINES)}; "
            "networks: navrep-data models; your own: ./folder or module:function."
        )
    record = registry.resolve(name)
    if record.kind != "policy":
        raise PolicyError(
            f"{record.name} is a {record.kind.replace('_', ' ')}, expected a policy: it does not choose actions from "
            "scans. List them: navrep-data models"
        )
    if record.ours and how["ranges"] == "as_released":
        raise _not_released(record.name)
    files = {e.path: e.sha256 or f"git:{e.git_blob_sha1}" for r in registry.with_parts(record) for e in r.files}
    # our run of a variant is never counted among the authors' runs of it
    variant = record.name if record.ours else record.variant
    return PilotSpec(record.name, "scan", variant, "zoo", source, files=files).fed(**how)
