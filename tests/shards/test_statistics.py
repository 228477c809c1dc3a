"""Statistics against a slow oracle: plain numpy over all rows at once."""

from __future__ import annotations

import numpy as np
import pytest

from navrep_data.schema import COLUMNS, EVENT_NAMES
from navrep_data.shards import merge_statistics
from navrep_data.shards._layout import VECTOR_COLUMNS
from navrep_data.shards.statistics import check_statistics

from .synthetic import ALL_COLUMNS, make_sequence, make_writer


def image_of(sequences, first=0, **changes):
    writer = make_writer(length=200, **changes)
    for k, (columns, worlds) in enumerate(sequences, first):
        writer.append(k, columns, worlds)
    return writer.finish().statistics


def oracle(name, values, is_last):
    values = values.astype(np.float64)
    if name in ("action", "reward"):
        values = values[~is_last]
    if name == "scan":
        values = values[values > 0]
    values = values.reshape(-1, values.shape[-1] if name in VECTOR_COLUMNS else 1)
    out = []
    for component in values.T:
        known = component[~np.isnan(component)]
        out.append((len(known), known.mean(), known.std(), known.min(), known.max()))
    return out


@pytest.mark.slow
@pytest.mark.parametrize("scan_dtype", ["uint16", "float32"])
def test_against_the_oracle(scan_dtype):
    sequences = [make_sequence(k, 150, scan_dtype=scan_dtype) for k in range(3)]
    statistics = image_of(sequences, scan_dtype=scan_dtype)
    together = {name: np.concatenate([c[name] for c, _ in sequences]) for name in ALL_COLUMNS}
    for name, values in together.items():
        scale = 0.001 if name == "scan" and scan_dtype == "uint16" else 1.0
        got = statistics["columns"][name]
        for k, (count, *rest) in enumerate(oracle(name, values, together["is_last"])):
            one = {key: v[k] if name in VECTOR_COLUMNS else v for key, v in got.items()}
            assert one["count"] == count, name
            for key, value in zip(("mean", "std", "min", "max"), rest, strict=True):
                assert one[key] == pytest.approx(value * scale, rel=1e-9, abs=1e-9), (name, key)
    ends = np.flatnonzero(together["is_last"])
    steps, events = together["step"][ends], together["event"][ends]
    for code, name in enumerate(EVENT_NAMES):
        mine = steps[events == code]
        assert (name in statistics["outcomes"]) == (len(mine) > 0)
        if len(mine):
            got = statistics["outcomes"][name]
            assert (got["episodes"], got["steps"]) == (len(mine), mine.sum())
            assert (got["min_length"], got["max_length"]) == (mine.min(), mine.max())
            assert got["share"] == pytest.approx(len(mine) / len(ends))


def test_merging_shards_is_the_whole():
    sequences = [make_sequence(k, 120) for k in range(4)]
    whole = image_of(sequences)
    merged = merge_statistics([image_of(sequences[:1]), image_of(sequences[1:], 1)])
    for name, values in whole["columns"].items():
        for key, value in values.items():
            assert merged["columns"][name][key] == pytest.approx(value, rel=1e-9, abs=1e-9), (name, key)
    for name, values in whole["outcomes"].items():
        assert merged["outcomes"][name] == pytest.approx(values)
    assert merged["humans_per_episode"] == pytest.approx(whole["humans_per_episode"])
    assert merge_statistics([]) == {}


def test_unknown_everywhere_is_none():
    columns, worlds = make_sequence(0, 150)
    columns["robot_radius"][:] = np.nan
    columns["robot_pose"][:, 1] = np.nan
    columns["scan"][:] = 0
    got = image_of([(columns, worlds)])["columns"]
    assert got["robot_radius"] == {"count": 0, "mean": None, "std": None, "min": None, "max": None}
    assert got["robot_pose"]["count"] == [150, 0, 150]
    assert got["scan"]["mean"] is None
    assert merge_statistics([image_of([(columns, worlds)])])["columns"]["robot_radius"]["mean"] is None


def test_statistics_from_elsewhere_are_checked():
    good = image_of([make_sequence(0)])
    assert check_statistics(good, ALL_COLUMNS) == ""
    for bad in (
        [],
        {},
        {**good, "columns": {}},
        {**good, "outcomes": {"goal": 3}},
        {**good, "humans_per_episode": None},
    ):
        assert check_statistics(bad, ALL_COLUMNS) != ""
    assert set(ALL_COLUMNS) <= set(COLUMNS)


@pytest.mark.parametrize("rays", [[0, 0], [65535, 0, 65535], [1], [0, 1, 2], [65535]])
def test_extreme_rays(rays):
    columns, worlds = make_sequence(0, 150)
    flat = columns["scan"].reshape(-1)
    flat[:] = 0
    flat[: len(rays)] = rays
    valid = [r * 0.001 for r in rays if r > 0]
    got = image_of([(columns, worlds)])["columns"]["scan"]
    assert got["count"] == len(valid)
    assert got["min"] == (pytest.approx(min(valid)) if valid else None)
    assert got["max"] == (pytest.approx(max(valid)) if valid else None)
    assert got["mean"] == (pytest.approx(np.mean(valid)) if valid else None)
    assert got["std"] == (pytest.approx(np.std(valid), abs=1e-9) if valid else None)
