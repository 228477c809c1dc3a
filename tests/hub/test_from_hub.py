"""Datasets opened on the Hub: whole in the cache, or streamed through a bounded one."""

import contextlib
import dataclasses
import os
import pickle
import time

import numpy as np
import pytest
import torch
from hub_server import Fault
from torch.utils.data import DataLoader

from navrep_data.datasets import ScanDataset, SequenceDataset, StreamingSequenceDataset, push
from navrep_data.datasets._hub_store import ShardStore
from navrep_data.errors import ConfigError, CorruptDataError, DatasetNotFoundError, HubError, OfflineError
from navrep_data.shards import Manifest, content_hash, select_shards

pytestmark = pytest.mark.usefixtures("no_pictures")
REPO = "user/crowd"
SHARD = r"^/cdn/"


def few(cases, n):
    """The first n cases in quick runs, all of them in slow ones."""
    wrap = [case if isinstance(case, tuple) else (case,) for case in cases]
    return [*cases[:n], *(pytest.param(*case, marks=pytest.mark.slow) for case in wrap[n:])]


def same(a, b):
    assert len(a) == len(b)
    for i in range(len(a)):
        one, other = a[i], b[i]
        assert set(one) == set(other)
        for name in one:
            torch.testing.assert_close(one[name], other[name], equal_nan=True)


@pytest.fixture
def pushed(hub, template):
    return push(template, REPO, license="cc-by-4.0")


def shard_bytes(template):
    return [s.bytes for s in Manifest.read(template).shards]


@pytest.mark.slow
@pytest.mark.parametrize("cls", [SequenceDataset, ScanDataset])
def test_from_hub_is_the_dataset(hub, pushed, template, cls):
    options = {"window": 8} if cls is SequenceDataset else {}
    there = cls.from_hub(REPO, "1d", split="train", **options)
    same(there, cls(template, "1d", split="train", **options))
    record = there.provenance
    assert (record["repo"], record["revision"]) == (REPO, pushed.commit)
    part = select_shards(Manifest.read(template), [0])  # that of the split
    assert record["content_hash"] == content_hash(part)
    before = hub.count(SHARD, "GET")
    cls.from_hub(REPO, "1d", split="train", **options)
    assert hub.count(SHARD, "GET") == before  # it is in huggingface_hub's cache


@pytest.mark.slow
def test_from_hub_brings_the_shards_of_the_split_alone(hub, pushed, template):
    there = SequenceDataset.from_hub(REPO, "1d", split="val", window=8)  # one of three shards
    assert hub.count(SHARD, "GET") == 2  # and its worlds
    same(there, SequenceDataset(template, "1d", split="val", window=8))
    assert there.provenance["partial"] is True


@pytest.mark.slow
def test_from_hub_offline(hub, pushed, monkeypatch):
    monkeypatch.setenv("NAVREP_DATA_OFFLINE", "1")
    with pytest.raises(OfflineError, match="NAVREP_DATA_OFFLINE=1"):
        SequenceDataset.from_hub(REPO, "1d", window=8)
    with pytest.raises(OfflineError, match="is not whole in the cache"):
        SequenceDataset.from_hub(REPO, "1d", window=8, revision=pushed.commit)
    monkeypatch.delenv("NAVREP_DATA_OFFLINE")
    online = SequenceDataset.from_hub(REPO, "1d", window=8, split="val")
    seen = len(hub.seen)
    monkeypatch.setenv("NAVREP_DATA_OFFLINE", "1")
    same(SequenceDataset.from_hub(REPO, "1d", window=8, split="val"), online)
    same(SequenceDataset.from_hub(REPO, "1d", window=8, split="val", revision=pushed.commit), online)
    with pytest.raises(OfflineError, match="is not whole in the cache"):
        SequenceDataset.from_hub(REPO, "1d", window=8)
    assert len(hub.seen) == seen


