"""What goes into a shard comes out of it, by our reader and by plain h5py, in equal bytes each time."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from navrep_data.errors import ConfigError, CorruptDataError, DatasetNotFoundError, SchemaVersionError
from navrep_data.schema import COLUMNS, LABEL_HUMAN
from navrep_data.shards import DatasetFolder, Shard, chunk_rows, dataset_card, publish, verify
from navrep_data.shards._codec import encode, inflate, unshuffle

from .synthetic import ALL_COLUMNS, MAX_HUMANS, make_dataset, make_sequence, make_writer

VARIANTS = {
    "all": {},
    "float32": {"scan_dtype": "float32"},
    "no_rings": {"columns": tuple(c for c in ALL_COLUMNS if c != "rings")},
    "no_humans": {"columns": tuple(c for c in ALL_COLUMNS if c != "humans")},
    "import": {"columns": tuple(c for c in COLUMNS if c not in ("rings", "humans"))},
}


def write(path: Path, rows: list[int], length: int, first: int = 0, **changes):
    writer = make_writer(length=length, **changes)
    parts = []
    for k, n in enumerate(rows):
        given = {key: changes[key] for key in ("scan_dtype", "columns") if key in changes}
        columns, worlds = make_sequence(first + k, n, **given)
        writer.append(first + k, columns, worlds)
        parts.append(columns)
    image = writer.finish()
    path.write_bytes(image.data)
    return image, {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}


def equal(a, b) -> bool:
    return a.dtype == b.dtype and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize(
    ("rows", "length"), [([100, 100], 100), ([7] * 9, 7), ([997], 997), ([1], 1), ([30, 2, 61], 61)]
)
def test_round_trip(tmp_path, variant, rows, length):
    _, expected = write(tmp_path / "s.h5", rows, length, **VARIANTS[variant])
    shard = Shard(tmp_path / "s.h5")
    assert list(shard.columns) == list(expected)
    with h5py.File(tmp_path / "s.h5") as file:
        for name, values in expected.items():
            assert equal(file[name][()], values), name
            assert equal(shard.read(name, 0, shard.rows), values), name
            assert file[name].shape[0] == sum(rows)


def test_random_slices_and_rows(tmp_path):
    _, expected = write(tmp_path / "s.h5", [100, 100, 60], 100)
    shard = Shard(tmp_path / "s.h5")
    rng = np.random.default_rng(0)
    for _ in range(60):
        start, stop = sorted(rng.integers(0, shard.rows + 1, 2))
        rows = rng.integers(0, shard.rows, 9)
        for name, values in expected.items():
            assert equal(shard.read(name, start, stop), values[start:stop])
            assert equal(shard.read_rows(name, rows), values[rows])
    out = shard.read("action", 0, 5)
    out[:] = 99  # a copy: the cached column stays as it was
    assert equal(shard.read("action", 0, 5), expected["action"][:5])


def test_bytes_are_a_function_of_the_input(tmp_path):
    a, _ = write(tmp_path / "a.h5", [100, 40], 100)
    b, _ = write(tmp_path / "b.h5", [100, 40], 100)
    assert (a.data, a.worlds, a.statistics, a.sequence_hashes) == (
        b.data,
        b.worlds,
        b.statistics,
        b.sequence_hashes,
    )
    c, _ = write(tmp_path / "c.h5", [100, 40], 100, seed=8)
    assert c.data != a.data
    assert c.sequence_hashes == a.sequence_hashes


@pytest.mark.slow
def test_sequence_hash_ignores_rings_chunks_and_nan_payloads():
    columns, worlds = make_sequence(0)
    plain = make_writer()
    plain.append(0, columns, worlds)
    odd = dict(columns)
    bits = columns["humans"].copy().view(np.uint32)
    bits[np.isnan(columns["humans"])] = 0x7FC12345
    odd["humans"] = bits.view(np.float32)
    other = make_writer()
    other.append(0, odd, worlds)
    bare = make_writer(columns=VARIANTS["no_rings"]["columns"])
    bare.append(0, {k: v for k, v in columns.items() if k != "rings"}, worlds)
    a, b, c = plain.finish(), other.finish(), bare.finish()
    assert a.data == b.data
    assert a.sequence_hashes == b.sequence_hashes == c.sequence_hashes
    for name in columns:
        if name in ("rings", "sequence", "episode", "step", "is_first", "is_last", "is_terminal", "event"):
            continue
        changed = {k: v.copy() for k, v in columns.items()}
        first = changed[name].reshape(-1)
        first[0] = first[0] == 0 if name in ("scan_label", "contact") else first[0] + 1
        third = make_writer()
        third.append(0, changed, worlds)
        assert (third.finish().sequence_hashes == a.sequence_hashes) == np.isnan(changed[name].reshape(-1)[0]), name


def test_attributes_serve_plain_h5py(tmp_path):
    write(tmp_path / "s.h5", [50], 100)
    with h5py.File(tmp_path / "s.h5") as file:
        assert file.attrs["format"] == b"navrep-data"
        assert json.loads(file.attrs["config"])["name"] == "\u00e9t\u00e9"
        assert file["scan"].attrs["units"] == "mm"
        assert file["scan"].attrs["scale"] == 0.001
        assert file["event"].attrs["names"].split(",")[1] == "goal"
        assert file["is_first"].dtype == bool
        assert all(isinstance(file.get(name, getlink=True), h5py.HardLink) for name in file)


def test_chunk_rows_divide_the_length():
    assert [chunk_rows(n) for n in (1000, 997, 7, 1, 36, 48)] == [25, 25, 25, 25, 18, 24]


@pytest.mark.slow
@pytest.mark.parametrize("noise", [True, False])
@pytest.mark.parametrize("dtype", ["u1", "<u2", "<i4", "<f4", "<f8"])
@pytest.mark.parametrize("items", [1, 50, 5000, 20_000])
def test_codec_against_hdf5(tmp_path, dtype, items, noise):
    """The oracle is the HDF5 library: its filters undo ours, and ours undo its."""
    rng = np.random.default_rng(items)
    values = rng.uniform(0, 250, (8, items)) if noise else np.arange(8 * items).reshape(8, items) // 64 % 250
    block = (values * (1 if np.dtype(dtype).itemsize == 1 else 97.3)).astype(dtype)
    with h5py.File(tmp_path / "x.h5", "w") as file:
        made = {"shape": block.shape, "dtype": dtype, "chunks": block.shape, "compression": "gzip"}
        mine = file.create_dataset("mine", **made, shuffle=block.itemsize > 1)
        mine.id.write_direct_chunk((0, 0), encode(block))
        theirs = file.create_dataset("theirs", **made, shuffle=block.itemsize > 1)
        theirs[...] = block
        assert np.array_equal(mine[...], block)
        plain = inflate(theirs.id.read_direct_chunk((0, 0))[1], block.nbytes)
    assert np.array_equal(unshuffle(plain, block.dtype, items, 2, 7).reshape(5, items), block[2:7])


def test_noisy_planes_are_stored_and_others_are_not():
    """What a scan's low bytes are decides: noise is read fast, anything else is kept small."""
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 25_000, (20, 1080)).astype("<u2")
    constant = np.full((20, 1080), 25_000, "<u2")
    assert noise.reshape(-1).view(np.uint8).reshape(-1, 2)[:, 0].tobytes() in encode(noise)
    assert len(encode(constant)) < 500


