"""The stream: every window once, in an order that depends on what it should and nothing else."""

from __future__ import annotations

import json
import os
import pickle
from collections import Counter

import numpy as np
import pytest
import torch
from dataset_files import identity, write_dataset
from torch.utils.data import DataLoader

from navrep_data.datasets import SequenceDataset, StreamingSequenceDataset
from navrep_data.errors import ConfigError

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:This DataLoader will create:UserWarning"),
]

SEQUENCES = [[9, 1, 3], [11], [2, 5, 4, 4], [1], [30], [7, 8], [12, 1, 1], [3, 3, 3]]
W = 4


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("datasets") / "plain"
    write_dataset(root, SEQUENCES, shard_size=3)
    return root


@pytest.fixture(scope="module")
def expected(root):
    dataset = SequenceDataset(root, None, window=W)
    return Counter(identity(dataset[i]) for i in range(len(dataset)))


def stream(root, **arguments):
    arguments = {"window": W, "buffer_sequences": 2, "rank": 0, "world_size": 1, **arguments}
    return StreamingSequenceDataset(root, None, **arguments)


def ids(batches):
    """Identities of single windows or of all windows in batches, in order."""
    found = []
    for batch in batches:
        states = batch["robot_state"]
        states = states[None] if states.ndim == 2 else states
        found += [identity({"robot_state": state}) for state in states]
    return found


def load(dataset, workers, batch_size=3, context="fork"):
    return DataLoader(
        dataset,
        batch_size=None if dataset.batch_size else batch_size,
        num_workers=workers,
        multiprocessing_context=context if workers else None,
    )


def test_windows_are_those_of_the_sequence_dataset(root):
    by_id = {}
    dataset = SequenceDataset(root, "rings", window=W, targets=True, action="leading", stride=3)
    for i in range(len(dataset)):
        by_id[identity(dataset[i])] = dataset[i]
    streamed = StreamingSequenceDataset(root, "rings", window=W, targets=True, action="leading", stride=3)
    count = 0
    for window in streamed:
        count += 1
        for name, value in by_id[identity(window)].items():
            assert torch.equal(value, window[name]), name
    assert count == len(dataset)


def test_across_episodes_and_split(root):
    for split in ("train", "val"):
        dataset = SequenceDataset(root, "1d", window=W, across_episodes=True, split=split)
        streamed = StreamingSequenceDataset(root, "1d", window=W, across_episodes=True, split=split)
        wanted = {identity(dataset[i]): dataset[i]["scan"].double().sum() for i in range(len(dataset))}
        got = {identity(w): w["scan"].double().sum() for w in streamed}
        assert got == wanted


@pytest.mark.parametrize(("world", "workers"), [(1, 0), (2, 0), (3, 0), (7, 0), (50, 0), (2, 2)])
def test_ranks_share_the_windows(root, expected, world, workers):
    parts = []
    for rank in range(world):
        dataset = stream(root, rank=rank, world_size=world)
        parts.append(Counter(ids(load(dataset, workers))))
        assert parts[-1].total() == dataset.windows_per_epoch
    assert sum(parts, Counter()) == expected
    assert max(p.total() for p in parts) - min(p.total() for p in parts) <= 1


@pytest.mark.parametrize("batch_size", [None, 5])
def test_workers_share_the_windows(root, expected, batch_size):
    for workers in (0, 2, 4):
        assert Counter(ids(load(stream(root, batch_size=batch_size), workers))) == expected


@pytest.mark.slow
def test_spawned_workers_share_the_windows(root, expected):
    assert Counter(ids(load(stream(root), 2, context="spawn"))) == expected


def test_batches_are_full_across_buffers(root, expected):
    dataset = stream(root, batch_size=5)
    sizes = [len(b["mask"]) for b in dataset]
    assert set(sizes[:-1]) == {5}
    assert sum(sizes) == expected.total()
    assert ids(dataset) == ids(stream(root))


def test_order_depends_on_seed_and_epoch_only(root):
    first = ids(stream(root))
    assert ids(stream(root)) == first
    assert ids(stream(root, seed=1)) != first
    dataset = stream(root)
    dataset.set_epoch(1)
    second = ids(dataset)
    assert second != first
    assert sorted(second) == sorted(first)
    dataset.set_epoch(0)
    assert ids(dataset) == first
    plain = ids(stream(root, shuffle=False))
    assert plain == sorted(plain) != first


def test_one_buffer_holds_few_sequences(root):
    """Windows of more than `buffer_sequences` sequences never alternate: that is the bound on memory."""
    order = [s for s, _ in ids(stream(root, buffer_sequences=2))]
    met = list(dict.fromkeys(order))
    for k in range(0, len(met), 2):
        pair = set(met[k : k + 2])
        places = [i for i, s in enumerate(order) if s in pair]
        assert places == list(range(places[0], places[-1] + 1))


def test_set_epoch_reaches_persistent_workers(root):
    dataset = stream(root)
    loader = DataLoader(dataset, batch_size=2, num_workers=2, persistent_workers=True, multiprocessing_context="fork")
    first = ids(loader)
    dataset.set_epoch(1)
    second = ids(loader)
    dataset.set_epoch(0)
    assert second != first == ids(loader)


