"""Where a copy of a dataset came from: the Hub repository and its commit, in a file beside the manifest."""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from navrep_data.errors import CorruptDataError
from navrep_data.io import REPO_NAME, atomic_write_json, read_json
from navrep_data.shards._fields import Fields

ORIGIN_FILE = "origin.json"
_MAX_BYTES = 1 << 16
_COMMIT = re.compile(r"[0-9a-f]{40}")


@dataclass(frozen=True)
class Origin:
    """The repository that a dataset was pulled from.

    Attributes
    ----------
    repo : str
        ``user/name``.
    commit : str
        The commit, 40 hex digits: the revision that never moves.
    asked : str
        The revision that was asked for, as a branch.
    endpoint : str
        Address of the Hub.
    manifest_sha256 : str
        Hash of the whole dataset's manifest there.
    """

    repo: str
    commit: str
    asked: str
    endpoint: str
    manifest_sha256: str

    def __str__(self) -> str:
        return f"{self.repo}@{self.commit}"

    def to_dict(self) -> dict[str, Any]:
        """Return JSON values."""
        return asdict(self)

    def save(self, root: Path | str) -> None:
        """Write it into the dataset folder `root`."""
        atomic_write_json(Path(root) / ORIGIN_FILE, self.to_dict())


def read_origin(root: Path | str) -> Origin | None:
    """Return where the dataset in `root` came from, None if that is not recorded.

    Raises
    ------
    CorruptDataError
        If the record is damaged.
    """
    path = Path(root) / ORIGIN_FILE
    if not path.is_file():
        return None
    fields = Fields(read_json(path, _MAX_BYTES), path)
    origin = Origin(*(fields.get(name, str) for name in ("repo", "commit", "asked", "endpoint", "manifest_sha256")))
    if not (_COMMIT.fullmatch(origin.commit) and REPO_NAME.fullmatch(origin.repo)):
        raise CorruptDataError(f"{path} names {str(origin)!r}, expected user/name@commit; pull the dataset again.")
    return origin