@pytest.mark.slow
def test_a_damaged_file_in_the_cache_is_replaced(hub, pushed, template):
    there = SequenceDataset.from_hub(REPO, "1d", window=8)
    blob = (there.root / "data" / "train-00000.h5").resolve()
    data = bytearray(blob.read_bytes())
    data[len(data) // 2] ^= 1
    blob.write_bytes(data)
    os.utime(blob, ns=(1, 1))
    same(SequenceDataset.from_hub(REPO, "1d", window=8), SequenceDataset(template, "1d", window=8))
    assert hub.count(SHARD, "GET") == 7


@pytest.mark.slow
def test_a_wrong_shard_never_opens(hub, pushed):
    hub.faults = [Fault("flip", SHARD, "GET", times=1000)]
    with pytest.raises(CorruptDataError, match=r"does not have its SHA-256 .* twice. It was not kept"):
        SequenceDataset.from_hub(REPO, "1d", window=8)
    hub.faults = []
    assert len(SequenceDataset.from_hub(REPO, "1d", window=8))


@pytest.mark.slow
@pytest.mark.parametrize("revision", few([None, "v1"], 1))
def test_a_revision_is_what_it_was(hub, pushed, template, revision):
    """A branch that moves changes nothing for who pinned a commit, or has opened the dataset."""
    hub.repo(REPO).branches["v1"] = pushed.commit
    stream = StreamingSequenceDataset.from_hub(REPO, "1d", revision=revision, window=8, shuffle=False)
    hub.repo(REPO).branches["v1"] = hub.repo(REPO).commit("main", {"README.md": b"gone"})
    here = SequenceDataset(template, "1d", window=8)
    assert len(list(stream)) == len(here)
    same(SequenceDataset.from_hub(REPO, "1d", revision=pushed.commit, window=8), here)
    with pytest.raises(DatasetNotFoundError, match=r"has no manifest.json"):
        SequenceDataset.from_hub(REPO, "1d", revision=revision, window=8)


@pytest.mark.slow
@pytest.mark.parametrize("cls", few([StreamingSequenceDataset, SequenceDataset], 1))
@pytest.mark.parametrize(
    "fault",
    few(
        [
            Fault("cut", SHARD, "GET", times=4, at=5000),
            Fault("flip", SHARD, "GET", times=1),
            Fault("status", SHARD, "GET", times=2, status=429, headers={"Retry-After": "3"}),
            Fault("stall", SHARD, "GET", times=1, seconds=600),
        ],
        1,
    ),
    ids=lambda f: f.kind,
)
def test_opening_goes_on_after_a_failure(hub, pushed, template, impatient, cls, fault):
    hub.faults = [dataclasses.replace(fault)]
    options = {"window": 8, "fields": ["sequence", "step"]}
    there = cls.from_hub(REPO, "1d", **options)
    assert windows(there) == windows(SequenceDataset(template, "1d", **options))
    assert hub.faults[0].times == 0


# ---- streaming ----


def windows(dataset):
    return sorted((int(w["sequence"][0]), int(w["step"][0]), w["scan"].sum().item()) for w in dataset)


@pytest.mark.slow
def test_streaming_yields_the_windows_of_the_dataset(hub, pushed, template):
    options = {"window": 8, "fields": ["sequence", "step"], "buffer_sequences": 2, "seed": 3}
    stream = StreamingSequenceDataset.from_hub(REPO, "1d", **options)
    assert hub.count(SHARD, "GET") == 0  # opening needs the index, which is a small file
    here = StreamingSequenceDataset(template, "1d", **options)
    for mine, other in zip(stream, here, strict=True):
        assert torch.equal(mine["scan"], other["scan"])
    assert hub.count(SHARD, "GET") == 3
    list(stream)
    assert hub.count(SHARD, "GET") == 3
    assert stream.provenance["revision"] == pushed.commit


@pytest.mark.slow
def test_streaming_reads_only_the_shards_it_needs(hub, pushed, template):
    stream = StreamingSequenceDataset.from_hub(REPO, "1d", window=8, split="val", fields=["sequence", "step"])
    assert windows(stream) == windows(
        SequenceDataset(template, "1d", window=8, split="val", fields=["sequence", "step"])
    )
    assert hub.count(SHARD, "GET") == 1


@pytest.mark.slow
def test_streaming_fetches_ahead_in_the_order_of_the_epoch(hub, pushed):
    stream = StreamingSequenceDataset.from_hub(REPO, "1d", window=8, shuffle=False, buffer_sequences=2, prefetch=1)
    first = iter(stream)
    next(first)
    while hub.count(SHARD, "GET") < 3:  # pytest's own limit ends a hang
        time.sleep(0.01)
    assert hub.count(SHARD, "GET") == 3  # those of the sequences 0 and 1, which are read, and the next one
    first.close()
    none = StreamingSequenceDataset.from_hub(REPO, "1d", window=8, split="test", prefetch=0)
    assert none._folder._coming == {}


def held(folder):
    return sum(p.stat().st_size for p in folder.rglob("*") if p.is_file() and p.suffix != ".lock")


@pytest.mark.slow
@pytest.mark.parametrize("prefetch", [0, 2])
def test_the_cache_stays_within_its_bound(hub, pushed, template, tmp_path, monkeypatch, prefetch):
    sizes = shard_bytes(template)
    limit = 2 * max(sizes) + 1000
    largest = [0]
    fetch = ShardStore.fetch

    def watched(self, at, entry):
        path = fetch(self, at, entry)
        total = 0
        for file in self.folder.glob("*.h5"):
            with contextlib.suppress(FileNotFoundError):  # the thread that fetches ahead makes room meanwhile
                total += file.stat().st_size
        largest[0] = max(largest[0], total)
        return path

    monkeypatch.setattr(ShardStore, "fetch", watched)
    stream = StreamingSequenceDataset.from_hub(
        REPO, "1d", window=8, fields=["sequence", "step"], buffer_sequences=1, cache_bytes=limit, prefetch=prefetch
    )
    expected = windows(SequenceDataset(template, "1d", window=8, fields=["sequence", "step"]))
    for epoch in range(3):
        stream.set_epoch(epoch)
        assert windows(stream) == expected
    assert max(sizes) < largest[0] <= limit
    assert hub.count(SHARD, "GET") > 3  # something went and came again


@pytest.mark.slow
def test_a_cache_that_is_too_small_is_refused(hub, pushed, template):
    largest = max(shard_bytes(template))
    with pytest.raises(ConfigError, match=f"expected at least the largest shard of user/crowd@.*, {largest:,} bytes"):
        StreamingSequenceDataset.from_hub(REPO, "1d", window=8, cache_bytes=largest - 1)
    with pytest.raises(ConfigError, match=r"cache_bytes holds 1 shards, expected 3 for buffer_sequences=16"):
        StreamingSequenceDataset.from_hub(REPO, "1d", window=8, cache_bytes=largest)
    with pytest.raises(ConfigError, match="cache_bytes is 0, expected a whole number of at least 1"):
        StreamingSequenceDataset.from_hub(REPO, "1d", window=8, cache_bytes=0)


@pytest.mark.slow
def test_a_reservation_of_a_killed_process_is_taken_back(hub, pushed, template, tmp_path):
    sizes = shard_bytes(template)
    folder = tmp_path / "navrep-home" / "hub" / "shards"
    (folder / ("a" * 64 + ".part")).mkdir(parents=True)
    (folder / ("a" * 64 + ".part") / "begun").write_bytes(b"x" * 100)
    (folder / f"{'a' * 64}.{max(sizes)}.reserved").touch()
    stream = StreamingSequenceDataset.from_hub(
        REPO, "1d", window=8, buffer_sequences=1, cache_bytes=2 * max(sizes), prefetch=0
    )
    assert len(list(stream)) > 0
    assert list(folder.glob("a" * 64 + "*")) == []


@pytest.mark.slow
@pytest.mark.parametrize("start", ["fork", "spawn"])
def test_streaming_in_workers(hub, pushed, template, monkeypatch, start):
    options = {"window": 8, "fields": ["sequence", "step"], "buffer_sequences": 2}
    if start == "spawn":  # a new process asks the environment where the Hub is
        monkeypatch.setenv("HF_ENDPOINT", hub.url)
        monkeypatch.setenv("HF_HUB_DISABLE_XET", "1")
    stream = StreamingSequenceDataset.from_hub(REPO, "1d", **options)
    loader = DataLoader(stream, batch_size=None, num_workers=2, multiprocessing_context=start)
    assert windows(loader) == windows(SequenceDataset(template, "1d", window=8, fields=["sequence", "step"]))
    assert hub.count(SHARD, "GET") == 3


@pytest.mark.slow
def test_streaming_without_an_index_reads_every_shard_once(hub, pushed, template, monkeypatch):
    files = hub.repo(REPO).files()
    plain = Manifest.read(template)
    from navrep_data.io import json_bytes

    hub.repo(REPO).commit("main", {**files, "manifest.json": json_bytes(plain.to_dict())})
    stream = StreamingSequenceDataset.from_hub(REPO, "1d", window=8, split="val", fields=["sequence", "step"])
    assert hub.count(SHARD, "GET") == 3
    assert windows(stream) == windows(
        SequenceDataset(template, "1d", window=8, split="val", fields=["sequence", "step"])
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "words"),
    few(
        [
            (lambda s: s["start"].__setitem__(1, s["start"][1] + 1), "does not fit"),
            (lambda s: s["event"].__setitem__(0, 7), "unknown events"),
            (lambda s: s["start"].__setitem__(-1, 10**6), "first rows that do not go up"),
            (lambda s: s["episode"].pop(), "columns of different lengths"),
            (lambda s: s["sequence"].__setitem__(0, 1), "other sequences than the manifest"),
            (lambda s: s["start"].__setitem__(0, -1), "a list of whole numbers"),
        ],
        2,
    ),
)
def test_an_index_that_lies_is_found(hub, template, monkeypatch, change, words):
    import json

    from navrep_data.datasets import _hub_extras

    make = _hub_extras.index_bytes

    def lying(episodes, manifest):
        values = json.loads(make(episodes, manifest))
        change(values["shards"][0])
        return json.dumps(values).encode()

    monkeypatch.setattr(_hub_extras, "index_bytes", lying)
    push(template, REPO, license="mit")
    with pytest.raises(CorruptDataError, match=words):
        list(StreamingSequenceDataset.from_hub(REPO, "1d", window=8, prefetch=0))


@pytest.mark.slow
def test_a_shard_that_cannot_be_had_is_an_error_of_the_stream(hub, pushed):
    stream = StreamingSequenceDataset.from_hub(REPO, "1d", window=8)
    hub.faults = [Fault("status", SHARD, "GET", times=1000, status=503)]
    with pytest.raises(HubError, match=r"Gave up after 5 attempts .* the Hub answers 503"):
        list(stream)
    hub.faults = [Fault("flip", SHARD, "GET", times=1000)]
    with pytest.raises(CorruptDataError, match="does not have its SHA-256"):
        list(stream)
    hub.faults = []
    assert len(list(stream)) == stream.windows_per_epoch


@pytest.mark.slow
def test_a_stream_can_be_pickled(hub, pushed):
    stream = StreamingSequenceDataset.from_hub(REPO, "1d", window=8)
    a = next(iter(stream))
    b = next(iter(pickle.loads(pickle.dumps(stream))))  # noqa: S301
    assert all(np.array_equal(a[name], b[name], equal_nan=True) for name in a)
