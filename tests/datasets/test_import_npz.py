"""Files of the original software: what they become, that nothing is lost, what is refused."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from recorded import write_original_npz

from navrep_data.datasets import SequenceDataset, import_npz
from navrep_data.datasets.npz import FILE_SUFFIX, MAX_ROWS
from navrep_data.errors import (
    ConfigError,
    CorruptDataError,
    DatasetError,
    DatasetNotFoundError,
    FolderInUseError,
)
from navrep_data.schema import Event
from navrep_data.shards import DatasetFolder, verify


def sequence(n=60, ends=(9, 29, 30, 45), unplayed=(30, 50), goals=(9,), crashes=(45,), seed=0):
    """What the original would write: `unplayed` rows are frames of episodes that were never played."""
    rng = np.random.default_rng(seed)
    dones, rewards, actions = np.zeros(n, bool), rng.normal(size=n) * 0.1, rng.normal(size=(n, 3))
    dones[[*ends, *unplayed, n - 1]] = True
    rewards[[*ends, *unplayed]] = 0
    rewards[list(goals)], rewards[list(crashes)] = 100.0, -25.0
    actions[list(unplayed)] = 0
    return {
        "scans": rng.uniform(0.3, 25, (n, 1080)).astype(np.float32),
        "robotstates": rng.normal(size=(n, 5)),
        "actions": actions,
        "rewards": rewards,
        "dones": dones,
    }


def write(folder, *arrays):
    folder.mkdir(exist_ok=True)
    for k, values in enumerate(arrays):
        np.savez_compressed(folder / f"{k:03}_{FILE_SUFFIX}", **values)
    return folder


def columns_of(root, index):
    """All columns of one sequence through plain h5py."""
    manifest = json.loads((root / "manifest.json").read_text())
    for shard in manifest["shards"]:
        with h5py.File(root / shard["file"]) as file:
            mine = file["sequence"][:] == index
            if mine.any():
                return {name: file[name][:][mine] for name in file}
    raise AssertionError(index)


def exported(columns):
    """The original's arrays from a dataset's columns, by the documented rules."""
    return {
        "scans": columns["scan"],
        "robotstates": columns["source_robot_state"],
        "actions": columns["leading_action"],
        "rewards": columns["leading_reward"],
        "dones": columns["is_last"] & (columns["event"] != Event.STUCK),
    }


def check_round_trip(source, columns):
    again = exported(columns)
    for name, values in source.items():
        np.testing.assert_array_equal(again[name], values, err_msg=name, strict=True)


def slow_alignment(source):
    """Actions and rewards of each row, looked up row by row; None where a row's episode ends."""
    n = len(source["dones"])
    zero = [not source["actions"][i].any() and source["rewards"][i] == 0 and source["dones"][i] for i in range(n)]
    for i in range(n):
        if source["dones"][i] or i == n - 1 or zero[i + 1]:
            yield None
        else:
            yield source["actions"][i + 1].astype(np.float32), np.float32(source["rewards"][i + 1])


def check_alignment(source, columns):
    for i, led in enumerate(slow_alignment(source)):
        assert columns["is_last"][i] == (led is None), i
        np.testing.assert_array_equal(columns["action"][i], np.zeros(3) if led is None else led[0])
        assert columns["reward"][i] == (0 if led is None else led[1])


def test_a_small_file(tmp_path):
    source = sequence()
    manifest = import_npz(write(tmp_path / "in", source), tmp_path / "out")
    columns = columns_of(tmp_path / "out", 0)
    check_round_trip(source, columns)
    check_alignment(source, columns)
    last = np.flatnonzero(columns["is_last"])
    events = [Event(e).label for e in columns["event"][last]]
    assert list(zip(last.tolist(), events, strict=True)) == [
        (9, "goal"), (29, "cut"), (30, "cut"), (45, "collision_obstacle"),
        (49, "stuck"), (50, "cut"), (59, "cut"),
    ]  # fmt: skip
    assert manifest.rows == 60
    assert manifest.scan_dtype == "float32"
    assert verify(tmp_path / "out").ok
    assert np.isnan(columns["robot_pose"]).all()


