"""Where the files of checkpoints come from: a folder that is named, the cache, the network, in this order.

Notes
-----
Our own weights are part of this package, and taken from nowhere else. The authors' files are not part of it. They are
taken from their public repository at the commit that the records name, or from a Hugging Face repository that holds the
same paths, and count only with the right hash.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from urllib.parse import quote

from navrep_data.errors import ConfigError, CorruptDataError, DownloadError, ModelNotFoundError, OfflineError
from navrep_data.io import HUB_SCHEME, cache_dir, download, is_offline, parse_repo, safe_join
from navrep_data.zoo import registry
from navrep_data.zoo.registry import Record, RecordFile, resolve, with_parts

DIR_VARIABLE = "NAVREP_RELEASED_DIR"
URL_VARIABLE = "NAVREP_RELEASED_URL"


@dataclass(frozen=True)
class Source:
    """Where to look, in this order: `folder`, the cache, `url`.

    Attributes
    ----------
    folder : pathlib.Path or None
        Folder with the authors' files: their repository, its ``models`` folder, or the files side by side.
    url : str or None
        Base address that a record's paths are appended to; None = the authors' repository.
    headers : dict
        Sent along with downloads.
    """

    folder: Path | None = None
    url: str | None = None
    headers: dict[str, str] | None = None

    @classmethod
    def of(cls, source: str | os.PathLike[str] | None) -> Source:
        """Read what a user gave as ``source=`` or ``--from``, or else the environment.

        Parameters
        ----------
        source : path-like or str, optional
            A folder, ``https://...`` or ``hf://user/name[@revision]``. Default: the folder ``NAVREP_RELEASED_DIR``
            and the address ``NAVREP_RELEASED_URL``, where they are set.

        Raises
        ------
        ConfigError
            If the folder does not exist or the address is not one.
        """
        url = os.environ.get(URL_VARIABLE) or None
        if source is None:
            source = os.environ.get(DIR_VARIABLE) or None
            told = DIR_VARIABLE
        else:
            told = "source"
        if source is None:
            return cls(None, url)
        text = os.fspath(source)
        if text.startswith(HUB_SCHEME):
            return _on_the_hub(text)
        if text.startswith(("http://", "https://")):
            return cls(None, text.rstrip("/"))
        folder = Path(text).expanduser()
        if not folder.is_dir():
            raise ConfigError(
                f"{told} is {text!r}, expected a folder with the released files, https://... or hf://user/name."
            )
        return cls(folder, url)

    def lacks(self) -> str:
        """Say of a file that it is in none of the places on this machine."""
        cache = f"in the cache {cache_folder()}"
        return f"is neither in {self.folder} nor {cache}" if self.folder else f"is not {cache}"


def _on_the_hub(text: str) -> Source:
    """Resolve ``hf://user/name[@revision]`` the way huggingface_hub does: its endpoint, its token."""
    from huggingface_hub import constants, get_token

    repo, revision = parse_repo(text)
    token = get_token()
    headers = {"Authorization": f"Bearer {token}"} if token else None
    return Source(None, f"{constants.ENDPOINT}/{repo}/resolve/{quote(revision, safe='')}", headers)


def cache_folder() -> Path:
    """Return the folder in the cache that holds the authors' files (not created)."""
    return cache_dir() / "released"


def _in_folder(folder: Path, entry: RecordFile) -> Path | None:
    """Find a file in the repository itself, in its models folder, or among files side by side."""
    path = PurePosixPath(entry.path)
    for name in (path, path.relative_to("models") if path.parts[0] == "models" else path, PurePosixPath(path.name)):
        found = safe_join(folder, str(name))
        if found.is_file():
            return found
    return None


def locate(entry: RecordFile, source: Source) -> tuple[Path | None, str | None]:
    """Look for a file on this machine.

    Parameters
    ----------
    entry : RecordFile
        Which file.
    source : Source
        Where.

    Returns
    -------
    path : pathlib.Path or None
        The first file found, right or wrong; None if there is none.
    wrong : str or None
        In what it differs from what it must be ("seen, expected"), None if it is right.
    """
    if entry.packaged:
        inside = safe_join(registry.FOLDER, entry.path)
        return (inside, entry.id.mismatch(inside)) if inside.is_file() else (None, None)
    if source.folder is not None and (found := _in_folder(source.folder, entry)) is not None:
        return found, entry.id.mismatch(found)
    cached = safe_join(cache_folder(), entry.path)
    return (cached, entry.id.mismatch(cached)) if cached.is_file() else (None, None)


