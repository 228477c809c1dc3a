"""Atomic writes, hashing and reading with bounds."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import math
import os
import re
import secrets
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

import platformdirs

from navrep_data.errors import (
    CorruptDataError,
    DatasetError,
    DiskSpaceError,
    FileAccessError,
    FolderNotWritableError,
    NavrepDataError,
)

PART_SUFFIX = ".part"
HASH_BLOCK = 1 << 20
# A manifest of 35,000 shards of 20 sequences is about this large; generate refuses to make a larger one.
MAX_JSON_BYTES = 256 << 20
# A list or object takes 60 bytes or more, as text two: files of this package have 20 characters for each.
_FREE_CONTAINERS, _BYTES_PER_CONTAINER = 1 << 16, 8
# Half a pair of surrogates is no character: it can be neither printed nor written.
_SURROGATE = re.compile(rb"\\u[dD][89a-fA-F]")
# What the operating system says when there is no room: disk full, quota used up, file size limit.
_NO_ROOM = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
_NOT_ALLOWED = frozenset({errno.EACCES, errno.EPERM, errno.EROFS})
# What no content of a file can cause; a damaged one makes libraries seek to nowhere, which is EINVAL.
_REFUSALS = _NO_ROOM | _NOT_ALLOWED | {
    errno.EIO, errno.ENAMETOOLONG, errno.ELOOP, errno.EMFILE, errno.ENFILE, errno.ENOENT, errno.ENOTDIR, errno.EISDIR,
    errno.EBUSY, errno.ENXIO, errno.ENODEV, errno.ESTALE, errno.ETIMEDOUT, errno.ENOTCONN,
}  # fmt: skip
_EXPECTED = {
    errno.EACCES: "Expected a file or folder that this user may use: change its permissions or choose another.",
    errno.EPERM: "Expected a file or folder that this user may use: change its permissions or choose another.",
    errno.ENAMETOOLONG: "Expected a shorter name: most file systems allow 255 bytes, .part and the like included.",
    errno.ENOENT: "Expected something that exists: check the name, and that nobody removes it meanwhile.",
    errno.ENOTDIR: "Expected a folder where a file is: choose another.",
    errno.EISDIR: "Expected a file where a folder is: choose another.",
    errno.EMFILE: "Expected to open more files at once: raise the limit, as in: ulimit -n 4096",
    errno.EIO: "The disk or its connection fails; the file may be well: try again, or copy it from elsewhere.",
}
_LONGEST_REASON = 80
_EXPECTED_ELSE = "Expected a file or folder that can be used: look at its disk and permissions, or choose another."


def cache_dir() -> Path:
    """Return the package's cache folder (not created): ``NAVREP_DATA_HOME`` or the platform's user cache.

    Returns
    -------
    pathlib.Path
        Absolute path.
    """
    home = os.environ.get("NAVREP_DATA_HOME")
    return Path(home).expanduser().absolute() if home else Path(platformdirs.user_cache_dir("navrep-data"))


def fsync_dir(folder: Path) -> None:
    """Make renames inside `folder` survive a power cut (where the platform can)."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:  # Windows cannot open folders
        return
    try:
        os.fsync(handle)
    except OSError:  # some network file systems refuse; the rename itself has happened
        pass
    finally:
        os.close(handle)


def raise_refusal(error: BaseException, path: Path | str) -> None:
    """Raise FileAccessError if the operating system refused to read `path`: that says nothing about what is in it.

    For readers that take whatever else a library raises for damage. That a file is missing is raised as it came.

    Parameters
    ----------
    error : BaseException
        What was raised while `path` was read; what caused it counts too.
    path : path-like
        For the message, where the error does not name a file.
    """
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, FileNotFoundError):
            if cause is error:
                raise cause
        elif isinstance(cause, OSError) and cause.errno in _REFUSALS:
            cause.filename = cause.filename or str(path)
            raise translate_os_error(cause) from error
        cause = cause.__cause__ or cause.__context__


def translate_os_error(error: OSError, path: Path | None = None) -> Exception:
    """Turn an error of the operating system into one that says in one line what to do.

    Parameters
    ----------
    error : OSError
        What was raised.
    path : pathlib.Path, optional
        What was being written; where it is left out nothing is known of what was done to ``error.filename``.

    Returns
    -------
    Exception
        An error of this package; `error` itself if it is one, or did not come from the operating system.
    """
    if isinstance(error, NavrepDataError) or error.errno is None:
        return error
    why = error.strerror
    if not why or len(why) > _LONGEST_REASON:  # the HDF5 library puts its whole story there
        why = os.strerror(error.errno)
    if error.errno in _NO_ROOM:
        return DiskSpaceError(
            f"No room left while writing{'' if path is None else f' {path}'}: {why}. "
            "What was finished is intact; free some space and run the same command again."
        )
    if error.errno in _NOT_ALLOWED and path is not None:
        return FolderNotWritableError(
            f"Cannot write {path}: {why}. Expected a folder that this user may write; "
            "choose another with --out or change its permissions."
        )
    where = error.filename if path is None or error.errno == errno.ENAMETOOLONG else path
    what = "The operating system refuses" if where is None else f"The operating system refuses {os.fsdecode(where)}"
    return FileAccessError(f"{what}: {why}. {_EXPECTED.get(error.errno, _EXPECTED_ELSE)}")


