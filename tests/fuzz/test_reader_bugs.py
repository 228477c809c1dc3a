"""What fuzzing and reading with suspicion found in the readers, one test each: refused with one line, cheaply."""

import io
import json
import math
import shutil
import sys
import time
import tracemalloc
import zipfile
import zlib

import h5py
import numpy as np
import pytest
from fuzz_edits import yaml_bomb
from fuzz_targets import TARGETS, load_files

from navrep_data.datasets import import_npz
from navrep_data.errors import (
    LONGEST_MESSAGE,
    CheckpointError,
    CorruptDataError,
    DatasetError,
    MapError,
    NavrepDataError,
)
from navrep_data.io import read_json
from navrep_data.io.npz import read_npz
from navrep_data.shards import Shard, read_recipe, read_worlds
from navrep_data.sim.maps import load_map
from navrep_data.zoo.importers_torch import load_torch_world_model

BY_NAME = {target.name: target for target in TARGETS}


def refused(read, error=NavrepDataError, match=None, seconds=5.0, megabytes=64):
    """`read` is refused on one short line, in little time and memory."""
    tracemalloc.start()
    start = time.process_time()
    with pytest.raises(error, match=match) as caught:
        read()
    took, peak = time.process_time() - start, tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(str(caught.value).splitlines()) == 1
    assert len(str(caught.value)) <= LONGEST_MESSAGE
    assert took < seconds
    assert peak < megabytes << 20


@pytest.fixture
def files(tmp_path, request):
    """A folder with the valid files of a target."""
    BY_NAME[request.param].make(tmp_path)
    return tmp_path


def of(name):
    return pytest.mark.parametrize("files", [name], indirect=True)


# --- JSON -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text", [b'{"a": "\\ud800"}', b'{"\\uDFFF": 1}', b'["\xed\xa0\x80"]', b'"\xff"', b"\xff\xfe1\0"]
)
def test_half_characters_and_other_encodings_are_no_json(tmp_path, text):
    (tmp_path / "a.json").write_bytes(text)
    refused(lambda: read_json(tmp_path / "a.json"), CorruptDataError, "is not valid JSON")


def test_pairs_of_surrogates_are_characters(tmp_path):
    (tmp_path / "a.json").write_bytes(b'["\\ud83d\\ude00"]')
    assert read_json(tmp_path / "a.json") == ["\U0001f600"]


def test_millions_of_empty_lists_are_not_parsed(tmp_path):
    (tmp_path / "a.json").write_bytes(b"[" + b"[]," * 1_000_000 + b"1]")
    refused(lambda: read_json(tmp_path / "a.json"), CorruptDataError, "1,000,001 lists and objects", megabytes=16)


@pytest.mark.slow
@of("manifest")
def test_a_manifest_that_is_nested_as_deep_as_python_parses(files):
    values = json.loads((files / "manifest.json").read_bytes())
    for depth in (300, 600, 900, 2000, 50_000):
        text = json.dumps({**values, "config": {"a": "@"}}).replace('"@"', "[" * depth + "]" * depth)
        (files / "manifest.json").write_text(text)
        refused(lambda: BY_NAME["manifest"].read(files), CorruptDataError)


@of("manifest")
@pytest.mark.parametrize(
    ("name", "key", "value"),
    [("action", "mean", None), ("action", "std", [1.0]), ("reward", "min", [1.0]), ("scan", "count", None),
     ("action", "max", [1, 2, "x"]), ("reward", "mean", True)],
)  # fmt: skip
def test_statistics_that_are_no_table(files, name, key, value):
    """Found by fuzzing: the card of such a manifest could not be written."""
    values = json.loads((files / "manifest.json").read_bytes())
    for statistics in (values["statistics"], values["shards"][0]["statistics"]):
        statistics["columns"][name][key] = value
    (files / "manifest.json").write_text(json.dumps(values))
    target = BY_NAME["manifest"]
    for file, data in target.seal(load_files(files)).items():
        (files / file).write_bytes(data)
    refused(lambda: target.read(files), CorruptDataError, "statistics' holds something else than numbers")


