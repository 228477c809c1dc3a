"""Worlds files: round trip, equal bytes, and files that are not what they claim."""

from __future__ import annotations

import io
import zipfile

import numpy as np
import pytest

from navrep_data.errors import CorruptDataError
from navrep_data.shards import WORLD_FIELDS, read_worlds
from navrep_data.shards import worlds as module

from .synthetic import make_sequence, make_writer


@pytest.fixture
def arrays():
    return module.as_worlds(make_sequence(0)[1])


def test_round_trip_over_sequences(tmp_path):
    writer = make_writer()
    given = [make_sequence(k) for k in range(3)]
    for k, (columns, worlds) in enumerate(given):
        writer.append(k, columns, worlds)
    path = tmp_path / "w.npz"
    path.write_bytes(writer.finish().worlds)
    worlds = read_worlds(path)
    assert len(worlds) == sum(len(w["episode"]) for _, w in given)
    at = 0
    for k, (_, w) in enumerate(given):
        for e in range(len(w["episode"])):
            got = worlds.episode(at)
            at += 1
            assert (got.sequence, got.episode, got.row) == (k, e, w["row"][e] + 100 * k)
            polygons = [*got.polygons, *([got.border] if got.border is not None else [])]
            assert (got.border is not None) == w["has_border"][e]
            first = w["episode_polygon_offset"][e]
            for p, polygon in enumerate(polygons, first):
                wanted = w["vertices"][w["polygon_offset"][p] : w["polygon_offset"][p + 1]]
                assert np.array_equal(polygon, wanted.astype(np.float32))
            assert len(polygons) == w["episode_polygon_offset"][e + 1] - first
            h = slice(*w["human_offset"][e : e + 2])
            assert np.array_equal(got.human_goal, w["human_goal"][h].astype(np.float32))
            assert np.array_equal(got.human_sees_robot, w["human_sees_robot"][h])
    with pytest.raises(IndexError, match="expected 0 to"):
        worlds.episode(at)


def test_plain_numpy_reads_it_and_bytes_repeat(arrays, tmp_path):
    data = module.worlds_bytes(arrays)
    assert data == module.worlds_bytes({k: v.copy() for k, v in arrays.items()})
    with np.load(io.BytesIO(data), allow_pickle=False) as npz:
        assert list(npz.files) == list(WORLD_FIELDS)
        assert all(np.array_equal(npz[name], arrays[name]) for name in WORLD_FIELDS)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert archive.testzip() is None
        assert {entry.date_time for entry in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}


def with_drawn(arrays, scale=1):
    """Return the arrays with a robot of its own, two lidars and people of their own in each episode."""
    n, h = len(arrays["episode"]), len(arrays["human_start"])
    corners, lidars = np.arange(n + 1) * 4, np.arange(n + 1) * 2
    drawn = {
        "robot_max_velocity": np.full((n, 3), 0.5 * scale), "robot_acceleration": np.full((n, 3), 1.0),
        "robot_drive": np.full(n, b"differential"), "footprint_offset": corners,
        "footprint": np.arange(8.0 * n).reshape(-1, 2) * scale, "lidar_offset": lidars,
        "lidar_pose": np.arange(6.0 * n).reshape(-1, 3), "lidar_rays": np.full(2 * n, 540),
        "lidar_angles": np.full((2 * n, 2), (-2.3, 0.01)), "lidar_ranges": np.full((2 * n, 2), (0.1, 25.0)),
        "human_model": np.full(h, b"orca"), "human_radius": np.linspace(0.2, 0.4, h),
    }  # fmt: skip
    return module.as_worlds({**arrays, **drawn})


