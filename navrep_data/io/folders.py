"""New folders that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

from navrep_data.errors import ConfigError, FolderInUseError
from navrep_data.io._files import PART_SUFFIX, fsync_dir, translate_os_error


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
        ``<out>.part``, empty.

    Raises
    ------
    FolderInUseError
        If `out` holds something, or another run is writing it or was killed.
    ConfigError
        If `out` lies in a folder that is only read.
    DiskSpaceError, FolderNotWritableError
        If it cannot be written.

    Notes
    -----
    Whatever is raised inside the ``with`` leaves `out` and its surroundings as they were.
    """
    out = Path(out)
    for folder in apart_from:
        if out.resolve().is_relative_to(Path(folder).resolve()) and out.resolve() != Path(folder).resolve():
            raise ConfigError(f"{out} lies inside {folder}, which is only read; expected a place of its own.")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise FolderInUseError(
            f"{out} is in use, expected a new or empty folder: {what} never overwrites. Choose another."
        )
    part = out.with_name(out.name + PART_SUFFIX)
    if part.exists():
        raise FolderInUseError(
            f"{part} exists, left by {what} that was interrupted or still runs. Remove it if none runs."
        )
    made = [folder for folder in out.parents if not folder.exists()]
    try:
        with _explained(out):
            part.mkdir(parents=True)
        yield part
        with _explained(out):
            if out.exists():
                out.rmdir()
            part.rename(out)
        fsync_dir(out.parent)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        for folder in made:
            with contextlib.suppress(OSError):  # somebody else put something there
                folder.rmdir()
        raise


@contextlib.contextmanager
def _explained(out: Path) -> Iterator[None]:
    try:
        yield
    except (FileExistsError, NotADirectoryError) as error:
        raise FolderInUseError(f"{out} is or lies under a file, expected a new folder; choose another.") from error
    except OSError as error:
        raise translate_os_error(error, out) from error