@pytest.mark.slow
@of("manifest")
@pytest.mark.parametrize("columns", [["a" * 100_000], ["scan"] * 10_000])
def test_column_names_without_end(files, columns):
    """Found by fuzzing: the refusal repeated them whole."""
    values = json.loads((files / "manifest.json").read_bytes())
    (files / "manifest.json").write_text(json.dumps({**values, "columns": columns}))
    refused(lambda: BY_NAME["manifest"].read(files), CorruptDataError, "field 'columns'")


@of("results")
@pytest.mark.parametrize(
    "change",
    [
        lambda v: v["episodes"].update(path_length=[10**400] * 6),
        lambda v: v["trajectories_cm"].update({"0": [10**400, 1]}),
        lambda v: v["settings"].pop("inference"),
        lambda v: v["settings"].update(physics=["original"]),
        lambda v: v["episodes"].update(steps=[math.pi * 1e300] * 6) or v["settings"].update(inference=None),
    ],
)
def test_results_with_numbers_too_large_or_settings_that_are_none(files, change):
    values = json.loads((files / "results.json").read_bytes())
    change(values)
    (files / "results.json").write_text(json.dumps(values))
    refused(lambda: BY_NAME["results"].read(files), CorruptDataError, "not a results file")


@of("latents")
def test_codes_whose_split_is_no_split(files):
    values = json.loads((files / "manifest.json").read_bytes())
    values["shards"][0]["split"] = [1]
    (files / "manifest.json").write_text(json.dumps(values))
    target = BY_NAME["latents"]
    for name, data in target.seal(load_files(files)).items():
        (files / name).write_bytes(data)
    refused(lambda: target.read(files), CorruptDataError, "lacks or garbles a field")


@pytest.mark.slow
@of("training")
@pytest.mark.parametrize("text", ["[]", "{}", '{"last": "step-/../.."}', '{"last": "step-00000099"}'])
def test_a_training_that_names_no_checkpoint(files, text):
    (files / "run" / "progress.json").write_text(text)
    refused(lambda: BY_NAME["training"].read(files), CheckpointError, "start anew in another folder")


@pytest.mark.slow
@of("training")
@pytest.mark.parametrize("text", ["[]", "{}", '{"step": "x"}', '{"best": null, "step": {}, "tokens": 1}'])
def test_a_training_that_stands_nowhere(files, text):
    (path,) = files.glob("run/checkpoints/*/training.json")
    path.write_text(text)
    refused(lambda: BY_NAME["training"].read(files), CheckpointError, "lacks or garbles a field")


@pytest.mark.parametrize("name", ["checkpoint", "training"])
def test_headers_of_safetensors_that_are_one_long_word(tmp_path, name):
    """Found by fuzzing: the refusal repeated it whole."""
    target = BY_NAME[name]
    target.make(tmp_path)
    for path in tmp_path.rglob("model.safetensors"):
        data = path.read_bytes()
        header = b'"' + b"a" * 50_000 + b'"'
        path.write_bytes(len(header).to_bytes(8, "little") + header + data[8 + int.from_bytes(data[:8], "little") :])
    for file, data in target.seal(load_files(tmp_path)).items():
        (tmp_path / file).write_bytes(data)
    refused(lambda: target.read(tmp_path), CheckpointError, "is not a safetensors file")


@pytest.mark.parametrize(
    ("name", "file"),
    [("checkpoint", "config.json"), ("policy", "saved/policy.json"), ("latents", "manifest.json")],
)
def test_versions_of_several_lines(tmp_path, name, file):
    """Found by fuzzing: the refusal showed them as they are."""
    target = BY_NAME[name]
    target.make(tmp_path)
    values = json.loads((tmp_path / file).read_bytes())
    (tmp_path / file).write_text(json.dumps({**values, "format_version": "1\n\n"}))
    refused(lambda: target.read(tmp_path), NavrepDataError, "has format version '1")


@pytest.mark.slow
@of("policy")
@pytest.mark.parametrize("key", ["features", "lidar", "context"])
def test_a_policy_that_does_not_say_what_it_sees(files, key):
    path = files / "saved" / "policy.json"
    values = json.loads(path.read_bytes())
    del values[key]
    path.write_text(json.dumps(values))
    refused(lambda: BY_NAME["policy"].read(files), CheckpointError)


# --- YAML and images --------------------------------------------------------------------------------------------


