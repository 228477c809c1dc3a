"""Encode a dataset once: the codes of every row, for M to train from."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from navrep_data.datasets.latents import (
    COPIED_COLUMNS,
    MANIFEST_FILE,
    LatentManifest,
    read_latent_shard,
    write_latent_shard,
)
from navrep_data.errors import ConfigError, CorruptDataError, DatasetMismatchError, FolderInUseError
from navrep_data.io import translate_os_error
from navrep_data.models import VAE, WorldModel, observation_from_rings, observation_from_scan
from navrep_data.schema import SCAN_SCALE
from navrep_data.shards import DatasetFolder, writer_lock
from navrep_data.train import passes
from navrep_data.train.data import check_sensor

_BATCH = 256


def weights_hash(module: nn.Module) -> str:
    """Return the SHA-256 over names and float32 numbers of a network, the same however it was stored."""
    digest = hashlib.sha256()
    for name, tensor in sorted(module.state_dict().items()):
        digest.update(name.encode() + b"\0" + tensor.detach().cpu().to(torch.float32).contiguous().numpy().tobytes())
    return digest.hexdigest()


def vae_of(model: Any, who: str) -> VAE:
    """Return the V of a model.

    Raises
    ------
    ConfigError
        If it has none.
    """
    if isinstance(model, VAE):
        return model
    found = model.vae if isinstance(model, WorldModel) else getattr(model, "vae", None)
    if not isinstance(found, VAE):
        raise ConfigError(
            f"{who} is a {type(model).__name__} without a V, expected a V or a world model to encode with."
        )
    return found


def encode_dataset(
    root: Path | str,
    model: nn.Module,
    out: Path | str,
    *,
    name: str = "",
    precision: str = "float32",
    device: str = "cpu",
    progress: bool = False,
) -> LatentManifest:
    """Write the codes (mu, logvar) of every row of a dataset.

    Parameters
    ----------
    root : path-like
        Dataset folder.
    model : nn.Module
        A V, or a world model whose V is used.
    out : path-like
        Folder of the latent dataset, new, empty, or with an unfinished one of the same dataset and model.
    name : str
        What the model is called, for the manifest.
    precision : str
        ``"float32"``, or ``"bfloat16"``: about twice as fast, codes off by some thousandths of their spread.
    device : str
        Where V runs.
    progress : bool
        Show a progress bar on stderr.

    Returns
    -------
    LatentManifest
        Complete.

    Raises
    ------
    DatasetMismatchError
        If the dataset has another sensor, or `out` holds codes of another dataset or model.
    FolderInUseError
        If `out` holds something else.
    """
    from tqdm import tqdm

    vae = vae_of(model, name or "The model").to(device).eval()
    root, out = Path(root), Path(out)
    with DatasetFolder(root) as folder:
        check_sensor(folder.manifest.sensor, str(root))
        wanted = _plan(folder, vae, name, precision)
        if out.exists() and not out.is_dir():
            raise FolderInUseError(f"{out} is a file, expected a new or empty folder: choose another with --out.")
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise translate_os_error(error, out) from error
        with writer_lock(out):
            manifest = _unfinished(out, wanted)
            shards = folder.manifest.shards
            with tqdm(total=folder.manifest.rows, unit="row", unit_scale=True, disable=not progress) as bar:
                for k, entry in enumerate(shards):
                    if k >= len(manifest.shards):
                        columns = _encode_shard(folder, k, vae, precision, device, bar)
                        written = write_latent_shard(out, entry.file, entry.split, columns)
                        manifest = manifest.with_shard(written, complete=k + 1 == len(shards))
                        manifest.save(out)
                    else:
                        bar.update(entry.rows)
    return manifest


def _plan(folder: DatasetFolder, vae: VAE, name: str, precision: str) -> LatentManifest:
    m = folder.manifest
    if precision not in passes.PRECISIONS:
        raise ConfigError(f"precision is {precision!r}, expected one of: {', '.join(passes.PRECISIONS)}.")
    return LatentManifest(
        vae.config.z_size,
        {"name": name, "weights_sha256": weights_hash(vae), "lidar": vae.config.lidar, "precision": precision},
        {**folder.provenance, "env": m.env, "physics": m.physics, "seed": m.seed, "rows": m.rows},
        m.sensor.to_dict(),
    )


def _unfinished(out: Path, wanted: LatentManifest) -> LatentManifest:
    """Return the manifest to go on from: that of `out` if it is of the same codes, else a new one."""
    if not (out / MANIFEST_FILE).exists():
        strangers = [p.name for p in out.iterdir() if not p.name.startswith(".") and p.name != "data"]
        if strangers:
            raise FolderInUseError(f"{out} holds {strangers[0]}, expected an empty folder: choose another with --out.")
        return wanted
    found = LatentManifest.read(out)
    for field, what in (("encoder", "model"), ("source", "dataset"), ("z_size", "model")):
        mine, theirs = getattr(wanted, field), getattr(found, field)
        if field == "encoder":  # what it is called does not matter
            mine, theirs = ({k: v for k, v in d.items() if k != "name"} for d in (mine, theirs))
        if mine != theirs:
            raise DatasetMismatchError(
                f"{out} holds codes of another {what}: choose another folder with --out, or remove it first."
            )
    for k, shard in enumerate(found.shards):
        try:
            read_latent_shard(out, shard, found.z_size)
        except CorruptDataError:  # damaged since: made again, with those after it
            return LatentManifest(found.z_size, found.encoder, found.source, found.sensor, found.shards[:k])
    return found


@torch.no_grad()
def _encode_shard(
    folder: DatasetFolder, k: int, vae: VAE, precision: str, device: str, bar: Any
) -> dict[str, np.ndarray[Any, Any]]:
    shard = folder.shard(k)
    columns: dict[str, np.ndarray[Any, Any]] = {
        name: np.asarray(shard.read(name, 0, shard.rows)) for name in COPIED_COLUMNS
    }
    mu = np.empty((shard.rows, vae.config.z_size), np.float32)
    logvar = np.empty_like(mu)
    stored_rings = vae.config.lidar == "rings" and "rings" in folder.manifest.columns
    for first in range(0, shard.rows, _BATCH):
        stop = min(shard.rows, first + _BATCH)
        if stored_rings:
            obs = observation_from_rings(shard.read("rings", first, stop))
        else:
            scan = shard.read("scan", first, stop)
            # as datasets give it: divided, not multiplied, so that rings equal the stored ones
            metres = scan.astype(np.float32) / np.float32(1.0 / SCAN_SCALE) if scan.dtype == np.uint16 else scan
            obs = observation_from_scan(metres, vae.config.lidar)
        means, logvars = passes.distribution(vae, obs.to(device), passes.PRECISIONS[precision])
        mu[first:stop], logvar[first:stop] = means.cpu().numpy(), logvars.cpu().numpy()
        bar.update(stop - first)
    return {"mu": mu, "logvar": logvar, **columns}
