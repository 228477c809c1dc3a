"""Files from the network: resumed where they were cut, checked before they count as present.

Notes
-----
The client is httpx2, the one that huggingface_hub itself runs on, so it costs no further package: it brings separate
timeouts, proxies, the system's certificates, and drops credentials on a redirect to another host.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from navrep_data._version import __version__
from navrep_data.errors import CorruptDataError, DownloadError, OfflineError
from navrep_data.io._files import HASH_BLOCK, PART_SUFFIX, fsync_dir, sha256_file, translate_os_error

if TYPE_CHECKING:
    import httpx2

OFFLINE_VARIABLES = ("NAVREP_DATA_OFFLINE", "HF_HUB_OFFLINE")
# The largest file that the zoo knows of is about 30 MB; a file of unknown size may not fill the disk.
DEFAULT_MAX_BYTES = 128 << 20
MAX_REDIRECTS = 5
MAX_RETRY_AFTER = 30.0
# A connection that brings less than this over a whole timeout [B/s] is as good as stalled.
LEAST_RATE = 256.0
LOCK_TIMEOUT = 600.0
_BUSY = frozenset({408, 425, 429, 500, 502, 503, 504})
_CONTENT_RANGE = re.compile(r"bytes (\d+)-(\d+)/(\d+|\*)$")


@dataclass(frozen=True)
class FileId:
    """What a file must be: its size and hashes, as far as they are known.

    Attributes
    ----------
    size : int or None
        Bytes.
    sha256 : str or None
        64 hex digits.
    git_blob_sha1 : str or None
        40 hex digits: what git calls the file's content; for files of which nothing else is known.
    """

    size: int | None = None
    sha256: str | None = None
    git_blob_sha1: str | None = None

    def __str__(self) -> str:
        if self.sha256:
            return f"sha256 {self.sha256}"
        return f"git blob {self.git_blob_sha1}" if self.git_blob_sha1 else "any content"

    def mismatch(self, path: Path) -> str | None:
        """Return in what the file at `path` differs ("seen, expected"), None if it is the right one.

        The SHA-256 decides where it is known, the git blob id otherwise: one pass over the file.
        """
        size = path.stat().st_size
        if self.size is not None and size != self.size:
            return f"{size:,} bytes, expected {self.size:,}"
        if self.sha256 is not None:
            return _differ("sha256", sha256_file(path), self.sha256)
        if self.git_blob_sha1 is not None:
            return _differ("git blob id", git_blob_sha1(path), self.git_blob_sha1)
        return None


def _differ(what: str, seen: str, expected: str) -> str | None:
    return None if seen == expected else f"{what} {seen}, expected {expected}"


def git_blob_sha1(path: Path | str) -> str:
    r"""Return the id that git gives to a file's content, 40 hex digits.

    Notes
    -----
    SHA-1 of ``blob <size>\0`` and the content. Good against accidents; against forgery only the SHA-256 is.
    """
    path = Path(path)
    digest = hashlib.sha1(b"blob %d\0" % path.stat().st_size, usedforsecurity=False)
    with open(path, "rb", buffering=0) as handle:
        while block := handle.read(HASH_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def switched_off() -> str:
    """Return the variable that switches the network off, as NAME=value; empty if none does."""
    for name in OFFLINE_VARIABLES:
        value = os.environ.get(name, "").strip()
        if value.lower() in ("1", "true", "yes", "on"):
            return f"{name}={value}"
    return ""


def is_offline() -> bool:
    """Return whether ``NAVREP_DATA_OFFLINE`` or ``HF_HUB_OFFLINE`` switches the network off."""
    return bool(switched_off())


class _TryAgainError(Exception):
    """The connection was cut, stalled or refused for now; what arrived is kept."""

    def __init__(self, what: str, wait: float | None = None) -> None:
        super().__init__(what)
        self.wait = wait


@dataclass(frozen=True)
class _Job:
    url: str
    part: Path
    expected: FileId
    max_bytes: int
    timeout: float
    headers: Mapping[str, str]
    progress: Callable[[int, int | None], None]

    @property
    def limit(self) -> int:
        return self.max_bytes if self.expected.size is None else self.expected.size


def download(
    url: str,
    target: Path | str,
    expected: FileId,
    *,
    max_bytes: int = DEFAULT_MAX_BYTES,
    timeout: float = 30.0,
    attempts: int = 5,
    backoff: float = 0.5,
    headers: Mapping[str, str] | None = None,
    progress: bool | None = None,
) -> Path:
    """Bring one file here: afterwards `target` is either as before or the right file.

    Parameters
    ----------
    url : str
        ``http://`` or ``https://`` address.
    target : path-like
        Where the file goes; folders are made. A right file that is there already is kept.
    expected : FileId
        What the file must be.
    max_bytes : int
        Bound on the size where `expected` does not know it.
    timeout : float
        Longest silence of the server [s].
    attempts : int
        Connections in a row that may bring nothing new before giving up.
    backoff : float
        Pause before the second attempt [s]; doubles.
    headers : mapping of str to str, optional
        Sent along, not to other hosts on redirects if it is ``Authorization``.
    progress : bool, optional
        Show a bar on stderr; default if that is a terminal.

    Returns
    -------
    pathlib.Path
        `target`.

    Raises
    ------
    OfflineError
        If the network is switched off.
    DownloadError
        If the server refuses, cannot be reached, or stalls and cuts too often. What arrived stays beside `target` and
        the next call goes on from there.
    CorruptDataError
        If what the server sends is not the expected file. Nothing is kept.
    """
    target = Path(target)
    if is_offline():
        raise OfflineError(
            f"The network is switched off ({switched_off()}), cannot get {url}: bring the file or unset it."
        )
    import filelock

    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with filelock.FileLock(target.with_name(f".{target.name}.lock"), timeout=LOCK_TIMEOUT):
            if target.exists() and expected.mismatch(target) is None:
                return target  # another process brought it while we waited
            # named by content: what was begun of another version is never continued
            key = (expected.sha256 or expected.git_blob_sha1 or hashlib.sha256(url.encode()).hexdigest())[:16]
            part = target.with_name(f".{target.name}.{key}{PART_SUFFIX}")
            with _bar(target.name, progress) as show:
                job = _Job(url, part, expected, max_bytes, timeout, headers or {}, show)
                _fetch_checked(job, attempts, backoff)
            os.replace(part, target)
            fsync_dir(target.parent)
    except filelock.Timeout as error:
        raise DownloadError(
            f"Another process has been downloading {target} for {LOCK_TIMEOUT:.0f} s: wait for it or end it."
        ) from error
    except (DownloadError, CorruptDataError):
        raise
    except OSError as error:
        raise translate_os_error(error, target) from error
    return target


@contextlib.contextmanager
def _bar(name: str, progress: bool | None) -> Iterator[Callable[[int, int | None], None]]:
    from tqdm import tqdm

    # disable=None: silent where stderr is not a terminal
    with tqdm(desc=name, unit="B", unit_scale=True, disable=None if progress is None else not progress) as bar:

        def show(done: int, total: int | None) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield show


def _fetch_checked(job: _Job, attempts: int, backoff: float) -> None:
    """Fill ``job.part`` with the right content, or raise; a wrong one is thrown away and fetched whole once more."""
    for last in (False, True):
        _fetch_all(job, attempts, backoff)
        wrong = job.expected.mismatch(job.part)
        if wrong is None:
            return
        job.part.unlink()
        if last:
            raise CorruptDataError(
                f"{job.url} gave a file of {wrong}, twice. Nothing was kept: the server or a proxy changes it; "
                "get the file elsewhere and name its folder with --from or NAVREP_RELEASED_DIR."
            )


def _fetch_all(job: _Job, attempts: int, backoff: float) -> None:
    import httpx2

    limits = httpx2.Timeout(job.timeout)
    longest, failures = _size(job.part), 0
    with httpx2.Client(timeout=limits, follow_redirects=True, max_redirects=MAX_REDIRECTS) as client:
        while True:
            try:
                _attempt(client, job)
                return
            except _TryAgainError as error:
                size = _size(job.part)
                # a server that cuts but moves on is worth asking as long as it moves on
                failures = 0 if size > longest else failures + 1
                longest = max(longest, size)
                if failures >= attempts:
                    raise DownloadError(
                        f"Gave up on {job.url} after {failures} attempts that brought nothing new: {error}. "
                        f"{size:,} bytes are kept; the same call goes on from there."
                    ) from error
                pause = backoff * 2.0 ** max(failures - 1, 0) if failures else 0.0
                time.sleep(min(pause if error.wait is None else error.wait, MAX_RETRY_AFTER))


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


def _attempt(client: httpx2.Client, job: _Job) -> None:
    """One connection: append to the part file what it lacks."""
    import httpx2

    have = _size(job.part)
    if job.expected.size is not None and have == job.expected.size:
        return
    headers = {"User-Agent": f"navrep-data/{__version__}", "Accept-Encoding": "identity", **job.headers}
    if have:
        headers["Range"] = f"bytes={have}-"
    try:
        with client.stream("GET", job.url, headers=headers) as response:
            start, total = _check_answer(response, job, have)
            with open(job.part, "r+b" if start else "wb") as handle:
                handle.seek(start)
                handle.truncate()
                _copy(response, handle, start, total, job)
                handle.flush()
                os.fsync(handle.fileno())
    except (httpx2.TooManyRedirects, httpx2.UnsupportedProtocol, httpx2.InvalidURL) as error:
        raise DownloadError(f"Cannot get {job.url}: {error}. Expected a plain http(s) address of a file.") from error
    except httpx2.TimeoutException as error:
        raise _TryAgainError(f"silent for {job.timeout:g} s") from error
    except httpx2.TransportError as error:
        raise _TryAgainError(str(error) or type(error).__name__) from error
    if total is not None and _size(job.part) < total:
        raise _TryAgainError(f"the connection ended after {_size(job.part):,} of {total:,} bytes")


def _check_answer(response: httpx2.Response, job: _Job, have: int) -> tuple[int, int | None]:
    """Return where the body starts in the file and how long the file will be (None = the server does not say)."""
    status = response.status_code
    if status == 416:  # what we have is longer than the file
        job.part.unlink(missing_ok=True)
        raise _TryAgainError("the server cannot continue the file")
    if status in _BUSY:
        raise _TryAgainError(f"the server answers {status}", _retry_after(response))
    if status not in (200, 206):
        raise DownloadError(
            f"{job.url} answers {status} {response.reason_phrase}, expected the file ({job.expected}): "
            "get it elsewhere."
        )
    if response.headers.get("content-encoding", "identity") != "identity":
        raise DownloadError(f"{job.url} sends a compressed body although told not to: get the file elsewhere.")
    length = response.headers.get("content-length", "")
    start, total = 0, int(length) if length.isdecimal() else None
    if status == 206:
        found = _CONTENT_RANGE.match(response.headers.get("content-range", ""))
        if not have or found is None or int(found[1]) != have:
            job.part.unlink(missing_ok=True)
            raise _TryAgainError("the server sends another part of the file than asked for")
        start, total = have, int(found[3]) if found[3] != "*" else None
    if total is not None and (total > job.limit or (job.expected.size is not None and total != job.expected.size)):
        job.part.unlink(missing_ok=True)
        bound = "" if job.expected.size is not None else "at most "
        raise CorruptDataError(
            f"{job.url} offers {total:,} bytes, expected {bound}{job.limit:,} "
            f"({job.expected}): another file, get it elsewhere."
        )
    return start, total if total is not None else job.expected.size


def _retry_after(response: httpx2.Response) -> float | None:
    value = response.headers.get("retry-after", "")
    return float(value) if value.isdecimal() else None


def _copy(response: httpx2.Response, handle: BinaryIO, start: int, total: int | None, job: _Job) -> None:
    done = mark_bytes = start
    mark_time = time.monotonic()
    job.progress(done, total)
    for block in response.iter_raw():
        done += len(block)
        if done > job.limit:
            handle.truncate(0)
            raise CorruptDataError(
                f"{job.url} sends more than the expected {job.limit:,} bytes ({job.expected}): "
                "another file, get it elsewhere."
            )
        handle.write(block)
        job.progress(done, total)
        now = time.monotonic()
        if now - mark_time > job.timeout:
            if done - mark_bytes < LEAST_RATE * (now - mark_time):
                raise _TryAgainError(f"{done - mark_bytes:,} bytes in {now - mark_time:.0f} s")
            mark_time, mark_bytes = now, done