def test_inflate_is_bounded_and_checked():
    data = encode(np.arange(4000, dtype="<u2"))
    assert len(inflate(data, 8000)) == 8000
    for size in (7999, 8001):
        with pytest.raises(ValueError, match="expected"):
            inflate(data, size)
    with pytest.raises(ValueError, match=r"damaged|expected"):
        inflate(data[:-3], 8000)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda c: c.pop("reward"), "'reward' is missing"),
        (lambda c: c.update(extra=c["step"]), "'extra' is not a column"),
        (lambda c: c.update(scan=c["scan"].astype(np.int32)), "'scan' is int32"),
        (lambda c: c.update(action=c["action"][:, :2]), r"'action' is float32 \(100, 2\)"),
        (lambda c: c.update(humans=c["humans"][:-1]), "'humans'"),
        (lambda c: c["sequence"].fill(3), "'sequence' is 3, expected 0"),
        (lambda c: c["episode"].__iadd__(1), "'episode'"),
        (lambda c: c["step"].__iadd__(1), "'step'"),
        (lambda c: c["event"].fill(0), "'event'"),
        (lambda c: np.logical_not(c["is_terminal"], out=c["is_terminal"]), "'is_terminal'"),
        (lambda c: c["is_last"].__setitem__(-1, False), "is_first and is_last"),
        (lambda c: c["rings"].__setitem__(0, 3), "'rings' holds 3"),
        (lambda c: c["action"].__setitem__(0, np.nan), "'action' holds NaN"),
        (lambda c: c["robot_state"].__setitem__(0, np.inf), "'robot_state' holds NaN or infinity"),
    ],
)
def test_append_refuses_and_stays_usable(change, match):
    good, worlds = make_sequence(0)
    bad = {k: v.copy() for k, v in good.items()}
    change(bad)
    writer = make_writer()
    with pytest.raises(CorruptDataError, match=match) as error:
        writer.append(0, bad, worlds)
    assert "\n" not in str(error.value)
    writer.append(0, good, worlds)
    fresh = make_writer()
    fresh.append(0, good, worlds)
    assert writer.finish().data == fresh.finish().data