@of("map")
@pytest.mark.parametrize("merge", [False, True])
def test_aliases_that_stand_for_billions_of_values(files, merge):
    text = (files / "pgm.yaml").read_text()
    for key in ("origin", "image", "negate", "mode", "resolution"):
        (files / "pgm.yaml").write_text(yaml_bomb(15, key, merge) + text.replace(f"{key}:", "other:"))
        refused(lambda: load_map(files / "pgm.yaml"), MapError, "it has an alias")


@pytest.mark.slow
@of("map")
@pytest.mark.parametrize(
    "value", ["!!int ''", "!!float ''", "!!timestamp x", "!!bool x", "0x" + "f" * 20_000, "[0x" + "f" * 20_000 + "]"]
)
def test_values_that_the_yaml_parser_stumbles_over(files, value):
    text = (files / "pgm.yaml").read_text().replace("resolution: 0.05", f"resolution: {value}")
    (files / "pgm.yaml").write_text(text)
    refused(lambda: load_map(files / "pgm.yaml"), MapError)


# --- zip and npy ------------------------------------------------------------------------------------------------


def npy(header, data=b""):
    text = header.encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + data


def packed(members, method=zipfile.ZIP_DEFLATED):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return buffer.getvalue()


@pytest.mark.slow
def test_npz_files_that_claim_or_unpack_too_much():
    """Sizes in headers are compared with bytes that are there before anything is made of them."""
    head = "{'descr': '%s', 'fortran_order': False, 'shape': %s}"
    for data, words in (
        (packed({"a.npy": npy(head % ("<f4", "(1000000000000,)"))}), "does not fit"),
        (packed({"a.npy": npy(head % ("|O", "(1,)"), b"x" * 8)}), "expected plain numbers"),
        (packed({"a.npy": npy(head % ("<f4", "(-1,)"))}), "expected plain numbers"),
        (packed({"a.npy": bytes(64 << 20)}), "or more than 1,000,000 bytes unpacked"),
        (packed({"a.npy": b"x"}, zipfile.ZIP_LZMA), "stored or deflated"),
        (packed({"a.npy": b"x"}, zipfile.ZIP_BZIP2), "stored or deflated"),
        (packed({"a.npy": npy("(" * 300)}), None),
        (packed({f"{k}": b"" for k in range(1001)}), "1001 members"),
        (b"PK", None),
    ):
        refused(lambda data=data: read_npz(data, 1_000_000), ValueError, words, megabytes=32)


def test_npz_files_are_read_as_numpy_reads_them():
    buffer = io.BytesIO()
    arrays = {
        "a": np.arange(6.0).reshape(2, 3),
        "f": np.asfortranarray(np.eye(3, 2)),
        "s": np.float32(2),
        "n": np.ones(0),
    }
    np.savez_compressed(buffer, **arrays)
    found = read_npz(buffer.getvalue(), 1 << 20)
    assert all(np.array_equal(found[name], value) for name, value in arrays.items())
    assert all(found[name].dtype == value.dtype for name, value in arrays.items())


