"""Worlds files: what stands around the robot in each episode, as a small npz beside each shard.

With them scenes can be drawn and other sensors recomputed. Ragged data are flat arrays with offsets. The zip
container is written here, not by the zipfile module: no timestamps, and libdeflate's output, so that equal content
is equal bytes.
"""

from __future__ import annotations

import io
import struct
import zipfile
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import deflate
import numpy as np
import numpy.typing as npt
from isal import isal_zlib

from navrep_data.errors import CorruptDataError
from navrep_data.io import reading
from navrep_data.io.npz import PLAIN_METHODS

MAX_WORLDS_BYTES = 256 << 20
_DIRECTORY_ENTRY, _MAX_ENTRIES = b"PK\x01\x02", 1000
"""What a member of a zip is announced by in its directory, and how many a worlds file may have: it has about twenty."""
_ADVICE = "get the file again, or run the generate command again"
# Name -> (dtype, shape after the first axis, what the first axis counts).
_FIELDS: dict[str, tuple[str, tuple[int, ...], str]] = {
    "sequence": ("<i4", (), "episode"),
    "episode": ("<i4", (), "episode"),
    "row": ("<i4", (), "episode"),
    "robot_start": ("<f4", (3,), "episode"),
    "robot_goal": ("<f4", (2,), "episode"),
    "robot_v_pref": ("<f4", (), "episode"),
    "vertices": ("<f4", (2,), "vertex"),
    "polygon_offset": ("<i8", (), "polygon+1"),
    "episode_polygon_offset": ("<i8", (), "episode+1"),
    "has_border": ("|b1", (), "episode"),
    "human_offset": ("<i8", (), "episode+1"),
    "human_start": ("<f4", (3,), "human"),
    "human_goal": ("<f4", (2,), "human"),
    "human_v_pref": ("<f4", (), "human"),
    "human_sees_robot": ("|b1", (), "human"),
    "human_gait": ("<f4", (3,), "human"),
}
WORLD_FIELDS = tuple(_FIELDS)
"""Names of the arrays of a worlds file, in file order."""
# In place of polygons, datasets on maps say which map: its name, the hash of its content, and the scenario or ''.
_MAP_FIELDS: dict[str, tuple[str, tuple[int, ...], str]] = {
    "map": ("|S64", (), "episode"),
    "map_hash": ("|S64", (), "episode"),
    "scenario": ("|S64", (), "episode"),
}
MAP_WORLD_FIELDS = tuple(_MAP_FIELDS)
"""Names of the arrays that the worlds files of datasets on maps have besides, in file order."""
# Reserved for what is drawn per episode. A group is there as a whole or not at all.
_DRAWN_GROUPS: tuple[dict[str, tuple[str, tuple[int, ...], str]], ...] = (
    {
        "robot_max_velocity": ("<f4", (3,), "episode"),
        "robot_acceleration": ("<f4", (3,), "episode"),
        "robot_drive": ("|S64", (), "episode"),
    },
    {"footprint_offset": ("<i8", (), "episode+1"), "footprint": ("<f4", (2,), "corner")},
    {
        "lidar_offset": ("<i8", (), "episode+1"),
        "lidar_pose": ("<f4", (3,), "lidar"),
        "lidar_rays": ("<i4", (), "lidar"),
        "lidar_angles": ("<f4", (2,), "lidar"),
        "lidar_ranges": ("<f4", (2,), "lidar"),
    },
    {"human_model": ("|S64", (), "human"), "human_radius": ("<f4", (), "human")},
)
_ALL_FIELDS = {k: v for group in (_FIELDS, _MAP_FIELDS, *_DRAWN_GROUPS) for k, v in group.items()}
DRAWN_WORLD_FIELDS = tuple(name for group in _DRAWN_GROUPS for name in group)
"""Names of the arrays that are reserved for what is drawn per episode, in file order."""
# The array whose entries say where an episode's rows along an axis begin.
_OFFSETS = {
    "polygon+1": "episode_polygon_offset", "vertex": "polygon_offset", "human": "human_offset",
    "corner": "footprint_offset", "lidar": "lidar_offset",
}  # fmt: skip

