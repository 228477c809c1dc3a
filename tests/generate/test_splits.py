"""No sequence is ever in two splits, whatever a dataset grows by, and whatever is merged and filtered in what order."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from navrep_data.datasets.tools import filter, merge
from navrep_data.generate import generate
from navrep_data.generate.worker import all_shards
from navrep_data.shards import SPLITS, DatasetFolder, Manifest, split_of

sizes = st.integers(1, 400)


@given(n=sizes, more=sizes, shard_size=st.integers(1, 50))
def test_growing_keeps_every_sequence_in_its_split(n, more, shard_size):
    before, after = all_shards(n, shard_size), all_shards(n + more, shard_size)
    for shards, count in ((before, n), (after, n + more)):
        numbers = [(k, shard.split) for shard in shards for k in shard.numbers]
        assert sorted(numbers) == [(k, split_of(k)) for k in range(count)]
        assert len({shard.file for shard in shards}) == len(shards)
    kept = {shard.file: shard for shard in after}
    for shard in before:
        now = kept[shard.file]
        assert (now.split, now.first) == (shard.split, shard.first)
        last_of_split = not any(s.split == shard.split and s.index > shard.index for s in before)
        assert now.stop == shard.stop or (last_of_split and now.stop > shard.stop)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Three datasets that grew in different ways: seeds 0, 1 and 2."""
    home = tmp_path_factory.mktemp("splits")
    for seed, steps in enumerate(((4, 13), (12,), (2, 3, 11))):
        for n in steps:
            generate(env="soadrl", n=n, length=20, seed=seed, shard_size=2 + seed, out=home / str(seed))
    return [home / str(seed) for seed in range(3)]


def splits_by_origin(root: Path) -> dict[tuple[str, int], set[str]]:
    """Return the splits of each original sequence, by the hash of its dataset and its number."""
    found: dict[tuple[str, int], set[str]] = {}
    manifest = Manifest.read(root)
    for entry in manifest.shards:
        for one in entry.source:
            key = manifest.source[one.dataset]["content_hash"], one.sequence
            found.setdefault(key, set()).add(entry.split)
    return found


@pytest.mark.slow
@settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
@given(order=st.permutations(range(3)), first_two=st.booleans(), least=st.integers(1, 12))
def test_merging_and_filtering_keep_every_sequence_in_its_split(made, tmp_path_factory, order, first_two, least):
    home = tmp_path_factory.mktemp("merged")
    a, b, c = (made[k] for k in order)
    if first_two:
        merge([a, b], home / "ab")
        merge([home / "ab", c], home / "abc")
    else:
        merge([b, c], home / "bc")
        filter(a, home / "some", min_steps=least)
        merge([home / "some", home / "bc"], home / "abc")
    found = splits_by_origin(home / "abc")
    assert len(found) > 20
    assert all(splits == {split_of(number)} for (_, number), splits in found.items())
    with DatasetFolder(home / "abc") as folder:
        held = {split: {k for start, stop in ranges for k in range(start, stop)}
                for split, ranges in folder.manifest.splits.items()}  # fmt: skip
    assert sum(map(len, held.values())) == len(set().union(*held.values()))
    assert all(held[split] for split in SPLITS)