@contextlib.contextmanager
def reading(path: Path | str) -> Iterator[None]:
    """Raise FileAccessError if the operating system refuses something while `path` is read in the ``with``.

    That a file is missing stays FileNotFoundError, which callers may expect.
    """
    try:
        yield
    except OSError as error:
        raise_refusal(error, path)
        raise


def atomic_write_bytes(path: Path | str, data: bytes | memoryview) -> None:
    """Write `data` so that `path` is afterwards either as before or complete: temp file, fsync, rename.

    Parameters
    ----------
    path : path-like
        Target; its folder must exist.
    data : bytes-like
        The whole content.

    Raises
    ------
    DiskSpaceError
        If there is no room. The temp file is removed, `path` is as it was.
    FolderNotWritableError
        If the folder cannot be written.
    """
    path = Path(path)
    # unique, also among machines that share the folder: an orphan of a killed run must never write into our temp file
    part = path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}{PART_SUFFIX}")
    try:
        with open(part, "wb") as handle:
            handle.write(data)
            handle.flush()
            os.fsync(handle.fileno())
        os.replace(part, path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise translate_os_error(error, path) from error
    fsync_dir(path.parent)


def json_bytes(value: Any) -> bytes:
    """Return `value` as UTF-8 JSON in one fixed layout: keys as given, one-space indent, NaN refused."""
    return (json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()


def atomic_write_json(path: Path | str, value: Any) -> None:
    """Write `value` as JSON by :func:`atomic_write_bytes`."""
    atomic_write_bytes(path, json_bytes(value))


def _finite(text: str) -> float:
    """Return the number that `text` is; Python's parser would let NaN, Infinity and 1e999 through."""
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is not a finite number")
    return value


def read_json(path: Path | str, max_bytes: int = MAX_JSON_BYTES) -> Any:
    """Read a JSON file that may come from anywhere.

    Parameters
    ----------
    path : path-like
        File to read.
    max_bytes : int
        Larger files are refused before anything is read.

    Raises
    ------
    FileAccessError
        If it cannot be read.
    DatasetError
        If the file is too large.
    CorruptDataError
        If it is not valid JSON in UTF-8 (NaN, infinite numbers and half characters are not), or holds so many lists and
        objects that they would take far more memory than the file has bytes.
    """
    path = Path(path)
    with reading(path):
        size = path.stat().st_size
        if size > max_bytes:
            raise DatasetError(
                f"{path} has {size:,} bytes, expected at most {max_bytes:,}: not a file of this package."
            )
        data = path.read_bytes()
    try:
        containers = data.count(b"[") + data.count(b"{")
        if containers > _FREE_CONTAINERS + len(data) // _BYTES_PER_CONTAINER:
            raise ValueError(f"{containers:,} lists and objects in {len(data):,} bytes")
        value = json.loads(data.decode(), parse_float=_finite, parse_constant=_finite)
        if _SURROGATE.search(data):
            json.dumps(value, ensure_ascii=False).encode()
        return value
    except (ValueError, RecursionError) as error:
        raise CorruptDataError(
            f"{path} is not valid JSON ({error}). Expected a file written by navrep-data; get it again."
        ) from error


def safe_join(root: Path, name: str) -> Path:
    """Return ``root / name`` for a relative POSIX `name` from outside, refusing whatever would leave `root`.

    Raises
    ------
    CorruptDataError
        If `name` is absolute, has a drive or backslash, or contains ``..``.
    """
    pure = PurePosixPath(name)
    if not name or pure.is_absolute() or ".." in pure.parts or "\\" in name or ":" in name or "\0" in name:
        raise CorruptDataError(
            f"File name {name!r} points outside the dataset; expected a relative path inside {root}."
        )
    return root.joinpath(*pure.parts)


def sha256_bytes(data: bytes | memoryview) -> str:
    """Return the SHA-256 of `data` as 64 hex digits."""
    return hashlib.sha256(data).hexdigest()


def sha256_file(path: Path | str) -> str:
    """Return the SHA-256 of a file's content as 64 hex digits, read in blocks of 1 MiB."""
    digest = hashlib.sha256()
    with reading(path), open(path, "rb", buffering=0) as handle:
        while block := handle.read(HASH_BLOCK):
            digest.update(block)
    return digest.hexdigest()