def test_writer_refuses_bad_settings():
    for changes, match in (
        ({"scan_dtype": "int8"}, "scan_dtype"),
        ({"columns": ("scan",)}, "missing"),
        ({"columns": (*ALL_COLUMNS, "ring")}, "Did you mean 'rings'"),
        ({"max_humans": 0}, "max_humans"),
        ({"seed": -1}, "seed"),
        ({"split": "all"}, "split is 'all'; expected one of: train, val, test"),
    ):
        with pytest.raises(ConfigError, match=match):
            make_writer(**changes)
    with pytest.raises(CorruptDataError, match="without sequences"):
        make_writer().finish()
    mixed = make_writer()
    mixed.append(0, *make_sequence(0))
    with pytest.raises(CorruptDataError, match="no worlds"):
        mixed.append(1, make_sequence(1)[0])


def test_publish_leaves_the_old_state_when_interrupted(tmp_path, monkeypatch):
    old, _ = write(tmp_path / "old", [20], 100)
    entry = publish(tmp_path, 0, old)
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    new, _ = write(tmp_path / "old", [30], 100)
    (tmp_path / "old").write_bytes(old.data)

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="free some space"):
        publish(tmp_path, 0, new)
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before
    assert Shard(tmp_path / entry.file, entry).rows == 20


# -- hostile and damaged files


@pytest.fixture
def shard_file(tmp_path):
    path = tmp_path / "s.h5"
    write(path, [60], 60)
    return path


def rewrite(path, change):
    with h5py.File(path, "r+") as file:
        change(file)


def replace_by_virtual(file):
    del file["reward"]
    layout = h5py.VirtualLayout(shape=(60,), dtype="f4")
    layout[:] = h5py.VirtualSource("/etc/other.h5", "reward", shape=(60,))
    file.create_virtual_dataset("reward", layout)


def replace_by(name, **settings):
    def change(file):
        del file[name]
        file.create_dataset(name, **settings)

    return change


def replace_by_link(link):
    def change(file):
        del file["reward"]
        file["reward"] = link

    return change


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "match"),
    [
        (replace_by_link(h5py.ExternalLink("/etc/passwd", "x")), "external link 'reward'"),
        (replace_by_link(h5py.SoftLink("/step")), "soft or external link 'reward'"),
        (replace_by_virtual, "other files"),
        (replace_by("reward", shape=(60,), dtype="f4", external=[("/etc/passwd", 0, 240)]), "other files"),
        (replace_by("reward", shape=(60,), dtype=h5py.ref_dtype), "references"),
        (replace_by("reward", shape=(60,), dtype=h5py.string_dtype()), "references or objects"),
        (replace_by("reward", shape=(60,), dtype="f8"), "float64"),
        (replace_by("reward", shape=(59,), dtype="f4"), r"\(59,\)"),
        (replace_by("scan", shape=(60, 1081), dtype="u2"), "1081"),
        (replace_by("reward", shape=(60,), dtype="f4", chunks=(60,), scaleoffset=2), "filter 6"),
        (lambda f: f.create_group("more"), "not a dataset"),
        (lambda f: f.create_dataset("more", data=[1]), "'more'"),
        (lambda f: f.__delitem__("action"), "'action'"),
        (lambda f: f.attrs.__setitem__("rows", 61), "61"),
        (lambda f: f.attrs.__setitem__("n_rays", "many"), "n_rays"),
        (lambda f: f.attrs.__setitem__("format", "minari"), "format"),
        (lambda f: f.attrs.__delitem__("sequences"), "sequences"),
    ],
)
def test_hostile_files_are_refused(shard_file, change, match):
    rewrite(shard_file, change)
    with pytest.raises(CorruptDataError, match=match) as error:
        Shard(shard_file)
    assert "\n" not in str(error.value)
    assert "navrep-data verify" in str(error.value)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        (
            "scan_label",
            LABEL_HUMAN + MAX_HUMANS,
            f"'scan_label' holds {LABEL_HUMAN + MAX_HUMANS} in row 0, expected at most",
        ),
        ("contact", 4, "'contact' holds 4, expected 0 to 3"),
    ],
)
def test_labels_and_contacts_that_mean_nothing_are_refused_and_found(name, value, words, tmp_path):
    columns, worlds = make_sequence(0)
    columns[name].reshape(-1)[7] = value
    with pytest.raises(CorruptDataError, match=rf"^Sequence 0: column {words}") as caught:
        make_writer().append(0, columns, worlds)
    assert "\n" not in str(caught.value)
    manifest = make_dataset(tmp_path / "d", 2, 2, 50)
    file = tmp_path / "d" / manifest.shards[0].file

    def change(f):
        stored = f[name][...]
        stored.reshape(-1)[7] = value
        f[name][...] = stored

    rewrite(file, change)
    data = file.read_bytes()
    entry = replace(manifest.shards[0], sha256=hashlib.sha256(data).hexdigest(), bytes=len(data))
    replace(manifest, shards=(entry,)).save(tmp_path / "d", dataset_card(manifest))
    assert any(words in problem.what for problem in verify(tmp_path / "d").problems)