def broken_stream(data):
    """Return a zip whose first deflated member is damaged in the middle, sizes and names whole."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        info = next(i for i in archive.infolist() if i.compress_type == zipfile.ZIP_DEFLATED)
    names = data[info.header_offset + 26 : info.header_offset + 30]
    start = info.header_offset + 30 + int.from_bytes(names[:2], "little") + int.from_bytes(names[2:], "little")
    return data[: start + 2] + b"\xff" * 20 + data[start + 22 :]


@pytest.mark.parametrize("name", ["npz", "worlds"])
def test_damaged_deflate_streams(name, tmp_path):
    target = BY_NAME[name]
    target.make(tmp_path)
    path = sorted(tmp_path.iterdir())[0]
    path.write_bytes(broken_stream(path.read_bytes()))
    refused(lambda: target.read(tmp_path), DatasetError)


def test_damaged_and_oddly_packed_controllers(tmp_path):
    from navrep_data.zoo.importers import load_controller_zip

    target = BY_NAME["sb2-zip"]
    target.make(tmp_path)
    path = tmp_path / "model.zip"
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    path.write_bytes(packed(members))
    load_controller_zip(path)
    path.write_bytes(broken_stream(packed({"parameter_list": members.pop("parameter_list"), **members})))
    refused(lambda: load_controller_zip(path), CheckpointError, "cannot be unpacked")
    target.make(tmp_path)
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    path.write_bytes(packed(members, zipfile.ZIP_LZMA))
    refused(lambda: load_controller_zip(path), CheckpointError, "expected stored or deflated")


@of("worlds")
def test_worlds_packed_in_another_way(files):
    path = files / "worlds.npz"
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    path.write_bytes(packed(members, zipfile.ZIP_BZIP2))
    refused(lambda: read_worlds(path), CorruptDataError, "stored or deflated")


def test_a_damaged_map_cache_is_made_again(tmp_path, monkeypatch):
    from navrep_data.sim._map_cache import cached_on_disk

    monkeypatch.setenv("NAVREP_DATA_HOME", str(tmp_path))

    def get():
        return cached_on_disk("d", "k", (2, 2), lambda: np.ones((2, 2), np.float32), np.float32)

    get()
    (path,) = tmp_path.glob("maps/*.npz")
    head = "{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000,)}"
    for data in (b"", b"PK", packed({"values.npy": npy(head)}), packed({"values.npy": b"x"}, zipfile.ZIP_LZMA)):
        path.write_bytes(data)
        assert np.array_equal(get(), np.ones((2, 2)))


# --- HDF5 -------------------------------------------------------------------------------------------------------


@pytest.fixture
def shard(tmp_path):
    BY_NAME["shard"].make(tmp_path)
    return tmp_path / "shard.h5"


def again(path, name, **options):
    with h5py.File(path, "r+") as file:
        values = options.pop("data", file[name][()])
        del file[name]
        if "shape" in options:
            return file.create_dataset(name, dtype=values.dtype, **options)
        return file.create_dataset(name, data=values, **options)


@pytest.mark.parametrize("chunks", [None, (1 << 20,)])
def test_rows_that_are_not_there(shard, chunks):
    """Millions of rows that take no byte of the file would take gigabytes of memory."""
    rows = 10_000_000
    with h5py.File(shard, "r+") as file:
        for name in list(file):
            shape, dtype = (rows, *file[name].shape[1:]), file[name].dtype
            del file[name]
            file.create_dataset(
                name, shape=shape, dtype=dtype, chunks=chunks and (12, *shape[1:]), shuffle=bool(chunks)
            )
        file.attrs["rows"] = file.attrs["length"] = rows
    refused(lambda: Shard(shard), CorruptDataError, "lacks (rows|chunks) of column")


def bomb(path, name, **options):
    with h5py.File(path, "r+") as file:
        values = file[name][()]
        del file[name]
        made = file.create_dataset(name, data=values, chunks=values.shape, compression="gzip", **options)
        made.id.write_direct_chunk((0,) * values.ndim, zlib.compress(bytes(128 << 20), 1))


@pytest.mark.slow
def test_chunks_that_inflate_without_end(shard):
    bomb(shard, "scan", fletcher32=True)
    refused(lambda: Shard(shard).read("scan", 0, 1), CorruptDataError, "does not inflate to the expected")
    BY_NAME["shard"].make(shard.parent)
    bomb(shard, "reward")
    refused(lambda: Shard(shard).read("reward", 0, 1), CorruptDataError, "does not inflate to the expected")


def test_filters_in_an_order_that_only_the_library_reads(shard):
    with h5py.File(shard, "r+") as file:
        values = file["reward"][()]
        del file["reward"]
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_chunk(values.shape)
        plist.set_deflate(1)
        plist.set_shuffle()
        space = h5py.h5s.create_simple(values.shape)
        made = h5py.h5d.create(file.id, b"reward", h5py.h5t.py_create(values.dtype), space, dcpl=plist)
        h5py.Dataset(made)[...] = values
    refused(lambda: Shard(shard), CorruptDataError, r"uses HDF5 filters \[1, 2\]; expected shuffle and deflate")


def test_huge_chunks(shard):
    with h5py.File(shard, "r+") as file:
        rows = len(file["reward"])
        del file["reward"]
        file.create_dataset(
            "reward", shape=(rows,), dtype="f4", chunks=(20 << 20,), maxshape=(None,), compression="gzip"
        )
    refused(lambda: Shard(shard), CorruptDataError, "chunks of more than 67,108,864 bytes")


def test_chunks_that_share_their_bytes(shard):
    """Many chunks in one place would unpack to any size."""
    with h5py.File(shard) as file:
        places = [file["scan"].id.get_chunk_info(k) for k in range(2)]
    assert len(places) == 2
    first, second = (place.byte_offset.to_bytes(8, "little") for place in places)
    data = shard.read_bytes()
    # the key of the chunk index says how long it is, the pointer behind it where
    assert data.count(second) == 1
    shard.write_bytes(data.replace(second, first))
    refused(lambda: Shard(shard), CorruptDataError, "overlap|not readable|lacks chunks")


def test_a_user_block(shard):
    data = shard.read_bytes()
    with h5py.File(shard.with_name("block.h5"), "w", userblock_size=512) as file, h5py.File(io.BytesIO(data)) as old:
        for name in old:
            old.copy(name, file)
        for name, value in old.attrs.items():
            file.attrs[name] = value
    refused(lambda: Shard(shard.with_name("block.h5")), CorruptDataError, "user block of 512 bytes")


def test_what_plain_h5py_writes_is_still_read(shard):
    """Chunks across columns, chunks that deflate made no smaller, checksums, none at all."""
    before = Shard(shard)
    names = ("scan", "rings", "robot_state", "reward", "step", "is_first")
    expected = {name: before.read(name, 0, before.rows) for name in names}
    noise = np.random.default_rng(0).normal(size=expected["robot_state"].shape).astype(np.float32)
    expected["robot_state"] = noise
    again(shard, "scan", compression="gzip", chunks=(7, 100), shuffle=True, fletcher32=True)
    again(shard, "rings", compression="gzip", chunks=(5, 64, 9))
    again(shard, "robot_state", data=noise, compression="gzip", chunks=(3, 5))
    again(shard, "reward", compression="lzf", fletcher32=True)
    again(shard, "step", fletcher32=True)
    again(shard, "is_first", chunks=(1,), compression="gzip")
    with h5py.File(shard, "r+") as file:  # HDF5 leaves gzip out where it fails
        file["robot_state"].id.write_direct_chunk((6, 0), noise[6:9].tobytes(), filter_mask=1)
    with h5py.File(shard) as file:
        assert np.array_equal(file["robot_state"][()], noise)
    shard_again = Shard(shard)
    for name, values in expected.items():
        assert np.array_equal(shard_again.read(name, 0, len(values)), values), name
        assert np.array_equal(shard_again.read(name, 5, 17), values[5:17]), name
        assert np.array_equal(shard_again.read_rows(name, [20, 3, 11]), values[[20, 3, 11]]), name


@pytest.mark.parametrize("value", [np.inf, np.nan, np.array([1, 2]), "x"])
def test_attributes_that_are_no_numbers(shard, value):
    with h5py.File(shard, "r+") as file:
        file.attrs["seed"] = value
    refused(lambda: read_recipe(shard), CorruptDataError, "cannot be read as a shard")


def endless_heap(path):
    """Let the free space of every global heap be 0 bytes long: the library looks for what follows it for ever."""
    data = bytearray(path.read_bytes())
    heap = data.find(b"GCOL")
    assert heap >= 0
    while heap >= 0:
        item = heap + 16
        while int.from_bytes(data[item : item + 2], "little"):
            size = int.from_bytes(data[item + 8 : item + 16], "little")
            item += 16 + -(-size // 8) * 8
        data[item + 8 : item + 16] = bytes(8)
        heap = data.find(b"GCOL", heap + 1)
    path.write_bytes(data)


@pytest.mark.parametrize("name", ["format", "env", "config"])
def test_text_whose_heap_has_no_end(shard, name):
    """Found by fuzzing: HDF5 itself hung on reading the attribute."""
    with h5py.File(shard, "r+") as file:
        file.attrs[name] = file.attrs[name].decode()
    endless_heap(shard)
    refused(lambda: read_recipe(shard), CorruptDataError, f"attribute '{name}' is text of variable length")
    if name != "config":  # which is not needed to read rows
        refused(lambda: Shard(shard), CorruptDataError, f"attribute '{name}' is text of variable length")


def test_a_shard_needs_nothing_from_a_heap(shard):
    expected = Shard(shard).read("scan", 0, 8)
    endless_heap(shard)  # of the columns' attributes
    assert read_recipe(shard).env == "soadrl"
    assert np.array_equal(Shard(shard).read("scan", 0, 8), expected)


@pytest.mark.parametrize(
    "value",
    [h5py.Empty("S3"), np.array([b"navrep-data"]), np.bytes_(b"\xff"), np.bytes_(b"x" * (2 << 20)), np.complex64(1),
     np.array([(1,)], [("a", "i4")]), True, 1],
)  # fmt: skip
def test_attributes_that_are_no_text(shard, value):
    with h5py.File(shard, "r+") as file:
        file.attrs["format"] = value
    refused(lambda: read_recipe(shard), CorruptDataError, "cannot be read as a shard")
    refused(lambda: Shard(shard), CorruptDataError, "attribute 'format'")


@of("latents")
def test_codes_that_are_not_there(files):
    (path,) = files.glob("**/*.h5")
    with h5py.File(path, "r+") as file:
        shape = file["mu"].shape
        del file["mu"]
        file.create_dataset("mu", shape=shape, dtype="f4", chunks=(1, shape[1]), compression="gzip")
    target = BY_NAME["latents"]
    for name, data in target.seal(load_files(files)).items():
        (files / name).write_bytes(data)
    refused(lambda: target.read(files), CorruptDataError, "not stored in one piece")


@pytest.mark.parametrize(
    ("name", "file", "at", "size", "words"),
    [("bag-ros1", "bag.bag", 13, 2**32 - 1, "Header could not be read"),
     ("bag-mcap", "bag/bag.mcap", 9, 2**40, "Truncated record")],
)  # fmt: skip
def test_bags_that_claim_more_bytes_than_they_have(tmp_path, name, file, at, size, words):
    """Found by fuzzing: the first record's length was set aside in memory before anything was read."""
    pytest.importorskip("rosbags")
    target = BY_NAME[name]
    target.make(tmp_path)
    data = bytearray((tmp_path / file).read_bytes())
    width = 4 if name == "bag-ros1" else 8
    data[at : at + width] = size.to_bytes(width, "little")
    (tmp_path / file).write_bytes(data)
    refused(lambda: target.read(tmp_path), CorruptDataError, words)