def test_what_is_drawn_per_episode_has_its_place(arrays):
    given = [with_drawn(arrays, scale) for scale in (1, 2)]
    joined = module.concatenate_worlds(given)
    worlds = module.parse_worlds(module.worlds_bytes(joined), "w.npz")
    n = len(arrays["episode"])
    assert set(worlds.arrays) == {*WORLD_FIELDS, *module.DRAWN_WORLD_FIELDS}
    for e in range(2 * n):
        found = worlds.episode(e).drawn
        assert set(found) == set(module.DRAWN_WORLD_FIELDS) - {"footprint_offset", "lidar_offset"}
        scale, k = 1 + e // n, e % n
        np.testing.assert_array_equal(found["footprint"], (8 * k + np.arange(8.0).reshape(4, 2)) * scale)
        np.testing.assert_array_equal(found["lidar_pose"], 6 * k + np.arange(6.0).reshape(2, 3))
        assert found["robot_max_velocity"].tolist() == [0.5 * scale] * 3
        assert found["robot_drive"] == b"differential"
        assert len(found["human_radius"]) == len(worlds.episode(e).human_start)
    again = module.take_episodes(joined, n, 2 * n)
    assert all(np.array_equal(again[name], values) for name, values in given[1].items())
    assert set(module.concatenate_worlds([arrays, given[0]])) == set(WORLD_FIELDS)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda a: a.pop("human_model"), "'human_model' is missing"),
        (lambda a: a["lidar_offset"].__setitem__(-1, 99), "'lidar_offset'"),
        (lambda a: a.update(footprint=a["footprint"][:-1]), "'footprint_offset'"),
        (lambda a: a.update(lidar_rays=a["lidar_rays"][:-1]), "'lidar_rays' has"),
    ],
)
def test_inconsistent_drawn_arrays_are_refused(arrays, change, match):
    drawn = with_drawn(arrays)
    change(drawn)
    with pytest.raises(CorruptDataError, match=match):
        module.as_worlds(drawn)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda a: a.pop("row"), "'row' is missing"),
        (lambda a: a.update(more=a["row"]), "'more' is unexpected"),
        (lambda a: a.update(robot_goal=a["robot_goal"][:, :1]), "'robot_goal'"),
        (lambda a: a.update(row=a["row"][:-1]), "'row' has"),
        (lambda a: a.update(human_goal=a["human_goal"][:-1]), "'human_goal'"),
        (lambda a: a["human_offset"].__setitem__(-1, 999), "'human_offset'"),
        (lambda a: a["polygon_offset"].__setitem__(1, 10**15), "'polygon_offset'"),
        (lambda a: a["polygon_offset"].__setitem__(0, -4), "'polygon_offset'"),
        (lambda a: a["episode_polygon_offset"].__setitem__(0, 1), "'episode_polygon_offset'"),
    ],
)
def test_inconsistent_arrays_are_refused(arrays, change, match):
    change(arrays)
    with pytest.raises(CorruptDataError, match=match):
        module.as_worlds(arrays)


def npz_with(arrays, name, member):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for field in WORLD_FIELDS:
            if field == name:
                archive.writestr(f"{field}.npy", member)
                continue
            part = io.BytesIO()
            np.lib.format.write_array(part, arrays[field], version=(1, 0))
            archive.writestr(f"{field}.npy", part.getvalue())
    return buffer.getvalue()


def npy(array, **kwargs):
    part = io.BytesIO()
    np.lib.format.write_array(part, array, **kwargs)
    return part.getvalue()


def test_hostile_archives_are_refused(arrays, monkeypatch):
    huge = npy(np.zeros(1, np.float32), version=(1, 0)).replace(b"(1,), }         ", b"(9999999999,), }")
    assert b"9999999999" in huge
    cases = {
        "pickled": npz_with(arrays, "robot_v_pref", npy(np.array([{}], dtype=object), allow_pickle=True)),
        "claims a huge shape": npz_with(arrays, "robot_v_pref", huge),
        "wrong dtype": npz_with(arrays, "robot_v_pref", npy(arrays["robot_v_pref"].astype("f8"))),
        "no npy": npz_with(arrays, "robot_v_pref", b"hello"),
        "no zip": b"PK\x03\x04 hello",
        "empty": b"",
    }
    for name, data in cases.items():
        with pytest.raises(CorruptDataError, match="w is not a worlds file") as error:
            module.parse_worlds(data, "w")
        assert "\n" not in str(error.value), name
    bomb = npz_with(arrays, "vertices", npy(np.zeros((1 << 20, 2), np.float32)))
    assert len(bomb) < 200_000
    monkeypatch.setattr(module, "MAX_WORLDS_BYTES", 1 << 20)
    with pytest.raises(CorruptDataError, match="unpacks to more than"):
        module.parse_worlds(bomb, "w")


def test_zip_whose_directory_lies_about_sizes_is_refused(arrays):
    """A member that inflates to more than its declared size: reading stops there, and its checksum fails."""
    data = bytearray(module.worlds_bytes(arrays))
    at = data.rindex(b"PK\x01\x02")
    size = int.from_bytes(data[at + 24 : at + 28], "little")
    data[at + 24 : at + 28] = (size - 8).to_bytes(4, "little")
    with pytest.raises(CorruptDataError, match="not a worlds file"):
        module.parse_worlds(bytes(data), "w")


def test_large_files_are_refused_unread(tmp_path):
    path = tmp_path / "w.npz"
    with open(path, "wb") as handle:
        handle.truncate(300 << 20)
    with pytest.raises(CorruptDataError, match="expected at most"):
        read_worlds(path)
