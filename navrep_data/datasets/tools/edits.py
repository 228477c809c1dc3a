"""Merge, split and filter: new datasets out of existing ones, which are only read."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from navrep_data.datasets.npz import exact
from navrep_data.datasets.tools._pieces import (
    Given,
    Piece,
    Progress,
    check_alike,
    check_not_empty,
    check_sources,
    write_dataset,
)
from navrep_data.errors import ConfigError, did_you_mean, whole_number
from navrep_data.io import new_folder, sha256_bytes
from navrep_data.schema import EVENT_NAMES, Event
from navrep_data.shards import SPLITS, DatasetFolder, Manifest

PathLike = str | os.PathLike[str]
OUTCOMES = EVENT_NAMES[1:]


def merge(roots: Iterable[PathLike], out: PathLike, *, progress: Progress | None = None) -> Manifest:
    """Join datasets of one kind into a new one.

    Parameters
    ----------
    roots : iterable of path-like
        Two or more dataset folders: one environment, physics, sensor, set of columns and scan dtype. Parts of a dataset
        will do.
    out : path-like
        New dataset folder.
    progress : callable, optional
        Called with (sequences done, sequences in all).

    Returns
    -------
    Manifest
        Of the new dataset.

    Raises
    ------
    ConfigError
        If there are fewer than two.
    DatasetMismatchError
        If they differ in kind, hold the same rows, or one sequence is in different splits.
    FolderInUseError
        If `out` holds something.
    DatasetNotFoundError, DatasetError, CorruptDataError
        If one cannot be read.

    Notes
    -----
    Sequences come in the order given and are numbered anew; each stays in its split. Crowds of different size are
    padded to the largest. Settings that differ (seeds, for one) are left out of the new manifest's `config`; those of
    each dataset are in its `source`.
    """
    given = [Given(root) for root in roots]
    if len(given) < 2:
        raise ConfigError(f"{len(given)} datasets were given, expected at least two to merge.")
    check_alike(given)
    pieces = [piece for one in given for piece in one.pieces()]
    check_not_empty(pieces, "the datasets hold no sequence; give others.")
    check_sources(pieces)
    with new_folder(out, what="merge", apart_from=[one.root for one in given]) as part:
        command = f"navrep-data merge {' '.join(['DIR'] * len(given))} --out OUT"
        return write_dataset(part, pieces, command=command, progress=progress)


def split(
    root: PathLike,
    out: PathLike,
    *,
    shares: Mapping[str, float] | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> dict[str, Manifest]:
    """Write each split of a dataset as a dataset of its own.

    Parameters
    ----------
    root : path-like
        Dataset folder.
    out : path-like
        New folder; the datasets are ``out/train``, ``out/val`` and ``out/test``.
    shares : mapping of str to float, optional
        Shares by split, adding up to 1: draw new splits instead of keeping the dataset's own.
    seed : int
        Chooses among the draws; the same one puts the same sequences together.
    progress : callable, optional
        Called with (sequences done, sequences in all).

    Returns
    -------
    dict of str to Manifest
        By split; splits without a sequence are left out.

    Raises
    ------
    ConfigError
        If shares cannot be used, or nothing is left.
    FolderInUseError
        If `out` holds something.
    DatasetNotFoundError, DatasetError, CorruptDataError
        If the dataset cannot be read.

    Notes
    -----
    What is drawn are sequences as they were generated: all that came from one (by ``filter``) goes into one split.
    Merging the results gives back one dataset with these splits.
    """
    given = Given(root)
    pieces = given.pieces()
    chosen, rule = [piece.split for piece in pieces], None
    if shares is not None:
        parts = ", ".join(f"{name} {shares.get(name, 0.0):g}" for name in SPLITS)
        chosen, rule = _draw(pieces, shares, seed), f"drawn with seed {seed} from whole source sequences: {parts}"
    options = "" if shares is None else f" --shares {','.join(exact(shares.get(n, 0.0)) for n in SPLITS)} --seed {seed}"
    groups = {name: [p for p, c in zip(pieces, chosen, strict=True) if c == name] for name in SPLITS}
    check_not_empty(pieces, f"{root} holds no sequence.")
    total, done = sum(map(len, groups.values())), 0
    made = {}
    with new_folder(out, what="split", apart_from=[given.root]) as part:
        for name, group in groups.items():
            if not group:
                continue
            (part / name).mkdir()
            made[name] = write_dataset(
                part / name,
                group,
                command=f"navrep-data split DIR{options} --out OUT  # OUT/{name}",
                splits=[name] * len(group),
                split_rule=rule or f"all are {name}, as before ({given.manifest.split_rule})",
                progress=progress and _shifted(progress, done, total),
            )
            done += len(group)
    return made


def _shifted(progress: Progress, before: int, total: int) -> Progress:
    return lambda done, _: progress(before + done, total)


def _draw(pieces: Sequence[Piece], shares: Mapping[str, float], seed: int) -> list[str]:
    """Return a split for each piece, the same for pieces of one source sequence."""
    odd = sorted(set(shares) - set(SPLITS))
    if odd:
        raise ConfigError(f"Unknown split {odd[0]!r}; expected {', '.join(SPLITS)}.{did_you_mean(odd[0], SPLITS)}")
    values = np.array([float(shares.get(name, 0.0)) for name in SPLITS])
    if not (np.isfinite(values).all() and (values >= 0).all() and abs(values.sum() - 1.0) < 1e-6):
        seen = ", ".join(f"{name} {v:g}" for name, v in zip(SPLITS, values, strict=True))
        raise ConfigError(f"The shares are {seen}; expected numbers from 0 to 1 that add up to 1.")
    # by a hash, not by a generator's stream: the order must not depend on how many there are
    sources = sorted({p.source.content_hash for p in pieces}, key=lambda h: sha256_bytes(f"{seed} {h}".encode()))
    # whole sequences, by largest remainder; each split that was asked for gets one
    exact = values * len(sources)
    counts = np.floor(exact + 1e-9).astype(int)
    for k in np.argsort(counts - exact, kind="stable")[: len(sources) - counts.sum()]:
        counts[k] += 1
    for k in np.flatnonzero((counts == 0) & (values > 0)):
        counts[np.argmax(counts)] -= 1
        counts[k] += 1
    if (counts[values > 0] == 0).any() or (counts < 0).any():
        raise ConfigError(
            f"{len(sources)} sequences are too few for {(values > 0).sum()} splits; expected at least one for each."
        )
    names = np.repeat(SPLITS, counts).tolist()
    of = dict(zip(sources, names, strict=True))
    return [of[piece.source.content_hash] for piece in pieces]


def filter(
    root: PathLike,
    out: PathLike,
    *,
    outcomes: Iterable[str] | None = None,
    min_humans: int | None = None,
    max_humans: int | None = None,
    min_steps: int | None = None,
    max_steps: int | None = None,
    progress: Progress | None = None,
) -> Manifest:
    """Write the episodes of a dataset that meet all conditions as a new dataset.

    Parameters
    ----------
    root : path-like
        Dataset folder.
    out : path-like
        New dataset folder.
    outcomes : iterable of str, optional
        Events that ended the episode: ``goal``, ``collision_human``, ``collision_obstacle``, ``timeout``, ``stuck``,
        ``cut``.
    min_humans, max_humans : int, optional
        Size of the crowd.
    min_steps, max_steps : int, optional
        Length of the episode [steps]: T actions, T + 1 rows.
    progress : callable, optional
        Called with (sequences done, sequences in all).

    Returns
    -------
    Manifest
        Of the new dataset.

    Raises
    ------
    ConfigError
        If there is no condition, an outcome is unknown, a bound cannot be used, the crowd is not recorded, or no
        episode is left.
    FolderInUseError
        If `out` holds something.
    DatasetNotFoundError, DatasetError, CorruptDataError
        If the dataset cannot be read.

    Notes
    -----
    Each run of consecutive episodes that stay becomes a sequence, so rows of a sequence still follow each other in
    time. It is in the split of the sequence it was cut from.
    """
    given = Given(root)
    bounds = {"humans": _bounds("humans", min_humans, max_humans), "steps": _bounds("steps", min_steps, max_steps)}
    wanted = None if outcomes is None else _outcomes(outcomes)
    if not wanted and not any(bounds.values()):
        raise ConfigError("There is no condition to filter by; expected an outcome, or bounds of humans or steps.")
    episodes = given.folder.episodes
    keep = np.ones(len(episodes), bool)
    options = ""
    if wanted:
        keep &= np.isin(episodes.event, wanted)
        options = "".join(f" --outcome {EVENT_NAMES[code]}" for code in wanted)
    for name, limits in bounds.items():
        if limits:
            values = crowd_sizes(given.folder) if name == "humans" else episodes.length - 1
            keep &= (values >= limits[0]) & (values <= limits[1])
            options += f" --min-{name} {limits[0]}" * (limits[0] > 0)
            options += f" --max-{name} {limits[1]}" * (limits[1] < _UNBOUNDED)
    pieces = given.pieces(keep)
    check_not_empty(pieces, f"none of the {len(episodes):,} episodes of {root} fits ({_there(episodes.event)}).")
    with new_folder(out, what="filter", apart_from=[given.root]) as part:
        return write_dataset(part, pieces, command=f"navrep-data filter DIR{options} --out OUT", progress=progress)


_UNBOUNDED = 1 << 31


def _bounds(name: str, low: int | None, high: int | None) -> tuple[int, int] | None:
    if low is None and high is None:
        return None
    given = 0 if low is None else low, _UNBOUNDED if high is None else high
    first, last = map(whole_number, given)
    if first is None or last is None or not 0 <= first <= last:
        raise ConfigError(
            f"The bounds of {name} are {given[0]} and {given[1]}; expected whole numbers, 0 <= least <= most."
        )
    return first, last


def _outcomes(names: Iterable[str]) -> list[int]:
    found = []
    for name in names:
        if name not in OUTCOMES:
            raise ConfigError(
                f"Unknown outcome {name!r}; expected some of {', '.join(OUTCOMES)}.{did_you_mean(name, OUTCOMES)}"
            )
        found.append(EVENT_NAMES.index(name))
    return sorted(set(found))


def _there(events: npt.NDArray[Any]) -> str:
    codes, counts = np.unique(events, return_counts=True)
    return ", ".join(f"{Event(int(c)).label} {n:,}" for c, n in zip(codes, counts, strict=True))


def crowd_sizes(folder: DatasetFolder) -> npt.NDArray[np.int64]:
    """Return the number of humans in each episode of a dataset.

    Raises
    ------
    ConfigError
        If neither a humans column nor worlds files tell.
    """
    e = folder.episodes
    sizes = np.zeros(len(e), np.int64)
    for k, entry in enumerate(folder.manifest.shards):
        mine = e.shard == k
        if "humans" in folder.manifest.columns:
            first_rows = folder.shard(k).read_rows("humans", e.start[mine])
            sizes[mine] = (~np.isnan(first_rows[..., 0])).sum(axis=1)
        elif entry.worlds is not None:
            worlds = folder.worlds(k)
            assert worlds is not None
            sizes[mine] = np.diff(worlds.arrays["human_offset"])
        else:
            raise ConfigError(f"{folder.root} does not record its humans; filter by outcome or steps instead.")
    return sizes


def describe(manifest: Manifest, root: Path) -> dict[str, Any]:
    """Return what the command line prints of a new dataset as JSON."""
    return {
        "root": str(root),
        "sequences": manifest.sequences,
        "rows": manifest.rows,
        "shards": len(manifest.shards),
        "bytes": manifest.bytes,
        "splits": {name: sum(b - a for a, b in manifest.splits.get(name, ())) for name in SPLITS},
        "episodes": {name: v["episodes"] for name, v in manifest.statistics["outcomes"].items()},
    }


def parse_shares(text: str) -> dict[str, float]:
    """Return the shares in ``0.7,0.2,0.1``: train, val, test.

    Raises
    ------
    ConfigError
        If that is not what `text` looks like.
    """
    try:
        return dict(zip(SPLITS, map(float, text.split(",")), strict=True))
    except ValueError:
        raise ConfigError(f"--shares is {text!r}; expected train,val,test as in 0.7,0.2,0.1.") from None
