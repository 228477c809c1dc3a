"""The Hub as huggingface_hub's own client sees it: with an end to waiting, checked files, and one-line errors."""

from __future__ import annotations

import contextlib
import random
import re
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Literal, TypeVar

from navrep_data.errors import CorruptDataError, HubError, NavrepDataError, OfflineError
from navrep_data.io import (
    atomic_write_bytes,
    is_offline,
    parse_repo,
    sha256_file,
    switched_off,
    translate_os_error,
)
from navrep_data.shards import FileEntry

Kind = Literal["dataset", "model"]
T = TypeVar("T")

ATTEMPTS = 5
BACKOFF = 0.5
# What a server may ask us to wait for [s]; a longer wait is told to the user instead.
MAX_RETRY_AFTER = 120.0
# huggingface_hub waits for ever for answers of its API; a commit of thousands of files takes a while.
SILENCE = 120.0
MAX_FILES = 200_000
# Files are fetched, checked and put in place so many at a time.
FILES_AT_ONCE, BYTES_AT_ONCE = 16, 512 << 20
THREADS = 4
_SLACK = 1 << 20
_BUSY = frozenset({408, 425, 429, 500, 502, 503, 504})
COMMIT = re.compile(r"[0-9a-f]{40}")


class _AgainError(Exception):
    """The client gave less than was asked for, because the Hub did not answer it."""


@dataclass(frozen=True)
class Revision:
    """One commit of a repository.

    Attributes
    ----------
    repo : str
        ``user/name``.
    kind : {"dataset", "model"}
        What it holds.
    commit : str
        40 hex digits.
    asked : str
        The branch, tag or commit that was asked for.
    endpoint : str
        Address of the Hub.
    token : str, bool or None
        As huggingface_hub takes it.
    """

    repo: str
    kind: Kind
    commit: str
    asked: str
    endpoint: str
    token: str | bool | None = None

    def __str__(self) -> str:
        return f"{self.repo}@{self.commit[:12]}"


@dataclass(frozen=True)
class RemoteFile:
    """What the Hub says of a file: its size, and its SHA-256 where it is a large file."""

    bytes: int
    sha256: str | None


def require_network(what: str) -> None:
    """Raise OfflineError if the network is switched off."""
    if is_offline():
        raise OfflineError(f"The network is switched off ({switched_off()}), cannot {what}: unset it.")


def call(what: str, function: Callable[[], T]) -> T:
    """Call the Hub until it answers, or until it is of no use.

    Parameters
    ----------
    what : str
        For errors, as ``pull user/name``.
    function : callable
        Talks to the Hub; may be called again.

    Raises
    ------
    HubError, OfflineError, DiskSpaceError
        One line each, see :func:`explain`.
    """
    failures = 0
    while True:
        try:
            _limit_silence()
            return function()
        except NavrepDataError:
            raise
        except Exception as error:
            reason, wait = _passing(error)
            failures += 1
            if reason is None:
                raise explain(what, error) from error
            if failures >= ATTEMPTS or (wait or 0.0) > MAX_RETRY_AFTER:
                later = f"; it asks to come back in {wait:.0f} s" if wait else ""
                raise HubError(
                    f"Gave up after {failures} attempts to {what}: {reason}{later}. What has arrived is kept; run the "
                    "same command again to go on."
                ) from error
        # jitter, so that many processes do not come back at the same moment
        time.sleep(BACKOFF * 2.0 ** (failures - 1) * (1.0 + random.random() / 4) if wait is None else wait)


def _limit_silence() -> None:
    from huggingface_hub import get_session

    session = get_session()
    hooks = session.event_hooks
    if _bound not in hooks["request"]:
        session.event_hooks = {**hooks, "request": [*hooks["request"], _bound]}


def _bound(request: Any) -> None:
    """Give a request of huggingface_hub that would wait for ever an end."""
    given = request.extensions.get("timeout", {})
    request.extensions["timeout"] = {
        name: SILENCE if given.get(name) is None else given[name] for name in ("connect", "read", "write", "pool")
    }


def _chain(error: BaseException) -> Iterable[BaseException]:
    seen: set[int] = set()
    current: BaseException | None = error
    while current is not None and id(current) not in seen:
        seen.add(id(current))
        yield current
        current = current.__cause__ or current.__context__


def _response(error: BaseException) -> Any:
    """Return the HTTP answer behind an error, None where there was none."""
    return next((r for e in _chain(error) if (r := getattr(e, "response", None)) is not None), None)


