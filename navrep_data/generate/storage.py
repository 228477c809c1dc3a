"""Where shards go: the dataset's own folder, a folder that all nodes share, or anything that fsspec can write."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Container
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from navrep_data.errors import ConfigError, DatasetError, FolderInUseError, FolderNotWritableError, MissingExtraError
from navrep_data.io import PART_SUFFIX, atomic_write_bytes, sha256_file
from navrep_data.shards import CARD_FILE, MANIFEST_FILE, FileEntry, ShardEntry, ShardImage, publish
from navrep_data.shards.writer import shard_entry, shard_files

# NFS shows a new file in a folder that it has listed before only after some seconds.
VISIBLE_SECONDS = 10.0
STAGING = ".staging"
"""Where a shard that replaces a shorter one waits until the manifest has let go of the old one."""


@dataclass(frozen=True)
class FolderStore:
    """A folder: every write is a temp file, synced, then renamed.

    Attributes
    ----------
    root : pathlib.Path
        The folder.
    """

    root: Path

    def __str__(self) -> str:
        return str(self.root)

    def publish(self, index: int, image: ShardImage, *, staged: bool) -> ShardEntry:
        """Write shard `index` of its split."""
        root = self.root / STAGING if staged else self.root
        root.mkdir(exist_ok=True)
        return publish(root, index, image)

    def intact(self, entry: ShardEntry | FileEntry, *, hashed: bool) -> bool:
        """Return whether a file is there with its size and, if `hashed`, its hash."""
        path = self.root / entry.file
        try:
            return path.stat().st_size == entry.bytes and (not hashed or sha256_file(path) == entry.sha256)
        except OSError:
            return False

    def unstage(self, file: str) -> None:
        """Move a file from staging to its place."""
        os.replace(self.root / STAGING / file, self.root / file)

    def clean_up(self, shards: Container[str] | None) -> None:
        """Remove temp files of these shards, such as train-00000 (None: of all), and what never left staging."""
        shutil.rmtree(self.root / STAGING, ignore_errors=True)
        for folder in (self.root / "data", self.root / "worlds"):
            for path in folder.glob(f".*{PART_SUFFIX}"):
                if shards is None or path.name.removeprefix(".").partition(".")[0] in shards:
                    path.unlink(missing_ok=True)

    def finish(self, root: Path) -> None:
        """Copy card and manifest here, unless they are here."""
        if self.root != root:
            for name in (CARD_FILE, MANIFEST_FILE):
                atomic_write_bytes(self.root / name, (root / name).read_bytes())


@dataclass(frozen=True)
class UrlStore:
    """Anything behind an fsspec URL that can be written: s3, gs, sftp, ...

    Attributes
    ----------
    url : str
        Where the dataset's ``data`` and ``worlds`` go.

    Notes
    -----
    Object stores show a file once it is whole. Where a file system doesn't, a cut file may stay, but no manifest lists
    it: the next attempt writes it again.
    """

    url: str

    def __str__(self) -> str:
        return self.url

    @cached_property
    def _place(self) -> tuple[Any, str]:
        return open_url(self.url)

    def publish(self, index: int, image: ShardImage, *, staged: bool) -> ShardEntry:
        """Write a shard, its worlds first."""
        for file, data in shard_files(index, image):
            self._write(f"{STAGING}/{file}" if staged else file, data)
        return shard_entry(index, image)

    def _write(self, file: str, data: bytes) -> None:
        fs, base = self._place
        path = f"{base}/{file}"
        try:
            fs.makedirs(path.rpartition("/")[0], exist_ok=True)
            fs.pipe_file(path, data)
        except OSError as error:
            raise FolderNotWritableError(
                f"Cannot write {file} to {self.url} ({error}); expected a place that every worker may write. "
                "What was finished is intact; run the same command again."
            ) from error

    def intact(self, entry: ShardEntry | FileEntry, *, hashed: bool) -> bool:
        """Return whether a file is there with its size; hashing would mean to fetch it."""
        fs, base = self._place
        try:
            return int(fs.size(f"{base}/{entry.file}")) == entry.bytes
        except (OSError, TypeError):
            return False

    def unstage(self, file: str) -> None:
        """Move a file from staging to its place."""
        fs, base = self._place
        fs.mv(f"{base}/{STAGING}/{file}", f"{base}/{file}")

    def clean_up(self, shards: Container[str] | None) -> None:
        """Remove shards that never left staging."""
        fs, base = self._place
        if fs.exists(f"{base}/{STAGING}"):
            fs.rm(f"{base}/{STAGING}", recursive=True)

    def finish(self, root: Path) -> None:
        """Copy card and manifest there."""
        for name in (CARD_FILE, MANIFEST_FILE):
            self._write(name, (root / name).read_bytes())

    def in_use(self) -> bool:
        """Return whether there is a dataset, or a part of one."""
        fs, base = self._place
        return any(fs.exists(f"{base}/{name}") for name in ("data", MANIFEST_FILE))


Store = FolderStore | UrlStore


def open_url(url: str) -> tuple[Any, str]:
    """Return the fsspec file system of a URL, and the path in it.

    Raises
    ------
    ConfigError
        If fsspec does not know such URLs.
    MissingExtraError
        If it needs another package for them.
    """
    from fsspec.core import url_to_fs

    try:
        fs, path = url_to_fs(url)
    except ImportError as error:
        raise MissingExtraError(f"--storage {url} needs another package: {error} with pip install.") from error
    except ValueError as error:
        raise ConfigError(
            f"--storage is {url}, expected a URL that fsspec knows, such as s3://bucket/name ({error})."
        ) from error
    return fs, str(path).rstrip("/")


def check_url(url: str) -> None:
    """Make sure that a URL can be used, before anything is made; see :func:`open_url` for what it raises."""
    if "://" not in url:
        raise ConfigError(
            f"--storage is {url}, expected a URL such as s3://bucket/name; a folder that all nodes share is given "
            "by --out."
        )
    scheme, _, path = url.partition("://")
    if scheme in ("file", "local") and not path.startswith("/"):
        raise ConfigError(
            f"--storage is {url}, which means another folder wherever it is read; expected a whole path: "
            f"{scheme}://{Path(path).absolute()}"
        )
    open_url(url)


def store_of(root: Path, storage: str | None) -> Store:
    """Return the place of a dataset's shards: `storage`, or `root` without one."""
    return FolderStore(root) if storage is None else UrlStore(storage)