def get_file(record: Record, entry: RecordFile, source: Source, *, progress: bool | None = None) -> Path:
    """Return the path of a checked file, downloaded if it must be.

    Parameters
    ----------
    record : Record
        The checkpoint that needs it.
    entry : RecordFile
        Which file.
    source : Source
        Where to look.
    progress : bool, optional
        Show a bar on stderr while downloading; default if that is a terminal.

    Raises
    ------
    CorruptDataError
        If a file in the named folder, or what the server sends, is not the right one.
    OfflineError
        If the file is not on this machine and the network is switched off.
    DownloadError
        If it cannot be downloaded.
    """
    found, wrong = locate(entry, source)
    if entry.packaged and (found is None or wrong is not None):
        raise CorruptDataError(
            f"{record.name} needs {entry.path} ({entry.id}) of this package, which is {wrong or 'missing'}: reinstall "
            "navrep-data."
        )
    cached = safe_join(cache_folder(), entry.path)
    if found is not None and wrong is None:
        return found
    if found is not None and found != cached:
        raise CorruptDataError(
            f"{found} is not the file that {record.name} needs: {wrong}. "
            f"Get it again from {record.source['repository']} at commit {record.source['commit']}."
        )
    lack = f"{record.name} needs {entry.path} ({entry.id}), which "
    lack += f"is wrong in {cached} ({wrong})" if wrong else source.lacks()
    place = f"put it at {cached}, or into a folder that --from, source= or {DIR_VARIABLE} names"
    if is_offline():
        raise OfflineError(f"{lack}, and the network is switched off: {place}.")
    url = f"{source.url or _raw_url(record)}/{quote(entry.path)}"
    try:
        return download(url, cached, entry.id, headers=source.headers, progress=progress)
    except DownloadError as error:
        raise type(error)(f"{lack}, and could not be downloaded: {str(error).rstrip('.')}. Or {place}.") from error


def _raw_url(record: Record) -> str:
    """Return the base address of the authors' files at the pinned commit."""
    repository = str(record.source["repository"]).removeprefix("https://github.com/")
    return f"https://raw.githubusercontent.com/{repository}/{record.source['commit']}"


def get_files(record: Record, source: Source, *, progress: bool | None = None) -> dict[str, Path]:
    """Return the checked files of one checkpoint, its parts apart, by the path in the record."""
    return {entry.path: get_file(record, entry, source, progress=progress) for entry in record.files}


def fetch(name: str, source: str | os.PathLike[str] | None = None, *, progress: bool | None = None) -> list[Path]:
    """Bring everything that a checkpoint needs to this machine, its parts included.

    Parameters
    ----------
    name : str
        Name of a model.
    source : path-like or str, optional
        Folder, ``https://...`` or ``hf://user/name`` to look in first.
    progress : bool, optional
        Show a bar on stderr; default if that is a terminal.

    Returns
    -------
    list of pathlib.Path
        The checked files: those of a named folder stay where they are, downloads lie in the cache.

    Raises
    ------
    UnknownNameError
        If there is no such name.
    CorruptDataError, OfflineError, DownloadError
        If a file is not what it must be, or cannot be had.
    """
    where = Source.of(source)
    return [path for r in with_parts(resolve(name)) for path in get_files(r, where, progress=progress).values()]


def missing_here(record: Record, source: Source) -> list[tuple[Record, RecordFile]]:
    """Return the files, of a record and its parts, that are not on this machine or are the wrong ones."""
    missing = []
    for part in with_parts(record):
        for entry in part.files:
            found, wrong = locate(entry, source)
            if found is None or wrong is not None:
                missing.append((part, entry))
    return missing


def require_here(record: Record, source: Source) -> None:
    """Raise unless all files of a record and its parts are on this machine.

    Raises
    ------
    ModelNotFoundError
        If one is missing; names it.
    """
    for part, entry in missing_here(record, source):
        raise ModelNotFoundError(
            f"{record.name} needs {entry.path} of {part.name} ({entry.id}), which {source.lacks()}: "
            f"navrep-data models fetch {record.name}"
        )
