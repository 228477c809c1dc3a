"""Files to the Hub: whole repositories in one commit, checked before and after."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from navrep_data.errors import CorruptDataError, HubError
from navrep_data.hub import client
from navrep_data.shards import FileEntry


def upload(
    repo: str,
    kind: client.Kind,
    files: Mapping[str, bytes | Path],
    expected: Mapping[str, FileEntry],
    *,
    branch: str,
    private: bool,
    message: str,
    token: str | bool | None,
    ours: re.Pattern[str],
) -> client.Revision:
    """Put files into a repository, made if there is none, in one commit.

    Parameters
    ----------
    repo : str
        ``user/name``.
    kind : {"dataset", "model"}
        Kind of repository.
    files : mapping of str to bytes or pathlib.Path
        Contents by name in the repository.
    expected : mapping of str to FileEntry
        Sizes and hashes that files must have, before and after.
    branch, private, message, token
        As for :func:`navrep_data.datasets.hub.push`.
    ours : re.Pattern
        Names that are removed where they are in the repository and not in `files`.

    Raises
    ------
    CorruptDataError
        If a file is not what it must be; nothing is published.
    HubError, OfflineError
        If the Hub refuses or cannot be reached, or holds something else afterwards.
    """
    from huggingface_hub import HfApi

    api = HfApi(token=token)
    what = f"push to {kind} {repo}"
    # hashing comes first: a wrong file is found before anything is sent
    hashes = {name: _checked_hash(name, content, expected.get(name)) for name, content in files.items()}
    client.call(what, lambda: api.create_repo(repo, repo_type=kind, private=private or None, exist_ok=True))
    if branch != "main":
        client.call(what, lambda: api.create_branch(repo, branch=branch, repo_type=kind, exist_ok=True))

    def send() -> str:
        from huggingface_hub import CommitOperationAdd, CommitOperationDelete

        # what the branch holds now: a commit that somebody makes in between is noticed, not overwritten
        head = client.resolve(repo, kind, branch, token)
        gone = [name for name in client.remote_files(head) if ours.fullmatch(name) and name not in files]
        operations: list[CommitOperationAdd | CommitOperationDelete] = []
        for name, content in files.items():
            add = CommitOperationAdd(name, content if isinstance(content, bytes) else str(content))
            add.upload_info.sha256 = hashes[name]
            operations.append(add)
        operations += [CommitOperationDelete(name) for name in gone]
        done = api.create_commit(
            repo,
            operations,
            commit_message=message,
            repo_type=kind,
            revision=branch,
            parent_commit=head.commit,
            num_threads=client.THREADS,
        )
        return str(done.oid)

    with client.quiet():
        commit = client.call(what, send)
    at = client.resolve(repo, kind, commit, token)
    there = client.remote_files(at)
    for name, content in files.items():
        size = len(content) if isinstance(content, bytes) else content.stat().st_size
        found = there.get(name)
        if found is None or found.bytes != size or found.sha256 not in (None, hashes[name].hex()):
            raise HubError(f"After the push, {at} does not hold {name} as it was sent: run the same command again.")
    return client.Revision(repo, kind, at.commit, branch, at.endpoint, token)


def _checked_hash(name: str, content: bytes | Path, expected: FileEntry | None) -> bytes:
    from navrep_data.io import sha256_bytes, sha256_file

    if isinstance(content, bytes):
        return bytes.fromhex(sha256_bytes(content))
    if not content.is_file():
        raise CorruptDataError(f"{content} is missing; run `navrep-data verify` on its folder. Nothing was published.")
    found = sha256_file(content)
    if expected is not None and found != expected.sha256:
        raise CorruptDataError(
            f"{content} differs from its SHA-256 in the manifest; run `navrep-data verify` on its folder, then make or "
            f"get {name} again. Nothing was published."
        )
    return bytes.fromhex(found)
