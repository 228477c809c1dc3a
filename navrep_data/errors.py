"""Every exception of the package.

Each error inherits from :class:`NavrepDataError`, so that one ``except`` catches them all, and from the builtin
that a caller would expect there. Messages are one line: what was seen, what was expected, what to do. They quote names
and texts from outside as they are; :func:`one_line` makes what is shown of them harmless, here and nowhere else.
"""

from __future__ import annotations

import difflib
import numbers
import operator
import re
from collections.abc import Iterable

LONGEST_MESSAGE = 1200
"""Characters of the longest message; the longest of our own, which list the settings of a recipe, have about 900."""
_END = 500  # what to do stands at the end, and is kept
_GAP = " [...] "
_SPACE = re.compile(r"\s+")
_BREAKS = frozenset("\t\n\v\f\r\x1c\x1d\x1e\x1f\x85\u2028\u2029")
_UNSEEN = re.compile(r"[\x00-\x1f\x7f-\x9f\ud800-\udfff]")  # control characters, and bytes of a name that are no text


def one_line(text: object) -> str:
    """Return what can be shown of a text from outside: one line, of no more than :data:`LONGEST_MESSAGE` characters.

    Line breaks become spaces, characters that steer a terminal or cannot be written are escaped. What is too long is
    cut in the middle: what was seen comes first in a message, what to do last. Any other text stays as it is.

    Parameters
    ----------
    text : object
        A message, or an error of another library.
    """
    shown = _cut(str(text), 10 * LONGEST_MESSAGE).strip()  # a whole file may have been quoted
    shown = _SPACE.sub(lambda found: found[0] if _BREAKS.isdisjoint(found[0]) else " ", shown)
    shown = _UNSEEN.sub(lambda found: ascii(found[0])[1:-1], shown)
    return _cut(shown, LONGEST_MESSAGE)


def _cut(text: str, longest: int) -> str:
    if len(text) <= longest:
        return text
    return text[: longest - len(_GAP) - _END] + _GAP + text[-_END:]


class NavrepDataError(Exception):
    """Base class of all errors that this package raises on purpose.

    Parameters
    ----------
    message : str
        What was seen, what was expected, what to do. Shown as :func:`one_line` makes it.
    """

    def __init__(self, message: str) -> None:
        super().__init__(one_line(message))


class ConfigError(NavrepDataError, ValueError):
    """A setting has a value that cannot be used."""


class ArrayError(NavrepDataError, ValueError):
    """An array has a shape, dtype or layout that cannot be used."""


class UnknownNameError(NavrepDataError, LookupError):
    """A name that is in no registry."""


class MapError(NavrepDataError, ValueError):
    """A map file cannot be used, or a place on a map cannot be used for what was asked."""


class MissingExtraError(NavrepDataError, ImportError):
    """An optional package is not installed; the message gives the pip command."""


class DatasetError(NavrepDataError, ValueError):
    """A folder or file is not what a dataset looks like."""


class CorruptDataError(DatasetError):
    """A file's content does not match its hash, its schema or itself."""


class SchemaVersionError(DatasetError):
    """A dataset was written in a format version that this package does not read."""


class DatasetMismatchError(DatasetError):
    """An existing dataset was made with other settings than those asked for."""


class DatasetNotFoundError(NavrepDataError, FileNotFoundError):
    """There is no dataset in this folder."""


class FolderInUseError(NavrepDataError, FileExistsError):
    """The folder holds something else, which is not overwritten."""


class DatasetLockedError(NavrepDataError, RuntimeError):
    """Another process is writing this dataset."""


class DiskSpaceError(NavrepDataError, OSError):
    """Too little space on the disk, before or while writing."""


class FolderNotWritableError(NavrepDataError, PermissionError):
    """The folder cannot be written."""


class FileAccessError(NavrepDataError, OSError):
    """The operating system refuses a file or folder: not readable, a name too long, a failing disk."""


class PolicyError(NavrepDataError, ValueError):
    """A policy cannot be loaded, or returned something that is not a batch of actions."""


class CheckpointError(NavrepDataError, ValueError):
    """A file of weights is not what it should be: wrong format, names, shapes, sizes or content."""


class TrainingError(NavrepDataError, ArithmeticError):
    """A training cannot go on: its loss is no number."""


class SimulationError(NavrepDataError, RuntimeError):
    """The simulator reached a state that it cannot go on from."""


class DisplayError(NavrepDataError, RuntimeError):
    """Something needs a window, and none can be opened here."""


class WorkerDiedError(NavrepDataError, RuntimeError):
    """A worker process ended without a result."""


class ClusterError(NavrepDataError, ConnectionError):
    """A cluster cannot be reached, or its nodes are not fit for the work."""


class DownloadError(NavrepDataError, OSError):
    """A file could not be brought here from the network."""


class OfflineError(DownloadError):
    """A file is not on this machine and the network is switched off."""


class HubError(NavrepDataError, OSError):
    """The Hub refuses, cannot be reached, or does not have what was asked for."""


class ModelNotFoundError(NavrepDataError, FileNotFoundError):
    """A checkpoint's file is neither in the given folder nor in the cache, and no network was asked or has it."""


class BlindSectorWarning(UserWarning):
    """Scans have directions that nobody saw, and nothing says that this is known."""


def whole_number(value: object) -> int | None:
    """Return what Python takes for an index as an int: int, numpy integer, tensor of one integer without axes.

    Parameters
    ----------
    value : object
        From a caller.

    Returns
    -------
    int or None
        None for all else: floats, even whole ones, truth values, lists, tensors with axes.
    """
    kind = str(getattr(value, "dtype", ""))
    if isinstance(value, bool) or kind.endswith("bool") or getattr(value, "ndim", None) not in (None, 0):
        return None
    try:
        return operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        return None


def check_whole(
    name: str, value: object, low: int, high: int | None = None, error: type[NavrepDataError] | None = None
) -> int:
    """Return `value` as an int, or refuse it.

    Parameters
    ----------
    name : str
        What the caller calls it.
    value : object
        Whatever :func:`whole_number` takes.
    low, high : int
        The smallest and the largest one; None: no largest one.
    error : type of NavrepDataError, optional
        What to raise; a ConfigError by default.

    Raises
    ------
    NavrepDataError
        If it is no whole number, or out of range.
    """
    number = whole_number(value)
    if number is None or number < low or (high is not None and number > high):
        wanted = f"of at least {low}" if high is None else f"from {low} to {high}"
        raise (error or ConfigError)(f"{name} is {value!r}, expected a whole number {wanted}.")
    return number


def real_number(value: object) -> int | float | None:
    """Return an int or float as it is and numpy's as Python's; None for all else, truth values and NaN among it."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real) or value != value:
        return None
    if isinstance(value, int | float):
        return value
    return int(value) if isinstance(value, numbers.Integral) else float(value)


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return ``" Did you mean 'x'?"`` for the known name closest to `name`, or an empty string.

    Parameters
    ----------
    name : str
        The unknown name.
    known : iterable of str
        The names that exist.
    """
    close = difflib.get_close_matches(str(name).lower(), [str(k) for k in known], n=1, cutoff=0.5)
    return f" Did you mean '{close[0]}'?" if close else ""
