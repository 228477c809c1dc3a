"""Datasets on the Hugging Face Hub: push, pull, and open them there."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from navrep_data.datasets._hub_extras import make_extras
from navrep_data.errors import (
    ConfigError,
    CorruptDataError,
    DatasetError,
    DatasetNotFoundError,
    DiskSpaceError,
    FolderInUseError,
)
from navrep_data.hub import client
from navrep_data.hub.upload import upload
from navrep_data.io import fsync_dir, json_bytes, parse_repo, read_json, safe_join, sha256_bytes, translate_os_error
from navrep_data.shards import (
    CARD_FILE,
    FILE_NAME,
    MANIFEST_FILE,
    FileEntry,
    Manifest,
    Origin,
    choose_shards,
    content_hash,
    dataset_card,
    read_origin,
    select_shards,
    writer_lock,
)
from navrep_data.shards.lock import LOCK_FILE
from navrep_data.shards.manifest import check_license

STAGING = ".pull"
_MAX_MANIFEST_BYTES = 256 << 20
_MAX_CARD_BYTES = 1 << 20


@dataclass(frozen=True)
class PushResult:
    """What :func:`push` did.

    Attributes
    ----------
    repo, revision : str
        Repository and branch.
    commit : str
        The commit that holds the dataset.
    url : str
        Page of the dataset.
    files, bytes : int
        What the dataset has there, uploaded now or before.
    content_hash : str
        See :func:`navrep_data.shards.content_hash`.
    """

    repo: str
    revision: str
    commit: str
    url: str
    files: int
    bytes: int
    content_hash: str

    def to_dict(self) -> dict[str, Any]:
        """Return JSON values."""
        return asdict(self)


@dataclass(frozen=True)
class PullResult:
    """What :func:`pull` did.

    Attributes
    ----------
    root : pathlib.Path
        The dataset folder.
    repo, commit : str
        Where it came from.
    shards, shards_in_all : int
        In the folder, and in the repository.
    bytes, new_bytes : int
        Of the dataset's files, and of those that were downloaded now.
    complete : bool
        Whether the folder has all of it.
    content_hash : str
        See :func:`navrep_data.shards.content_hash`.
    """

    root: Path
    repo: str
    commit: str
    shards: int
    shards_in_all: int
    bytes: int
    new_bytes: int
    complete: bool
    content_hash: str

    def to_dict(self) -> dict[str, Any]:
        """Return JSON values."""
        return {**asdict(self), "root": str(self.root)}


def push(
    root: str | os.PathLike[str],
    repo: str,
    *,
    license: str | None = None,
    private: bool = False,
    revision: str | None = None,
    message: str | None = None,
    token: str | bool | None = None,
) -> PushResult:
    """Publish a dataset on the Hub, in one commit; the folder itself stays as it is.

    Parameters
    ----------
    root : path-like
        Dataset folder, complete.
    repo : str
        ``user/name``; made if there is none.
    license : str, optional
        Identifier as on the Hub (``cc-by-4.0``, ``mit``, ``other``). Needed unless the dataset has one, as a pulled one
        does.
    private : bool
        Whether a new repository is private.
    revision : str, optional
        Branch, made if there is none; ``main`` by default.
    message : str, optional
        Of the commit.
    token : str or bool, optional
        As huggingface_hub takes it; by default the one that is logged in.

    Returns
    -------
    PushResult
        With the commit.

    Raises
    ------
    ConfigError
        If there is no licence or the repository's name is none.
    DatasetError, CorruptDataError
        If the dataset is not complete, or a file differs from its hash in the manifest: nothing is published.
    HubError, OfflineError
        If the Hub refuses or cannot be reached. What was uploaded is not uploaded again by the next call.

    Notes
    -----
    Added on the way: the licence, an index of the episodes (so that streams open without reading all shards), a picture
    and a GIF drawn from the data where it has worlds and humans. Files of an older version that the new one lacks are
    removed in the same commit; other people's commits in between are noticed, not overwritten.
    """
    root = Path(root)
    name, branch = parse_repo(repo, revision)
    manifest = Manifest.read(root)
    if not manifest.complete:
        state = "is a part of a dataset" if manifest.partial else "is not finished"
        raise DatasetError(f"{root} {state}, expected a complete one: generate or pull the rest first.")
    chosen = license or manifest.license
    if chosen is None:
        raise ConfigError(
            f"{root} has no licence, expected one to publish it under: --license cc-by-4.0 (cc0-1.0, mit, other, ...)."
        )
    if problem := check_license(chosen):
        raise ConfigError(f"{problem[0].upper()}{problem[1:]}.")
    client.require_network(f"push {root} to {name}")
    whole, small = published(root, chosen)
    files: dict[str, bytes | Path] = {
        entry.file: safe_join(root, entry.file) for entry in _listed(whole) if entry.file not in small
    }
    commit = upload(
        name,
        "dataset",
        {**files, **small},
        {entry.file: entry for entry in _listed(whole)},
        branch=branch,
        private=private,
        message=message or f"{whole.env}: {whole.rows:,} steps",
        token=token,
        ours=FILE_NAME,  # not what somebody added
    )
    return PushResult(
        repo=name,
        revision=branch,
        commit=commit.commit,
        url=f"{commit.endpoint}/datasets/{name}",
        files=len(files) + len(small),
        bytes=sum(entry.bytes for entry in _listed(whole)),
        content_hash=content_hash(whole),
    )


def published(root: Path, license: str) -> tuple[Manifest, dict[str, bytes]]:
    """Return what the dataset in `root` is once published: its manifest, and the files that a push adds, by name."""
    manifest = Manifest.read(root)
    small: dict[str, bytes] = {}
    if not (manifest.extras and all(client.is_right(safe_join(root, e.file), e) for e in manifest.extras)):
        small = make_extras(root)
        extras = tuple(FileEntry(name, sha256_bytes(data), len(data)) for name, data in small.items())
        manifest = replace(manifest, extras=extras)
    manifest = replace(manifest, license=license, card_sha256=None)
    card = dataset_card(manifest).encode()
    manifest = replace(manifest, card_sha256=sha256_bytes(card))
    return manifest, {**small, CARD_FILE: card, MANIFEST_FILE: json_bytes(manifest.to_dict())}


def _listed(manifest: Manifest) -> list[FileEntry]:
    """Return all files that a manifest lists, shards with their worlds first."""
    found: list[FileEntry] = []
    for shard in manifest.shards:
        found.append(FileEntry(shard.file, shard.sha256, shard.bytes))
        found += [shard.worlds] if shard.worlds else []
    return [*found, *manifest.extras]


def fetch_manifest(at: client.Revision, folder: Path | None) -> tuple[Manifest, dict[str, client.RemoteFile]]:
    """Return the manifest of a commit, checked, and all files that the Hub has at that commit.

    Raises
    ------
    DatasetNotFoundError
        If the repository holds no dataset of this package.
    CorruptDataError, SchemaVersionError
        If the manifest is damaged, names files elsewhere, or is of a newer version.
    DatasetError
        If the dataset was pushed unfinished, by other means than ours.
    """
    there = client.remote_files(at)
    listed = there.get(MANIFEST_FILE)
    if listed is None:
        raise DatasetNotFoundError(f"{at} has no {MANIFEST_FILE}, expected a dataset from `navrep-data push`.")
    if listed.bytes > _MAX_MANIFEST_BYTES:
        raise DatasetError(f"{at} has a {MANIFEST_FILE} of {listed.bytes:,} bytes, expected at most 256 MiB.")
    found: list[Path] = []
    # not hashed anywhere else: it holds a hash over itself, which Manifest checks
    client.bring(
        at,
        [FileEntry(MANIFEST_FILE, "", listed.bytes)],
        folder,
        done=lambda _, path: found.append(path),
        checked=lambda path, entry: path.stat().st_size == entry.bytes,
    )
    return parse_manifest(at, found[0]), there


def parse_manifest(at: client.Revision, path: Path) -> Manifest:
    """Return the manifest in the file that came from the Hub, checked; see :func:`fetch_manifest`."""
    manifest = Manifest.from_dict(read_json(path), Path(f"{at.repo}"))
    if not manifest.complete:
        raise DatasetError(f"{at} holds an unfinished dataset, expected one that `navrep-data push` put there.")
    return manifest


def origin_of(at: client.Revision, manifest: Manifest) -> Origin:
    """Return the record of where a dataset came from."""
    return Origin(at.repo, at.commit, at.asked, at.endpoint, manifest.to_dict()["manifest_sha256"])


def pull(
    repo: str,
    out: str | os.PathLike[str] | None = None,
    *,
    revision: str | None = None,
    split: str | None = None,
    shards: Iterable[int] | None = None,
    token: str | bool | None = None,
    progress: bool | None = None,
) -> PullResult:
    """Bring a dataset from the Hub into a folder, every file checked against its SHA-256 before it is put in place.

    Parameters
    ----------
    repo : str
        ``user/name``, with ``@revision`` if you like.
    out : path-like, optional
        Dataset folder, ``data/<name>`` by default: new, empty, or with a part of the same dataset from the same
        repository, which is completed. Nothing else is touched.
    revision : str, optional
        Branch, tag or commit; ``main`` by default.
    split : {"train", "val", "test"}, optional
        Only shards that hold a sequence of this split.
    shards : iterable of int, optional
        Only these.
    token : str or bool, optional
        As huggingface_hub takes it.
    progress : bool, optional
        Show a bar on stderr; default if that is a terminal.

    Returns
    -------
    PullResult
        What came.

    Raises
    ------
    ConfigError
        If there is no such split or shard.
    FolderInUseError
        If the folder holds something else.
    CorruptDataError
        If a file does not have its hash, twice. It is not kept; all others are, for the next call.
    DatasetNotFoundError, DatasetError, HubError, OfflineError, DiskSpaceError
        If there is no such dataset, or it cannot be had.

    Notes
    -----
    A part is a dataset: its manifest lists what is there and says of how much; ``info``, ``verify`` and the loaders
    take it. A later pull into the same folder adds to it.
    """
    name, asked = parse_repo(repo, revision)
    root = Path(out) if out is not None else Path("data") / name.split("/")[1]
    client.require_network(f"pull {name}")
    at = client.resolve(name, "dataset", asked, token)
    fresh = not root.exists()
    try:
        root.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise translate_os_error(error, root) from error
    try:
        with writer_lock(root):
            return _Pull(root, at, progress).run(split, shards)
    finally:
        if fresh and {path.name for path in root.iterdir()} <= {LOCK_FILE}:
            shutil.rmtree(root)


class _Pull:
    """One pull into a locked folder."""

    def __init__(self, root: Path, at: client.Revision, progress: bool | None) -> None:
        self.root, self.at, self.progress = root, at, progress
        self.staging = root / STAGING
        self.old = self._held()

    def _held(self) -> Manifest | None:
        """Return the manifest of the part that is there, None in an empty folder; refuse everything else."""
        root, repo = self.root, self.at.repo
        if (root / MANIFEST_FILE).exists():
            origin = read_origin(root)
            if origin is None or origin.repo != repo:
                whose = f"a dataset from {origin}" if origin else "a dataset that did not come from the Hub"
                raise FolderInUseError(f"{root} holds {whose}; it is left alone. Choose another folder with --out.")
            return Manifest.read(root)
        begun = read_origin(self.staging)
        others = sorted(p.name for p in root.iterdir() if p.name not in (LOCK_FILE, STAGING))
        if others and (begun is None or begun.repo != repo):
            raise FolderInUseError(
                f"{root} holds {others[0]!r} and no dataset of {repo}; it is left alone. Choose another --out."
            )
        return None

    def run(self, split: str | None, shards: Iterable[int] | None) -> PullResult:
        begun = self.staging.exists()
        self.staging.mkdir(exist_ok=True)
        try:
            whole, there = fetch_manifest(self.at, self.staging)
            chosen = choose_shards(whole, split=split, shards=shards)
            part = select_shards(whole, sorted({*chosen, *self._kept(whole)}))
            wanted = _listed(part)
            client.check_listed(self.at, there, wanted)
            missing = [e for e in wanted if not client.is_right(safe_join(self.root, e.file), e)]
            self._check_space(missing)
            card = self._card(whole, there) if part is whole else dataset_card(part)
        except Exception:
            if not begun:  # nothing of worth has come yet
                shutil.rmtree(self.staging, ignore_errors=True)
            raise
        origin = origin_of(self.at, whole)
        origin.save(self.staging)
        client.bring(self.at, missing, self.staging, done=self._put, progress=self.progress)
        origin.save(self.root)
        part.save(self.root, card)
        shutil.rmtree(self.staging)
        return PullResult(
            root=self.root,
            repo=self.at.repo,
            commit=self.at.commit,
            shards=len(part.shards),
            shards_in_all=len(whole.shards),
            bytes=sum(e.bytes for e in wanted),
            new_bytes=sum(e.bytes for e in missing),
            complete=part.complete,
            content_hash=content_hash(part),
        )

    def _kept(self, whole: Manifest) -> Sequence[int]:
        """Return the positions, in the new version, of the shards that are there already."""
        if self.old is None:
            return ()
        at = {(s.file, s.sha256): k for k, s in enumerate(whole.shards)}
        for shard in self.old.shards:
            if (shard.file, shard.sha256) not in at:
                raise FolderInUseError(
                    f"{self.root} holds {shard.file} of another version than {self.at} has; it is left alone. Choose "
                    "another folder with --out."
                )
        return [at[s.file, s.sha256] for s in self.old.shards]

    def _card(self, whole: Manifest, there: Mapping[str, client.RemoteFile]) -> str:
        """Return the card whose hash the manifest gives: as this version writes it, else as the Hub has it."""
        card = dataset_card(whole)
        if sha256_bytes(card.encode()) == whole.card_sha256:
            return card
        listed = there.get(CARD_FILE)
        if listed is None or listed.bytes > _MAX_CARD_BYTES or whole.card_sha256 is None:
            raise CorruptDataError(f"{self.at} lacks the {CARD_FILE} that its manifest gives the hash of.")
        found: list[str] = []
        entry = FileEntry(CARD_FILE, whole.card_sha256, listed.bytes)
        client.bring(self.at, [entry], self.staging, done=lambda _, path: found.append(path.read_text("utf-8")))
        return found[0]

    def _check_space(self, missing: Sequence[FileEntry]) -> None:
        need, free = sum(e.bytes for e in missing), shutil.disk_usage(self.root).free
        if need > free:
            raise DiskSpaceError(
                f"{self.root} needs {need:,} bytes, {free:,} are free: make room, or pull fewer shards (--shards 0-9)."
            )

    def _put(self, entry: FileEntry, path: Path) -> None:
        """Put a checked file in its place."""
        target = safe_join(self.root, entry.file)
        target.parent.mkdir(exist_ok=True)
        os.replace(path, target)
        fsync_dir(target.parent)


def parse_shards(text: str) -> list[int]:
    """Return the numbers in ``0-9,12``.

    Raises
    ------
    ConfigError
        If that is not what `text` looks like.
    """
    numbers: set[int] = set()
    for piece in text.split(","):
        found = re.fullmatch(r"\s*(\d{1,6})(?:-(\d{1,6}))?\s*", piece)
        first, last = (int(found[1]), int(found[2] or found[1])) if found else (1, 0)
        if first > last:
            raise ConfigError(f"--shards is {text!r}, expected numbers and ranges as in 0-9,12.")
        numbers |= set(range(first, last + 1))
    return sorted(numbers)
