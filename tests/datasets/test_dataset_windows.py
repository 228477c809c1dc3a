"""Windows and frames against the rows they were written from."""

from __future__ import annotations

import os
import pickle
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch
from dataset_files import identity, make_sequence, slow_windows, write_dataset
from torch.utils.data import BatchSampler, DataLoader, RandomSampler

from navrep_data.datasets import ScanDataset, SequenceDataset
from navrep_data.errors import ConfigError, DatasetNotFoundError, UnknownNameError, whole_number
from navrep_data.observations import fill_blind, rings_to_float, scan_to_rings

# The tests ask for four workers wherever they run.
pytestmark = pytest.mark.filterwarnings("ignore:This DataLoader will create:UserWarning")

SEQUENCES = [[40, 1, 33, 32, 14], [120], [5, 64, 51], [31, 89], [1, 1, 118]]
W = 32


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    root = tmp_path_factory.mktemp("datasets") / "plain"
    return root, write_dataset(root, SEQUENCES)


def rows_of(contents, sequence, column, first, count):
    return contents[sequence][column][first : first + count]


@pytest.mark.slow
@pytest.mark.parametrize("window", [1, 7, 32, 200])
@pytest.mark.parametrize("stride", [None, 1, 5, 64])
def test_the_index_is_the_oracles(made, window, stride):
    root, contents = made
    dataset = SequenceDataset(root, None, window=window, stride=stride, fields=("robot_state",))
    expected = slow_windows(contents, window, stride or window)
    found = []
    for i in range(len(dataset)):
        info = dataset.info(i)
        found.append((info["sequence"], int(contents_row(contents, info)), info["rows"]))
    assert found == expected


def contents_row(contents, info):
    """Row in its sequence of a window's first row, from episode and step alone."""
    columns = contents[info["sequence"]]
    return np.flatnonzero((columns["episode"] == info["episode"]) & (columns["step"] == info["step"]))[0]


@pytest.mark.slow
@pytest.mark.parametrize("preload", [False, True])
@pytest.mark.parametrize("lidar", ["rings", "1d"])
def test_default_fields_hold_the_rows_and_zeros_past_the_episode(made, lidar, preload):
    root, contents = made
    dataset = SequenceDataset(root, lidar, preload=preload)
    assert len(dataset) == len(slow_windows(contents, W, W))
    for i, (sequence, first, count) in enumerate(slow_windows(contents, W, W)):
        window = dataset[i]
        name = "rings" if lidar == "rings" else "scan"
        assert set(window) == {
            name, "robot_state", "action", "action_valid", "reward",
            "is_first", "is_last", "is_terminal", "mask",
        }  # fmt: skip
        assert all(len(value) == W for value in window.values())
        expected = {k: rows_of(contents, sequence, k, first, count) for k in ("robot_state", "action", "reward")}
        expected |= {k: rows_of(contents, sequence, k, first, count) for k in ("is_first", "is_last", "is_terminal")}
        expected["action_valid"] = ~expected["is_last"]
        expected["mask"] = np.ones(count, bool)
        scan = rows_of(contents, sequence, "scan", first, count)
        expected[name] = (
            rings_to_float(scan_to_rings(scan)) if lidar == "rings" else scan.astype(np.float32) / np.float32(1000)
        )
        for field, rows in expected.items():
            value = window[field].numpy()
            assert value.dtype == rows.dtype, field
            np.testing.assert_array_equal(value[:count], rows, err_msg=field)
            assert not value[count:].any(), field
        assert not torch.isnan(window[name]).any()


@pytest.mark.slow
def test_rings_are_computed_where_the_dataset_has_none(made, tmp_path):
    root, _ = made
    write_dataset(
        tmp_path / "d", SEQUENCES, without=("rings", "leading_action", "leading_reward", "source_robot_state")
    )
    for preload in (False, True):
        computed = SequenceDataset(tmp_path / "d", "rings", targets=True, preload=preload)
        stored = SequenceDataset(root, "rings", targets=True)
        index = list(range(len(stored)))
        a, b = computed.batch(index), stored.batch(index)
        assert set(np.unique(b["rings"])) == {0.0, 0.5, 1.0}
        assert torch.equal(a["rings"], b["rings"])
        assert torch.equal(a["next_rings"], b["next_rings"])


