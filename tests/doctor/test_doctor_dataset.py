"""Each check of `doctor DIR` finds the mistake that it is for, in data whose every hash is right."""

import json

import numpy as np
import pytest

from navrep_data.cli import main
from navrep_data.doctor import check_dataset
from navrep_data.errors import DatasetNotFoundError
from navrep_data.generate import generate
from navrep_data.observations import scan_to_rings
from navrep_data.schema import Event
from navrep_data.shards import DatasetFolder, DatasetWriter, verify

LENGTH = 150


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """Three sequences, one per split, one shard each."""
    root = tmp_path_factory.mktemp("doctor") / "sound"
    generate(n=3, out=root, length=LENGTH, humans=3, obstacles=3, shard_size=1, workers=1)
    return root


def rebuilt(sound, out, change, splits=None, **settings):
    """Write the dataset again with `change(k, columns, worlds)` applied to sequence k, hashes and all."""
    from dataclasses import replace

    writer = None
    with DatasetFolder(sound) as folder:
        old = folder.manifest
        for k in range(3):
            place, _ = old.place_of(k)
            shard = folder.shard(place)
            columns = {name: shard.read(name, 0, shard.rows) for name in old.columns}
            worlds = {name: values.copy() for name, values in folder.worlds(place).arrays.items()}
            worlds = change(k, columns, worlds) or worlds
            names = [name for name in old.columns if name in columns]
            if writer is None:
                out.mkdir()
                rule = old.split_rule if splits is None else "as the test wants"
                writer = DatasetWriter(out, replace(old, columns=tuple(names), split_rule=rule, **settings))
            writer.append(k, (splits or ("train", "val", "test"))[k], columns, worlds)
    writer.finish()
    assert verify(out).ok
    return out


def problems(root):
    return [(f.check, f.where, f.what) for f in check_dataset(root).findings if f.severity == "problem"]


def test_a_sound_dataset(sound, tmp_path):
    report = check_dataset(sound)
    assert report.findings == []
    assert (report.sequences, report.rows, report.skipped) == (3, 3 * LENGTH, [])
    assert report.episodes >= 3
    # and written again unchanged: what the tests below find is what they changed
    assert problems(rebuilt(sound, tmp_path / "again", lambda *_: None)) == []


@pytest.mark.slow
def test_rows_in_two_splits(sound, tmp_path):
    first = {}

    def change(k, columns, worlds):
        if k == 0:
            first.update(columns=dict(columns), worlds=dict(worlds))
        elif k == 2:
            columns.update(first["columns"], sequence=np.full(LENGTH, 2, np.int32))
            return {**first["worlds"], "sequence": np.full_like(first["worlds"]["sequence"], 2)}
        return None

    found = problems(rebuilt(sound, tmp_path / "d", change))
    assert found
    assert {(check, where.split(" episode")[0]) for check, where, _ in found} == {("duplicates", "sequence 2")}
    assert "is in split test, the other in train" in found[0][2]


@pytest.mark.slow
def test_doubled_rows_in_one_split_are_a_note(sound, tmp_path):
    def change(k, columns, worlds):
        if k == 0:
            change.kept = dict(columns), dict(worlds)
        elif k == 1:
            columns.update(change.kept[0], sequence=np.full(LENGTH, 1, np.int32))
            return {**change.kept[1], "sequence": np.full_like(change.kept[1]["sequence"], 1)}
        return None

    root = rebuilt(sound, tmp_path / "d", change, splits=("train", "train", "val"))
    report = check_dataset(root)
    assert report.ok
    assert {f.check for f in report.findings} == {"duplicates"}


@pytest.mark.slow
def test_frozen_and_dead_lidars(sound, tmp_path):
    def freeze(k, columns, worlds):
        columns["scan"][:] = columns["scan"][0]
        columns["rings"][:] = scan_to_rings(columns["scan"])

    found = problems(rebuilt(sound, tmp_path / "frozen", freeze))
    assert {check for check, _, _ in found} == {"sensor"}
    assert "have the scan of the row before" in found[0][2]

    def kill(k, columns, worlds):
        columns["scan"][:, 100:120] = 0
        columns["rings"][:] = scan_to_rings(columns["scan"])

    found = problems(rebuilt(sound, tmp_path / "dead", kill))
    assert [(check, what) for check, _, what in found] == [
        ("sensor", "20 of 1080 rays are invalid (0) on every row")
    ] * 3


