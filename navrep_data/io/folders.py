"""New folders that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

from navrep_data.errors import ConfigError, FolderInUseError
from navrep_data.io._files import PART_SUFFIX, fsync_dir, translate_os_error

_INSIDE = f".navrep-data{PART_SUFFIX}"
_LAST = "manifest.json"


@contextlib.contextmanager
def new_folder(
    out: str | os.PathLike[str], *, what: str = "this", apart_from: Iterable[str | os.PathLike[str]] = ()
) -> Iterator[Path]:
    """Make a folder beside `out`, to be filled inside the ``with``; afterwards it is renamed to `out`.

    Parameters
    ----------
    out : path-like
        New or empty folder.
    what : str
        What is going on, for messages: "an import".
    apart_from : iterable of path-like
        Folders that are only read: `out` must not lie in one of them.

    Yields
    ------
    pathlib.Path
        ``<out>.part``, empty; inside `out` where that is an empty folder that cannot be replaced.

    Raises
    ------
    FolderInUseError
        If `out` holds something, or another run is writing it or was killed.
    ConfigError
        If `out` lies in a folder that is only read.
    DiskSpaceError, FolderNotWritableError, FileAccessError
        If it cannot be written.

    Notes
    -----
    Whatever is raised inside the ``with`` leaves `out` and its surroundings as they were.

    The working folder, a mount point, a folder behind a link, and one in a folder that this user may not write stay
    what they are. They are filled by renaming, what makes a folder a dataset (``manifest.json``) last: cut in between,
    they hold no dataset.
    """
    out = Path(out)
    for folder in apart_from:
        if out.resolve().is_relative_to(Path(folder).resolve()) and out.resolve() != Path(folder).resolve():
            raise ConfigError(f"{out} lies inside {folder}, which is only read; expected a place of its own.")
    if out.is_symlink() and not out.exists():
        raise FolderInUseError(
            f"{out} is a link to {os.readlink(out)}, which does not exist; make that folder, or remove the link."
        )
    inside = out.is_dir() and not _replaceable(out)
    part = out / _INSIDE if inside else out.with_name(out.name + PART_SUFFIX)
    if part.exists():
        raise FolderInUseError(
            f"{part} exists, left by {what} that was interrupted or still runs. Remove it if none runs."
        )
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise FolderInUseError(
            f"{out} is in use, expected a new or empty folder: {what} never overwrites. Choose another."
        )
    made = [folder for folder in out.parents if not folder.exists()]
    moved: list[Path] = []
    try:
        with _explained(out):
            part.mkdir(parents=True)
        yield part
        with _explained(out):
            if inside:
                _fill(out, part, moved)
            else:
                if os.name == "nt" and out.exists():  # elsewhere an empty folder gives way
                    out.rmdir()
                part.rename(out)
        fsync_dir(out if inside else out.parent)
    except BaseException:
        for path in (*moved, part):
            _remove(path)
        for folder in made:
            with contextlib.suppress(OSError):  # somebody else put something there
                folder.rmdir()
        raise


def _replaceable(out: Path) -> bool:
    """Return whether a folder beside an empty folder could be renamed over it, and nobody would miss it."""
    if out.is_symlink() or os.path.ismount(out) or not os.access(out.absolute().parent, os.W_OK):
        return False
    return out.name not in ("", "..") and not out.samefile(os.curdir)


def _fill(out: Path, part: Path, moved: list[Path]) -> None:
    """Move all that is in `part` up into `out`; `moved` gets what is there."""
    for path in sorted(part.iterdir(), key=lambda path: (path.name == _LAST, path.name)):
        if path.name == _LAST:
            fsync_dir(out)  # nor may a power cut put it before the others
        moved.append(out / path.name)
        path.rename(moved[-1])
    part.rmdir()


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):  # there is nothing, or what it lies under is no folder
            path.unlink()


@contextlib.contextmanager
def _explained(out: Path) -> Iterator[None]:
    try:
        yield
    except (FileExistsError, NotADirectoryError) as error:
        raise FolderInUseError(f"{out} is or lies under a file, expected a new folder; choose another.") from error
    except OSError as error:
        raise translate_os_error(error, out) from error
