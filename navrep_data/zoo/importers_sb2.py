"""Reader of the released controllers and end-to-end networks: zips of stable-baselines 2."""

from __future__ import annotations

import io
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from navrep_data.errors import CheckpointError
from navrep_data.io.npz import PLAIN_METHODS
from navrep_data.models import checkpoint
from navrep_data.models.config import ControllerConfig, EndToEndConfig
from navrep_data.models.controllers import Controller, EndToEnd
from navrep_data.models.vae import CHANNELS, FLAT_SIZE
from navrep_data.zoo.importers_bounds import HEADROOM, MAX_MEMBERS, check_size, read_member, zip_members
from navrep_data.zoo.importers_tf import Arrays, ArrayShapes, channels_first, conv_from_tf, tensor

_MEMBERS = ("data", "parameter_list", "parameters")
# Its base64 pickles take up to 50 kB; it is not opened at all, only bounded.
_MAX_DATA = 1 << 20
_MAX_ARRAY_HEADER = 256


def controller_variables(n_inputs: int) -> ArrayShapes:
    """Return names and shapes of the arrays of a stable-baselines 2 MlpPolicy, in the zip's order."""
    shapes: ArrayShapes = []
    for layer, n in (("pi_fc0", n_inputs), ("vf_fc0", n_inputs), ("pi_fc1", 64), ("vf_fc1", 64)):
        shapes += [(f"model/{layer}/w:0", (n, 64)), (f"model/{layer}/b:0", (64,))]
    return shapes + _output_variables("w", "b")


def end_to_end_variables(lidar: str) -> ArrayShapes:
    """Return names and shapes of the arrays of the authors' end-to-end policy, in the zip's order."""
    kernels: list[tuple[int, ...]] = [(4, 4)] * 4 if lidar == "rings" else [(k,) for k in (8, 9, 6, 4)]
    shapes: ArrayShapes = []
    for i, kernel in enumerate(kernels):
        shapes += [(f"model/enc_conv{i + 1}/kernel:0", (*kernel, *CHANNELS[i : i + 2]))]
        shapes += [(f"model/enc_conv{i + 1}/bias:0", (CHANNELS[i + 1],))]
    for layer, sizes in (
        ("enc_fc_mu", (FLAT_SIZE, 32)),
        ("pi_fc0", (37, 64)),
        ("pi_fc1", (64, 64)),
        ("vf_fc0", (37, 64)),
        ("vf_fc1", (64, 64)),
    ):
        shapes += [(f"model/{layer}/kernel:0", sizes), (f"model/{layer}/bias:0", sizes[1:])]
    return shapes + _output_variables("kernel", "bias")


def _output_variables(weight: str, bias: str) -> ArrayShapes:
    return [
        (f"model/vf/{weight}:0", (64, 1)),
        (f"model/vf/{bias}:0", (1,)),
        ("model/pi/w:0", (64, 2)),
        ("model/pi/b:0", (2,)),
        ("model/pi/logstd:0", (1, 2)),
        ("model/q/w:0", (64, 2)),
        ("model/q/b:0", (2,)),
    ]


# The widest input of an MlpPolicy that is read: the CARCH run has 1085.
_WIDEST = 8192


def load_controller_zip(path: Path | str) -> Controller | EndToEnd:
    """Read a released controller or end-to-end network: a zip of stable-baselines 2.

    Parameters
    ----------
    path : path-like
        ``*_ckpt.zip``.

    Raises
    ------
    CheckpointError
        If the file is no such zip, too large, or its arrays are not those of a known network.

    Notes
    -----
    Of the three members, ``data`` (JSON with serialised Python objects) is not opened at all; ``parameter_list``
    tells which network it is; ``parameters`` is read by ``numpy.load(allow_pickle=False)`` after its array headers
    were compared with the shapes expected.
    """
    path = Path(path)
    limit = 4 * 2 * 64 * _WIDEST + (1 << 20)
    check_size(path, limit, "a controller")
    members = zip_members(path, limit)
    if sorted(members) != sorted(_MEMBERS):
        raise CheckpointError(
            f"{path} holds {', '.join(sorted(members)) or 'nothing'}, expected {', '.join(_MEMBERS)}: it is "
            "no zip of stable-baselines 2."
        )
    for name, bound in (("data", _MAX_DATA), ("parameter_list", HEADROOM), ("parameters", limit)):
        if members[name].file_size > bound:
            raise CheckpointError(
                f"{path}: {name!r} has {members[name].file_size:,} bytes unpacked, expected at most {bound:,}."
            )
    listed = read_member(path, members["parameter_list"])
    try:
        names = json.loads(listed)
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"{path}: 'parameter_list' is not valid JSON ({error}).") from error
    arrays_file = read_member(path, members["parameters"])
    shapes = _which_network(names, _array_headers(arrays_file, path), path)
    arrays = _read_arrays(arrays_file, shapes, path)
    network = _network_of(arrays)
    checkpoint.put_weights(network, _actor_critic_state(arrays), str(path))
    return network


