"""Small real data for tests: ours and other people's."""

from __future__ import annotations

import os
from pathlib import Path

from navrep_data.generate import generate


def tiny_dataset(
    path: str | os.PathLike[str],
    *,
    n: int = 4,
    length: int = 60,
    seed: int = 0,
    humans: int = 4,
    obstacles: int = 3,
) -> Path:
    """Write a small soadrl dataset, simulated like a large one, in about a second.

    Parameters
    ----------
    path : path-like
        Dataset folder, new or empty (or holding the same dataset already).
    n : int
        Sequences; two per shard. With three or more, all splits have one.
    length : int
        Rows per sequence.
    seed : int
        Dataset seed.
    humans, obstacles : int
        As in :func:`navrep_data.generate.generate`.

    Returns
    -------
    pathlib.Path
        The folder.

    Notes
    -----
    The first call on a machine compiles the kernels, which takes about half a minute.
    """
    root = Path(path)
    generate(n=n, out=root, seed=seed, length=length, humans=humans, obstacles=obstacles, shard_size=2)
    return root
