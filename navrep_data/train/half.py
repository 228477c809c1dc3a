"""What storing weights in half precision costs: codes, frames and actions before and after rounding."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from navrep_data.datasets import SequenceDataset
from navrep_data.errors import ConfigError
from navrep_data.models import WorldModel
from navrep_data.zoo.policy import Policy

_WINDOW, _WINDOWS = 8, 256


@dataclass(frozen=True)
class Rounding:
    """Differences between weights as trained and as stored.

    Attributes
    ----------
    storage : str
        How they are stored.
    rows : int
        Rows looked at, of the test split.
    z_change, z_spread : float or None
        Largest change of a number of z, and the standard deviation of z, for its scale.
    reconstruction_mse, reconstruction_mse_stored : float or None
        Error of V before and after.
    action_change, action_change_mean : float or None
        Largest and mean change of an action [m/s].
    """

    storage: str
    rows: int
    z_change: float | None = None
    z_spread: float | None = None
    reconstruction_mse: float | None = None
    reconstruction_mse_stored: float | None = None
    action_change: float | None = None
    action_change_mean: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON values, those that were measured."""
        return {
            key: float(f"{value:.4g}") if isinstance(value, float) else value
            for key, value in asdict(self).items()
            if value is not None
        }


def rounding(
    trained: Policy | WorldModel, stored: Policy | WorldModel, data: Path, storage: str = "float16"
) -> Rounding:
    """Measure what rounding changes.

    Parameters
    ----------
    trained, stored : Policy or WorldModel
        Before and after.
    data : pathlib.Path
        Dataset; its test split is looked at.
    storage : str
        For the result.

    Raises
    ------
    ConfigError
        If the split has no whole window of 8 rows.
    """
    if isinstance(trained, Policy):
        assert isinstance(stored, Policy)
        return _of_policies(trained, stored, data, storage)
    assert isinstance(stored, WorldModel)
    scan, _ = _rows(data)
    obs = trained.observation(scan.reshape(-1, scan.shape[-1]))
    with torch.no_grad():
        before, after = trained.encode(obs), stored.encode(obs)
        errors = [float((m.decode(z) - obs).square().mean()) for m, z in ((trained, before), (stored, after))]
    return Rounding(storage, len(obs), float((before - after).abs().max()), float(before.std()), errors[0], errors[1])


def _of_policies(trained: Policy, stored: Policy, data: Path, storage: str) -> Rounding:
    scan, robot_state = _rows(data)
    changes = []
    for policy in (trained, stored):
        policy.reset(batch_size=len(scan))
    for t in range(scan.shape[1]):
        one, other = (p.act(scan[:, t], robot_state[:, t]) for p in (trained, stored))
        stored.observe(one)  # both remember what the robot really did
        changes.append(np.abs(one - other))
    found = np.concatenate(changes)
    return Rounding(storage, len(found), action_change=float(found.max()), action_change_mean=float(found.mean()))


def _rows(data: Path) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Return scans (N, 8, 1080) [m] and robot states (N, 8, 5), evenly spread over the test split."""
    dataset = SequenceDataset(data, "1d", window=_WINDOW, split="test", fields=["robot_state"], invalid="near")
    whole = np.flatnonzero(dataset.table.count == _WINDOW)
    if len(whole) == 0:
        raise ConfigError(f"{data} has no episode of {_WINDOW} rows in its test split, expected a larger dataset.")
    chosen = whole[np.unique(np.linspace(0, len(whole) - 1, min(_WINDOWS, len(whole))).astype(int))]
    batch = dataset.batch([int(k) for k in chosen])
    dataset.close()
    return batch["scan"].numpy(), batch["robot_state"].numpy()