def test_rays_that_saw_nothing_in_any_file_are_declared(tmp_path):
    sources = [sequence(), sequence(seed=3)]
    sources[0]["scans"][:, 400:700] = np.nan
    sources[1]["scans"][:, 500:800] = np.nan
    said = []
    manifest = import_npz(write(tmp_path / "in", *sources), tmp_path / "out", report=said.append)
    assert manifest.config["blind_rays"] == [[500, 699]]
    assert len(said) == 1
    assert said[0].startswith("200 of 1080 rays are blind in every scan (167 to 233 deg)")
    assert "blind_rays" not in import_npz(write(tmp_path / "other", sequence()), tmp_path / "seen").config


@pytest.mark.slow
def test_timeouts(tmp_path):
    source = sequence(400, ends=(175, 351, 399), unplayed=(), goals=(351,), crashes=())
    import_npz(write(tmp_path / "in", source), tmp_path / "out")
    columns = columns_of(tmp_path / "out", 0)
    assert columns["event"][[175, 351, 399]].tolist() == [Event.TIMEOUT, Event.GOAL, Event.CUT]


def test_several_files_of_different_length_without_rings(tmp_path):
    sources = [
        sequence(60, seed=1),
        sequence(51, unplayed=(30,), seed=2),
        sequence(1, (), (), (), (), seed=3),
    ]
    seen = []
    manifest = import_npz(
        write(tmp_path / "in", *sources),
        tmp_path / "out",
        rings=False,
        env="irl",
        progress=lambda *a: seen.append(a),
    )
    assert (manifest.env, manifest.length, manifest.sequences) == ("irl", 60, 3)
    assert seen == [(1, 3), (2, 3), (3, 3)]
    assert "rings" not in manifest.columns
    for k, source in enumerate(sources):
        check_round_trip(source, columns_of(tmp_path / "out", k))
        check_alignment(source, columns_of(tmp_path / "out", k))


def test_windows_of_an_import_hold_no_nan(tmp_path):
    source = sequence()
    source["robotstates"][::4, :2] = np.nan
    source["scans"][3, 5:9] = [np.nan, -1.0, np.inf, 0.0]
    import_npz(write(tmp_path / "in", source), tmp_path / "out")
    assert verify(tmp_path / "out").ok
    dataset = SequenceDataset(tmp_path / "out", "1d", targets=True, action="leading")
    for window in dataset:
        assert all(not torch.isnan(value).any() for value in window.values())
    assert dataset[0]["scan"][3, 5:9].tolist() == [0, 0, 25, 0]
    assert dataset[0]["goal_valid"][:10].tolist() == [i % 4 != 0 for i in range(10)]
    # An action led to the first stored row of an episode, but to no frame of an episode that was never
    # played.
    assert dataset[0]["action_valid"][:10].all()
    odd = next(w for i, w in enumerate(dataset) if dataset.info(i)["rows"] == 1)
    assert not odd["action_valid"].any()


@pytest.mark.slow
def test_the_original_files(tmp_path):
    original = write_original_npz(tmp_path / "original")
    files = sorted(original.glob("*.npz"))
    assert len(files) == 2
    import_npz(original, tmp_path / "out")
    folder = DatasetFolder(tmp_path / "out")
    assert folder.manifest.rows == 2000
    stuck = 0
    for k, path in enumerate(files):
        with np.load(path, allow_pickle=False) as archive:
            source = dict(archive)
        columns = columns_of(tmp_path / "out", k)
        check_round_trip(source, columns)
        check_alignment(source, columns)
        # In the original, a row's velocity is the action that led to it, rotated by its small turn.
        led = columns["action"][:-1][~columns["is_last"][:-1]]
        went = columns["robot_state"][1:, 2:4][~columns["is_last"][:-1]]
        assert np.abs(led[:, :2] - went).max() < 0.011
        stuck += (columns["event"] == Event.STUCK).sum()
        # A goal jumps only between episodes: so these are cut where the robot's task changes.
        jump = np.linalg.norm(np.diff(columns["robot_state"][:, :2], axis=0), axis=1) > 0.5
        np.testing.assert_array_equal(jump, columns["is_last"][:-1])
    assert stuck == 15
    outcomes = {Event(e).label: int((folder.episodes.event == e).sum()) for e in Event if e}
    assert outcomes["goal"] == 3
    assert outcomes["timeout"] == 1
    report = verify(tmp_path / "out")
    assert report.ok, report