def _passing(error: Exception) -> tuple[str | None, float | None]:
    """Return why an error may pass, and how long [s] the server asks to wait; (None, None) for one that stays."""
    import httpx2

    response = _response(error)
    if response is not None:
        if response.status_code not in _BUSY:
            return None, None
        after = response.headers.get("retry-after", "")
        return f"the Hub answers {response.status_code}", float(after) if after.isdecimal() else None
    for e in _chain(error):
        if isinstance(e, _AgainError):
            return str(e), None
        if isinstance(e, httpx2.ProxyError | httpx2.UnsupportedProtocol | httpx2.InvalidURL):
            return None, None
        if isinstance(e, httpx2.TimeoutException):
            return "the Hub is silent", None
        if isinstance(e, httpx2.TransportError):
            return str(e) or type(e).__name__, None
        if type(e) is OSError and e.errno is None and "Consistency check failed" in str(e):
            return "a file arrived with another size than announced", None
    return None, None


def explain(what: str, error: Exception) -> NavrepDataError:
    """Return the one-line error that says what is wrong and what to do."""
    from huggingface_hub import errors

    found = list(_chain(error))
    if any(isinstance(e, errors.OfflineModeIsEnabled) for e in found):
        return OfflineError(f"The network is switched off (HF_HUB_OFFLINE), cannot {what}: unset it.")
    response = _response(error)
    for kind, words in (
        (
            errors.GatedRepoError,
            "it is gated: ask for access on its page, then log in with `hf auth login`",
        ),
        (errors.RevisionNotFoundError, "there is no such revision; check --revision"),
        (
            errors.RemoteEntryNotFoundError,
            "it lacks a file; check that navrep-data wrote it",
        ),
        (
            errors.RepositoryNotFoundError,
            "there is no such repository, or it is private; check the name, log in with `hf auth login` (or HF_TOKEN)",
        ),
    ):
        if any(isinstance(e, kind) for e in found):
            return HubError(f"Cannot {what}: {words}.")
    if response is None:
        if isinstance(error, OSError) and error.errno is not None:
            translated = translate_os_error(error, Path(error.filename or "."))
            if isinstance(translated, NavrepDataError):
                return translated
        first = found[-1]  # what began it says more than what was made of it
        return HubError(f"Cannot {what}: {str(first).strip().rstrip('.') or type(first).__name__}.")
    said = response.headers.get("x-error-message", "")
    advice = {
        401: "it is private or not there, or the token is not accepted; log in with `hf auth login`, or set HF_TOKEN",
        403: "the token may not do that; make one that may write, and log in with `hf auth login`",
        409: "the repository is in the way of another one",
        412: "somebody else changed the repository meanwhile; run the same command again",
        413: "the Hub takes no more",
    }.get(response.status_code, f"the Hub answers {response.status_code}")
    return HubError(f"Cannot {what}: {advice}{f' (it says: {said})' if said else ''}.")


def resolve(text: str, kind: Kind, revision: str | None = None, token: str | bool | None = None) -> Revision:
    """Return the commit that a revision stands for now; offline, the one it stood for when it was last asked.

    Parameters
    ----------
    text : str
        ``user/name``, ``hf://user/name@revision``.
    kind : {"dataset", "model"}
        Kind of repository.
    revision : str, optional
        Branch, tag or commit, ``main`` by default.
    token : str or bool, optional
        As huggingface_hub takes it: by default the one that is logged in.

    Raises
    ------
    ConfigError
        If the name is none.
    HubError, OfflineError
        If it cannot be told.
    """
    from huggingface_hub import HfApi, constants

    repo, asked = parse_repo(text, revision)
    commit = asked
    if not COMMIT.fullmatch(asked):
        if is_offline():
            commit = _remembered(repo, kind, asked)
        else:
            api = HfApi(token=token)
            # not resolve_revision: when the Hub is busy, that gives an old commit without a word
            what = f"find {kind} {repo} at revision {asked} on {constants.ENDPOINT}"
            commit = str(call(what, lambda: api.repo_info(repo, repo_type=kind, revision=asked)).sha)
    if not COMMIT.fullmatch(commit):
        raise HubError(f"The Hub gave commit {commit!r} for {repo}, expected 40 hex digits: ask another endpoint.")
    if commit != asked and not is_offline():
        _remember(repo, kind, asked, commit)
    return Revision(repo, kind, commit, asked, constants.ENDPOINT, token)