@pytest.mark.slow
@pytest.mark.parametrize("scan_dtype", ["uint16", "float32"])
def test_scan_units_and_invalid_rays(tmp_path, scan_dtype):
    contents = write_dataset(tmp_path / "d", [[10]], scan_dtype=scan_dtype)
    stored = contents[0]["scan"]
    metres = stored.astype(np.float32) / np.float32(1000) if scan_dtype == "uint16" else stored
    assert (metres == 0).any()
    cases = {
        ("metres", "zero"): metres,
        ("metres", "range_max"): np.where(metres == 0, np.float32(25), metres),
        ("normalized", "zero"): metres / np.float32(25),
        ("normalized", "range_max"): np.where(metres == 0, np.float32(1), metres / np.float32(25)),
        ("metres", "near"): fill_blind(metres),
        ("normalized", "near"): fill_blind(metres) / np.float32(25),
    }
    for (unit, invalid), expected in cases.items():
        got = SequenceDataset(tmp_path / "d", "1d", window=12, scan_unit=unit, invalid=invalid)[0]["scan"]
        np.testing.assert_array_equal(got[:10], expected)
        assert not got[10:].any()


@pytest.mark.slow
@pytest.mark.parametrize("preload", [False, True])
@pytest.mark.parametrize("stride", [32, 3])
def test_targets_are_the_next_row_of_the_same_episode(made, stride, preload):
    root, contents = made
    fields = ("robot_state", "humans", "robot_pose", "reward")
    dataset = SequenceDataset(root, "1d", stride=stride, targets=True, fields=fields, preload=preload)
    for i, (sequence, first, count) in enumerate(slow_windows(contents, W, stride)):
        window = dataset[i]
        assert {k for k in window if k.startswith("next_")} == {
            "next_scan", "next_robot_state", "next_humans", "next_robot_pose", "next_mask",
        }  # fmt: skip
        columns = contents[sequence]
        for t in range(W):
            row = first + t
            has = (
                t < count and row + 1 < len(columns["step"]) and columns["episode"][row + 1] == columns["episode"][row]
            )
            assert bool(window["next_mask"][t]) == has
            state = columns["robot_state"][row + 1] if has else np.zeros(5)
            np.testing.assert_array_equal(window["next_robot_state"][t], state)
            scan = columns["scan"][row + 1].astype(np.float32) / np.float32(1000) if has else np.zeros(1080)
            np.testing.assert_array_equal(window["next_scan"][t], scan)
            if has and t + 1 < W:
                assert torch.equal(window["next_scan"][t], window["scan"][t + 1])


def test_an_episodes_last_row_has_no_target(made):
    root, _ = made
    batch = SequenceDataset(root, None, targets=True).batch([0, 1, 2])
    # Episode 0 has 40 rows: a whole window that goes on, then 8 rows; episode 1 has a single row.
    assert batch["next_mask"].sum(1).tolist() == [32, 7, 0]


@pytest.mark.slow
@pytest.mark.parametrize("preload", [False, True])
@pytest.mark.parametrize("stride", [32, 5])
def test_leading_is_taken_one_row_later(made, stride, preload):
    root, contents = made
    dataset = SequenceDataset(root, None, stride=stride, action="leading", preload=preload)
    for i, (sequence, first, count) in enumerate(slow_windows(contents, W, stride)):
        window, columns = dataset[i], contents[sequence]
        for t in range(W):
            row = first + t
            known = t < count and columns["step"][row] > 0
            np.testing.assert_array_equal(window["action"][t], columns["action"][row - 1] if known else np.zeros(3))
            assert bool(window["action_valid"][t]) == known


def test_leading_of_an_import_is_the_stored_one(tmp_path):
    contents = write_dataset(tmp_path / "d", [[10, 20]], without=())
    columns = contents[0]
    batch = SequenceDataset(tmp_path / "d", None, window=30, across_episodes=False, action="leading").batch([0, 1])
    leading = columns["leading_action"].astype(np.float32)
    np.testing.assert_array_equal(batch["action"][0, :10], leading[:10])
    np.testing.assert_array_equal(batch["action"][1, :20], leading[10:])
    assert batch["action_valid"].sum(1).tolist() == [10, 20]


