"""Pictures of rows drawn at random."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from navrep_data.datasets._hub_pictures import read_episode, still
from navrep_data.datasets.tools._pieces import Progress
from navrep_data.errors import ConfigError, check_whole
from navrep_data.io import atomic_write_bytes, new_folder
from navrep_data.shards import DatasetFolder

MAX_PICTURES = 1000


def sample(
    root: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    n: int = 9,
    seed: int = 0,
    split: str | None = None,
    progress: Progress | None = None,
) -> list[Path]:
    """Draw rows of a dataset, chosen at random: world where it is known, scan and rings.

    Parameters
    ----------
    root : path-like
        Dataset folder.
    out : path-like
        New folder for the pictures.
    n : int
        How many; all rows if there are fewer.
    seed : int
        Chooses the rows.
    split : {"train", "val", "test"}, optional
        Only rows of this split.
    progress : callable, optional
        Called with (pictures done, pictures in all).

    Returns
    -------
    list of pathlib.Path
        ``sequence-00003-row-0123.png`` and so on, rows counted in their sequence.

    Raises
    ------
    ConfigError
        If `n` cannot be used, or there is no such split or nothing in it.
    FolderInUseError
        If `out` holds something.
    DatasetNotFoundError, CorruptDataError
        If the dataset cannot be read.
    """
    if not 1 <= n <= MAX_PICTURES:
        raise ConfigError(f"{n} pictures were asked for; expected 1 to {MAX_PICTURES:,}.")
    with DatasetFolder(Path(root)) as folder:
        e = folder.episodes
        chosen = e.in_split(split)
        if not len(chosen):
            raise ConfigError(f"Nothing is left: {root} has no sequence" + (f" in split {split}." if split else "."))
        ends = np.cumsum(e.length[chosen])
        drawn = np.random.default_rng(check_whole("seed", seed, 0)).choice(
            ends[-1], size=min(n, int(ends[-1])), replace=False
        )
        names = []
        with new_folder(out, what="sample", apart_from=[root]) as part:
            for done, at in enumerate(np.sort(drawn).tolist(), 1):
                i = int(np.searchsorted(ends, at, side="right"))
                k, row = int(chosen[i]), at - int(ends[i] - e.length[chosen[i]])
                first = int(np.searchsorted(e.sequence, e.sequence[k], side="left"))
                name = f"sequence-{e.sequence[k]:05d}-row-{int(e.start[k] - e.start[first]) + row:04d}.png"
                atomic_write_bytes(part / name, still(read_episode(folder, k), row))
                names.append(name)
                if progress is not None:
                    progress(done, len(drawn))
    return [Path(out) / name for name in names]
