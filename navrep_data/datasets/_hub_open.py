"""Datasets opened on the Hub: whole, in huggingface_hub's cache, or shard by shard in a bounded one."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from itertools import pairwise
from pathlib import Path
from typing import Any

from navrep_data.datasets._hub_extras import check_shard_index, read_index
from navrep_data.datasets._hub_store import ShardStore
from navrep_data.datasets.hub import fetch_manifest, origin_of, parse_manifest
from navrep_data.errors import ConfigError, NavrepDataError, check_whole
from navrep_data.hub import client
from navrep_data.io import atomic_write_json, cache_dir, is_offline, read_json
from navrep_data.shards import (
    INDEX_FILE,
    MANIFEST_FILE,
    DatasetFolder,
    Episodes,
    FileEntry,
    Manifest,
    Origin,
    Shard,
    ShardEntry,
    choose_shards,
    select_shards,
)

STREAM_CACHE_BYTES = 8 << 30
MAX_OPEN = 128
_MAX_MEMO_BYTES = 64 << 20


class _Memo:
    """Which files of huggingface_hub's cache were checked: hashing a whole dataset at every start takes too long.

    A file counts as checked while its size and time of change are those it had then.
    """

    def __init__(self, at: client.Revision) -> None:
        self.path = cache_dir() / "hub" / "checked" / f"{at.repo.replace('/', '--')}--{at.commit}.json"
        self.known: dict[str, Any] = {}
        try:
            found = read_json(self.path, _MAX_MEMO_BYTES)
            self.known = found if isinstance(found, dict) else {}
        except (OSError, NavrepDataError):
            pass  # none yet, or damaged: then all is checked again

    def is_right(self, path: Path, entry: FileEntry) -> bool:
        try:
            stat = path.stat()
        except OSError:
            return False
        mark = [entry.sha256, stat.st_size, stat.st_mtime_ns]
        if stat.st_size == entry.bytes and self.known.get(entry.file) == mark:
            return True
        right = client.is_right(path, entry)
        if right:
            self.known[entry.file] = mark
        return right

    def save(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        atomic_write_json(self.path, self.known)


def open_whole(
    repo: str,
    *,
    revision: str | None = None,
    split: str | None = None,
    token: str | bool | None = None,
    progress: bool | None = None,
) -> DatasetFolder:
    """Return a dataset of the Hub, brought into huggingface_hub's cache and checked.

    Parameters
    ----------
    repo, revision, split, token, progress
        As for :func:`navrep_data.datasets.pull`.

    Raises
    ------
    DatasetNotFoundError, DatasetError, CorruptDataError, HubError, OfflineError
        As :func:`navrep_data.datasets.pull`; offline, a dataset that is in the cache opens.
    """
    at = client.resolve(repo, "dataset", revision, token)
    manifest, there = _manifest(at)
    part = select_shards(manifest, choose_shards(manifest, split=split))
    wanted = [e for s in part.shards for e in (FileEntry(s.file, s.sha256, s.bytes), s.worlds) if e is not None]
    if there is not None:
        client.check_listed(at, there, wanted)
    memo = _Memo(at)
    roots: set[Path] = set()

    def done(entry: FileEntry, path: Path) -> None:
        roots.add(path.parents[entry.file.count("/")])

    try:
        client.bring(at, wanted, None, done=done, checked=memo.is_right, progress=progress)
    finally:
        memo.save()
    return DatasetFolder(roots.pop(), manifest=part, origin=origin_of(at, manifest))


def _manifest(at: client.Revision) -> tuple[Manifest, dict[str, client.RemoteFile] | None]:
    """Return the manifest, from the cache where the network is off, and what the Hub has."""
    if not is_offline():
        return fetch_manifest(at, None)
    from huggingface_hub import try_to_load_from_cache

    found = try_to_load_from_cache(at.repo, MANIFEST_FILE, revision=at.commit, repo_type="dataset")
    if not isinstance(found, str):
        raise client.not_here(at)
    return parse_manifest(at, Path(found)), None


class HubFolder(DatasetFolder):
    """A dataset on the Hub whose shards come when they are read, the next ones ahead of time.

    Parameters
    ----------
    at : Revision
        Which commit.
    manifest : Manifest
        Its manifest.
    index : pathlib.Path or None
        The index of its episodes; without one every shard must come once before the first row.
    origin : Origin
        Where it came from.
    store : ShardStore
        The bounded cache.
    ahead : int
        How many shards to fetch ahead.

    Notes
    -----
    Can be pickled and forked; each process fetches for itself into the common cache.
    """

    def __init__(
        self,
        at: client.Revision,
        manifest: Manifest,
        index: Path | None,
        origin: Origin,
        store: ShardStore,
        ahead: int,
    ) -> None:
        largest = max((shard.bytes for shard in manifest.shards), default=1)
        if store.limit < largest:
            raise ConfigError(
                f"cache_bytes is {store.limit:,}, expected at least the largest shard of {at}, {largest:,} bytes."
            )
        self.room = store.limit // largest
        super().__init__(store.folder, manifest=manifest, origin=origin, max_open=min(self.room, MAX_OPEN))
        self._at, self._index_file, self._store = at, index, store
        # one in use, the rest ahead
        self._ahead = min(ahead, self.room - 1)
        self._order: list[int] = []
        self._coming: dict[int, Future[None]] = {}
        self._pool: ThreadPoolExecutor | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_order": [], "_coming": {}, "_pool": None}

    def _index(self) -> Episodes:
        return super()._index() if self._index_file is None else read_index(self._index_file, self.manifest)

    def shard(self, index: int) -> Shard:
        """Return shard `index`, fetched if it is not here; the ones after it are fetched meanwhile."""
        self._look_ahead(index)
        return super().shard(index)

    def _open_shard(self, entry: ShardEntry) -> Shard:
        shard = self._store.open(self._at, entry)
        if self._index_file is not None:
            episodes = self.episodes
            mine = episodes.shard == self.manifest.shards.index(entry)
            columns = (episodes.sequence, episodes.episode, episodes.start, episodes.event)
            check_shard_index(shard, tuple(column[mine] for column in columns))
        return shard

    def expect(self, shards: Iterable[int]) -> None:
        """Take note of which shards will be read next, in this order; an empty order ends fetching ahead."""
        self._forget_if_forked()
        self._order = list(dict.fromkeys(int(k) for k in shards))
        if not self._order and self._pool is not None:
            for coming in self._coming.values():
                coming.cancel()
            wait(self._coming.values())
            self._pool.shutdown()
            self._pool, self._coming = None, {}

    def _forget_if_forked(self) -> None:
        if self._pid != os.getpid():  # threads do not survive a fork
            self._pool, self._coming = None, {}

    def _look_ahead(self, index: int) -> None:
        self._forget_if_forked()
        if self._ahead < 1 or index not in self._order:
            return
        at = self._order.index(index)
        self._coming = {k: f for k, f in self._coming.items() if not f.done()}
        for k in self._order[at + 1 : at + 1 + self._ahead]:
            if k not in self._coming and not self._store.has(self.manifest.shards[k]):
                self._pool = self._pool or ThreadPoolExecutor(max_workers=1, thread_name_prefix="navrep-data-ahead")
                self._coming[k] = self._pool.submit(self._fetch_ahead, self.manifest.shards[k])

    def _fetch_ahead(self, entry: ShardEntry) -> None:
        # whoever needs the shard will meet the same error, and say so
        with contextlib.suppress(NavrepDataError):
            self._store.fetch(self._at, entry)


def open_stream(
    repo: str,
    *,
    revision: str | None = None,
    token: str | bool | None = None,
    cache_bytes: int = STREAM_CACHE_BYTES,
    ahead: int = 2,
) -> HubFolder:
    """Return a dataset of the Hub whose shards are fetched when they are read.

    Parameters
    ----------
    repo, revision, token
        As for :func:`navrep_data.datasets.pull`.
    cache_bytes : int
        Bound on the shards kept on disk, those on their way included; the ones used longest ago go first.
    ahead : int
        Shards fetched ahead of the one that is read.

    Raises
    ------
    ConfigError
        If the cache is too small for a shard.
    DatasetNotFoundError, DatasetError, CorruptDataError, HubError, OfflineError
        If there is no such dataset, or it cannot be had.
    """
    cache_bytes, ahead = check_whole("cache_bytes", cache_bytes, 1), check_whole("prefetch", ahead, 0)
    at = client.resolve(repo, "dataset", revision, token)
    manifest, there = _manifest(at)
    listed = [entry for entry in manifest.extras if entry.file == INDEX_FILE]
    if there is not None:
        client.check_listed(at, there, [*(FileEntry(s.file, s.sha256, s.bytes) for s in manifest.shards), *listed])
    found: list[Path] = []
    client.bring(at, listed, None, done=lambda _, path: found.append(path))
    store = ShardStore(cache_dir() / "hub" / "shards", cache_bytes)
    return HubFolder(at, manifest, found[0] if found else None, origin_of(at, manifest), store, ahead)


def check_room(folder: HubFolder, sequences: int, shards: Sequence[ShardEntry]) -> None:
    """Raise ConfigError unless the shards of so many sequences fit into the cache together."""
    # the last shard of a split may have fewer
    fewest = min((one.count for one, after in pairwise(shards) if one.split == after.split), default=1)
    together = min(-(-sequences // fewest) + 1, len(shards))
    if together > folder.room:
        need = together * max(s.bytes for s in shards)
        raise ConfigError(
            f"cache_bytes holds {folder.room} shards, expected {together} for buffer_sequences={sequences}: give at "
            f"least {need:,} bytes, or lower buffer_sequences."
        )


__all__ = ["STREAM_CACHE_BYTES", "HubFolder", "check_room", "open_stream", "open_whole"]
