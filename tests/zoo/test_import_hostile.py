"""Files made to harm: refused with one clear line, cheaply, and nothing in them is run."""

import base64
import io
import json
import os
import pickle
import time
import tracemalloc
import zipfile

import numpy as np
import oracles_models as oracles
import pytest
import torch

from navrep_data.errors import LONGEST_MESSAGE, CheckpointError, ConfigError
from navrep_data.models import checkpoint
from navrep_data.zoo.importers import load_any, load_controller_zip, load_tf_json, load_torch_world_model
from navrep_data.zoo.importers_sb2 import controller_variables, end_to_end_variables

pytestmark = pytest.mark.slow  # seconds in all; `make test` runs them


class Bomb:
    """Makes a folder when it is unpickled."""

    def __init__(self, at):
        self.at = str(at)

    def __reduce__(self):
        return os.mkdir, (self.at,)


@pytest.fixture
def bang(tmp_path):
    """Where the bombs of a test go off; they are shown to work first, and must not have at the end."""
    probe = tmp_path / "probe"
    pickle.loads(pickle.dumps(Bomb(probe)))  # noqa: S301
    assert probe.is_dir()
    yield tmp_path / "bang"
    assert not (tmp_path / "bang").exists(), "code from a file was run"


def refused(load, path, words):
    """The file is refused with these words, on one line."""
    with pytest.raises(CheckpointError, match=words) as caught:
        load(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) <= LONGEST_MESSAGE


def refused_cheaply(load, path, words):
    """And in less time and memory than reading it would take."""
    tracemalloc.start()
    start = time.process_time()  # not the clock: other programs may be at work
    refused(load, path, words)
    took, peak = time.process_time() - start, tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert took < 5
    assert peak < 8e6


# --- stable-baselines 2 zips ------------------------------------------------------------------------------------


def arrays_of(shapes, seed=0):
    rng = np.random.default_rng(seed)
    return {name: rng.normal(0, 0.1, shape).astype(np.float32) for name, shape in shapes}


def npz_bytes(arrays, compressed=False):
    buffer = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(buffer, **arrays)
    return buffer.getvalue()


def write_zip(path, arrays=None, *, names=None, parameters=None, data=b"{}", more=None, compression=zipfile.ZIP_STORED):
    arrays = arrays_of(controller_variables(37)) if arrays is None else arrays
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr("data", data)
        archive.writestr("parameter_list", json.dumps(list(arrays) if names is None else names))
        archive.writestr("parameters", npz_bytes(arrays) if parameters is None else parameters)
        for name, value in (more or {}).items():
            archive.writestr(name, value)
    return path


def test_good_zips_are_read(tmp_path):
    for n in (37, 1085):
        assert (
            load_controller_zip(write_zip(tmp_path / "c.zip", arrays_of(controller_variables(n)))).config.n_inputs == n
        )
    for lidar in ("1d", "rings"):
        network = load_controller_zip(write_zip(tmp_path / "e.zip", arrays_of(end_to_end_variables(lidar))))
        assert network.config.lidar == lidar


def test_serialised_blobs_are_ignored(tmp_path, bang):
    blob = base64.b64encode(pickle.dumps(Bomb(bang))).decode()
    data = json.dumps({"policy": {":type:": "x", ":serialized:": blob}, "learning_rate": {":serialized:": blob}})
    load_controller_zip(write_zip(tmp_path / "c.zip", data=data))
    load_controller_zip(write_zip(tmp_path / "d.zip", data=pickle.dumps(Bomb(bang))))


def test_pickled_arrays_are_refused(tmp_path, bang):
    arrays = arrays_of(controller_variables(37))
    arrays["model/q/b:0"] = np.array([Bomb(bang), Bomb(bang)], dtype=object)
    refused(load_controller_zip, write_zip(tmp_path / "c.zip", arrays), "dtype object|no npz of plain arrays")
    bare = write_zip(tmp_path / "d.zip", parameters=pickle.dumps(Bomb(bang)))
    refused(load_controller_zip, bare, "no npz of plain arrays")


