"""The paper's world-model error, for every architecture, and how far a dream stays true.

Notes
-----
Paper section III-A: the mean squared error of the next step, apart for the lidar part of the state and for s_r; the
paper computes it on the training split. Of s_r the models predict the goal only, so that is what is compared [m^2]; the
paper does not say its unit. The released software took a modular model's predicted *change* of z for z itself
(MODEL_FACTS 3); here it is added.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from navrep_data.datasets import SequenceDataset
from navrep_data.errors import ConfigError, DatasetMismatchError, check_whole
from navrep_data.models.vae import VAE
from navrep_data.models.world_model import WorldModel
from navrep_data.schema import SensorContract
from navrep_data.shards import DatasetFolder

_BATCH = 16
CONTEXT = 16
"""Real rows that a dream starts from."""


@dataclass(frozen=True)
class WorldModelError:
    """How well a world model predicts a dataset.

    Attributes
    ----------
    name : str
        The model.
    split : str
        Part of the dataset.
    lidar : str
        Representation that the errors are in: values {0, 0.5, 1}, or ranges over 25 m.
    rows : int
        Predicted rows.
    scan_mse, goal_mse : float or None
        World-model error, teacher-forced: each row predicted from the real rows before it. goal_mse in m^2. None for a
        V alone, which predicts nothing; so are the dreams' then.
    reconstruction_mse : float
        Error of V itself, on the rows that predictions start from.
    still_scan_mse, still_goal_mse : float
        Error of predicting that nothing changes, for comparison.
    context : int
        Real rows before a dream.
    dream_scan_mse, dream_goal_mse : list of float
        Errors after 1, 2, ... k steps of a free-running dream.
    dream_still_scan_mse, dream_still_goal_mse : list of float
        The same for a world that stands still.
    dreams : list of int
        Dreams behind each of them.
    """

    name: str
    split: str
    lidar: str
    rows: int
    scan_mse: float | None
    goal_mse: float | None
    reconstruction_mse: float
    still_scan_mse: float
    still_goal_mse: float
    context: int
    dream_scan_mse: list[float]
    dream_goal_mse: list[float]
    dream_still_scan_mse: list[float]
    dream_still_goal_mse: list[float]
    dreams: list[int]

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return asdict(self)


def world_model_error(
    model: WorldModel | VAE,
    data: Path | str,
    *,
    split: Literal["train", "val", "test"] = "train",
    steps: int = 16,
    limit: int | None = None,
    name: str = "",
    progress: bool = False,
) -> WorldModelError:
    """Measure a world model on a split of a dataset.

    Parameters
    ----------
    model : WorldModel or VAE
        Modular, joint or transformer; of a V alone, its reconstruction error.
    data : path-like
        Dataset folder.
    split : {"train", "val", "test"}
        Part of it; the paper takes ``"train"``.
    steps : int
        k, steps of the dream; with the rows before it at most the model's window of 32.
    limit : int, optional
        Look at this many windows only, evenly spread over the split.
    name : str
        For the result.
    progress : bool
        Show a progress bar on stderr.

    Returns
    -------
    WorldModelError

    Raises
    ------
    ConfigError
        If `model` is no world model, or a number cannot be used.
    DatasetMismatchError
        If the dataset has another sensor.

    Notes
    -----
    Windows of 32 rows that stay within an episode. A dream starts after 16 real rows; from then on the model is fed its
    own codes and goals and the actions that were really taken. Everything is deterministic: z is the mean, there is no
    dropout.
    """
    if isinstance(model, VAE):
        return _of_v(model, Path(data), split, limit, name, progress)
    if not isinstance(model, WorldModel):
        raise ConfigError(
            f"{name or 'This'} is a {type(model).__name__}, expected a world model such as transformer_1d."
        )
    window = getattr(model.config, "context", 32)
    steps = check_whole("steps", steps, 1, window - 1)  # dream and context share the rows of a window
    context = min(CONTEXT, window - steps + 1)
    dataset = _open(model.lidar, model.config.action_alignment, Path(data), split, window)
    sums = _Sums(steps)
    for batch in _batches(model.vae, dataset, _chosen(dataset, limit), progress):
        _teacher_forced(model, batch, sums)
        _dreams(model, batch, context, steps, sums)
    dataset.close()
    return sums.result(name, split, model.lidar, context)


def _of_v(
    model: VAE, data: Path, split: Literal["train", "val", "test"], limit: int | None, name: str, progress: bool
) -> WorldModelError:
    """Return the reconstruction error of a V, over the rows that a world model's is taken of."""
    dataset = _open(model.config.lidar, "taken", data, split, 32)
    sums = _Sums(0)
    for batch in _batches(model, dataset, _chosen(dataset, limit), progress):
        _still_and_reconstructed(model, batch, model.encode(batch["obs"][:, :-1]).detach(), sums)
    dataset.close()
    found = sums.result(name, split, model.config.lidar, 0)
    return replace(found, scan_mse=None, goal_mse=None)