def _reference(repo: str, kind: Kind, asked: str) -> Path:
    """Return the file in huggingface_hub's cache that tells which commit a branch was when it was last asked."""
    from huggingface_hub import constants

    return Path(constants.HF_HUB_CACHE, f"{kind}s--{repo.replace('/', '--')}", "refs", *asked.split("/"))


def _remember(repo: str, kind: Kind, asked: str, commit: str) -> None:
    path = _reference(repo, kind, asked)
    with contextlib.suppress(OSError, NavrepDataError):  # a cache that cannot be written is no reason to stop
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic_write_bytes(path, commit.encode())


def _remembered(repo: str, kind: Kind, asked: str) -> str:
    try:
        with open(_reference(repo, kind, asked), "rb") as file:
            return file.read(100).decode("ascii", "replace").strip()
    except OSError as error:
        raise OfflineError(
            f"The network is switched off ({switched_off()}) and {repo}@{asked} was never fetched: unset it "
            "or give a commit that was."
        ) from error


def remote_files(at: Revision) -> dict[str, RemoteFile]:
    """Return all files of a commit with their sizes.

    Raises
    ------
    HubError
        If it cannot be had, or has more than 200,000 files.
    """
    from huggingface_hub import HfApi, RepoFile

    api = HfApi(token=at.token)

    def listing() -> dict[str, RemoteFile]:
        tree = api.list_repo_tree(at.repo, recursive=True, revision=at.commit, repo_type=at.kind)
        found = {
            f.path: RemoteFile(f.size, f.lfs.sha256 if f.lfs is not None else None)
            for f in islice(tree, MAX_FILES + 1)
            if isinstance(f, RepoFile)
        }
        if len(found) > MAX_FILES:
            raise HubError(f"{at} has more than {MAX_FILES:,} files, expected a repository that navrep-data wrote.")
        return found

    return call(f"list the files of {at.kind} {at.repo}", listing)


def check_listed(at: Revision, there: Mapping[str, RemoteFile], wanted: Iterable[FileEntry]) -> None:
    """Raise CorruptDataError unless the Hub has the wanted files with the sizes and hashes they must have."""
    for entry in wanted:
        found = there.get(entry.file)
        if found is None:
            raise CorruptDataError(f"{at} lacks {entry.file}, which its manifest lists: it was not pushed whole.")
        if found.bytes != entry.bytes or (found.sha256 is not None and found.sha256 != entry.sha256):
            raise CorruptDataError(
                f"{at} holds another {entry.file} ({found.bytes:,} bytes) than its manifest says ({entry.bytes:,}, "
                f"sha256 {entry.sha256[:12]}...): it was changed after it was pushed."
            )


def _meter(limit: int, show: bool | None) -> type[Any]:
    """Return a progress bar for huggingface_hub that ends a download which brings more than was announced."""
    from huggingface_hub.utils.tqdm import tqdm

    class Meter(tqdm):
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            self.seen = 0
            kwargs["disable"] = not (sys.stderr.isatty() if show is None else show)
            super().__init__(*args, **kwargs)  # type: ignore[no-untyped-call]

        def update(self, n: float | None = 1) -> bool | None:
            self.seen += int(n or 0)
            if self.seen > limit:
                raise CorruptDataError(
                    f"The Hub sends more than the {limit - _SLACK:,} bytes that the manifest lists; nothing was kept."
                )
            return bool(super().update(n))

    return Meter


_chunks = threading.Lock()
_chunk_users: list[int] = []


@contextlib.contextmanager
def _keep_what_arrives() -> Iterator[None]:
    """Let huggingface_hub write down every byte as it arrives, so that it goes on from there when it is cut.

    It collects 10 MiB before it writes, and loses them with the connection: over a line that is cut more often than
    that it would never end.
    """
    from huggingface_hub import constants

    with _chunks:
        if not _chunk_users:
            _chunk_users.append(constants.DOWNLOAD_CHUNK_SIZE)
            constants.DOWNLOAD_CHUNK_SIZE = None  # type: ignore[assignment]  # what httpx takes for "as it arrives"
        _chunk_users.append(0)
    try:
        yield
    finally:
        with _chunks:
            _chunk_users.pop()
            if len(_chunk_users) == 1:
                constants.DOWNLOAD_CHUNK_SIZE = _chunk_users.pop()


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Silence huggingface_hub's bars for uploads where nobody watches stderr, unless the user forced them."""
    from huggingface_hub import constants
    from huggingface_hub.utils.tqdm import are_progress_bars_disabled, disable_progress_bars, enable_progress_bars

    if sys.stderr.isatty() or constants.HF_HUB_DISABLE_PROGRESS_BARS is not None or are_progress_bars_disabled():
        yield
        return
    disable_progress_bars()
    try:
        yield
    finally:
        enable_progress_bars()