@pytest.mark.slow
@pytest.mark.parametrize(("declared", "left"), [([[100, 119]], None), ([[90, 109], [3, 4]], 10), ("rubbish", 20)])
def test_sectors_that_are_declared_blind(sound, tmp_path, declared, left):
    def kill(k, columns, worlds):
        columns["scan"][:, 100:120] = 0
        columns["rings"][:] = scan_to_rings(columns["scan"])

    root = rebuilt(sound, tmp_path / "d", kill, config={"blind_rays": declared})
    found = [what for check, _, what in problems(root) if check == "sensor"]
    assert [what.split(" rays")[0] for what in found] == ([] if left is None else [f"{left} of 1080"] * 3)


@pytest.mark.slow
def test_a_sensor_that_cannot_be(sound, tmp_path):
    from dataclasses import replace

    with DatasetFolder(sound) as folder:
        sensor = folder.manifest.sensor
    root = rebuilt(sound, tmp_path / "slow", lambda *_: None, sensor=replace(sensor, dt=0.4))
    found = problems(root)
    # the clock of the sensor is not that of the poses
    assert {check for check, _, _ in found} >= {"motion"}
    assert any("times as far as its velocity and dt = 0.4 s say" in what for _, _, what in found)
    root = rebuilt(sound, tmp_path / "wide", lambda *_: None, sensor=replace(sensor, angle_increment=0.02))
    assert any("expected a full turn at most" in what for check, _, what in problems(root) if check == "sensor")


