"""Prove a dataset by making some of it again."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from navrep_data.errors import ConfigError, DatasetError, check_whole
from navrep_data.generate.inputs import check_inputs, find_maps, inputs_of
from navrep_data.generate.policy import MAX_BATCH, make_policy, make_rollout
from navrep_data.generate.worker import DatasetSpec, new_writer
from navrep_data.schema import SCAN_SCALE
from navrep_data.shards import DatasetFolder, Manifest, ShardEntry, sequence_hash
from navrep_data.sim import RolloutSettings, ScriptedPolicy, SimConfig

# Another CPU or library may round differently: up to this much is called equal, and counted [m, m/s, rad].
TOLERANCE = 1e-3
EQUAL_BYTES, EQUAL_COLUMNS, WITHIN, DIFFERENT = "equal bytes", "equal columns", "equal within 1 mm", "different"


@dataclass(frozen=True)
class SequenceComparison:
    """How one sequence compares with itself made again.

    Attributes
    ----------
    sequence : int
        Its index.
    verdict : str
        ``"equal bytes"``: also the compressed bytes; ``"equal columns"``: every decoded value; ``"equal within 1 mm"``;
        ``"different"``.
    values : int
        Values that differ.
    largest : float
        Largest difference (scans in metres, others in the column's unit).
    columns : dict of str to int
        Differing values by column.
    """

    sequence: int
    verdict: str
    values: int = 0
    largest: float = 0.0
    columns: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class RegenerateReport:
    """What :func:`regenerate` found.

    Attributes
    ----------
    comparisons : list of SequenceComparison
        One per sequence, in order.
    """

    comparisons: list[SequenceComparison]

    @property
    def ok(self) -> bool:
        """Whether no sequence is different."""
        return all(c.verdict != DIFFERENT for c in self.comparisons)

    def to_dict(self) -> dict[str, Any]:
        """Return JSON values."""
        return {"ok": self.ok, "sequences": [asdict(c) for c in self.comparisons]}


def recipe_of(root: Path, manifest: Manifest, maps: Sequence[str] = ()) -> DatasetSpec:
    """Return what makes a dataset, from its manifest and the maps that it names, or those at the paths `maps`.

    Raises
    ------
    DatasetError
        If it was not generated (an import, for example).
    ConfigError, PolicyError
        If this version cannot simulate it, or its policy cannot be imported.
    MapError, DatasetMismatchError
        If a map is not found, or it or the policy is not the one that it was made with.
    """
    if manifest.source:
        raise DatasetError(f"{root} was made out of other datasets ({manifest.command}); regenerate from those.")
    if "name" not in manifest.policy or "env" not in manifest.config:
        raise DatasetError(f"{root} was not made by `navrep-data generate`; there is no recipe to make it again from.")
    config = find_maps(root, manifest, SimConfig.from_dict(manifest.config), maps)
    settings = RolloutSettings(
        manifest.length, manifest.scan_dtype,
        *(name in manifest.columns for name in ("rings", "humans", "scan_label", "contact")),
    )  # fmt: skip
    name, batch = str(manifest.policy["name"]), manifest.policy.get("batch", 1)
    if type(batch) is not int or not 1 <= batch <= MAX_BATCH:
        raise DatasetError(f"{root} says policy.batch is {batch!r}, expected 1 to {MAX_BATCH}; get the manifest again.")
    policy = make_policy(name, batch)
    if policy.spec is None and policy.to_dict() != manifest.policy:
        raise ConfigError(
            f"{root} was made with policy settings {manifest.policy}, this version has "
            f"{ScriptedPolicy(name).to_dict()}; use the version in its manifest."
        )
    check_inputs(root, manifest, inputs_of(config, policy))
    return DatasetSpec(root, config, settings, policy, manifest.seed, manifest.columns, inputs=manifest.inputs)


def regenerate(root: Path | str, k: int, seed: int | None = None, maps: Sequence[str] = ()) -> RegenerateReport:
    """Simulate `k` random sequences of a dataset again from its manifest, and compare.

    Parameters
    ----------
    root : path-like
        Dataset folder.
    k : int
        Number of sequences; all of them if there are fewer.
    seed : int, optional
        Chooses the sequences; a new choice each time by default.
    maps : sequence of str, optional
        Paths of the dataset's maps, in their order, where they are not found: a relative path is looked for from the
        dataset's folder, then from the working folder.

    Returns
    -------
    RegenerateReport
        Verdict per sequence.

    Raises
    ------
    ConfigError
        If `k` is not at least 1.
    DatasetError, ConfigError, PolicyError
        If the dataset cannot be made again.
    MapError, DatasetMismatchError
        If a map is not found, or it or the policy is not the one that the dataset was made with.
    CorruptDataError
        If a shard is damaged.
    """
    root = Path(root)
    k = check_whole("--regenerate", k, 1)
    with DatasetFolder(root) as folder:
        manifest = folder.manifest
        spec = recipe_of(root, manifest, maps)
        everything = sorted(number for entry in manifest.shards for number in entry.numbers)
        chosen = sorted(random.Random(seed).sample(everything, min(k, len(everything))))
        rollout = make_rollout(spec.config, spec.settings, spec.policy, spec.seed)
        comparisons = []
        for sequence in chosen:
            place = manifest.place_of(sequence)
            assert place is not None
            shard, at = place
            first = at // rollout.batch * rollout.batch
            group = manifest.shards[shard].numbers[first : first + rollout.batch]
            with spec.policy.in_its_way():
                columns, worlds = rollout.run(group)[at - first]
            comparisons.append(_compare(folder, spec, place, columns, worlds))
    return RegenerateReport(comparisons)


def _compare(
    folder: DatasetFolder, spec: DatasetSpec, place: tuple[int, int],
    columns: dict[str, npt.NDArray[Any]], worlds: dict[str, npt.NDArray[Any]],
) -> SequenceComparison:  # fmt: skip
    (index, at), length = place, spec.settings.length
    entry = folder.manifest.shards[index]
    sequence, start = entry.numbers[at], at * length
    counts: dict[str, int] = {}
    largest = 0.0
    for name in spec.columns:
        old = folder.read(name, index, start, start + length)
        new = columns[name]
        same = (old == new) | ((old != old) & (new != new))
        if not same.all():
            counts[name] = int((~same).sum())
            if name != "rings":  # steps, not lengths: a range that moves by nothing to speak of may change its cell
                scale = SCAN_SCALE if old.dtype == np.uint16 else 1.0
                size = np.abs(old[~same].astype(np.float64) - new[~same].astype(np.float64)) * scale
                largest = max(largest, float(np.nan_to_num(size, nan=np.inf).max()))
    if not counts:
        listed = entry.sequence_hashes[at]
        if sequence_hash({name: columns[name] for name in spec.columns}) != listed:
            return SequenceComparison(sequence, DIFFERENT, columns={"sequence_hashes": 1})
        same_bytes = _same_chunks(spec, entry, at, columns, worlds)
        return SequenceComparison(sequence, EQUAL_BYTES if same_bytes else EQUAL_COLUMNS)
    # the slack lets a difference of one millimetre pass in spite of its rounding; rings follow from the scan alone
    hard = largest > TOLERANCE * (1 + 1e-6) or set(counts) == {"rings"}
    return SequenceComparison(sequence, DIFFERENT if hard else WITHIN, sum(counts.values()), largest, counts)


def _same_chunks(
    spec: DatasetSpec, entry: ShardEntry, at: int, columns: dict[str, npt.NDArray[Any]],
    worlds: dict[str, npt.NDArray[Any]],
) -> bool:  # fmt: skip
    """Return whether the compressed chunks of a sequence are the stored ones, byte for byte."""
    writer = new_writer(spec, entry.split)
    writer.append(entry.numbers[at], columns, worlds)
    image = writer.finish().data
    start = at * spec.settings.length
    with h5py.File(spec.root / entry.file, "r") as old, h5py.File.in_memory(image) as new:
        for name in spec.columns:
            a, b = old[name].id, new[name].id
            rows = new[name].chunks[0]
            if start % rows or spec.settings.length % rows:
                return False  # chunks hold rows of several sequences: equal columns is all that can be said
            for row in range(0, spec.settings.length, rows):
                rest = (0,) * (len(new[name].shape) - 1)
                if a.read_direct_chunk((start + row, *rest)) != b.read_direct_chunk((row, *rest)):
                    return False
    return True