def test_nothing_is_overwritten_and_failures_leave_nothing(tmp_path):
    source = write(tmp_path / "in", sequence())
    out = tmp_path / "out"
    out.mkdir()
    (out / "thesis.tex").write_text("mine")
    with pytest.raises(FolderInUseError, match="is in use, expected a new or empty folder"):
        import_npz(source, out)
    assert [p.name for p in out.iterdir()] == ["thesis.tex"]
    (out / "thesis.tex").unlink()
    bad = sequence(seed=4)
    bad["rewards"][3] = np.nan
    write(tmp_path / "in", sequence(), bad)
    with pytest.raises(CorruptDataError, match="array 'rewards' holds NaN"):
        import_npz(source, out)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in", "out"]
    assert not list(out.iterdir())
    (tmp_path / "out.part").mkdir()
    with pytest.raises(FolderInUseError, match=r"out.part exists, left by an import"):
        import_npz(source, out)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.int64, np.uint8])
def test_files_of_the_originals_tool_for_bags(tmp_path, dtype):
    """float64 scans, whole numbers as dones, goals unknown; inf hit nothing, NaN saw nothing. As a folder in a list."""
    source = sequence()
    plain = import_npz(write(tmp_path / "plain", source), tmp_path / "a")
    wide = {**source, "scans": source["scans"].astype(np.float64), "dones": source["dones"].astype(dtype)}
    folder = write(tmp_path / "wide", wide)
    assert import_npz([folder], tmp_path / "b").rows == plain.rows
    for name, values in columns_of(tmp_path / "a", 0).items():
        np.testing.assert_array_equal(columns_of(tmp_path / "b", 0)[name], values, err_msg=name)
    wide["scans"][3, :20], wide["scans"][3, 20:40], wide["scans"][3, 40] = np.nan, np.inf, 27.0
    write(tmp_path / "wide", wide)
    with pytest.raises(ConfigError, match="--range-max"):
        import_npz([folder], tmp_path / "c")
    wide["scans"][3, 40] = 1e300
    write(tmp_path / "wide", wide)
    import_npz([folder, tmp_path / "plain"], tmp_path / "d")
    columns = columns_of(tmp_path / "d", 0)
    assert (columns["scan"][3, :20] == 0).all()
    assert (columns["scan"][3, 20:41] == 25).all()
    assert (columns["rings"][3, 0] == 1).all()
    (tmp_path / "empty").mkdir()
    with pytest.raises(DatasetNotFoundError, match=r"nothing to import in .*empty"):
        import_npz([folder, tmp_path / "empty"], tmp_path / "e")


def spoilt(name, value):
    return {**sequence(), name: value}


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        (
            spoilt("actions", np.array([None] * 60)),
            "array 'actions' holds pickled objects, which are never loaded",
        ),
        (spoilt("scans", np.zeros((60, 1080), int)), "array 'scans' is int64 .*, expected float32 or float64"),
        (spoilt("dones", np.arange(60)), "array 'dones' holds 59 and 0, expected 0 and 1 only"),
        (spoilt("scans", np.zeros((60, 720), np.float32)), "array 'scans' is float32 \\(60, 720\\)"),
        (spoilt("dones", np.zeros(60)), "array 'dones' is float64 .*, expected bool"),
        (spoilt("rewards", np.zeros((60, 1))), "array 'rewards' is float64 \\(60, 1\\)"),
        (spoilt("actions", np.zeros((59, 3))), "arrays differ in length .*actions 59"),
        (spoilt("actions", np.asfortranarray(np.ones((60, 3)))), "array 'actions'"),
        (spoilt("robotstates", np.full((60, 5), np.nan)), "'robotstates' holds inf or NaN velocities"),
        ({k: v for k, v in sequence().items() if k != "dones"}, "has no array 'dones'"),
    ],
)
def test_wrong_arrays_are_refused(tmp_path, arrays, words):
    with pytest.raises(CorruptDataError, match=words) as caught:
        import_npz(write(tmp_path / "in", arrays), tmp_path / "out")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_pickles_are_not_loaded(tmp_path):
    """The payload would leave a file behind."""

    class Payload:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "pwned",))

    evil = np.empty(60, object)
    evil[0] = Payload()
    write(tmp_path / "in", spoilt("rewards", evil))
    with pytest.raises(CorruptDataError, match="never loaded"):
        import_npz(tmp_path / "in", tmp_path / "out")
    assert not (tmp_path / "pwned").exists()


