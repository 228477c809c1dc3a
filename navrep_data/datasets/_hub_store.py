"""A cache of shards on disk that never grows beyond a bound, shared by all processes of a user."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path

import filelock

from navrep_data.errors import CorruptDataError, HubError
from navrep_data.hub import client
from navrep_data.io import is_offline, translate_os_error
from navrep_data.shards import FileEntry, Shard, ShardEntry

LOCK_TIMEOUT = 600.0
_POLL = 0.05
_RESERVED = ".reserved"


class ShardStore:
    """Shards by content, the ones used longest ago removed when room is needed.

    Parameters
    ----------
    folder : pathlib.Path
        Where they lie; made when needed.
    limit : int
        Bytes of all shards together, those on their way included.

    Notes
    -----
    ``<sha256>.h5`` exists only after its hash was checked. A download holds the lock of its hash and leaves a file that
    names its size, so that other processes count it; what a killed process left behind is known by its free lock. A
    shard that is removed while some process reads it stays readable there, and takes room until it is closed.
    """

    def __init__(self, folder: Path, limit: int) -> None:
        self.folder, self.limit = folder, limit

    def path(self, entry: ShardEntry) -> Path:
        """Return where a shard lies if it is here."""
        return self.folder / f"{entry.sha256}.h5"

    def has(self, entry: ShardEntry) -> bool:
        """Return whether a shard is here."""
        return self.path(entry).exists()

    def open(self, at: client.Revision, entry: ShardEntry) -> Shard:
        """Return a shard opened for reading, fetched if it is not here."""
        for _ in range(client.ATTEMPTS):
            path = self.fetch(at, entry)
            try:
                shard = Shard(path, entry)
                shard.read("is_first", 0, 1)  # holds the file open: from now on it may be removed
            except (FileNotFoundError, CorruptDataError):
                if path.exists():
                    raise
                continue  # another process needed the room
            return shard
        raise HubError(
            f"{entry.file} of {at} was removed from {self.folder} before it was read, {client.ATTEMPTS} times: too "
            "many processes share a small cache. Raise cache_bytes."
        )

    def fetch(self, at: client.Revision, entry: ShardEntry) -> Path:
        """Bring a shard here if it is not, and return where it lies.

        Raises
        ------
        CorruptDataError, HubError, OfflineError, DiskSpaceError
            If it cannot be had.
        """
        target = self.path(entry)
        try:
            if self._touch(target):
                return target
            if is_offline():
                client.require_network(f"get {entry.file} of {at}, which is not in {self.folder}")
            self.folder.mkdir(parents=True, exist_ok=True)
            with self._lock(entry.sha256):
                if not self._touch(target):
                    self._bring(at, entry, target)
        except filelock.Timeout as error:
            raise HubError(f"Another process has held {self.folder} for {LOCK_TIMEOUT:.0f} s: end it.") from error
        except HubError:
            raise
        except OSError as error:
            raise translate_os_error(error, self.folder) from error
        return target

    def _touch(self, path: Path) -> bool:
        try:
            os.utime(path)
        except FileNotFoundError:
            return False
        return True

    def _lock(self, name: str, timeout: float = LOCK_TIMEOUT) -> filelock.BaseFileLock:
        return filelock.FileLock(self.folder / f".{name}.lock", timeout=timeout)

    def _bring(self, at: client.Revision, entry: ShardEntry, target: Path) -> None:
        mark = self.folder / f"{entry.sha256}.{entry.bytes}{_RESERVED}"
        staging = self.folder / f"{entry.sha256}.part"
        self._reserve(entry, mark)
        try:
            client.bring(
                at,
                [FileEntry(entry.file, entry.sha256, entry.bytes)],
                staging,
                done=lambda _, path: os.replace(path, target),
                progress=False,
            )
        finally:
            shutil.rmtree(staging, ignore_errors=True)
            mark.unlink(missing_ok=True)

    def _reserve(self, entry: ShardEntry, mark: Path) -> None:
        """Make room for a shard and reserve it; waits while others' downloads hold it."""
        deadline = time.monotonic() + LOCK_TIMEOUT
        while True:
            with self._lock("room"):
                if self._make_room(entry.bytes, mine=entry.sha256):
                    mark.touch()
                    return
            if time.monotonic() > deadline:
                raise HubError(f"No room came free in {self.folder} for {LOCK_TIMEOUT:.0f} s: raise cache_bytes.")
            time.sleep(_POLL)

    def _make_room(self, need: int, mine: str) -> bool:
        """Remove what was used longest ago until `need` more bytes fit; False if downloads of others are in the way."""
        reserved = sum(self._reservation(mark, mine) for mark in self.folder.glob(f"*{_RESERVED}"))
        held = []
        for path in self.folder.glob("*.h5"):
            stat = path.stat()
            held.append((stat.st_mtime_ns, stat.st_size, path))
        used = reserved + sum(size for _, size, _ in held)
        for _, size, path in sorted(held):
            if used + need <= self.limit:
                break
            path.unlink()
            used -= size
        return used + need <= self.limit

    def _reservation(self, mark: Path, mine: str) -> int:
        """Return the bytes that a reservation stands for, 0 for one whose process is gone."""
        digest, size, _ = mark.name.split(".")
        if digest != mine:
            try:
                with self._lock(digest, timeout=0):
                    pass
            except filelock.Timeout:
                return int(size)
        shutil.rmtree(self.folder / f"{digest}.part", ignore_errors=True)
        mark.unlink(missing_ok=True)
        return 0