Arrays = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class EpisodeWorld:
    """What stands around the robot in one episode.

    Attributes
    ----------
    sequence, episode, row : int
        Indices as in the columns; `row` is the episode's first row in its shard.
    robot_start : ndarray of shape (3,), float32
        x, y [m], heading [rad], world frame.
    robot_goal : ndarray of shape (2,), float32
        x, y [m], world frame.
    robot_v_pref : float
        Preferred speed [m/s].
    polygons : tuple of ndarray of shape (V, 2), float32
        Obstacles [m], world frame, anticlockwise.
    border : ndarray of shape (V, 2), float32, or None
        Polygon around everything, clockwise.
    human_start : ndarray of shape (H, 3), float32
        x, y [m], heading [rad] at the episode's first row.
    human_goal : ndarray of shape (H, 2), float32
        x, y [m].
    human_v_pref : ndarray of shape (H,), float32
        Preferred speeds [m/s].
    human_sees_robot : ndarray of shape (H,), bool
        Whether the human avoids the robot.
    human_gait : ndarray of shape (H, 3), float32
        Gait distances accumulated at the episode's first row [m, m, rad].
    map, map_hash, scenario : str
        On maps: the map's name, its content's hash (``GridMap.hash``) and the scenario's name; '' elsewhere.
    drawn : dict of str to ndarray
        What else the episode drew, by name, where the file has it: of the robot ``robot_max_velocity`` (3,) and
        ``robot_acceleration`` (3,) [m, rad, s], ``robot_drive``, ``footprint`` (V, 2) [m]; of its L lidars
        ``lidar_pose`` (L, 3), ``lidar_rays``, ``lidar_angles`` (L, 2) first and increment [rad], ``lidar_ranges``
        (L, 2) least and most [m]; of H humans ``human_model`` and ``human_radius`` [m].
    """

    sequence: int
    episode: int
    row: int
    robot_start: npt.NDArray[np.float32]
    robot_goal: npt.NDArray[np.float32]
    robot_v_pref: float
    polygons: tuple[npt.NDArray[np.float32], ...]
    border: npt.NDArray[np.float32] | None
    human_start: npt.NDArray[np.float32]
    human_goal: npt.NDArray[np.float32]
    human_v_pref: npt.NDArray[np.float32]
    human_sees_robot: npt.NDArray[np.bool_]
    human_gait: npt.NDArray[np.float32]
    map: str = ""
    map_hash: str = ""
    scenario: str = ""
    drawn: Arrays = field(default_factory=dict)


@dataclass(frozen=True)
class Worlds:
    """The worlds of the episodes of one shard.

    Attributes
    ----------
    arrays : dict of str to ndarray
        The file's arrays by name; see :data:`WORLD_FIELDS`.
    """

    arrays: Arrays

    def __len__(self) -> int:
        return len(self.arrays["episode"])

    def episode(self, index: int) -> EpisodeWorld:
        """Return episode `index` of the file.

        Raises
        ------
        IndexError
            If there is no such episode.
        """
        a = self.arrays
        if not 0 <= index < len(self):
            raise IndexError(f"Episode {index} is not in this worlds file; expected 0 to {len(self) - 1}.")
        first, stop = (int(v) for v in a["episode_polygon_offset"][index : index + 2])
        offsets = a["polygon_offset"]
        polygons = [a["vertices"][offsets[p] : offsets[p + 1]] for p in range(first, stop)]
        border = polygons.pop() if a["has_border"][index] else None
        h = slice(*a["human_offset"][index : index + 2])
        return EpisodeWorld(
            sequence=int(a["sequence"][index]),
            episode=int(a["episode"][index]),
            row=int(a["row"][index]),
            robot_start=a["robot_start"][index],
            robot_goal=a["robot_goal"][index],
            robot_v_pref=float(a["robot_v_pref"][index]),
            polygons=tuple(polygons),
            border=border,
            human_start=a["human_start"][h],
            human_goal=a["human_goal"][h],
            human_v_pref=a["human_v_pref"][h],
            human_sees_robot=a["human_sees_robot"][h],
            human_gait=a["human_gait"][h],
            **{name: a[name][index].decode("ascii", "replace") for name in MAP_WORLD_FIELDS if name in a},
            drawn={
                name: self._drawn(name, index)
                for name in DRAWN_WORLD_FIELDS
                if name in a and name not in _OFFSETS.values()
            },
        )

    def _drawn(self, name: str, index: int) -> npt.NDArray[Any]:
        """Return the part of an array that belongs to an episode."""
        axis = _ALL_FIELDS[name][2]
        if axis == "episode":
            return np.asarray(self.arrays[name][index])
        start, stop = self.arrays[_OFFSETS[axis]][index : index + 2]
        return self.arrays[name][start:stop]


def _fields_of(names: Collection[str]) -> dict[str, tuple[str, tuple[int, ...], str]]:
    """Return the fields that a worlds file with these arrays should have."""
    groups = [group for group in (_MAP_FIELDS, *_DRAWN_GROUPS) if any(name in names for name in group)]
    return _FIELDS | {name: kind for group in groups for name, kind in group.items()}


