"""What decides a dataset's bytes beside its settings: contents of its maps, and of the policy that drove.

A manifest holds their hashes. Whoever makes more of the dataset compares them with what is there now: going on,
extending, parts of a job array, workers elsewhere, making it again to prove it.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from navrep_data.errors import DatasetMismatchError, MapError
from navrep_data.generate.policy import DatasetPolicy
from navrep_data.shards import Manifest
from navrep_data.sim import GridMap, SimConfig
from navrep_data.sim.map_tables import map_for_physics
from navrep_data.sim.maps import is_packaged, load_map
from navrep_data.sim.scenarios import get_scenario

MAP, POLICY = "map:", "policy"
"""Keys of ``inputs``: a map by its name in ``config``, or that of its scenarios; and the policy."""

_SHOWN = 12


def inputs_of(config: SimConfig, policy: DatasetPolicy) -> dict[str, str]:
    """Return SHA-256 hashes of what a dataset is made from, as it is now: ``map:NAME`` and ``policy``.

    Raises
    ------
    MapError
        If a map cannot be read.
    PolicyError
        If the policy cannot be imported.
    """
    found = {MAP + name: _grid(file, config).hash for name, file in _maps(config)}
    digest = policy.content()
    return found | ({POLICY: digest} if digest else {})


def origins_of(config: SimConfig) -> dict[str, tuple[float, float]]:
    """Return where a dataset's coordinates begin on each of its maps: (x, y) [m] in the frame of the map's file.

    Raises
    ------
    MapError
        If a map cannot be read.
    """
    origins = {}
    for name, file in _maps(config):
        given, used = load_map(file).origin, _grid(file, config).origin
        if given != used:
            origins[MAP + name] = (given[0] - used[0], given[1] - used[1])
    return origins


def _grid(file: str, config: SimConfig) -> GridMap:
    """Return a map as it is simulated on, so that its hash is that of what decides bytes."""
    return map_for_physics(load_map(file), config.physics)


def _maps(config: SimConfig) -> list[tuple[str, str]]:
    """Return the maps that a config simulates on: names, and the files that they are read from."""
    if config.scenarios:
        return [(name, name) for name in sorted({get_scenario(scenario).map for scenario in config.scenarios})]
    return list(zip(config.maps, config.map_files, strict=True))


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


def check_unchanged(root: Path, old: Manifest, config: SimConfig, now: Mapping[str, str]) -> None:
    """Make sure that a dataset which is to be extended was made on the maps of `config`, by the same policy.

    Maps are told apart by what they hold: another path to the same one is fine.

    Parameters
    ----------
    root : pathlib.Path
        The dataset's folder.
    old : Manifest
        Its manifest.
    config : SimConfig
        What is asked for.
    now : mapping of str to str
        From :func:`inputs_of`.

    Raises
    ------
    DatasetMismatchError
        Naming what differs.
    """
    names = list(old.config.get("maps", ())) or sorted(k.removeprefix(MAP) for k in old.inputs if k.startswith(MAP))
    maps = _maps(config)
    if len(names) != len(maps):
        raise DatasetMismatchError(
            f"{root} was made with maps={names}, asked for maps={[name for name, _ in maps]}; repeat the old setting "
            "to go on with it, or choose another --out."
        )
    for before, (name, file) in zip(names, maps, strict=True):
        seen, there = old.inputs.get(MAP + before), now[MAP + name]
        if seen != there:
            raise DatasetMismatchError(
                f"{root} was made on a map {before!r} with content {_short(seen)}, asked for {file} ({_short(there)}): "
                "the map has been edited, or is another one; put the old map back to go on with it, or choose another "
                "--out."
            )
        had, has = old.origins.get(MAP + before), origins_of(config).get(MAP + name)
        if had != has:
            raise DatasetMismatchError(
                f"{root} was made with the origin of map {before!r} at {had}, which {file} puts at {has}: put it back "
                "to go on with it, or choose another --out."
            )
    _check_policy(root, old, now)


def check_inputs(root: Path, old: Manifest, now: Mapping[str, str]) -> None:
    """Make sure that everything that a dataset was made from is what it was then; maps are called as in its manifest.

    Raises
    ------
    DatasetMismatchError
        Naming the first that differs.
    """
    _check_policy(root, old, now)
    for name in sorted({*old.inputs, *now}):
        seen, there = old.inputs.get(name), now.get(name)
        if seen != there:
            raise DatasetMismatchError(
                f"{root} was made from {name} with content {_short(seen)}, which is {_short(there)} here: put the old "
                "one back to make its sequences again."
            )


def _check_policy(root: Path, old: Manifest, now: Mapping[str, str]) -> None:
    seen, there = old.inputs.get(POLICY), now.get(POLICY)
    if seen != there:
        raise DatasetMismatchError(
            f"{root} was made by {old.policy.get('name')} with content {_short(seen)}, which is {_short(there)} now: "
            "the policy has been edited; put the old one back to go on with it, or choose another --out."
        )


def check_here(spec_inputs: Mapping[str, str], config: SimConfig, policy: DatasetPolicy, where: str) -> None:
    """Make sure that a worker has before it what the run began with.

    Raises
    ------
    DatasetMismatchError
        Naming what differs, and `where`.
    """
    for key, digest in inputs_of(config, policy.found_here()).items():
        if digest != spec_inputs.get(key):
            what = f"map {key.removeprefix(MAP)!r}" if key.startswith(MAP) else f"policy {policy.name}"
            raise DatasetMismatchError(
                f"The {what} has content {_short(digest)} {where}, but the run began with "
                f"{_short(spec_inputs.get(key))}: it was edited, or is another one there; give all workers the same "
                "and run the command again."
            )


def _short(digest: str | None) -> str:
    return "unknown" if digest is None else digest[:_SHOWN]


def find_maps(root: Path, manifest: Manifest, config: SimConfig, given: Sequence[str] = ()) -> SimConfig:
    """Return the config of a stored dataset with its maps found again.

    A relative path is looked for from the dataset's folder, then from the working folder.

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
    files = []
    for index, name in enumerate(config.maps):
        places = [given[index]] if given else _places(root, name)
        there = [place for place in places if place == name or Path(place).exists()]
        if not there:
            raise MapError(
                f"Map {name!r} of {root} is not at {' or '.join(places)}: put it there, or name its path by --map."
            )
        hashes = {place: _grid(place, config).hash for place in there}
        expected = manifest.inputs.get(MAP + name)
        same = [place for place in there if hashes[place] == expected]
        if not same:
            raise DatasetMismatchError(
                f"Map {there[0]} has content {_short(hashes[there[0]])}, but {root} was made on {_short(expected)}: it "
                "has been edited, or is another one; put the old map back, or name its path by --map."
            )
        files.append(same[0])
    return config.with_maps(config.maps, files)


def _places(root: Path, name: str) -> list[str]:
    """Return where a map may be that a manifest calls `name`."""
    path = Path(name)
    if path.is_absolute() or is_packaged(name):
        return [name]
    return [str(Path(os.path.realpath(root)) / path), str(path.absolute())]