def test_one_sequence_of_more_rows_than_fit_into_memory(tmp_path, monkeypatch):
    from navrep_data.shards import verify
    from navrep_data.testing import tiny_dataset

    root = tiny_dataset(tmp_path / "d", n=1, length=30, humans=1)
    # the package has a function of the module's name
    monkeypatch.setattr(sys.modules["navrep_data.shards.verify"], "MAX_SEQUENCE_BYTES", 100_000)
    (problem,) = verify(root).problems
    assert "30 rows take" in problem.what
    shutil.rmtree(root)


def test_worlds_with_an_endless_directory(tmp_path):
    path = tmp_path / "worlds.npz"
    with zipfile.ZipFile(path, "w") as archive:
        for k in range(1500):
            archive.writestr(f"{k}.npy", b"")
    refused(lambda: read_worlds(path), CorruptDataError, match="more than 1000 members")


def test_npz_with_long_names_of_arrays(tmp_path):
    path = tmp_path / "000_scans_robotstates_actions_rewards_dones.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a" * 60_000 + ".npy", b"")
    refused(
        lambda: import_npz([path], tmp_path / "out"),
        CorruptDataError,
        match=r"no array 'scans' \(it has: a+ \[...\] a+.npy\); ex",
    )


@pytest.mark.parametrize("name", ["archive/" + "n" * 5000, "archive/" + "n\n" * 2500], ids=["long", "many lines"])
def test_zip_with_a_member_of_a_long_name(tmp_path, name):
    """Found by fuzzing: a refusal of 5,114 characters."""
    path = tmp_path / "model.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, b"x" * 40)
    refused(lambda: load_torch_world_model(path), CheckpointError, match="^[^\n]*torch never does; the file is refused")


def test_npz_with_a_member_larger_than_its_file(tmp_path):
    path = tmp_path / "claims.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", b"x" * 40)
    data = bytearray(path.read_bytes())
    at = data.index(b"PK\x01\x02")
    data[at + 20 : at + 24] = (0x7FFFFFF0).to_bytes(4, "little")  # its packed size, in the directory
    path.write_bytes(data)

    def read():
        with path.open("rb") as file:
            read_npz(file, 1 << 20)

    refused(read, ValueError, match="more than the file's")
