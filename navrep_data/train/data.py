"""Batches for training: which windows a step sees is a function of seed and step, so that resuming is exact."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from torch import Tensor

from navrep_data.datasets import LatentDataset, ScanDataset, SequenceDataset
from navrep_data.errors import ConfigError, DatasetMismatchError
from navrep_data.schema import SensorContract
from navrep_data.shards import DatasetFolder
from navrep_data.train.recipe import Recipe

Batch = dict[str, Tensor]
LIDAR_FIELD = {"rings": "rings", "1d": "scan"}
# A dataset is held in memory where it takes no more than this share of what is free.
_MEMORY_SHARE = 0.5
_BYTES_OF_PEOPLE = 30 * 6 * 4
_BYTES_PER_ROW = {"rings": 4096 + 64, "1d": 2160 + 64}


class _Windows(Protocol):
    def __len__(self) -> int: ...

    def batch(self, indices: Any) -> Batch: ...


def check_sensor(sensor: SensorContract, who: str) -> None:
    """Raise unless scans of `sensor` are what the networks take.

    Raises
    ------
    DatasetMismatchError
        If rays, angles, range or time step differ.
    """
    for name, value in SensorContract().to_dict().items():
        seen = float(getattr(sensor, name))
        if abs(seen - float(value)) > 1e-4:
            raise DatasetMismatchError(
                f"{who} has scans with {name} = {seen:g}, expected {value:g}: the networks take this sensor only. Put "
                "its scans through navrep_data.observations.ScanAdapter, or generate with the default sensor."
            )


def describe_dataset(root: Path, model: str) -> dict[str, Any]:
    """Return what a checkpoint records of its dataset, after checking the sensor."""
    if model == "m":
        latents = LatentDataset(root, window=1).manifest
        check_sensor(SensorContract(**latents.sensor), str(root))
        return {**latents.source, "encoder": latents.encoder, "sensor": latents.sensor}
    with DatasetFolder(root) as folder:
        check_sensor(folder.manifest.sensor, str(root))
        m = folder.manifest
        return {
            **folder.provenance,
            "env": m.env,
            "physics": m.physics,
            "seed": m.seed,
            "sequences": m.sequences,
            "rows": m.rows,
            "sensor": m.sensor.to_dict(),
        }


def _free_bytes() -> int:
    try:
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (ValueError, OSError, AttributeError):  # not on this system
        return 4 << 30


def _fits(root: Path, recipe: Recipe) -> bool:
    with DatasetFolder(root) as folder:
        rows = folder.manifest.rows
    people = _BYTES_OF_PEOPLE if has_people(root, recipe) else 0
    return rows * (_BYTES_PER_ROW[recipe.lidar] + people) < _MEMORY_SHARE * _free_bytes()


def has_people(root: Path, recipe: Recipe) -> bool:
    """Tell whether a recipe asks for people and a dataset has them: imported ones mostly don't."""
    if recipe.model == "m" or recipe.people_weight == 0.0:
        return False
    with DatasetFolder(root) as folder:
        return "humans" in folder.manifest.columns


def open_dataset(
    root: Path, recipe: Recipe, split: Literal["train", "val", "test"], preload: bool | None = None
) -> _Windows:
    """Return the windows of a split that a recipe trains on."""
    alignment: Any = recipe.action_alignment
    if recipe.model == "m":
        # one row more than is predicted from
        extra = 0 if recipe.original else 1
        return LatentDataset(
            root, window=recipe.window + extra, stride=recipe.stride, split=split, action=alignment,
            across_episodes=recipe.original,
        )  # fmt: skip
    preload = _fits(root, recipe) if preload is None else preload
    lidar: Any = recipe.lidar
    people = ["humans"] if has_people(root, recipe) else []
    common: dict[str, Any] = {"split": split, "scan_unit": "normalized", "invalid": "near", "preload": preload}
    if recipe.model == "v":
        return ScanDataset(root, lidar, fields=people, **common)
    fields = ["robot_state", "action", "goal_valid", *people]
    if recipe.original:
        return SequenceDataset(
            root, lidar, window=recipe.window, stride=recipe.stride, fields=fields, action=alignment, targets=True,
            across_episodes=True, **common,
        )  # fmt: skip
    return SequenceDataset(
        root, lidar, window=recipe.window + 1, stride=recipe.stride, fields=fields, action=alignment, **common
    )


