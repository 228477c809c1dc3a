"""The zoo's policies where people type policies: names, and folders that hold one."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from navrep_data.errors import ConfigError, PolicyError, UnknownNameError, did_you_mean
from navrep_data.io import HUB_SCHEME, here_hint, sha256_file
from navrep_data.policies import BASELINES, PolicySpec
from navrep_data.zoo import registry
from navrep_data.zoo.folders import place_of, policy_files

if TYPE_CHECKING:
    from navrep_data.zoo.policy import Policy


def _not_released(name: str) -> ConfigError:
    return ConfigError(
        f"ranges as_released means how the authors' software feeds their networks, and {name} is none of them: leave "
        "it out, its ranges are cut as in its training."
    )


class Zoo:
    """Policies of the zoo, by name."""

    @staticmethod
    def find(name: str, source: str | None, how: Mapping[str, str], more: Iterable[str] = ()) -> PolicySpec:
        """Return what a name of the zoo stands for, run and fed in this way; nothing is loaded."""
        if name.partition(".")[0] not in registry.variants():
            own = list(dict.fromkeys([*BASELINES, *more]))
            known = [*own, *registry.full_names(), *registry.variants()]
            raise UnknownNameError(
                f"Unknown policy {name!r}.{did_you_mean(name, known)}{here_hint(name)} Baselines: "
                f"{', '.join(own)}; networks: navrep-data models; your own: ./folder or module:function."
            )
        record = registry.resolve(name)
        if record.kind != "policy":
            raise PolicyError(
                f"{record.name} is a {record.kind.replace('_', ' ')}, expected a policy: it does not choose actions "
                "from scans. List them: navrep-data models"
            )
        if record.ours and how["ranges"] == "as_released":
            raise _not_released(record.name)
        files = {e.path: e.sha256 or f"git:{e.git_blob_sha1}" for r in registry.with_parts(record) for e in r.files}
        # our run of a variant is never counted among the authors' runs of it
        variant = record.name if record.ours else record.variant
        return PolicySpec(record.name, "scan", variant, "zoo", source, files=files).fed(**how)

    @staticmethod
    def load(spec: PolicySpec) -> Policy:
        """Return the network."""
        return _load(spec.name, spec.source, spec)


class Folder:
    """Policies that lie in folders, here or on the Hub."""

    @staticmethod
    def find(name: str, source: str | None, how: Mapping[str, str], more: Iterable[str] = ()) -> PolicySpec:
        """Return what a place holds; it is loaded once, so that what is no policy is refused at once."""
        place = place_of(name)
        assert place is not None
        folder = place.resolve()
        if not name.startswith(HUB_SCHEME):
            name = os.path.normpath(name)
        if how["ranges"] == "as_released":
            raise _not_released(name)
        spec = PolicySpec(name, "scan", name, "folder", str(folder))
        Folder.load(spec)
        files = {part: sha256_file(path) for part, path in policy_files(folder).items()}
        return PolicySpec(name, "scan", name, "folder", str(folder), files=files).fed(**how)

    @staticmethod
    def load(spec: PolicySpec) -> Policy:
        """Return the network."""
        return _load(Path(str(spec.source)), None, spec)


def _load(place: str | Path, source: str | None, spec: PolicySpec) -> Policy:
    from navrep_data.zoo import load
    from navrep_data.zoo.policy import Policy

    policy = load(place, source=source, inference=spec.inference, ranges=spec.ranges)
    if not isinstance(policy, Policy):
        raise PolicyError(
            f"{spec.name} holds a {type(policy).__name__}, expected a policy, for example what navrep-data train "
            "controller wrote."
        )
    return policy