def check_worlds(arrays: Mapping[str, npt.NDArray[Any]]) -> str:
    """Return what is wrong with the arrays of a worlds file, or an empty string.

    Parameters
    ----------
    arrays : mapping of str to ndarray
        As in :data:`WORLD_FIELDS`.
    """
    fields = _fields_of(arrays)
    if set(arrays) != set(fields):
        odd = sorted(set(arrays) ^ set(fields))[0]
        return f"array {odd!r} is {'unexpected' if odd in arrays else 'missing'}"
    for name, (dtype, tail, _) in fields.items():
        array = arrays[name]
        if array.dtype != np.dtype(dtype) or array.ndim != 1 + len(tail) or array.shape[1:] != tail:
            wanted = f"{np.dtype(dtype)} ({', '.join(['n', *map(str, tail)])})"
            return f"array {name!r} is {array.dtype} {array.shape}, expected {wanted}"
    firsts = {"episode": "episode", "human": "human_start", "vertex": "vertices", "polygon+1": "polygon_offset",
              "corner": "footprint", "lidar": "lidar_pose"}  # fmt: skip
    sizes = {axis: len(arrays[name]) for axis, name in firsts.items() if name in arrays}
    sizes["episode+1"] = sizes["episode"] + 1
    for name, (_, _, axis) in fields.items():
        if len(arrays[name]) != sizes[axis]:
            return f"array {name!r} has {len(arrays[name])} entries, expected {sizes[axis]}"
    for axis, name in _OFFSETS.items():
        if name not in arrays:
            continue
        offset = arrays[name]
        end = sizes[axis] - (axis == "polygon+1")
        if not len(offset) or offset[0] != 0 or offset[-1] != end or (np.diff(offset) < 0).any():
            return f"offsets {name!r} do not go up from 0 to {end}"
    if (np.diff(arrays["episode_polygon_offset"]) < arrays["has_border"]).any():
        return "an episode has a border but no polygon"
    return ""


def as_worlds(arrays: Mapping[str, npt.ArrayLike]) -> Arrays:
    """Return the arrays of one sequence in the stored dtypes, checked.

    Raises
    ------
    CorruptDataError
        If an array is missing or has another shape.
    """
    fields = _fields_of(arrays)
    cast = {k: np.asarray(v, dtype=fields[k][0] if k in fields else None) for k, v in arrays.items()}
    problem = check_worlds(cast)
    if problem:
        raise CorruptDataError(f"Worlds of a sequence: {problem}; fix the caller of ShardWriter.append.")
    return cast


def concatenate_worlds(parts: Sequence[Arrays]) -> Arrays:
    """Join the worlds of consecutive sequences; offsets, each starting at 0, are moved up.

    What was drawn per episode is kept where all of them have it.
    """
    result: Arrays = {}
    in_all = set(parts[0]).intersection(*parts[1:])
    known = _fields_of({name for part in parts for name in part})
    fields = {name: kind for name, kind in known.items() if name in in_all or name not in DRAWN_WORLD_FIELDS}
    for name, (dtype, tail, axis) in fields.items():
        if axis.endswith("+1"):
            pieces, base = [np.zeros(1, dtype)], 0
            for part in parts:
                pieces.append(part[name][1:] + base)
                base += int(part[name][-1])
            result[name] = np.concatenate(pieces).astype(dtype)
        else:
            result[name] = np.concatenate([np.empty((0, *tail), dtype), *(part[name] for part in parts)])
    return result


def take_episodes(arrays: Mapping[str, npt.NDArray[Any]], first: int, stop: int) -> Arrays:
    """Return the worlds of consecutive episodes alone, offsets starting at 0 again; the opposite of joining.

    Parameters
    ----------
    arrays : mapping of str to ndarray
        Of a worlds file.
    first, stop : int
        Episodes [first, stop) of the file.
    """
    polygon = slice(*arrays["episode_polygon_offset"][[first, stop]])
    parts = {
        axis: slice(*arrays[name][[first, stop]])
        for axis, name in _OFFSETS.items()
        if name in arrays and axis not in ("polygon+1", "vertex")
    }
    parts |= {
        "episode": slice(first, stop),
        "episode+1": slice(first, stop + 1),
        "polygon+1": slice(polygon.start, polygon.stop + 1),
        "vertex": slice(*arrays["polygon_offset"][[polygon.start, polygon.stop]]),
    }
    result: Arrays = {}
    for name, (_, _, axis) in _fields_of(arrays).items():
        taken = arrays[name][parts[axis]]
        result[name] = taken - taken[0] if axis.endswith("+1") else taken.copy()
    return result