def check_storage(store: Store) -> None:
    """Make sure that a new dataset does not write over another one.

    Raises
    ------
    FolderInUseError
        If there is one behind the URL; folders are checked by :func:`navrep_data.generate.plan.check_folder`.
    """
    if isinstance(store, UrlStore) and store.in_use():
        raise FolderInUseError(
            f"{store.url} holds a dataset already, expected an empty place: choose another --storage, or the --out "
            "where that dataset's manifest is kept."
        )


def check_visible(store: Store, entry: ShardEntry, *, staged: bool) -> None:
    """Make sure that what a worker has written can be seen from here, where the manifest is written.

    Raises
    ------
    DatasetError
        If it cannot, after a while that network file systems may take.
    """
    deadline = time.monotonic() + VISIBLE_SECONDS
    for part in (entry, entry.worlds):
        if part is None:
            continue
        seen = FileEntry(f"{STAGING}/{part.file}" if staged else part.file, part.sha256, part.bytes)
        while not store.intact(seen, hashed=False):
            if time.monotonic() > deadline:
                raise DatasetError(
                    f"A worker has written {part.file}, but from here it cannot be seen in {store}; expected --out on "
                    "storage that this machine and all workers share, or --storage with such a URL."
                )
            time.sleep(VISIBLE_SECONDS / 50)