@pytest.mark.slow
@pytest.mark.parametrize("preload", [False, True])
@pytest.mark.parametrize("action", ["taken", "leading"])
def test_across_episodes_is_the_papers_rule(made, action, preload):
    root, contents = made
    dataset = SequenceDataset(root, "1d", across_episodes=True, targets=True, action=action, preload=preload)
    expected = [(s, 1 + 32 * k) for s, c in enumerate(contents) for k in range(4) if 1 + 32 * k + 33 <= len(c["step"])]
    assert len(dataset) == len(expected) == 3 * len(contents)
    blanked = 0
    for i, (sequence, first) in enumerate(expected):
        window, columns = dataset[i], contents[sequence]
        info = dataset.info(i)
        assert (info["sequence"], info["step"], info["episode"]) == (
            sequence,
            first,
            columns["episode"][first],
        )
        here, after = slice(first, first + W), slice(first + 1, first + W + 1)
        last = columns["is_last"][here]
        blanked += last.sum()
        scan = columns["scan"].astype(np.float32) / np.float32(1000)
        np.testing.assert_array_equal(window["scan"], np.where(last[:, None], 0, scan[here]))
        np.testing.assert_array_equal(window["next_scan"], np.where(last[:, None], 0, scan[after]))
        np.testing.assert_array_equal(window["robot_state"], columns["robot_state"][here])
        np.testing.assert_array_equal(window["next_robot_state"], columns["robot_state"][after])
        assert window["mask"].all()
        assert window["next_mask"].all()
        if action == "taken":
            np.testing.assert_array_equal(window["action"], columns["action"][here])
        else:
            led = np.where(columns["is_first"][here, None], 0, columns["action"][first - 1 : first + W - 1])
            np.testing.assert_array_equal(window["action"], led)
    assert blanked > 3


def test_across_episodes_needs_long_enough_sequences(tmp_path):
    write_dataset(tmp_path / "d", [[33], [30]])
    with pytest.raises(ConfigError, match=r"No window of 32 \+ 1 rows fits into the longest sequence, 33 rows"):
        SequenceDataset(tmp_path / "d", None, across_episodes=True)
    write_dataset(tmp_path / "e", [[34], [30]])
    assert len(SequenceDataset(tmp_path / "e", None, across_episodes=True)) == 1


def test_no_default_window_crosses_an_episode(made):
    root, _ = made
    for stride in (32, 7):
        batch = SequenceDataset(root, None, stride=stride, fields=("sequence", "episode", "step", "is_last"))
        for window in DataLoader(batch, batch_size=None):
            real = window["mask"]
            assert (
                len({(int(s), int(e)) for s, e in zip(window["sequence"][real], window["episode"][real], strict=True)})
                == 1
            )
            assert (window["step"][real].diff() == 1).all()
            assert not window["is_last"][real][:-1].any()


@pytest.mark.slow
def test_every_row_comes_once_and_splits_are_disjoint(made):
    root, contents = made
    seen = {}
    for split in ("train", "val", "test", None):
        batch = SequenceDataset(root, None, split=split)
        seen[split] = Counter()
        for i in range(len(batch)):
            window = batch[i]
            seen[split].update((int(s[2]), int(s[3])) for s in window["robot_state"][window["mask"]])
    assert seen["train"] + seen["val"] + seen["test"] == seen[None]
    assert set(seen[None].values()) == {1}
    assert len(seen[None]) == sum(len(c["step"]) for c in contents)
    assert {s for s, _ in seen["val"]} == {1}
    assert {s for s, _ in seen["test"]} == {2}


@pytest.mark.parametrize("preload", [False, True])
def test_unknown_goals_become_zero_and_invalid(tmp_path, preload):
    contents = write_dataset(tmp_path / "d", [[50]], without=("humans",), nan_goals=True)
    for window in SequenceDataset(tmp_path / "d", "1d", targets=True, preload=preload):
        for name, value in window.items():
            assert not torch.isnan(value).any(), name
    assert np.isnan(contents[0]["robot_state"]).any()
    window = SequenceDataset(tmp_path / "d", None, window=50, targets=True, preload=preload)[0]
    unknown = np.isnan(contents[0]["robot_state"][:, 0])
    goal_valid = window["goal_valid"].numpy()
    np.testing.assert_array_equal(goal_valid, ~unknown)
    np.testing.assert_array_equal(window["next_goal_valid"][:-1], ~unknown[1:])
    assert not window["robot_state"][unknown, :2].any()
    np.testing.assert_array_equal(window["robot_state"][:, 2:], contents[0]["robot_state"][:, 2:])


