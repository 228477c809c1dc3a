"""Valid HDF5 files that a reader should not trust: links, sizes, filters, chunks and values that are not ours."""

from __future__ import annotations

import io
import zlib
from typing import Any

import h5py
import numpy as np

ATTRIBUTES: tuple[Any, ...] = (
    0, 1, -1, 2, 12, 1 << 20, (1 << 31) - 1, 1 << 40, (1 << 62), -(1 << 62), 0.5, 1e308, np.nan, np.inf, -np.inf, 25.0,
    "", "x" * 5000, "navrep-data", "{}", "[" * 3000, '{"a": NaN}', "\u20ac", np.arange(2), np.arange(-3, 0),
    np.zeros(0),
    np.array([0, 2**62]), np.array([2, 1]), np.array(["a", "b"], "S1"), True, np.complex64(1), np.float16(2),
    np.array([[1, 2]]), h5py.Empty("f4"), np.uint64(2**64 - 1),
    *map(np.bytes_, (b"navrep-data", b"x" * 5000, b"{}", b"[" * 3000, b'{"a": NaN}', b"\xff", b"soadrl\n", b"")),
    np.zeros(1 << 18, "f8"), np.bytes_(b"[" * (2 << 20)),
)  # fmt: skip
_VALUES = (
    0,
    1,
    -1,
    2,
    3,
    7,
    255,
    127,
    65535,
    -(1 << 31),
    (1 << 31) - 1,
    np.nan,
    np.inf,
    -np.inf,
    1e30,
    1e-40,
    25.0,
    0.5,
)
_HUGE = (1 << 10, 1 << 20, 1 << 24, 1 << 26, 1 << 31, 1 << 40)
_UNKNOWN_FILTER = 32099
_BOMB = zlib.compress(bytes(256 << 20), 9)