def test_bombs_are_refused_unopened(tmp_path):
    zeros = bytes(60 << 20)
    for name in ("data", "parameters"):
        bomb = write_zip(tmp_path / f"{name}.zip", **{name: zeros}, compression=zipfile.ZIP_DEFLATED)
        assert bomb.stat().st_size < 2 << 20
        refused_cheaply(load_controller_zip, bomb, "unpacks to 3 members of 6|'data' has")
    inner = io.BytesIO()
    with zipfile.ZipFile(inner, "w", zipfile.ZIP_DEFLATED) as npz:
        npz.writestr("model/pi_fc0/w:0.npy", zeros)
    refused_cheaply(
        load_controller_zip, write_zip(tmp_path / "n.zip", parameters=inner.getvalue()), "no npz of plain arrays"
    )
    many = write_zip(tmp_path / "m.zip", more={f"f{i}": b"" for i in range(2000)})
    refused_cheaply(load_controller_zip, many, "2003 members")


def test_arrays_that_claim_more_than_they_hold_are_refused_cheaply(tmp_path):
    for shape in ((10**9, 64), (37, 64, 1), (2**40,), (-1, 64)):
        head = io.BytesIO()
        np.lib.format.write_array_header_1_0(head, {"descr": "<f4", "fortran_order": False, "shape": shape})
        inner = io.BytesIO()
        with zipfile.ZipFile(inner, "w") as npz:
            npz.writestr("model/pi_fc0/w:0.npy", head.getvalue() + bytes(64))
        bad = write_zip(tmp_path / "c.zip", parameters=inner.getvalue())
        refused_cheaply(load_controller_zip, bad, "claims shape|no npz of plain arrays")


def test_wrong_arrays_are_refused(tmp_path):
    good = arrays_of(controller_variables(37))
    names = list(good)
    wide = {**good, "model/vf_fc0/w:0": np.zeros((38, 64), np.float32)}
    for arrays, words in (
        (wide, r"'model/vf_fc0/w:0' has shape \(38, 64\), expected \(37, 64\)"),
        ({**good, "model/pi/w:0": np.zeros((64, 2))}, "expected float32"),
        ({k: good[k] for k in names[:-1]}, "names no network"),
        ({k: good[k] for k in reversed(names)}, "names no network"),
        ({**good, "model/q/b:0": np.array([np.inf, 0], np.float32)}, "holds NaN or infinity"),
        (arrays_of(controller_variables(8193)), "bytes, expected at most|names no network"),
    ):
        refused(load_controller_zip, write_zip(tmp_path / "c.zip", arrays), words)
    refused(load_controller_zip, write_zip(tmp_path / "c.zip", names={"a": 1}), "names no network")
    refused(load_controller_zip, write_zip(tmp_path / "c.zip", more={"x": b""}), "no zip of stable-baselines 2")