def test_fields_on_request(made):
    root, contents = made
    names = ("humans", "robot_pose", "event", "sequence", "episode", "step", "robot_radius", "scan")
    window = SequenceDataset(root, "rings", fields=names)[1]
    assert set(window) == {*names, "rings", "mask"}
    for name in names[1:-1]:
        np.testing.assert_array_equal(window[name][:8], contents[0][name][32:40])
        assert not window[name][8:].any()
    np.testing.assert_array_equal(window["humans"][:8], contents[0]["humans"][32:40])
    assert torch.isnan(window["humans"][8:]).all()


def test_single_frames(made):
    root, contents = made
    for preload in (False, True):
        frames = ScanDataset(root, "1d", preload=preload, fields=("robot_state",), split="train")
        kept = [k for k in range(len(contents)) if k not in (1, 2)]
        states = np.concatenate([contents[k]["robot_state"] for k in kept])
        scans = np.concatenate([contents[k]["scan"] for k in kept]).astype(np.float32) / np.float32(1000)
        assert len(frames) == len(states)
        order = np.random.default_rng(0).permutation(len(frames))
        batch = frames.batch(order)
        assert set(batch) == {"scan", "robot_state"}
        np.testing.assert_array_equal(batch["robot_state"], states[order])
        np.testing.assert_array_equal(batch["scan"], scans[order])
    rings = ScanDataset(root)
    assert {name: value.shape for name, value in rings[5].items()} == {"rings": (64, 64)}


def loader_multiset(dataset, workers, context=None):
    loader = DataLoader(dataset, batch_size=4, shuffle=True, num_workers=workers, multiprocessing_context=context)
    found = Counter()
    for batch in loader:
        for i in range(len(batch["mask"])):
            found[(*identity({"robot_state": batch["robot_state"][i]}), float(batch["scan"][i].double().sum()))] += 1
    return found


@pytest.mark.slow
@pytest.mark.parametrize("preload", [False, True])
def test_workers_yield_the_same_multiset(made, preload):
    root, contents = made
    dataset = SequenceDataset(root, "1d", preload=preload)
    dataset[0]  # an open file before the fork
    expected = loader_multiset(dataset, 0)
    assert set(expected.values()) == {1}
    assert {key[:2] for key in expected} == {(s, first) for s, first, _ in slow_windows(contents, W, W)}
    for workers in (2, 4):
        assert loader_multiset(dataset, workers, "fork") == expected


@pytest.mark.slow
@pytest.mark.parametrize("preload", [False, True])
def test_spawned_workers_yield_the_same_multiset(made, preload):
    dataset = SequenceDataset(made[0], "1d", preload=preload)
    dataset[0]
    expected = loader_multiset(dataset, 0)
    assert loader_multiset(dataset, 2, "spawn") == expected


def test_batches_three_ways_are_equal(made):
    dataset = SequenceDataset(made[0], "rings", targets=True)
    index = [3, 0, 7, 3, -1]
    batch = dataset.batch(index)
    listed = dataset[index]
    fetched = dataset.__getitems__(index)
    for name, value in batch.items():
        assert torch.equal(value, listed[name])
        assert torch.equal(value, torch.stack([dataset[i][name] for i in index]))
        assert torch.equal(value, torch.stack([item[name] for item in fetched]))
    sampler = BatchSampler(RandomSampler(dataset), 4, False)
    assert sum(len(b["mask"]) for b in DataLoader(dataset, sampler=sampler, batch_size=None)) == len(dataset)


@pytest.mark.slow
@pytest.mark.parametrize("preload", [False, True])
def test_batches_that_are_kept_do_not_change(made, preload):
    """The memory of a batch is used again, but never while somebody holds the batch or a part of it."""
    dataset = SequenceDataset(made[0], "1d", preload=preload)
    rng = np.random.default_rng(3)
    kept = []
    for k in range(40):
        index = rng.integers(0, len(dataset), 8)
        batch = dataset.batch(index)
        part = batch["scan"][2:3].view(-1) if k % 2 else batch["scan"].numpy()[4]
        kept.append((part, np.array(part.tolist())))
        del batch
        if k % 5 == 4:
            del kept[:3]
    for part, copy in kept:
        np.testing.assert_array_equal(part.tolist(), copy)