def _portions(wanted: Sequence[FileEntry]) -> Iterable[list[FileEntry]]:
    portion: list[FileEntry] = []
    for entry in wanted:
        if portion and (len(portion) == FILES_AT_ONCE or sum(e.bytes for e in portion) + entry.bytes > BYTES_AT_ONCE):
            yield portion
            portion = []
        portion.append(entry)
    if portion:
        yield portion


def is_right(path: Path, entry: FileEntry) -> bool:
    """Return whether `path` is there and is the file that `entry` describes, by size and SHA-256."""
    return path.is_file() and path.stat().st_size == entry.bytes and sha256_file(path) == entry.sha256


def bring(
    at: Revision,
    wanted: Sequence[FileEntry],
    folder: Path | None,
    *,
    done: Callable[[FileEntry, Path], None] | None = None,
    checked: Callable[[Path, FileEntry], bool] = is_right,
    progress: bool | None = None,
) -> None:
    """Download files and check each against its SHA-256 before it counts.

    Parameters
    ----------
    at : Revision
        Which commit.
    wanted : sequence of FileEntry
        Which files; their names must be checked already.
    folder : pathlib.Path or None
        Where to put them; None = huggingface_hub's cache.
    done : callable, optional
        Called with (entry, path) for each right file, as it comes.
    checked : callable
        Says whether a file is the right one.
    progress : bool, optional
        Show a bar on stderr; default if that is a terminal.

    Raises
    ------
    CorruptDataError
        If a file is wrong twice. It is not kept.
    HubError, OfflineError, DiskSpaceError
        If a file cannot be had.
    """
    for portion in _portions(wanted):
        left = portion
        for last in (False, True):
            paths = _download(at, left, folder, progress)
            wrong = []
            for entry in left:
                if checked(paths[entry.file], entry):
                    if done is not None:
                        done(entry, paths[entry.file])
                else:
                    _throw_away(paths[entry.file])
                    wrong.append(entry)
            if not wrong:
                break
            if last:
                raise CorruptDataError(
                    f"{at} gave a {wrong[0].file} that does not have its SHA-256 ({wrong[0].sha256[:12]}...), twice. "
                    "It was not kept: the Hub, a mirror or a proxy changes it; try later or another HF_ENDPOINT."
                )
            left = wrong


def _throw_away(path: Path) -> None:
    """Remove a wrong file; in the cache a name is a link to the content, which goes too."""
    if path.is_symlink():
        path.resolve().unlink(missing_ok=True)
    path.unlink(missing_ok=True)


def _download(at: Revision, wanted: Sequence[FileEntry], folder: Path | None, progress: bool | None) -> dict[str, Path]:
    from huggingface_hub import snapshot_download

    meter = _meter(sum(entry.bytes for entry in wanted) + _SLACK, progress)

    def fetch() -> dict[str, Path]:
        with _keep_what_arrives():
            root = snapshot_download(
                at.repo,
                repo_type=at.kind,
                revision=at.commit,
                allow_patterns=[entry.file for entry in wanted],
                local_dir=folder,
                max_workers=THREADS,
                token=at.token,
                tqdm_class=meter,
                local_files_only=is_offline(),
            )
        paths = {entry.file: Path(root).joinpath(*entry.file.split("/")) for entry in wanted}
        missing = [name for name, path in paths.items() if not path.is_file()]
        if missing:  # huggingface_hub falls back to what is there when the Hub does not answer
            raise _AgainError(f"{missing[0]} did not come")
        return paths

    try:
        return call(f"get {len(wanted)} files of {at.kind} {at.repo}", fetch)
    except HubError as error:
        if is_offline():
            raise not_here(at) from error
        raise


def not_here(at: Revision) -> OfflineError:
    """Return the error for what would have to come from the Hub while the network is off."""
    return OfflineError(f"The network is switched off ({switched_off()}) and {at} is not whole in the cache: unset it.")