def test_damaged_zips_are_refused(tmp_path):
    """Cut anywhere, or with any byte changed: an error of ours, or the very same weights."""
    path = write_zip(tmp_path / "c.zip")
    good = path.read_bytes()
    expected = load_controller_zip(path).state_dict()
    rng = np.random.default_rng(0)
    for cut in (0, 1, 100, len(good) // 2, len(good) - 1):
        path.write_bytes(good[:cut])
        refused(load_controller_zip, path, "no zip file")
    noticed = 0
    for at in rng.integers(0, len(good), 150):
        path.write_bytes(good[:at] + bytes([good[at] ^ (1 << rng.integers(8))]) + good[at + 1 :])
        try:
            loaded = load_controller_zip(path).state_dict()
        except CheckpointError:
            noticed += 1
        else:
            assert all(torch.equal(v, loaded[k]) for k, v in expected.items())
    assert noticed > 100


# --- torch state dicts ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def joint_state():
    torch.manual_seed(0)
    state = {}
    for name, value in checkpoint.make("joint", {"lidar": "1d"}).state_dict().items():
        value = value.squeeze(2) if value.ndim == 4 else value
        state[name.replace("vae.", "convVAE.", 1)] = value.clone()
    return state


def saved(state, path):
    torch.save(state, path)
    return path


def test_good_state_dicts_are_read(joint_state, tmp_path):
    model = load_torch_world_model(saved(joint_state, tmp_path / "w"))
    weights = model.state_dict()
    torch.testing.assert_close(weights["vae.fc1.weight"], joint_state["convVAE.fc1.weight"])
    (tmp_path / "w").unlink()  # the weights are copies, not views of the file
    assert all(bool(torch.isfinite(v).all()) for v in weights.values())


def test_hostile_pickles_are_refused(tmp_path, bang, joint_state):
    bare = tmp_path / "bare"
    bare.write_bytes(pickle.dumps(Bomb(bang)))
    refused(load_torch_world_model, bare, "no zip file")
    refused(load_any, bare, "no file of weights that can be read")
    torch.save({"pos_emb": Bomb(bang)}, tmp_path / "zip")
    refused(load_torch_world_model, tmp_path / "zip", "no plain torch state dict")
    refused(load_any, tmp_path / "zip", "no plain torch state dict")
    torch.save({**joint_state, "extra": Bomb(bang)}, tmp_path / "mixed")
    refused(load_torch_world_model, tmp_path / "mixed", "no plain torch state dict")
    torch.save({**joint_state, "extra": bytearray(8)}, tmp_path / "room")  # torch's own list allows bytearray(2**40)
    refused(load_torch_world_model, tmp_path / "room", "names .*bytearray|holds a dict")
    torch.save(joint_state, tmp_path / "old", _use_new_zipfile_serialization=False)
    refused(load_torch_world_model, tmp_path / "old", "no zip file")


def edit_zip(source, target, change, compression=zipfile.ZIP_STORED):
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w", compression, compresslevel=1) as new:
        for info in old.infolist():
            new.writestr(info.filename, change(info.filename, old.read(info)))
    return target


def test_tensors_that_claim_more_than_they_hold_are_refused(joint_state, tmp_path):
    """A pickle may claim any number of values for a stored tensor; none may be read from beyond the file."""
    path = saved(joint_state, tmp_path / "w")
    cut = edit_zip(path, tmp_path / "cut", lambda name, data: data[:16] if name.endswith("/data/0") else data)
    refused(load_torch_world_model, cut, "it is damaged|no plain torch state dict")
    last = max(int(n.rsplit("/", 1)[1]) for n in zipfile.ZipFile(path).namelist() if "/data/" in n)
    end = edit_zip(path, tmp_path / "end", lambda n, data: b"" if n.endswith(f"/data/{last}") else data)
    refused(load_torch_world_model, end, "it is damaged|no plain torch state dict")


def test_other_state_dicts_are_refused(joint_state, tmp_path):
    path = tmp_path / "w"
    first = "convVAE.encoder.0.weight"
    for state, words in (
        ({k: v for k, v in joint_state.items() if k != "ln_f.bias"}, "lacks the weights 'ln_f.bias'"),
        ({**joint_state, "hook": torch.zeros(1)}, "'hook', unknown in a joint model"),
        ({**joint_state, first: torch.zeros(32, 1, 9)}, r"has shape \(32, 1, 9\)"),
        ({**joint_state, first: joint_state[first].double()}, "names .torch DoubleStorage"),
        ({**joint_state, first: torch.full((32, 1, 8), float("nan"))}, "holds NaN or infinity"),
        ({**joint_state, first: torch.zeros(1).expand(1 << 20, 1 << 20, 1 << 10)}, "has shape"),
        ({**joint_state, first: torch.zeros(32, 1, 8).to_sparse()}, "names .torch._utils _rebuild_sparse_tensor"),
        ({}, "lacks 'convVAE.encoder.0.weight'"),
        ([1, 2], "expected a dictionary of named tensors"),
        ({"a": "b"}, "expected a dictionary of named tensors"),
    ):
        refused(load_torch_world_model, saved(state, path), words)


def test_torch_bombs_are_refused_unopened(joint_state, tmp_path):
    path = saved(joint_state, tmp_path / "w")
    packed = edit_zip(path, tmp_path / "z", lambda _, data: data, zipfile.ZIP_DEFLATED)
    refused_cheaply(load_torch_world_model, packed, "is compressed")
    fat = edit_zip(path, tmp_path / "f", lambda n, d: bytes(1 << 20) if n.endswith(".pkl") else d)
    refused_cheaply(load_torch_world_model, fat, "far beyond a list of tensors")
    big = edit_zip(
        path, tmp_path / "b", lambda n, d: bytes(1 << 30) if n.endswith("version") else d, zipfile.ZIP_DEFLATED
    )
    refused_cheaply(load_torch_world_model, big, "unpacks to")
    odd = edit_zip(path, tmp_path / "o", lambda n, d: b"big" if n.endswith("byteorder") else d)
    refused_cheaply(load_torch_world_model, odd, "big-endian")
    with open(tmp_path / "huge", "wb") as handle:
        handle.truncate(1 << 33)
    refused_cheaply(load_torch_world_model, tmp_path / "huge", "it is not read")


# --- JSON -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def v_lists():
    rng = np.random.default_rng(0)
    return [rng.integers(-900, 900, shape).tolist() for shape in oracles.tf_shapes("vae_1d")]


def test_other_json_is_refused(tmp_path, v_lists):
    path = tmp_path / "v.json"

    def with_first(value):
        return [value, *v_lists[1:]]

    ragged = with_first([[[1] * 32]] * 7 + [[[1] * 31]])
    words_in = with_first(np.full((8, 1, 32), "1").tolist())
    for lists, words in (
        (v_lists[:-1], "holds 21 arrays, expected 22"),
        (ragged, "no regular array|has shape"),
        (words_in, "expected .* and integers"),
        (with_first(np.full((8, 1, 32), 0.5).tolist()), "float64, expected .* and integers"),
        (with_first(np.full((8, 1, 32), True).tolist()), "bool, expected .* and integers"),
        (with_first(np.zeros((9, 1, 32), int).tolist()), r"has shape \(9, 1, 32\)"),
        (with_first([[[10**30] * 32]] * 8), "object, expected|no regular array"),
        (with_first([[[10**9] * 32]] * 8), "it is damaged"),
        (with_first([[[-(2**63)] * 32]] * 8), "it is damaged"),
        (with_first(None), "has shape"),
        ({"a": v_lists}, "holds 0 arrays"),
        (3, "holds 0 arrays"),
    ):
        path.write_text(json.dumps(lists))
        refused(lambda p: load_tf_json(p, "vae_1d"), path, words)
    with pytest.raises(ConfigError, match="expected one of: vae_1d, vae_rings, memory"):
        load_tf_json(path, "vae")


def test_bad_or_huge_json_is_refused(tmp_path, bang, v_lists):
    path = tmp_path / "v.json"
    for data in (b"", b"[", b"[" * 2000, b"\xff\xfe", b"[" + b"9" * 10_000 + b"]", pickle.dumps(Bomb(bang))):
        path.write_bytes(data)
        refused(lambda p: load_tf_json(p, "vae_1d"), path, "not valid JSON")
    for data in (b"[" * 100_000, b"[" + b"[]," * 1_000_000 + b"1]", b"[" + b"1," * 2_900_000 + b"1]"):
        path.write_bytes(data)
        refused_cheaply(lambda p: load_tf_json(p, "vae_1d"), path, "it is not parsed|bytes, expected at most")
    path.write_text(json.dumps([v_lists[0]] * 22))
    refused(lambda p: load_any(p), path, "has shape")
    with open(path, "wb") as handle:
        handle.truncate(1 << 33)
    refused_cheaply(lambda p: load_tf_json(p, "vae_rings"), path, "it is not read")
    refused_cheaply(lambda p: load_tf_json(p, None), path, "it is not read")


def test_missing_files_say_how_to_get_them(tmp_path):
    for load in (load_any, load_controller_zip, load_torch_world_model, lambda p: load_tf_json(p, "memory")):
        refused(load, tmp_path / "none.zip", "navrep-data models fetch")
