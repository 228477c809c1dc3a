"""Models by name or by folder: what a command line's NAME|DIR stands for."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from navrep_data.errors import CheckpointError


def is_folder(name: str | os.PathLike[str]) -> bool:
    """Return whether NAME|DIR means a path: it has a separator, is absolute, or exists as a file or folder."""
    text = os.fspath(name)
    return os.sep in text or text.endswith((".safetensors", ".json")) or Path(text).is_dir()


def load_any_model(name: str | os.PathLike[str], source: str | os.PathLike[str] | None = None, **options: Any) -> Any:
    """Load a model of the zoo by name, or a checkpoint by its folder.

    Parameters
    ----------
    name : str or path-like
        Name such as ``transformer_1d.released``, or a folder with ``model.safetensors`` and ``config.json``: a
        checkpoint of :mod:`navrep_data.models.checkpoint`, or what ``navrep-data train`` wrote.
    source : path-like or str, optional
        Where names are looked for, see :func:`navrep_data.zoo.load`.
    **options
        For names: passed on to :func:`navrep_data.zoo.load`.

    Returns
    -------
    torch.nn.Module or navrep_data.zoo.policy.Policy

    Raises
    ------
    CheckpointError
        If the folder holds no checkpoint.
    UnknownNameError, CorruptDataError, OfflineError, DownloadError
        As :func:`navrep_data.zoo.load`.
    """
    if not is_folder(name):
        from navrep_data import zoo

        return zoo.load(os.fspath(name), source, **options)
    path = Path(name)
    if not path.exists():
        raise CheckpointError(
            f"There is no {path}; expected a folder with model.safetensors, or a name: navrep-data models"
        )
    from navrep_data.models import checkpoint

    return checkpoint.load(path)
