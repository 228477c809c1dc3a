"""Bags that were cut off, never indexed or lost their metadata: what can be read of them, and what mends the rest."""

from __future__ import annotations

import contextlib
import io
import os
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from navrep_data.errors import CorruptDataError, NavrepDataError
from navrep_data.io import raise_refusal

STORAGE = (".db3", ".mcap")
_ROS1 = b"#ROSBAG"
_SQLITE, _MCAP = b"SQLite format 3", b"\x89MCAP0"
_PlainPath: Any = type(Path())


class _SizedFile(io.BufferedReader):
    """A file that is never asked for more bytes than are left: memory is set aside for whatever a header claims."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self._size = os.fstat(self.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        left = max(self._size - self.tell(), 0)
        return super().read(left if size is None or size < 0 else min(size, left))


class _BagPath(_PlainPath):  # type: ignore[misc]
    """A path that opens such files; rosbags takes any path that has the methods of one."""

    def open(self, mode: str = "r", *arguments: Any, **named: Any) -> Any:
        return _SizedFile(self) if mode == "rb" else super().open(mode, *arguments, **named)


def open_readers(
    path: Path, ros1: Any, ros2: Any, stack: contextlib.ExitStack, note: Callable[[str], None]
) -> tuple[list[Any], bool]:
    """Open a bag.

    Parameters
    ----------
    path : pathlib.Path
        A ROS 1 file, the folder of a ROS 2 bag, or one of its files.
    ros1, ros2 : module
        ``rosbags.rosbag1`` and ``rosbags.rosbag2``.
    stack : contextlib.ExitStack
        Closes what is opened.
    note : callable
        Called with lines about what was read in another way than usual.

    Returns
    -------
    readers : list
        One or several, whose messages belong together.
    is_ros1 : bool
        Whether messages are those of ROS 1.

    Raises
    ------
    CorruptDataError
        If it cannot be read; the message names the command that mends it, where one does.
    FileAccessError
        If the operating system refuses a file.
    """
    with explained(path):
        if path.is_dir():
            return _open_folder(path, ros2, stack, note), False
        if _begins(path, _ROS1) or path.suffix == ".bag":
            return [stack.enter_context(ros1.Reader(_BagPath(path)))], True
        return [_open_file(path, ros2, stack)], False


def _open_folder(path: Path, ros2: Any, stack: contextlib.ExitStack, note: Callable[[str], None]) -> list[Any]:
    files = sorted(item for item in path.iterdir() if item.suffix in STORAGE and item.is_file())
    metadata = path / "metadata.yaml"
    reason = "has no metadata.yaml"
    if metadata.is_file():
        for file in files:
            _check_journal(file)
        try:
            reader = stack.enter_context(ros2.Reader(_BagPath(path)))
            if any(connection.msgcount for connection in reader.connections) or not files:
                return [reader]
            reason = "has a metadata.yaml that lists no message"
        except Exception as error:  # a cut YAML, a file that is not there, damaged storage: nearly anything
            if not files:
                raise
            if not isinstance(error, FileNotFoundError):  # one that the bag names
                raise_refusal(error, metadata)  # it will be read once more, for its hash
            reason = f"has a metadata.yaml that does not fit ({_said(error)})"
    packed = sorted(item.name for item in path.iterdir() if item.name.endswith((".db3.zstd", ".mcap.zstd")))
    if not files and packed:
        raise CorruptDataError(
            f"{path} {reason}, and its files are compressed; expected both. Unpack them (unzstd {packed[0]}), "
            "then import the folder again."
        )
    ros1 = sorted(item.name for item in path.glob("*.bag*"))
    if not files and ros1:
        raise CorruptDataError(
            f"{path} cannot be read as a ROS bag (it is a folder); give the files in it: {ros1[0]} ..."
        )
    if not files:
        raise CorruptDataError(
            f"{path} cannot be read as a ROS bag (it {reason} and holds no .db3 or .mcap); expected the folder of a "
            "ROS 2 bag, or a ROS 1 .bag file."
        )
    readers = []
    for file in files:
        with explained(file):
            readers.append(_open_file(file, ros2, stack))
    names = ", ".join(file.name for file in files[:3]) + (f" and {len(files) - 3} more" if len(files) > 3 else "")
    note(f"{path} {reason}: read {names} directly. For other tools: ros2 bag reindex {shlex.quote(str(path))}")
    return readers


def _open_file(path: Path, ros2: Any, stack: contextlib.ExitStack) -> Any:
    _check_journal(path)
    return stack.enter_context(ros2.Reader(_BagPath(path)))


def _check_journal(path: Path) -> None:
    """Refuse a database whose last messages lie in a file beside it, which a reader of the one file does not see."""
    for suffix in ("-wal", "-journal"):
        beside = path.with_name(path.name + suffix)
        if path.suffix == ".db3" and beside.is_file() and beside.stat().st_size:
            raise CorruptDataError(
                f"{path} was not closed: {beside.name} beside it holds what is not written into it yet; expected a "
                f"closed file. Close it: sqlite3 {shlex.quote(str(path))} 'PRAGMA wal_checkpoint(TRUNCATE); PRAGMA "
                "integrity_check;'"
            )


def _begins(path: Path, magic: bytes) -> bool:
    with path.open("rb") as file:
        return file.read(len(magic)) == magic


def _said(error: Exception) -> str:
    return str(error).strip().rstrip(".") or type(error).__name__


@contextlib.contextmanager
def explained(path: Path) -> Iterator[None]:
    """Turn whatever the library raises on damaged bags into an error that names what mends the bag."""
    try:
        yield
    except (NavrepDataError, PermissionError):
        raise
    except Exception as error:  # damaged bags make the library raise nearly anything
        if not isinstance(error, FileNotFoundError):  # one that the bag names
            raise_refusal(error, path)
        raise CorruptDataError(f"{path} cannot be read as a ROS bag ({_said(error)}); {_remedy(path)}") from error


def _remedy(path: Path) -> str:
    """Return what to do about a bag that cannot be read: it may be the only copy of a recording."""
    files = [path]
    if path.is_dir():
        files = sorted(item for item in path.iterdir() if item.suffix in STORAGE) or [path]
    for file in files:
        if not file.is_file() or not file.stat().st_size:
            continue
        name = shlex.quote(str(file))
        if _begins(file, _ROS1) or file.suffix == ".bag":
            return f"if the recording was cut off, mend it: rosbag reindex {name}"
        if _begins(file, _MCAP) or file.suffix == ".mcap":
            return f"if the recording was cut off, mend it: mcap recover {name} -o recovered.mcap"
        if _begins(file, _SQLITE) or file.suffix == ".db3":
            return f"if the recording was cut off, mend it: sqlite3 {name} .recover | sqlite3 recovered.db3"
    return "expected a ROS 1 .bag, the folder of a ROS 2 bag, or its .mcap or .db3."
