"""One writer per dataset at a time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import filelock

from navrep_data.errors import DatasetLockedError
from navrep_data.io import translate_os_error

LOCK_FILE = ".navrep-data.lock"


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
        If the folder cannot be written.
    """
    root = Path(root)
    lock = filelock.FileLock(root / LOCK_FILE, timeout=0)
    try:
        lock.acquire()
    except filelock.Timeout:
        raise DatasetLockedError(
            f"Another process is writing the dataset in {root}; expected one writer at a time. "
            "Wait until it ends, or choose another folder with --out."
        ) from None
    except OSError as error:
        raise translate_os_error(error, root) from error
    try:
        yield
    finally:
        lock.release()
