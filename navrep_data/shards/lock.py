"""One writer per dataset at a time."""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import filelock

from navrep_data.errors import DatasetLockedError, FolderNotWritableError
from navrep_data.io import translate_os_error

LOCK_FILE = ".navrep-data.lock"
_READABLE = stat.S_IRUSR | stat.S_IWUSR | stat.S_IRGRP | stat.S_IROTH
_WRITABLE = stat.S_IWGRP | stat.S_IWOTH


@contextmanager
def writer_lock(root: Path | str) -> Iterator[None]:
    """Hold the right to write the dataset in `root`; released when the process ends, however it ends.

    Parameters
    ----------
    root : path-like
        Dataset folder (must exist).

    Raises
    ------
    DatasetLockedError
        If another process holds it.
    FolderNotWritableError
        If the folder cannot be written, or another user's lock file cannot be opened.

    Notes
    -----
    The lock file may be written by the group, or by all, where its folder may: users of one group go on with each
    other's datasets.
    """
    root = Path(root)
    path = root / LOCK_FILE
    try:
        made = not path.exists()
        # whoever may write the folder may lock it, in turn
        mode = _READABLE | (root.stat().st_mode & _WRITABLE)
        lock = filelock.FileLock(path, timeout=0, mode=mode)
        lock.acquire()
    except filelock.Timeout:
        raise DatasetLockedError(
            f"Another process is writing the dataset in {root}; expected one writer at a time. "
            "Wait until it ends, or choose another folder with --out."
        ) from None
    except PermissionError as error:
        if not _may_be_seen(path):
            raise translate_os_error(error, root) from error
        raise FolderNotWritableError(
            f"{path} belongs to user {_owner(path)} and cannot be opened by this one: {error.strerror}. If nobody "
            f"writes the dataset, remove that file or ask its owner to: chmod g+w {path}; or choose another folder "
            "with --out."
        ) from error
    except OSError as error:
        raise translate_os_error(error, root) from error
    if made:
        _give_to_group(path, root)
    try:
        yield
    finally:
        lock.release()


def _may_be_seen(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:
        return False


def _owner(path: Path) -> str:
    try:
        return path.owner()
    except (KeyError, OSError, NotImplementedError):  # of another machine, or on Windows
        return str(path.stat().st_uid)


def _give_to_group(path: Path, root: Path) -> None:
    """Put the lock file into the folder's group, where this user is in it; a setgid folder does so by itself."""
    if hasattr(os, "chown"):
        with contextlib.suppress(OSError):
            os.chown(path, -1, root.stat().st_gid)
