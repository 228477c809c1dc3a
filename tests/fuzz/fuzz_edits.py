"""Changes to files that keep much of their structure, so that what is read gets past the first check.

A case is a dictionary of files by name. An :class:`Edit` is four numbers; which change they stand for follows from
the file they fall on, so that hypothesis can make smaller ones of them.
"""

from __future__ import annotations

import contextlib
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from fuzz_hdf5 import edit_hdf5
from hypothesis import strategies as st

Files = dict[str, bytes]
OUTSIDE = "../outside.txt"
"""A file beside the folder that a reader is given; no reader may touch it."""


@dataclass(frozen=True)
class Edit:
    """One change.

    Attributes
    ----------
    file, kind, at, value : int
        Which file, what is done to it, where, and with what; each taken modulo the number of choices.
    """

    file: int
    kind: int
    at: int
    value: int


BOUNDS = (64, 256, 1 << 32, 1 << 32)
"""The numbers of an edit are lower than these."""
MOST_EDITS = 4
"""Changes to the files of one case."""
EDITS = st.lists(st.builds(Edit, *(st.integers(0, bound - 1) for bound in BOUNDS)), min_size=1, max_size=MOST_EDITS)


def apply(files: Files, edits: list[Edit]) -> Files:
    """Return changed files; an edit that finds nothing to change in a structure changes bytes instead."""
    files = dict(files)
    damaged = set()  # HDF5 files that were changed as bytes: writing into them, the library itself may hang
    for edit in edits:
        name = sorted(files)[edit.file % len(files)]
        data = files[name]
        structured = _STRUCTURED.get(_suffix(name, data))
        changed = None
        if structured is not None and edit.kind % 4 and name not in damaged:  # three of four
            changed = structured(data, Edit(edit.file, edit.kind // 4, edit.at, edit.value))
        if changed is None:
            changed = edit_bytes(data, edit)
            damaged |= {name} if structured is edit_hdf5 else set()
        files[name] = changed
    return files


def _suffix(name: str, data: bytes) -> str:
    if data[:2] == b"PK":
        return "zip"
    return name.rsplit(".", 1)[-1] if "." in name else ""


# --- bytes ------------------------------------------------------------------------------------------------------

_MANY_BYTES = 4 << 20  # a file that is larger is not made forty times as large
_INTEGERS = (0, 1, -1, 2, 255, 0x7FFF, 0x7FFFFFFF, -0x80000000, 0xFFFF, (1 << 40), (1 << 62), -(1 << 63), 1 << 20)


def edit_bytes(data: bytes, edit: Edit) -> bytes:
    """Return changed bytes: flipped, cut, doubled, moved, or replaced by numbers at the end of a range."""
    if not data:
        return bytes([edit.value & 255])
    at, value = edit.at % len(data), edit.value
    n = 1 + value % 64
    number = _INTEGERS[value % len(_INTEGERS)]
    match edit.kind // 4 % 12:
        case 0:
            return data[:at] + bytes([data[at] ^ (1 << value % 8)]) + data[at + 1 :]
        case 1:
            return data[:at] + bytes([value % 256]) + data[at + 1 :]
        case 2:
            return data[:at]
        case 3:
            return data[:at] + data[at + n :]
        case 4:
            return data[:at] + value.to_bytes(4, "little") * (n // 4 + 1) + data[at:]
        case 5:
            return data[:at] + data[at : at + n] * (2 + value % 50) + data[at + n :]
        case 6:  # splice: a piece of the file elsewhere
            other = value % len(data)
            return data[:at] + data[other : other + n * 8] + data[at + n * 8 :]
        case 7:
            return data[:at] + (number & 0xFFFFFFFF).to_bytes(4, "little") + data[at + 4 :]
        case 8:
            return data[:at] + (number & ((1 << 64) - 1)).to_bytes(8, "little") + data[at + 8 :]
        case 9:
            return data[:at] + (number & 0xFFFFFFFF).to_bytes(4, "big") + data[at + 4 :]
        case 10:
            return data[:at] + bytes(n * 16) + data[at + n * 16 :]
        case _:
            return data + data[: value % (4 * len(data))] + b"\0" * (value % 7)


# --- JSON -------------------------------------------------------------------------------------------------------

_DEEP = 100_000


@dataclass(frozen=True)
class _Raw:
    """Text that goes into the file as it is."""

    text: str


EXTREMES: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 2, 3.5, -0.5, 1e308, -1e308, 1e-320, 255, 1 << 16, (1 << 31) - 1, 1 << 31, 1 << 53,
    (1 << 63) - 1, 1 << 63, 1 << 64, -(1 << 63), 10**25, 10**400, "", "x", "a" * 100_000, OUTSIDE, "/etc/passwd",
    "a/../../b", "\0", "\ud800", "é" * 50, "1", "nan", "C:\\x", "{}", "\n\n", "<script>", [], {}, [[]], [None], [{}],
    [0] * 1000, [1, 2], {"a": 1}, {"": {}}, [1e308] * 3, ["a", 1], [[[]]], _Raw("NaN"), _Raw("Infinity"),
    _Raw("-Infinity"), _Raw("1e999"), _Raw("9" * 5000), _Raw("[" * _DEEP + "]" * _DEEP), _Raw("[" * 900 + "]" * 900),
    _Raw('{"a":' * 400 + "1" + "}" * 400), _Raw('{"a":' * _DEEP), _Raw("[" + "[]," * 200_000 + "1]"), _Raw("\udc80"),
    _Raw('"\\ud83d"'), _Raw("01"), _Raw("1 2"), _Raw("-"), _Raw("1" + "0" * 300),
)  # fmt: skip


def edit_json(data: bytes, edit: Edit) -> bytes | None:
    """Return JSON with one value changed, None where `data` is none."""
    try:
        root = json.loads(data)
        places = [*_places(root)]
    except (ValueError, RecursionError):
        return None
    new: Any = EXTREMES[edit.value % len(EXTREMES)]
    if not places or edit.at % 97 == 0:
        return _dump(new)
    parent, key = places[edit.at % len(places)]
    match edit.kind % 8:
        case 0 | 1 | 2:
            parent[key] = new
        case 3:
            del parent[key]
        case 4:  # a value of elsewhere
            other, name = places[edit.value % len(places)]
            parent[key] = other[name]
        case 5:
            parent[key] = [parent[key]] * (edit.value % 3)
        case 6 if isinstance(parent, dict):
            parent["x" if isinstance(new, _Raw) else str(new)[:50]] = parent.pop(key)
        case 6:
            parent.append(new)
        case _:
            _nudge(parent, key, edit.value)
    try:
        return _dump(root)
    except (RecursionError, ValueError):  # a value that holds itself
        return None


def _places(value: Any) -> Any:
    items = (
        list(value.items()) if isinstance(value, dict) else list(enumerate(value)) if isinstance(value, list) else []
    )
    for key, inner in items:
        yield value, key
        yield from _places(inner)


def _nudge(parent: Any, key: Any, value: int) -> None:
    old = parent[key]
    if isinstance(old, bool):
        parent[key] = not old
    elif isinstance(old, int | float):
        with contextlib.suppress(OverflowError, ValueError):  # whole numbers that no float holds, or no text
            parent[key] = (
                lambda: old + 1, lambda: old - 1, lambda: -old, lambda: old * 1000, lambda: float(old),
                lambda: str(old), lambda: old + 0.5,
            )[value % 7]()  # fmt: skip
    elif isinstance(old, str) and old:
        at = value % len(old)
        parent[key] = old[:at] + chr(32 + value % 95) + old[at + 1 :]
    elif isinstance(old, list):
        parent[key] = (old[1:], old + old, old[::-1], old * 20)[value % 4]


def _dump(value: Any) -> bytes:
    raw: list[str] = []

    def plain(v: Any) -> Any:
        if isinstance(v, _Raw):
            raw.append(v.text)
            return f"@raw{len(raw) - 1}@"
        if isinstance(v, dict):
            return {k: plain(x) for k, x in v.items()}
        return [plain(x) for x in v] if isinstance(v, list) else v

    text = json.dumps(plain(value), allow_nan=True, ensure_ascii=True)
    for k, piece in enumerate(raw):
        text = text.replace(f'"@raw{k}@"', piece)
    return text.encode("utf-8", "surrogatepass")


# --- zip and npy ------------------------------------------------------------------------------------------------

_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
_NAMES = (OUTSIDE, "/etc/x", "", "a\\b", "x.npy", "parameters", "data.pkl", "archive/data.pkl", "é", "a" * 5000)


def edit_zip(data: bytes, edit: Edit) -> bytes | None:
    """Return a valid zip with one member changed, or one whose directory lies; None where `data` is no zip."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [(i.filename, i.compress_type, archive.read(i)) for i in archive.infolist()]
    except Exception:  # changed before: no zip any more
        return None
    if not members:
        return None
    k = edit.at % len(members)
    name, compression, content = members[k]
    inner = Edit(edit.file, edit.value // 7 * 4, edit.at // 31, edit.value // 3)
    match edit.kind % 11:
        case 0 | 1:
            content = edit_bytes(content, inner)
        case 2 | 3 if content[:6] == b"\x93NUMPY":
            content = edit_npy(content, inner)
        case 2 | 3:
            structured = _STRUCTURED.get(_suffix(name, content)) or (edit_json if content[:1] in b"[{" else None)
            changed = None if structured is None else structured(content, inner)
            content = edit_bytes(content, inner) if changed is None else changed
        case 4:
            name = _NAMES[edit.value % len(_NAMES)]
        case 5:
            compression = _COMPRESSIONS[edit.value % len(_COMPRESSIONS)]
        case 6:  # a bomb
            compression, content = zipfile.ZIP_DEFLATED, content[: edit.value % 256] + bytes(32 << 20)
        case 7:
            del members[k]
            return _zip(members)
        case 8:
            return _zip([*members, members[k]])
        case 9:
            small = sum(len(content) for *_, content in members) < _MANY_BYTES
            return _zip(members * 40 if edit.value % 2 and small else members[::-1])
        case _:
            return _lie(data, edit)
    members[k] = (name, compression, content)
    return _zip(members)


def _zip(members: list[tuple[str, int, bytes]]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, compression, content in members:
            info = zipfile.ZipInfo(name or "x")
            info.compress_type = compression
            archive.NameToInfo.clear()  # doubled names are on purpose: no warning
            archive.writestr(info, content)
    return buffer.getvalue()


def _lie(data: bytes, edit: Edit) -> bytes:
    """Return a zip whose directory claims another method, size or place for a member."""
    at = data.rfind(b"PK\x01\x02", 0, len(data) - edit.at % max(1, len(data) // 4))
    if at < 0:
        return data[:-1]
    offset, size = ((10, 2), (16, 4), (20, 4), (24, 4), (42, 4), (8, 2), (30, 2), (28, 2), (6, 2))[edit.kind // 11 % 9]
    wrong = _INTEGERS[edit.value % len(_INTEGERS)] & ((1 << 8 * size) - 1)
    if offset == 10:
        wrong = (0, 8, 12, 14, 9, 93, 99)[edit.value % 7]
    return data[: at + offset] + wrong.to_bytes(size, "little") + data[at + offset + size :]


_NPY_HEADERS = (
    "{'descr': '|O', 'fortran_order': False, 'shape': (%s,)}",
    "{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000,)}",
    "{'descr': '<f4', 'fortran_order': False, 'shape': (-1,)}",
    "{'descr': '<f4', 'fortran_order': False, 'shape': (4294967296, 4294967296, 4294967296)}",
    "{'descr': '<f4', 'fortran_order': True, 'shape': (2, 2)}",
    "{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': ()}",
    "{'descr': '<M8[D]', 'fortran_order': False, 'shape': (0,)}",
    "{'descr': ',,', 'fortran_order': False, 'shape': (1,)}",
    "{'descr': 5, 'fortran_order': 3, 'shape': 'x'}",
    "{'descr': ('<f4', (1 << 30,)), 'fortran_order': False, 'shape': (1,)}",
    "{'descr': ('<f4', (1073741824,)), 'fortran_order': False, 'shape': (0,)}",
    "{'descr': '<f4', 'fortran_order': False, 'shape': (True, 1.5)}",
    "(" * 200, "-" * 3000 + "1", "{'a': " * 100, "[" + "[]," * 1000 + "]", "'", "\\", "1L", "{}", "\x00", "'''",
    "9" * 3000, "{'shape': (" + "1," * 500 + "), 'descr': '<f4', 'fortran_order': False}",
)  # fmt: skip


def edit_npy(content: bytes, edit: Edit) -> bytes:
    """Return an npy file with another header or version."""
    length = struct.unpack("<H", content[8:10])[0]
    if edit.value % 8 == 0:
        return content[:6] + bytes([edit.at % 5, edit.at // 5 % 3]) + content[8:]
    header = _NPY_HEADERS[edit.at % len(_NPY_HEADERS)].encode() + b"\n"
    return content[:8] + struct.pack("<H", len(header)) + header + content[10 + length :]


# --- text, images, safetensors ----------------------------------------------------------------------------------

_YAML_VALUES = (
    "*a", "&a [*a, *a]", "!!python/object/apply:os.system ['touch x']", "!!int ''", "!!float ''", "!!int '_'",
    "!!timestamp x", "!!bool x", "!!binary '='", "!!omap [1]", "!!set {1, [2]}", "0x" + "f" * 20_000, "1:" * 2000 + "1",
    ".inf", ".nan", "-.inf", "1e999", "~", "[]", "{}", "{[1]: 2}", "[" * 2000, "- " * 400, "2020-99-99", "'", '"\\',
    "|2\n x", "&x", "*undefined", "!x y", "%", "@", "\t", "-1", "0", "5e-2", "[0, 0, 0]", "[1e308, -1e308, 0]", OUTSIDE,
    "/etc/passwd", "map.yaml", "true", "''", "'\\0'", "? ? ?", "9" * 5000, "{a: {a: {a: {a: 1}}}}", "x\n---\ny: 1",
    "2001-12-14t21:59:43.10-05:00", "\ufeff", "\U0001f600", "12345678901234567890", "<<",
)  # fmt: skip


def yaml_bomb(levels: int, key: str, merge: bool) -> str:
    """Return YAML whose aliases stand for 9 to the power of `levels` values."""
    start, inner = ("{x: 1}", "{{<<: [{}]}}") if merge else ("[x]", "[{}]")
    lines = [f"a0: &a0 {start}"]
    for k in range(1, levels):
        lines.append(f"a{k}: &a{k} " + inner.format(", ".join([f"*a{k - 1}"] * 9)))
    return "\n".join([*lines, f"{key}: *a{levels - 1}", ""])


def edit_yaml(data: bytes, edit: Edit) -> bytes | None:
    """Return YAML with one value replaced, a line removed or doubled, or a bomb in front."""
    try:
        lines = data.decode().splitlines()
    except UnicodeDecodeError:
        return None
    if not lines:
        return None
    k = edit.at % len(lines)
    key = lines[k].split(":")[0]
    match edit.kind % 6:
        case 0:
            del lines[k]
        case 1:
            lines.insert(k, lines[edit.value % len(lines)])
        case 2:
            del lines[k]
            lines = [yaml_bomb(3 + edit.value % 12, key, bool(edit.value % 2)), *lines]
        case _:
            lines[k] = f"{key}: {_YAML_VALUES[edit.value % len(_YAML_VALUES)]}"
    return ("\n".join(lines) + "\n").encode("utf-8", "surrogatepass")


_PGM_TOKENS = (
    b"0", b"1", b"-1", b"8192", b"8193", b"99999999999999999999", b"65535", b"65536", b"1000000000", b"x", b"#c\n3",
    b"", b"255", b"256", b"P2", b"P6", b"P4", b"Pf", b"P7", b"P0CMYK", b"1e3", b"2147483647",
)  # fmt: skip


def edit_pgm(data: bytes, edit: Edit) -> bytes:
    """Return a PGM with one word of its header replaced."""
    words = data.split(maxsplit=4)
    if len(words) < 4:
        return edit_bytes(data, edit)
    words[edit.at % 4] = _PGM_TOKENS[edit.value % len(_PGM_TOKENS)]
    return b"\n".join(words)


def edit_png(data: bytes, edit: Edit) -> bytes | None:
    """Return a PNG with one chunk changed, its checksum right."""
    chunks, at = [], 8
    while at + 12 <= len(data):
        (size,) = struct.unpack(">I", data[at : at + 4])
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    if not chunks:
        return None
    k = edit.at % len(chunks)
    kind, content = chunks[k]
    inner = Edit(edit.file, edit.value // 7 * 4, edit.at // 31, edit.value // 3)
    match edit.kind % 6:
        case 0 | 1:
            chunks[k] = (kind, edit_bytes(content, inner) if content else content)
        case 2:
            chunks[k] = ((b"PLTE", b"tRNS", b"iCCP", b"zTXt", b"iTXt", b"IDAT", b"acTL", b"fdAT", b"eXIf", b"gAMA",
                          b"fcTL", b"pHYs", b"sRGB", b"IEND", b"IHDR")[edit.value % 15], content)  # fmt: skip
        case 3:
            bomb = (b"zTXt", b"x\0\0"), (b"iCCP", b"x\0\0"), (b"iTXt", b"x\0\1\0\0\0"), (b"IDAT", b"")
            name, head = bomb[edit.value % 4]
            chunks.insert(1 + k % len(chunks), (name, head + zlib.compress(bytes(64 << 20), 1)))
        case 4:
            chunks.insert(k, chunks[edit.value % len(chunks)])
        case _:
            depth, colour = (1, 2, 4, 8, 16)[edit.value % 5], (0, 2, 3, 4, 6)[edit.value // 5 % 5]
            size = (1, 40, 8192, 8193, 1 << 20, (1 << 31) - 1, 0)[edit.value // 25 % 7]
            chunks[0] = (b"IHDR", struct.pack(">IIBBBBB", size, 30, depth, colour, 0, 0, edit.value % 2))
    out = [data[:8]]
    for name, content in chunks:
        out += [struct.pack(">I", len(content)), name, content, struct.pack(">I", zlib.crc32(name + content))]
    return b"".join(out)


def edit_safetensors(data: bytes, edit: Edit) -> bytes | None:
    """Return safetensors with one value of the header changed."""
    size = int.from_bytes(data[:8], "little")
    header = edit_json(data[8 : 8 + size], edit) if size <= len(data) else None
    return None if header is None else len(header).to_bytes(8, "little") + header + data[8 + size :]


_STRUCTURED: dict[str, Callable[[bytes, Edit], bytes | None]] = {
    "json": edit_json,
    "zip": edit_zip,
    "h5": edit_hdf5,
    "yaml": edit_yaml,
    "pgm": edit_pgm,
    "png": edit_png,
    "safetensors": edit_safetensors,
}