def test_a_file_that_lies_about_its_split_is_refused(tmp_path):
    manifest = make_dataset(tmp_path / "d", 4, 2, 50)
    rewrite(tmp_path / "d" / manifest.shards[1].file, lambda f: f.attrs.__setitem__("split", np.bytes_("val")))
    with DatasetFolder(tmp_path / "d") as folder, pytest.raises(CorruptDataError, match="belongs to split 'val', the"):
        folder.read("step", 1, 0, 1)


def test_newer_version_names_the_command(shard_file):
    rewrite(shard_file, lambda f: f.attrs.__setitem__("format_version", 3))
    with pytest.raises(SchemaVersionError, match="pip install -U navrep-data"):
        Shard(shard_file)


def test_other_filters_are_read_through_h5py(shard_file):
    expected = Shard(shard_file).read("scan", 0, 60)

    def change(file):
        for name, settings in (
            ("scan", {"compression": "gzip", "fletcher32": True}),
            ("step", {"compression": "lzf"}),
            ("action", {}),
            ("reward", {"compression": "gzip"}),
        ):
            values, attributes = file[name][()], dict(file[name].attrs)
            del file[name]
            file.create_dataset(name, data=values, **settings).attrs.update(attributes)

    before = Shard(shard_file)
    columns = {name: before.read(name, 3, 50) for name in ("step", "action", "reward")}
    rewrite(shard_file, change)
    shard = Shard(shard_file)
    assert equal(shard.read("scan", 3, 50), expected[3:50])
    assert equal(shard.read_rows("scan", [59, 0, 30]), expected[[59, 0, 30]])
    for name, values in columns.items():
        assert equal(shard.read(name, 3, 50), values)


def test_truncated_files_are_refused(shard_file, tmp_path):
    data = shard_file.read_bytes()
    for keep in np.linspace(0, len(data) - 1, 25).astype(int):
        path = tmp_path / "cut.h5"
        path.write_bytes(data[:keep])
        with pytest.raises(CorruptDataError, match=r"cut.h5"):
            Shard(path).read("scan", 0, 60)


def test_damaged_chunk_names_the_file(shard_file):
    shard = Shard(shard_file)
    data = bytearray(shard_file.read_bytes())
    at = int(shard._chunked["scan"].offsets[1])
    data[at + 40] ^= 0xFF
    shard_file.write_bytes(data)
    shard = Shard(shard_file)
    shard.read("scan", 0, 20)
    with pytest.raises(CorruptDataError, match=r"s\.h5 is damaged: chunk 1 of column 'scan'"):
        shard.read("scan", 0, 60)


def test_missing_and_out_of_range(shard_file, tmp_path):
    with pytest.raises(DatasetNotFoundError, match="missing"):
        Shard(tmp_path / "none.h5")
    shard = Shard(shard_file)
    for start, stop in ((-1, 3), (0, 61), (5, 4)):
        with pytest.raises(IndexError, match="0 to 60"):
            shard.read("step", start, stop)
    with pytest.raises(IndexError):
        shard.read_rows("scan", [60])
    with pytest.raises(KeyError, match="robot_state"):
        shard.read("velocity", 0, 1)
    assert shard.read("scan", 5, 5).shape == (0, 1080)


def _sum(shard):
    return int(shard.read("scan", 0, 60).sum(dtype=np.int64))


def test_pickle_threads_and_fork(shard_file):
    shard = Shard(shard_file)
    expected = _sum(shard)
    again = pickle.loads(pickle.dumps(shard))  # noqa: S301
    assert _sum(again) == expected
    with ThreadPoolExecutor(8) as pool:
        assert set(pool.map(lambda _: _sum(shard), range(40))) == {expected}
    shard.close()
    assert _sum(shard) == expected
    if "fork" in multiprocessing.get_all_start_methods():
        pid = os.fork()
        if pid == 0:
            os._exit(0 if _sum(shard) == expected else 1)
        assert os.waitpid(pid, 0)[1] == 0