class Batches:
    """The batches of a training, by step.

    Parameters
    ----------
    dataset : ScanDataset, SequenceDataset or LatentDataset
        Windows.
    recipe : Recipe
        Batch size and seed; the authors' v and m leave out a smaller last batch.
    """

    def __init__(self, dataset: _Windows, recipe: Recipe) -> None:
        self.dataset, self.recipe = dataset, recipe
        drop = recipe.original and recipe.model in ("v", "m")
        self.per_epoch = len(dataset) // recipe.batch if drop else -(-len(dataset) // recipe.batch)
        if self.per_epoch == 0:
            raise ConfigError(
                f"The dataset has {len(dataset)} windows, expected at least a batch of {recipe.batch}: generate more "
                "sequences, or lower --batch."
            )
        self._order: tuple[int, np.ndarray[Any, Any]] = (-1, np.zeros(0, np.int64))

    def indices(self, step: int) -> np.ndarray[Any, Any]:
        """Return which windows step `step` (from 0) sees."""
        epoch, k = divmod(step, self.per_epoch)
        if self._order[0] != epoch:
            draw = np.random.default_rng([self.recipe.seed, epoch])
            self._order = (epoch, draw.permutation(len(self.dataset)))
        return self._order[1][k * self.recipe.batch : (k + 1) * self.recipe.batch]

    def read(self, step: int) -> Batch:
        """Return the batch of step `step`, laid out by :func:`prepare`."""
        return prepare(self.dataset.batch(self.indices(step)), self.recipe)

    def ahead(self, first: int, stop: int) -> Iterator[Batch]:
        """Yield the batches of steps first to stop - 1, each read while the one before is used."""
        with ThreadPoolExecutor(1) as pool:
            coming: Future[Batch] | None = pool.submit(self.read, first) if first < stop else None
            for step in range(first, stop):
                assert coming is not None
                batch = coming.result()
                coming = pool.submit(self.read, step + 1) if step + 1 < stop else None
                yield batch


def prepare(raw: Batch, recipe: Recipe) -> Batch:
    """Return a batch in the form that the losses take, still with all rows of its windows.

    Returns
    -------
    dict of str to Tensor
        v: `obs` (B, ...). Others: `mask`, `next_mask` (B, T), `goal`, `next_goal`, `goal_mask` (both known), `action`;
        lidar models `obs` and `next_obs` (B, T, ...); m `mu`, `logvar` of T + 1 rows, `restart`, `next_last`.
    """
    if recipe.model == "m":
        return _prepare_codes(raw, recipe)
    name = LIDAR_FIELD[recipe.lidar]
    for field in (name, f"next_{name}"):
        if recipe.lidar == "rings" and field in raw:
            raw[field][..., 0] = 0.0  # the nearest cell, as everywhere in the original but end to end
    if recipe.model == "v":
        return {"obs": raw[name], **({"humans": raw["humans"]} if "humans" in raw else {})}
    if recipe.original:
        x, y = raw, {field: raw[f"next_{field}"] for field in (name, "robot_state", "goal_valid", "mask")}
    else:
        x = {field: value[:, :-1] for field, value in raw.items()}
        y = {field: value[:, 1:] for field, value in raw.items()}
    return {
        **({"humans": x["humans"]} if "humans" in x else {}),
        "obs": x[name],
        "next_obs": y[name],
        "mask": x["mask"],
        "next_mask": y["mask"],
        "goal": x["robot_state"][..., :2],
        "next_goal": y["robot_state"][..., :2],
        "goal_mask": y["mask"] & y["goal_valid"] & x["goal_valid"],
        "action": x["action"],
    }


def _prepare_codes(raw: Batch, recipe: Recipe) -> Batch:
    last = raw["is_last"]
    return {
        "mu": raw["mu"],
        "logvar": raw["logvar"],
        "mask": raw["mask"][:, :-1],
        "next_mask": raw["mask"][:, 1:],
        "goal": raw["robot_state"][:, :-1, :2],
        "next_goal": raw["robot_state"][:, 1:, :2],
        "goal_mask": raw["mask"][:, 1:] & raw["goal_valid"][:, 1:] & raw["goal_valid"][:, :-1],
        "action": raw["action"][:, :-1],
        # the authors restart the state on an episode's last row; windows within episodes hold no restart
        "restart": last[:, :-1] & recipe.original,
        "next_last": last[:, 1:],
    }


def part(batch: Batch, first: int, stop: int) -> Batch:
    """Return windows first to stop - 1 of a prepared batch, with the observations of real rows only."""
    piece = {name: value[first:stop] for name, value in batch.items()}
    if "obs" in piece and "mask" in piece:
        for name in ("obs", "humans"):
            if name in piece:
                piece[name] = piece[name][piece["mask"]]
        piece["next_obs"] = piece["next_obs"][piece["next_mask"]]
    return piece