@pytest.mark.slow
def test_too_large_is_refused_before_it_is_read(tmp_path):
    """A bomb: 60 honest rows in the other arrays, and a header that promises far more than fits in memory."""
    folder = write(tmp_path / "in", sequence())
    path = next(folder.iterdir())
    with zipfile.ZipFile(path, "w") as archive, archive.open("scans.npy", "w", force_zip64=True) as handle:
        np.lib.format.write_array_header_1_0(handle, {"descr": "<f4", "fortran_order": False, "shape": (10**10, 1080)})
    with pytest.raises(DatasetError, match=f"10,000,000,000 rows, expected 1 to {MAX_ROWS:,}"):
        import_npz(folder, tmp_path / "out")
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("scans.npy", "w") as handle,
    ):
        np.lib.format.write_array_header_1_0(handle, {"descr": "<f4", "fortran_order": False, "shape": (60, 1080)})
        handle.write(bytes(50_000_000))
    with pytest.raises(CorruptDataError, match="array 'scans' has 50,000,128 bytes, expected 259,200 and a header"):
        import_npz(folder, tmp_path / "out")


def test_damaged_files_are_refused(tmp_path):
    folder = write(tmp_path / "in", sequence())
    path = next(folder.iterdir())
    good = path.read_bytes()
    rng = np.random.default_rng(0)
    for size in [0, 10, 100, 5000, len(good) // 2, len(good) - 1]:
        path.write_bytes(good[:size])
        with pytest.raises(CorruptDataError, match="cannot be read as npz"):
            import_npz(folder, tmp_path / "out")
    for at in rng.integers(100, len(good) - 600, 25):
        path.write_bytes(good[:at] + bytes([good[at] ^ 0x41]) + good[at + 1 :])
        with pytest.raises(CorruptDataError) as caught:
            import_npz(folder, tmp_path / "out")
        assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_sources_that_are_none(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(DatasetNotFoundError, match=r"There is nothing to import in .*empty"):
        import_npz(tmp_path / "empty", tmp_path / "out")
    with pytest.raises(DatasetNotFoundError, match=r"There is no file .*gone\.npz"):
        import_npz([tmp_path / "gone.npz"], tmp_path / "out")


def test_range_max(tmp_path):
    source = sequence()
    source["scans"][5, 5] = 109.44
    folder = write(tmp_path / "in", source)
    with pytest.raises(ConfigError, match=r"ranges up to 109.44 m, expected at most 25 m. Pass the sensor's range_max"):
        import_npz(folder, tmp_path / "out")
    manifest = import_npz(folder, tmp_path / "out", range_max=110)
    assert manifest.sensor.range_max == 110
    assert SequenceDataset(tmp_path / "out", "1d")[0]["scan"][5, 5] == np.float32(109.44)
    with pytest.raises(ConfigError, match="expected positive numbers"):
        import_npz(folder, tmp_path / "other", range_max=0)


def test_the_card_gives_the_whole_command(tmp_path):
    manifest = import_npz(write(tmp_path / "in", sequence()), tmp_path / "d", env="my lab", range_max=30.0)
    assert manifest.command.endswith("--out OUT --env 'my lab' --range-max 30")
    assert manifest.command in (tmp_path / "d" / "README.md").read_text()


def test_numbers_on_the_card_are_exact(tmp_path):
    manifest = import_npz(write(tmp_path / "in", sequence()), tmp_path / "d", range_max=100 / 3)
    assert float(manifest.command.split("--range-max ")[1]) == 100 / 3
