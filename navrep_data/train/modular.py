"""Join a V and the M that was trained on its codes to a modular world model."""

from __future__ import annotations

from pathlib import Path

from navrep_data.errors import CheckpointError, DatasetMismatchError
from navrep_data.models import MDNRNN, VAE, ModularWorldModel, checkpoint
from navrep_data.train.encode import weights_hash

WORLD_MODEL = "world_model"
"""Folder beside M's weights that holds the joined model."""


def check_encoder(vae: VAE, recorded: object, who: str) -> None:
    """Raise unless codes were made by this V.

    Parameters
    ----------
    vae : VAE
        V.
    recorded : object
        What the latent dataset, or M's checkpoint, says of its encoder.
    who : str
        Where that stands.

    Raises
    ------
    DatasetMismatchError
        If it was another one.
    """
    seen = recorded.get("weights_sha256") if isinstance(recorded, dict) else None
    if seen != weights_hash(vae):
        raise DatasetMismatchError(
            f"{who} holds codes of another V (weights {str(seen)[:12]}), expected {weights_hash(vae)[:12]}: encode the "
            "dataset again with this V, or name the V that it was encoded with."
        )


def join(vae: VAE, memory: Path) -> Path:
    """Write the modular world model of a V and a trained M beside M.

    Parameters
    ----------
    vae : VAE
        The V whose codes M was trained on.
    memory : Path
        M's output folder.

    Returns
    -------
    pathlib.Path
        Folder of the joined model.

    Raises
    ------
    CheckpointError
        If there is no M.
    DatasetMismatchError
        If M was trained on codes of another V.
    """
    m = checkpoint.load(memory)
    if not isinstance(m, MDNRNN):
        raise CheckpointError(f"{memory} holds a {type(m).__name__}, expected an M: navrep-data train m")
    metadata = checkpoint.read_config(memory)["metadata"]
    check_encoder(vae, metadata.get("dataset", {}).get("encoder"), str(memory))
    checkpoint.save(ModularWorldModel.of(vae, m), memory / WORLD_MODEL, metadata, dataset=metadata["dataset"])
    return memory / WORLD_MODEL