def edit_hdf5(data: bytes, edit: Any) -> bytes | None:
    """Return an HDF5 file with one thing changed, None where `data` is none any more."""
    memory = io.BytesIO(data)
    try:
        with h5py.File(memory, "r+") as file:
            names = [name for name in file if isinstance(file.get(name, getlink=True), h5py.HardLink)]
            columns = [name for name in names if isinstance(file[name], h5py.Dataset)]
            if not columns:
                return None
            name = columns[edit.at % len(columns)]
            _OPERATIONS[edit.kind % len(_OPERATIONS)](file, name, edit.at // 64, edit.value)
    except Exception:  # h5py raises anything for what was changed before, and refuses some of what is tried here
        return None
    return memory.getvalue()


def _attribute(file: Any, name: str, at: int, value: int) -> None:
    attributes = file.attrs if value % 5 else file[name].attrs
    keys = list(attributes)
    attributes[keys[at % len(keys)]] = ATTRIBUTES[value // 5 % len(ATTRIBUTES)]


def _no_attribute(file: Any, name: str, at: int, value: int) -> None:
    keys = list(file.attrs)
    del file.attrs[keys[value % len(keys)]]


def _values(file: Any, name: str, at: int, value: int) -> None:
    column = file[name][()]
    flat = column.reshape(-1)
    where = slice(None) if value % 3 == 0 else slice(at % flat.size, at % flat.size + 1 + value % 40)
    with np.errstate(all="ignore"):
        flat[where] = np.array(_VALUES[value // 3 % len(_VALUES)]).astype(column.dtype)
    _again(file, name, data=column)


def _again(file: Any, name: str, **options: Any) -> None:
    del file[name]
    file.create_dataset(name, **options)


def _shape(file: Any, name: str, at: int, value: int) -> None:
    old = file[name]
    rows, rest = old.shape[0], old.shape[1:]
    shapes = ((rows + 1, *rest), (rows, 1), (), (0, *rest), (rows, *rest, 1), (rows, *(n + 1 for n in rest)), (rows,))
    _again(file, name, shape=shapes[value % len(shapes)], dtype=old.dtype)


def _dtype(file: Any, name: str, at: int, value: int) -> None:
    kinds = (
        ">f4", "f8", "S5", "u8", "c8", h5py.string_dtype(), h5py.ref_dtype, h5py.vlen_dtype("f4"), "f2", "i1",
        h5py.enum_dtype({"a": 1}), np.dtype([("a", "f4")]), np.dtype(("f4", (3,))),
        h5py.opaque_dtype(np.dtype("M8[s]")),
    )  # fmt: skip
    _again(file, name, shape=file[name].shape, dtype=kinds[value % len(kinds)])


def _link(file: Any, name: str, at: int, value: int) -> None:
    other = list(file)[at % len(file)]
    del file[name]
    match value % 8:
        case 0:
            file[name] = h5py.ExternalLink("/etc/passwd", "x")
        case 1:
            file[name] = h5py.ExternalLink("other.h5", name)
        case 2:
            file[name] = h5py.SoftLink(f"/{other}")
        case 3:
            file[name] = h5py.SoftLink(f"/{name}")
        case 4 if other != name:
            file[name] = file[other]
        case 5:
            file.create_group(name)
        case 6:
            file[name] = file["/"]
        case _:
            file[name] = np.dtype("f4")


def _elsewhere(file: Any, name: str, at: int, value: int) -> None:
    shape, dtype = file[name].shape, file[name].dtype
    del file[name]
    if value % 2:
        file.create_dataset(name, shape=shape, dtype=dtype, external=[("/etc/passwd", 0, h5py.h5f.UNLIMITED)])
    else:
        layout = h5py.VirtualLayout(shape=shape, dtype=dtype)
        layout[...] = h5py.VirtualSource("other.h5", name, shape=shape)
        file.create_virtual_dataset(name, layout)


def _unallocated(file: Any, name: str, at: int, value: int) -> None:
    """Give one or all columns many rows that take no bytes."""
    rows = _HUGE[at % len(_HUGE)]
    for column in list(file) if value % 3 else [name]:
        old = file[column]
        shape = (rows, *old.shape[1:])
        chunks = {0: None, 1: (min(rows, 1 << 20), *old.shape[1:]), 2: (1, *old.shape[1:])}[value // 3 % 3]
        more = {} if chunks is None else {"compression": "gzip", "shuffle": bool(value % 2)}
        _again(file, column, shape=shape, dtype=old.dtype, chunks=chunks, **more)
    if value % 5:
        file.attrs["rows"] = rows
    if value % 7:
        file.attrs["length"] = rows


def _filters(file: Any, name: str, at: int, value: int) -> None:
    column = file[name][()]
    options: tuple[dict[str, Any], ...] = (
        {"compression": "lzf"}, {"fletcher32": True}, {"compression": "gzip", "fletcher32": True}, {"shuffle": True},
        {"compression": "lzf", "shuffle": True, "fletcher32": True}, {"scaleoffset": 3}, {"compression": "gzip"},
        {"compression": "gzip", "shuffle": True}, {}, {"maxshape": (None, *column.shape[1:])},
    )  # fmt: skip
    rows = (1, 7, len(column))[at % 3]
    more = options[value % len(options)]
    _again(file, name, data=column, chunks=(rows, *column.shape[1:]) if more else None, **more)


def _unknown_filter(file: Any, name: str, at: int, value: int) -> None:
    column = file[name][()]
    plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plist.set_chunk(column.shape)
    if value % 2:
        plist.set_deflate(1)
    plist.set_filter(_UNKNOWN_FILTER if value % 3 else 1, h5py.h5z.FLAG_OPTIONAL, (1,))
    space = h5py.h5s.create_simple(column.shape)
    del file[name]
    made = h5py.h5d.create(file.id, name.encode(), h5py.h5t.py_create(column.dtype), space, dcpl=plist)
    h5py.Dataset(made).write_direct(np.ascontiguousarray(column))


def _bomb(file: Any, name: str, at: int, value: int) -> None:
    """Put a chunk that inflates to more than a chunk, or claims other filters than the column's."""
    column = file[name][()]
    more: dict[str, Any] = ({}, {"fletcher32": True}, {"shuffle": True}, {"compression": "lzf"})[at % 4]
    rows = max(1, (len(column), 5, 40)[value % 3])
    _again(
        file, name, shape=column.shape, dtype=column.dtype, chunks=(min(rows, len(column)), *column.shape[1:]),
        **{"compression": "gzip", **more},
    )  # fmt: skip
    file[name][...] = column
    content = _BOMB[: len(_BOMB) if value % 7 else value % len(_BOMB)]
    file[name].id.write_direct_chunk((0,) * column.ndim, content, filter_mask=(0, 0, 1, 2, 3, 4)[value // 7 % 6])


def _more(file: Any, name: str, at: int, value: int) -> None:
    if value % 2:
        del file[name]
    else:
        file.create_dataset(("x", "leading_action", "é", "a" * 300)[at % 4], data=np.zeros(len(file[name])))


_OPERATIONS = (
    _attribute, _attribute, _no_attribute, _values, _values, _values, _shape, _dtype, _link, _elsewhere, _unallocated,
    _filters, _unknown_filter, _bomb, _more,
)  # fmt: skip
