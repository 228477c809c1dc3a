"""Own maps of a dataset: where they are found again, and whether they are still what the dataset was made on.

A dataset names a map by the path from its own folder to it, so that both can be moved together; what is the same map
is decided by content: worlds files hold the hash of the map of every episode.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from navrep_data.errors import DatasetMismatchError, MapError
from navrep_data.shards import Manifest, ShardEntry, read_worlds
from navrep_data.sim import SimConfig
from navrep_data.sim.maps import load_map
from navrep_data.sim.scenarios import get_scenario

Hashes = Mapping[str, frozenset[str]]
"""Names of maps, as in worlds files, and the hashes of their contents."""

_SHOWN = 12


def named_from(config: SimConfig, root: Path) -> SimConfig:
    """Return the config of a dataset in `root`: maps that were given by relative paths are named from there."""
    names = []
    for name, file in zip(config.maps, config.map_files, strict=True):
        if file != name:
            try:
                name = Path(os.path.relpath(file, os.path.realpath(root))).as_posix()
            except ValueError:  # on another drive
                name = file
        names.append(name)
    return config.with_maps(names, config.map_files)


def stored_hashes(root: Path, entries: Iterable[ShardEntry]) -> Hashes:
    """Return what the worlds files of shards say of maps; nothing for files that are not in `root`."""
    found: dict[str, set[str]] = {}
    for entry in entries:
        if entry.worlds is None or not (root / entry.worlds.file).is_file():
            continue
        arrays = read_worlds(root / entry.worlds.file).arrays
        if "map_hash" in arrays:
            for name, digest in set(zip(arrays["map"].tolist(), arrays["map_hash"].tolist(), strict=True)):
                found.setdefault(name.decode("ascii", "replace"), set()).add(digest.decode("ascii", "replace"))
    return {name: frozenset(digests) for name, digests in found.items()}


def present_hashes(config: SimConfig) -> dict[str, str]:
    """Return the maps that a config simulates on, by the files that they are read from, and their hashes."""
    if config.scenarios:
        files: Sequence[str] = sorted({get_scenario(name).map for name in config.scenarios})
    else:
        files = config.map_files
    return {file: load_map(file).hash for file in files}


def check_unchanged(root: Path, old: Manifest, config: SimConfig) -> None:
    """Make sure that a dataset which is to be extended was made on the maps of `config`.

    Raises
    ------
    DatasetMismatchError
        Naming the map that differs.
    """
    if config.world != "map":
        return
    stored = stored_hashes(root, old.shards)
    known = present_hashes(config)
    for name, digests in stored.items():
        for digest in sorted(digests - set(known.values())):
            now = ", ".join(f"{file} ({found[:_SHOWN]})" for file, found in known.items())
            raise DatasetMismatchError(
                f"{root} was made on a map {name!r} with content {digest[:_SHOWN]}, asked for {now}: the map has been "
                "edited, or is another one; put the old map back to go on with it, or choose another --out."
            )
    before = tuple(old.config.get("maps", ()))
    if before == config.maps or (stored and _renamed(before, config.maps)):
        return
    raise DatasetMismatchError(
        f"{root} was made with maps={list(before)}, asked for maps={list(config.maps)}; repeat the old setting to go "
        "on with it, or choose another --out."
    )


def _renamed(before: Sequence[str], now: Sequence[str]) -> bool:
    """Return whether paths may be the same maps, in the same order, by another way; their contents agree."""
    if len(before) != len(now):
        return False
    return len(now) == 1 or all(Path(a).name == Path(b).name for a, b in zip(before, now, strict=True))


def check_one_map_each(root: Path, parts: Iterable[tuple[object, Manifest]]) -> None:
    """Make sure that parts of a dataset were made on the same maps.

    Raises
    ------
    DatasetMismatchError
        Naming the map and two parts.
    """
    seen: dict[str, tuple[object, frozenset[str]]] = {}
    for part, manifest in parts:
        if manifest.config.get("world") != "map":
            continue
        several = len(manifest.config.get("maps", ())) > 1
        for name, digests in stored_hashes(root, manifest.shards).items():
            other, before = seen.setdefault(name, (part, digests))
            # two maps of one config may bear one name, and an episode is on either
            if digests != before and (not several or len(digests) == len(before) == 1):
                a, b = (sorted(d)[0][:_SHOWN] for d in (digests - before or digests, before))
                raise DatasetMismatchError(
                    f"Part {part} was made on another map {name!r} (content {a}) than part {other} (content {b}): the "
                    "map was edited between the jobs; put the right one back, remove the folder of the wrong part from "
                    f"{root / 'parts'} and its shards, and run its job again."
                )


def find_maps(root: Path, manifest: Manifest, config: SimConfig, given: Sequence[str] = ()) -> SimConfig:
    """Return the config of a stored dataset with its maps found again.

    A relative path is looked for from the dataset's folder, then from the working folder, where earlier versions
    stored it from.

    Parameters
    ----------
    root : pathlib.Path
        The dataset's folder.
    manifest : Manifest
        Its manifest.
    config : SimConfig
        What that holds.
    given : sequence of str
        Paths to read the maps from instead, in their order.

    Raises
    ------
    MapError
        If a map is not found, or the number of those given is another one.
    DatasetMismatchError
        If none of the places holds the map that the dataset was made on.
    """
    if config.world != "map" or config.scenarios:
        if given:
            raise MapError("--map is given, but the dataset is on no map of its own: leave it out.")
        return config
    if given and len(given) != len(config.maps):
        raise MapError(f"{len(given)} maps are given by --map, but {root} is on {len(config.maps)}: give as many.")
    stored = stored_hashes(root, manifest.shards)
    known = frozenset().union(*stored.values()) if stored else frozenset()
    files = []
    for index, name in enumerate(config.maps):
        places = [given[index]] if given else _places(root, name)
        there = [place for place in places if place == name or Path(place).exists()]
        if not there:
            raise MapError(
                f"Map {name!r} of {root} is not at {' or '.join(places)}: put it there, or name its path by --map."
            )
        hashes = {place: load_map(place).hash for place in there}
        same = [place for place in there if not known or hashes[place] in known]
        # of several maps one may never have been played: only a dataset's single map must be among those stored
        if not same and len(config.maps) == 1:
            place, expected = there[0], sorted(known)[0]
            raise DatasetMismatchError(
                f"Map {place} has content {hashes[place][:_SHOWN]}, but {root} was made on {expected[:_SHOWN]}: it has "
                "been edited, or is another one; put the old map back, or name its path by --map."
            )
        files.append((same or there)[0])
    return config.with_maps(config.maps, files)


def _places(root: Path, name: str) -> list[str]:
    """Return where a map may be that a manifest calls `name`."""
    path = Path(name)
    if path.is_absolute():
        return [name]
    return [str(Path(os.path.realpath(root)) / path), str(path.absolute())]