@pytest.mark.slow
def test_a_goal_that_jumps(sound, tmp_path):
    def change(k, columns, worlds):
        if k == 1:
            row = int(np.flatnonzero(columns["is_last"])[0])
            columns["robot_state"][row // 2 : row + 1, 0] += 0.5

    found = problems(rebuilt(sound, tmp_path / "d", change))
    assert [(check, where) for check, where, _ in found] == [("goal", "sequence 1 episode 0")]
    assert "the goal jumps by 0.50 m" in found[0][2]


@pytest.mark.slow
def test_a_goal_beside_that_of_the_worlds_file(sound, tmp_path):
    def change(k, columns, worlds):
        worlds["robot_goal"][0, 1] += 0.3

    found = problems(rebuilt(sound, tmp_path / "d", change))
    assert [check for check, _, _ in found] == ["goal"] * 3
    assert "points 0.30 m beside the goal of its worlds file" in found[0][2]


@pytest.mark.slow
def test_a_goal_that_was_not_reached(sound, tmp_path):
    def change(k, columns, worlds):
        last = int(np.flatnonzero(columns["is_last"])[0])
        first = columns["robot_state"][0].copy()
        columns["robot_state"][: last + 1] = columns["robot_state"][: last + 1][::-1]
        columns["robot_pose"][: last + 1] = columns["robot_pose"][: last + 1][::-1]
        columns["event"][last], columns["is_terminal"][last] = Event.GOAL, True
        worlds["robot_start"][0] = columns["robot_pose"][0]
        change.first = first

    found = problems(rebuilt(sound, tmp_path / "d", change))
    assert any(check == "goal" and "ends as 'goal'" in what for check, _, what in found)


@pytest.mark.slow
def test_a_reset_out_of_line(sound, tmp_path):
    def change(k, columns, worlds):
        worlds["robot_start"][0] += (0.5, 0.0, 0.0)

    found = problems(rebuilt(sound, tmp_path / "d", change))
    assert [(check, where) for check, where, _ in found] == [("reset", f"sequence {k} episode 0") for k in range(3)]
    assert "starts 0.50 m and 0.00 rad from the start" in found[0][2]


@pytest.mark.slow
def test_a_reset_without_is_first(sound, tmp_path):
    """A robot that is somewhere else in the middle of an episode: its goal stays in place, so only motion tells."""

    def change(k, columns, worlds):
        first, last = np.flatnonzero(columns["is_first"]), np.flatnonzero(columns["is_last"])
        longest = int((last - first).argmax())
        row, stop = (first[longest] + last[longest]) // 2, last[longest] + 1
        columns["robot_pose"][row:, :2] += 3.0
        later = worlds["row"] >= stop
        worlds["robot_start"][later, :2] += 3.0
        worlds["robot_goal"][later] += 3.0
        theta = columns["robot_pose"][row:stop, 2]
        back = np.stack([np.cos(theta) + np.sin(theta), np.cos(theta) - np.sin(theta)], axis=1) * 3.0
        columns["robot_state"][row:stop, :2] -= back

    found = problems(rebuilt(sound, tmp_path / "d", change))
    assert {check for check, _, _ in found if check != "goal"} == {"motion"}
    assert any("a reset without is_first?" in what for _, _, what in found)


@pytest.mark.slow
def test_without_poses_goals_are_still_looked_at(sound, tmp_path):
    def change(k, columns, worlds):
        columns["robot_pose"][:] = np.nan
        if k == 2:
            row = int(np.flatnonzero(columns["is_last"])[0]) // 2
            columns["robot_state"][row, :2] += 4.0

    root = rebuilt(sound, tmp_path / "d", change)
    report = check_dataset(root)
    assert [(f.check, f.where) for f in report.findings] == [("goal", "sequence 2")]
    assert report.skipped == ["poses, resets and clock: the poses are unknown (NaN), as in imports"]


def test_damage_is_told_and_the_rest_still_checked(sound, tmp_path):
    import shutil

    root = tmp_path / "d"
    shutil.copytree(sound, root)
    path = root / "data/val-00000.h5"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    report = check_dataset(root)
    assert [(f.check, f.where) for f in report.findings] == [("verify", "data/val-00000.h5")]
    assert report.sequences == 2


@pytest.mark.slow
def test_many_findings_are_counted(sound, tmp_path, monkeypatch):
    monkeypatch.setattr("navrep_data.doctor.dataset.MAX_FINDINGS", 1)

    def change(k, columns, worlds):
        worlds["robot_start"][0] += (0.5, 0.0, 0.0)

    report = check_dataset(rebuilt(sound, tmp_path / "d", change))
    assert [f.what for f in report.findings][1:] == ["and 2 more of this kind"]
    assert not report.ok


def run(capsys, *arguments):
    with pytest.raises(SystemExit) as ended:
        main.run([str(a) for a in arguments])
    out, err = capsys.readouterr()
    return ended.value.code, out, err


@pytest.mark.slow
def test_the_command(sound, tmp_path, capsys):
    code, out, _ = run(capsys, "doctor", sound)
    assert code == 0
    assert out.splitlines()[-1].startswith(f"{sound}: 3 sequences, ")
    assert out.endswith("all well\n")

    def change(k, columns, worlds):
        worlds["robot_start"][0] += (0.5, 0.0, 0.0)

    bad = rebuilt(sound, tmp_path / "d", change)
    code, out, _ = run(capsys, "doctor", bad)
    assert code == 1
    assert out.startswith("problem reset: sequence 0 episode 0: starts 0.50 m")
    assert out.endswith("3 problems\n")
    code, out, _ = run(capsys, "doctor", bad, "--json")
    found = json.loads(out)
    assert (code, found["ok"], len(found["findings"])) == (1, False, 3)
    assert set(found["findings"][0]) == {"check", "severity", "where", "what"}
    code, out, err = run(capsys, "doctor", tmp_path / "nowhere")
    assert (code, out) == (2, "")
    assert err.startswith("Error: No dataset in")


def test_no_dataset(tmp_path):
    with pytest.raises(DatasetNotFoundError):
        check_dataset(tmp_path)
