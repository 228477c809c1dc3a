"""Every exception of the package.

Each class inherits from :class:`NavrepDataError`, so that one ``except`` catches them all, and from the builtin
that a caller would expect there. Messages are one line: what was seen, what was expected, what to do.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class NavrepDataError(Exception):
    """Base class of all errors that this package raises on purpose."""


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


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return ``" Did you mean 'x'?"`` for the known name closest to `name`, or an empty string.

    Parameters
    ----------
    name : str
        The unknown name.
    known : iterable of str
        The names that exist.
    """
    close = difflib.get_close_matches(name.lower(), [str(k) for k in known], n=1, cutoff=0.5)
    return f" Did you mean '{close[0]}'?" if close else ""