def _chosen(dataset: SequenceDataset, limit: int | None) -> np.ndarray[Any, Any]:
    """Return the windows to look at, evenly spread."""
    if limit is not None and limit < 1:
        raise ConfigError(f"limit is {limit}, expected at least 1 window.")
    n = len(dataset)
    return np.arange(n) if limit is None else np.unique(np.linspace(0, n - 1, min(limit, n)).astype(int))


def _open(lidar: Any, alignment: Any, data: Path, split: Any, window: int) -> SequenceDataset:
    folder = DatasetFolder(data)
    sensor, expected = folder.manifest.sensor, SensorContract()
    folder.close()
    for key, value in expected.to_dict().items():
        if abs(float(getattr(sensor, key)) - float(value)) > 1e-4:
            seen = getattr(sensor, key)
            raise DatasetMismatchError(
                f"{data} has scans with {key} = {seen}, expected {value}: the model takes this sensor only."
            )
    return SequenceDataset(
        data, lidar, window=window + 1, stride=window, split=split, fields=["robot_state", "action", "goal_valid"],
        action=alignment, scan_unit="normalized", invalid="near",
    )  # fmt: skip


def _batches(
    vae: VAE, dataset: SequenceDataset, chosen: np.ndarray[Any, Any], progress: bool
) -> Iterator[dict[str, Tensor]]:
    from tqdm import tqdm

    field = "rings" if vae.config.lidar == "rings" else "scan"
    device = vae.fc1.weight.device
    for first in tqdm(range(0, len(chosen), _BATCH), unit="batch", disable=not progress):
        raw = dataset.batch(chosen[first : first + _BATCH])
        obs = raw[field]
        if field == "rings":
            obs[..., 0] = 0.0
        goal = raw["robot_state"][..., :2]
        yield {
            "obs": obs.to(device),
            "goal": goal.to(device),
            "action": raw["action"].to(device),
            "mask": raw["mask"].to(device),
            "goal_mask": (raw["mask"] & raw["goal_valid"]).to(device),
        }


class _Sums:
    """Sums of squared errors and the numbers of rows behind them."""

    def __init__(self, steps: int) -> None:
        self.forced: dict[str, float] = dict.fromkeys(("scan", "goal", "rec", "still_scan", "still_goal"), 0.0)
        self.rows = self.goal_rows = 0.0
        self.dream = {name: np.zeros(steps) for name in ("scan", "goal", "still_scan", "still_goal")}
        self.count, self.goal_count = np.zeros(steps), np.zeros(steps)

    def result(self, name: str, split: str, lidar: str, context: int) -> WorldModelError:
        """Return the means."""
        forced, rows, goals = self.forced, max(1.0, self.rows), max(1.0, self.goal_rows)
        counts = {"scan": np.maximum(1.0, self.count), "goal": np.maximum(1.0, self.goal_count)}
        dream = {k: (v / counts[k.removeprefix("still_")]).tolist() for k, v in self.dream.items()}
        return WorldModelError(
            name, split, lidar, int(self.rows), forced["scan"] / rows, forced["goal"] / goals, forced["rec"] / rows,
            forced["still_scan"] / rows, forced["still_goal"] / goals, context, dream["scan"], dream["goal"],
            dream["still_scan"], dream["still_goal"], self.count.astype(int).tolist(),
        )  # fmt: skip


def _row_errors(a: Tensor, b: Tensor) -> Tensor:
    """Return the mean squared error of each row of (N, ...)."""
    return (a - b).square().flatten(1).mean(1)