def test_pickle(made):
    dataset = SequenceDataset(made[0], "1d", preload=True)
    data = pickle.dumps(dataset)
    assert len(data) < 200_000  # the index, not the rows
    copy = pickle.loads(data)  # noqa: S301 -- made a line above
    for i in (0, 3, len(dataset) - 1):
        assert all(torch.equal(value, copy[i][name]) for name, value in dataset[i].items())


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="needs /proc")
def test_few_files_stay_open(tmp_path):
    write_dataset(tmp_path / "d", [[3]] * 30, shard_size=1)
    before = len(os.listdir("/proc/self/fd"))
    dataset = SequenceDataset(tmp_path / "d", "1d")
    dataset._folder._max_open = 8
    dataset.close()  # what the index opened
    for i in range(len(dataset)):
        dataset[i]
    assert 1 <= len(os.listdir("/proc/self/fd")) - before <= 8
    dataset.close()
    assert len(os.listdir("/proc/self/fd")) == before
    dataset[0]
    del dataset
    assert len(os.listdir("/proc/self/fd")) == before


def test_bad_arguments(made, tmp_path):
    root, _ = made
    with pytest.raises(DatasetNotFoundError, match="No dataset in"):
        SequenceDataset(tmp_path / "nothing")
    cases = [
        ({"lidar": "2d"}, ConfigError, "lidar is '2d', expected 'rings', '1d' or None"),
        ({"window": 0}, ConfigError, "window is 0, expected a whole number of at least 1"),
        ({"window": 3.5}, ConfigError, "window is 3.5"),
        ({"stride": -1}, ConfigError, "stride is -1"),
        ({"split": "training"}, ConfigError, "split 'training'.*train, val, test"),
        ({"action": "next"}, ConfigError, "action is 'next', expected 'taken' or 'leading'"),
        ({"scan_unit": "mm"}, ConfigError, "scan_unit is 'mm'"),
        ({"invalid": "nan"}, ConfigError, "invalid is 'nan'"),
        ({"fields": "humans"}, ConfigError, "expected a list of names"),
        ({"fields": ["human"]}, UnknownNameError, "Unknown field 'human'. Did you mean 'humans'?"),
        ({"fields": ["leading_reward"]}, ConfigError, "no column 'leading_reward'"),
    ]
    for arguments, error, words in cases:
        with pytest.raises(error, match=words):
            SequenceDataset(root, **arguments)
    dataset = SequenceDataset(root, None)
    for index in ([], [[0]], [0.5], [len(dataset)], [-len(dataset) - 1]):
        with pytest.raises(IndexError, match=r"expected a non-empty 1-D list of int|out of range"):
            dataset.batch(index)
    with pytest.raises(IndexError, match="out of range"):
        dataset[len(dataset)]
    write_dataset(tmp_path / "one", [[9]])
    with pytest.raises(ConfigError, match="nothing in split 'val'"):
        SequenceDataset(tmp_path / "one", split="val")


def test_the_maker_is_not_constant():
    a, b = (make_sequence(k, [20], ("scan", "action")) for k in (0, 1))
    assert (a["scan"] != b["scan"]).mean() > 0.9


NUMBERS = [3, np.int64(3), np.uint8(3), np.array(3), torch.tensor(3), torch.tensor(3, dtype=torch.uint8)]
NO_NUMBERS = [3.0, True, np.True_, np.float32(3), torch.tensor(3.0), torch.tensor(True), "3", None]


@pytest.mark.slow
@pytest.mark.parametrize("number", NUMBERS, ids=repr)
def test_whatever_is_a_whole_number_is_an_index(made, number):
    """Samplers and ``torch.randint`` hand out tensors without axes, numpy its own integers."""
    dataset = SequenceDataset(made[0], lidar="1d", window=8)
    expected = dataset[3]
    for name, value in dataset[number].items():
        torch.testing.assert_close(value, expected[name], rtol=0, atol=0)
    assert dataset.info(number) == dataset.info(3)
    assert len(dataset[[number, number]]["scan"]) == 2
    assert whole_number(number) == 3


@pytest.mark.slow
@pytest.mark.parametrize("number", NO_NUMBERS, ids=repr)
def test_what_is_none_is_refused(made, number):
    dataset = SequenceDataset(made[0], lidar="1d", window=8)
    for ask in (lambda: dataset[number], lambda: dataset[[number]], lambda: dataset.info(number)):
        with pytest.raises(IndexError, match=r"expected a non-empty 1-D list of int|is out of range"):
            ask()
    assert whole_number(number) is None