@pytest.mark.parametrize("batch_size", [None, 4])
def test_resume_in_one_process(root, batch_size):
    dataset = stream(root, batch_size=batch_size)
    dataset.set_epoch(3)
    whole = [ids([b]) for b in dataset]
    for stop in sorted({0, 1, *range(2, len(whole), 7), len(whole) - 1, len(whole)}):
        dataset = stream(root, batch_size=batch_size)
        dataset.set_epoch(3)
        iterator = iter(dataset)
        for _ in range(stop):
            next(iterator)
        state = json.loads(json.dumps(dataset.state_dict()))
        fresh = pickle.loads(pickle.dumps(stream(root, batch_size=batch_size)))  # noqa: S301
        fresh.load_state_dict(state)
        if stop < len(whole):
            assert fresh.state_dict() == state
        assert [ids([b]) for b in fresh] == whole[stop:]
        fresh.set_epoch(4)
        dataset.set_epoch(4)
        assert ids(fresh) == ids(dataset)


@pytest.mark.parametrize("own", [False, True])
def test_resume_with_workers(root, expected, own):
    """After n batches of a plain DataLoader, the state says what is left; also when taken after a resume."""
    workers, size = 3, 2

    def fresh():
        return stream(root, batch_size=size if own else None)

    whole = [ids([b]) for b in load(fresh(), workers, size)]
    for stop in (0, 1, 4, 5, len(whole) - 1):
        state = fresh().state_dict(stop, num_workers=workers, batch_size=size)
        resumed = fresh()
        resumed.load_state_dict(json.loads(json.dumps(state)))
        rest = [ids([b]) for b in load(resumed, workers, size)]
        assert rest == whole[stop:]
        if len(rest) > 2:
            again = fresh()
            again.load_state_dict(resumed.state_dict(2, num_workers=workers, batch_size=size))
            assert [ids([b]) for b in load(again, workers, size)] == whole[stop + 2 :]
    assert Counter(w for b in whole for w in b) == expected


def test_state_inside_a_worker(root, monkeypatch):
    """What torchdata's StatefulDataLoader does: ask and tell each worker's copy."""
    from navrep_data.datasets import streaming

    class Info:
        num_workers = 2

    for worker in (0, 1):
        info = Info()
        info.id = worker
        monkeypatch.setattr(streaming, "get_worker_info", lambda info=info: info)
        dataset = stream(root)
        whole = ids(dataset)
        iterator = iter(dataset)
        for _ in range(3):
            next(iterator)
        copy = stream(root)
        copy.load_state_dict(dataset.state_dict())
        assert ids(copy) == whole[3:]


def test_a_state_of_something_else_is_refused(root):
    state = stream(root).state_dict(2, num_workers=2, batch_size=3)
    for arguments, name in [
        ({"seed": 5}, "seed"),
        ({"rank": 1, "world_size": 2}, "rank"),
        ({"window": 5}, "windows"),
        ({"buffer_sequences": 3}, "buffer_sequences"),
        ({"shuffle": False}, "shuffle"),
    ]:
        with pytest.raises(ConfigError, match=f"has {name} "):
            stream(root, **arguments).load_state_dict(state)
    dataset = stream(root)
    dataset.load_state_dict(state)
    with pytest.raises(ConfigError, match=r"2 consumers .* this loader has 1"):
        next(iter(dataset))
    with pytest.raises(ConfigError, match="expected one per worker"):
        dataset.load_state_dict({**state, "positions": [1]})
    with pytest.raises(ConfigError, match="batches is given without batch_size, expected both"):
        dataset.state_dict(3, num_workers=2)


def test_rank_comes_from_the_environment_or_torch(root, monkeypatch):
    monkeypatch.setenv("RANK", "2")
    monkeypatch.setenv("WORLD_SIZE", "4")
    dataset = stream(root, rank=None, world_size=None)
    assert (dataset.rank, dataset.world_size) == (2, 4)
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.distributed, "get_rank", lambda: 1)
    monkeypatch.setattr(torch.distributed, "get_world_size", lambda: 3)
    dataset = stream(root, rank=None, world_size=None)
    assert (dataset.rank, dataset.world_size) == (1, 3)
    with pytest.raises(ConfigError, match="expected both or neither"):
        stream(root, rank=None)
    with pytest.raises(ConfigError, match="rank is 2, expected a whole number from 0 to 1"):
        stream(root, rank=2, world_size=2)
    monkeypatch.undo()
    monkeypatch.setenv("RANK", "first")
    with pytest.raises(ConfigError, match="RANK is 'first'"):
        stream(root, rank=None, world_size=None)


@pytest.mark.skipif(not os.path.exists("/proc/self/fd"), reason="needs /proc")
def test_nothing_stays_open(root):
    before = len(os.listdir("/proc/self/fd"))
    dataset = stream(root)
    np.testing.assert_array_equal(len(ids(dataset)), dataset.windows_per_epoch)
    shared = 1  # the epoch's shared memory
    dataset.close()
    assert len(os.listdir("/proc/self/fd")) - before <= shared
    del dataset
    assert len(os.listdir("/proc/self/fd")) == before


@pytest.mark.parametrize("kind", [np.int64, np.array, torch.tensor])
def test_whole_numbers_of_any_kind(root, kind):
    plain = stream(root, seed=3, rank=1, world_size=2)
    other = stream(root, seed=kind(3), rank=kind(1), world_size=kind(2))
    other.set_epoch(kind(0))
    assert ids(other) == ids(plain)
    state = other.state_dict(kind(1), num_workers=kind(2), batch_size=kind(3))
    assert json.loads(json.dumps(state)) == plain.state_dict(1, num_workers=2, batch_size=3)


@pytest.mark.parametrize("settings", [{"seed": 1.5}, {"seed": -1}, {"rank": 0, "world_size": True}])
def test_what_is_no_whole_number_is_refused(root, settings):
    with pytest.raises(ConfigError, match=r"(seed|world_size) is .*, expected a whole number of at least"):
        stream(root, **settings)