def _which_network(names: Any, found: dict[str, tuple[int, ...]], path: Path) -> ArrayShapes:
    """Return the arrays of the network whose names these are, after comparing all shapes."""
    candidates = [end_to_end_variables("1d"), end_to_end_variables("rings")]
    first = found.get("model/pi_fc0/w:0", ())
    if len(first) == 2 and 1 <= first[0] <= _WIDEST:
        candidates.append(controller_variables(first[0]))
    for shapes in candidates:
        if names == [name for name, _ in shapes] and found == dict(shapes):
            return shapes
    known = next((dict(s) for s in candidates if names == [name for name, _ in s]), None)
    if known is None:
        raise CheckpointError(f"{path}: 'parameter_list' names no network of NavRep's.")
    wrong = next((n for n in sorted({*known, *found}) if known.get(n) != found.get(n)), "")
    raise CheckpointError(
        f"{path}: {wrong!r} has shape {found.get(wrong)}, expected {known.get(wrong)} in a network of NavRep's."
    )


def _array_headers(data: bytes, path: Path) -> dict[str, tuple[int, ...]]:
    """Return the shapes that the arrays of an npz claim, checked against the bytes that they have."""
    shapes: dict[str, tuple[int, ...]] = {}
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as npz:
            infos = npz.infolist()
            if len(infos) > MAX_MEMBERS:
                raise CheckpointError(f"{path}: 'parameters' holds {len(infos)} arrays, expected about 20.")
            if any(info.compress_type not in PLAIN_METHODS for info in infos):
                raise ValueError("arrays are packed in another way than stored or deflated")
            for info in infos:
                name = info.filename.removesuffix(".npy")
                with npz.open(info) as member:
                    head = io.BytesIO(member.read(_MAX_ARRAY_HEADER))
                version = np.lib.format.read_magic(head)
                if version != (1, 0):
                    raise ValueError(f"array format {version}")
                shape, _, dtype = np.lib.format.read_array_header_1_0(head)
                if dtype != np.float32 or head.tell() + 4 * math.prod(shape) != info.file_size or name in shapes:
                    raise CheckpointError(
                        f"{path}: array {name!r} claims shape {shape} and dtype {dtype} in {info.file_size:,} "
                        "bytes, expected float32 and as many bytes as that takes."
                    )
                shapes[name] = shape
    except Exception as error:  # damaged archives raise a dozen kinds, struct.error and zlib.error among them
        if isinstance(error, CheckpointError):
            raise
        raise CheckpointError(f"{path}: 'parameters' is no npz of plain arrays ({error}).") from error
    return shapes


def _read_arrays(data: bytes, shapes: ArrayShapes, path: Path) -> Arrays:
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as npz:
            return {name: np.ascontiguousarray(npz[name]) for name, _ in shapes}
    except Exception as error:
        raise CheckpointError(f"{path}: 'parameters' cannot be read ({error}).") from error


def _network_of(arrays: Arrays) -> Controller | EndToEnd:
    if "model/enc_conv1/kernel:0" in arrays:
        return EndToEnd(EndToEndConfig("rings" if arrays["model/enc_conv1/kernel:0"].ndim == 4 else "1d"))
    return Controller(ControllerConfig(arrays["model/pi_fc0/w:0"].shape[0]))


def _actor_critic_state(arrays: Arrays) -> dict[str, Tensor]:
    places = {"pi_fc0": "pi.0", "pi_fc1": "pi.2", "vf_fc0": "vf.0", "vf_fc1": "vf.2", "pi": "mean", "vf": "value"}
    places |= {"q": "q", "enc_fc_mu": "fc"} | {f"enc_conv{i + 1}": f"encoder.{2 * i}" for i in range(4)}
    state: dict[str, Tensor] = {}
    for key, value in arrays.items():
        _, layer, role = key.removesuffix(":0").split("/")
        if role == "logstd":
            state["logstd"] = tensor(value[0])
        elif role in ("b", "bias"):
            state[f"{places[layer]}.bias"] = tensor(value)
        elif layer.startswith("enc_conv"):
            state[f"{places[layer]}.weight"] = tensor(conv_from_tf(value))
        else:
            value = channels_first(value.T) if layer == "enc_fc_mu" else value.T
            state[f"{places[layer]}.weight"] = tensor(value)
    return state