def _zip_bytes(members: Mapping[str, bytes]) -> bytes:
    """Return a zip archive of `members`, deflated, with the zip epoch as date."""
    body, directory = [], []
    offset = 0
    for name, data in members.items():
        packed = bytes(deflate.deflate_compress(data, 1))
        # version 2.0, no flags, deflate, time 00:00, date 1980-01-01
        common = struct.pack(
            "<HHHHHIIIHH", 20, 0, 8, 0, 0x21, isal_zlib.crc32(data), len(packed), len(data), len(name), 0
        )
        head = b"PK\x03\x04" + common + name.encode("ascii")
        directory.append(
            b"PK\x01\x02\x14\x00" + common + struct.pack("<HHHII", 0, 0, 0, 0, offset) + name.encode("ascii")
        )
        body += [head, packed]
        offset += len(head) + len(packed)
    index = b"".join(directory)
    end = b"PK\x05\x06" + struct.pack("<HHHHIIH", 0, 0, len(members), len(members), len(index), offset, 0)
    return b"".join(body) + index + end


def worlds_bytes(arrays: Arrays) -> bytes:
    """Return a worlds file: equal arrays give equal bytes."""
    members = {}
    for name in _fields_of(arrays):
        buffer = io.BytesIO()
        np.lib.format.write_array(buffer, np.ascontiguousarray(arrays[name]), version=(1, 0), allow_pickle=False)
        members[f"{name}.npy"] = buffer.getvalue()
    return _zip_bytes(members)


def _member(archive: zipfile.ZipFile, name: str) -> npt.NDArray[Any]:
    """Read one array without trusting its header."""
    stream = io.BytesIO(archive.read(f"{name}.npy"))
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError(f"array {name!r} is not npy version 1.0")
    shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    wanted = _ALL_FIELDS[name][0]
    if dtype != np.dtype(wanted) or (fortran and len(shape) > 1):
        raise ValueError(f"array {name!r} is {dtype}, expected {wanted} in C order")
    data = stream.read()
    count = 1
    for n in shape:
        count *= int(n)
    if count < 0 or count * dtype.itemsize != len(data):
        raise ValueError(f"array {name!r} has {len(data)} bytes, expected shape {shape}")
    return np.frombuffer(data, dtype).reshape(shape)


def parse_worlds(data: bytes, where: str) -> Worlds:
    """Read the bytes of a worlds file; `where` names it in errors.

    Raises
    ------
    CorruptDataError
        If they are not a worlds file, or unpack to more than 256 MiB.
    """
    try:
        # zipfile reads the whole directory, however long, before anybody can look at it
        if data.count(_DIRECTORY_ENTRY) > _MAX_ENTRIES:
            raise ValueError(f"it has more than {_MAX_ENTRIES} members")
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            names = [entry.filename for entry in archive.infolist()]
            fields = _fields_of([name.removesuffix(".npy") for name in names])
            if sorted(names) != sorted(f"{name}.npy" for name in fields):
                raise ValueError(f"its members are {names[:20]}")
            if any(entry.compress_type not in PLAIN_METHODS for entry in archive.infolist()):
                raise ValueError("it is packed in another way than stored or deflated")
            # zipfile stops at the size that the directory declares, so this bounds what is unpacked.
            if sum(entry.file_size for entry in archive.infolist()) > MAX_WORLDS_BYTES:
                raise ValueError(f"it unpacks to more than {MAX_WORLDS_BYTES:,} bytes")
            arrays = {name: _member(archive, name) for name in fields}
        problem = check_worlds(arrays)
        if problem:
            raise ValueError(problem)
    except Exception as error:  # damaged zips raise a dozen kinds, NotImplementedError and struct.error among them
        reason = str(error).strip().rstrip(".") or type(error).__name__
        raise CorruptDataError(f"{where} is not a worlds file: {reason}; {_ADVICE}.") from error
    return Worlds(arrays)


def read_worlds(path: Path | str) -> Worlds:
    """Read a worlds file.

    Parameters
    ----------
    path : path-like
        ``worlds/train-NNNNN.npz`` of a dataset, or of another split.

    Raises
    ------
    CorruptDataError
        If it is no worlds file, or larger than 256 MiB.
    """
    path = Path(path)
    with reading(path):
        size = path.stat().st_size
        if size > MAX_WORLDS_BYTES:
            raise CorruptDataError(f"{path} has {size:,} bytes, expected at most {MAX_WORLDS_BYTES:,}; {_ADVICE}.")
        data = path.read_bytes()
    return parse_worlds(data, str(path))