@torch.no_grad()
def _still_and_reconstructed(vae: VAE, batch: dict[str, Tensor], mu: Tensor, sums: _Sums) -> Tensor:
    """Add what needs no memory, given the codes of all rows but the last; return which pairs have a known goal."""
    obs, goal = batch["obs"], batch["goal"]
    now, after, target = obs[:, :-1], obs[:, 1:], batch["mask"][:, 1:]
    sums.rows += float(target.sum())
    sums.forced["rec"] += float(_row_errors(vae.decode(mu[target]), now[target]).sum())
    sums.forced["still_scan"] += float(_row_errors(now[target], after[target]).sum())
    known = batch["goal_mask"][:, 1:] & batch["goal_mask"][:, :-1]
    sums.goal_rows += float(known.sum())
    sums.forced["still_goal"] += float(_row_errors(goal[:, :-1][known], goal[:, 1:][known]).sum())
    return known


@torch.no_grad()
def _teacher_forced(model: WorldModel, batch: dict[str, Tensor], sums: _Sums) -> None:
    obs, goal, target = batch["obs"], batch["goal"], batch["mask"][:, 1:]
    out = model.forward(obs[:, :-1], goal[:, :-1], batch["action"][:, :-1])
    sums.forced["scan"] += float(_row_errors(model.decode(out.next_z[target]), obs[:, 1:][target]).sum())
    known = _still_and_reconstructed(model.vae, batch, out.mu, sums)
    sums.forced["goal"] += float(_row_errors(out.next_goal[known], goal[:, 1:][known]).sum())


@torch.no_grad()
def dream(model: WorldModel, z: Tensor, goal: Tensor, action: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """Let a world model run on its own codes and goals.

    Parameters
    ----------
    model : WorldModel
        Any architecture.
    z : Tensor of shape (B, C, Z)
        Codes of the real rows before the dream.
    goal : Tensor of shape (B, C, 2) [m]
        Their goals, robot frame.
    action : Tensor of shape (B, C + steps - 1, 3)
        Actions of the real rows, then those of the dreamed ones, in the model's action alignment.
    steps : int
        Rows to dream.

    Returns
    -------
    z : Tensor of shape (B, steps, Z)
    goal : Tensor of shape (B, steps, 2) [m]
    """
    context = z.shape[1]
    for k in range(steps):
        h, _ = model.hidden(z, goal, action[:, : context + k])
        next_z, next_goal = model.heads(z[:, -1:], goal[:, -1:], h[:, -1:])
        z, goal = torch.cat([z, next_z], dim=1), torch.cat([goal, next_goal], dim=1)
    return z[:, context:], goal[:, context:]


@torch.no_grad()
def _dreams(model: WorldModel, batch: dict[str, Tensor], context: int, steps: int, sums: _Sums) -> None:
    usable = batch["mask"][:, context]
    if not bool(usable.any()):
        return
    b = {name: value[usable][:, : context + steps] for name, value in batch.items()}
    mu, _ = model.vae.distribution(b["obs"][:, :context])
    z, goal = dream(model, mu, b["goal"][:, :context], b["action"][:, :-1], steps)
    target, known = b["mask"][:, context:], b["goal_mask"][:, context:] & b["goal_mask"][:, context - 1 : context]
    last_obs = b["obs"][:, context - 1 : context].expand_as(b["obs"][:, context:])
    last_goal = b["goal"][:, context - 1 : context].expand_as(goal)
    real, real_goal = b["obs"][:, context:], b["goal"][:, context:]
    for k in range(target.shape[1]):
        at, there = target[:, k], known[:, k]
        sums.count[k] += float(at.sum())
        sums.goal_count[k] += float(there.sum())
        sums.dream["scan"][k] += float(_row_errors(model.decode(z[at, k]), real[at, k]).sum())
        sums.dream["still_scan"][k] += float(_row_errors(last_obs[at, k], real[at, k]).sum())
        sums.dream["goal"][k] += float(_row_errors(goal[there, k], real_goal[there, k]).sum())
        sums.dream["still_goal"][k] += float(_row_errors(last_goal[there, k], real_goal[there, k]).sum())
