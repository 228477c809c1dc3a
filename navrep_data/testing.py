"""Small real data and networks for tests: ours and other people's."""

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
        Sequences; two per shard at most. With three or more, all splits have one.
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


def tiny_checkpoint(
    path: str | os.PathLike[str], *, model: str = "e2e", lidar: str = "1d", z_size: int = 8, seed: int = 0
) -> Path:
    """Write a checkpoint with untrained weights, which ``navrep_data.zoo.load(path)`` loads like a trained one.

    Parameters
    ----------
    path : path-like
        Folder of the checkpoint, made if missing; an older checkpoint in it is replaced.
    model : str
        ``"e2e"`` (a policy), ``"vae"``, ``"joint"``, ``"transformer"`` or ``"modular"``.
    lidar : str
        ``"1d"`` or ``"rings"``.
    z_size : int
        Numbers per code; ``"e2e"`` has none. A multiple of 8 for the transformer.
    seed : int
        Of the weights: same seed, same weights.

    Returns
    -------
    pathlib.Path
        The folder.

    Raises
    ------
    ConfigError
        If there is no such model, or a size that it cannot have.
    """
    import torch

    from navrep_data.models import checkpoint

    config: dict[str, object] = {"lidar": lidar}
    if model != "e2e":
        config["z_size"] = z_size
    root = Path(path)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        checkpoint.save(checkpoint.make(model, config), root)
    return root
