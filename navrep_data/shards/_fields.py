"""Typed access to parsed JSON from anywhere, with errors that name the field."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import Any

from navrep_data.errors import CorruptDataError
from navrep_data.io import safe_join
from navrep_data.shards.entries import FileEntry

SHA256 = re.compile(r"[0-9a-f]{64}")
_MAX_COUNT = 1 << 62


class Fields:
    """Typed access to parsed JSON that names the field in every error."""

    def __init__(self, values: Any, path: Path, prefix: str = "") -> None:
        self.path, self.prefix = path, prefix
        if not isinstance(values, dict):
            raise CorruptDataError(
                f"{path}: {prefix.rstrip('.') or 'the file'} is not a JSON object; get the file again."
            )
        self.values = values

    def bad(self, name: str, expected: str) -> CorruptDataError:
        seen = self.values.get(name, "missing")
        raise CorruptDataError(
            f"{self.path}: field '{self.prefix}{name}' is {seen!r}, expected {expected}; get the file again."
        )

    def get(self, name: str, kind: type) -> Any:
        value = self.values.get(name)
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            self.bad(
                name,
                {
                    str: "a text",
                    dict: "an object",
                    list: "a list",
                    bool: "true or false",
                    int: "a whole number",
                }[kind],
            )
        return value

    def count(self, name: str) -> int:
        value: int = self.get(name, int)
        if not 0 <= value < 1 << 64:
            self.bad(name, "a whole number of 0 or more")
        return value

    def sha256(self, name: str) -> str:
        value: str = self.get(name, str)
        if not SHA256.fullmatch(value):
            self.bad(name, "64 hex digits")
        return value

    def strings(self, name: str) -> tuple[str, ...]:
        value = self.get(name, list)
        if not all(isinstance(v, str) for v in value):
            self.bad(name, "a list of texts")
        return tuple(value)

    def ranges(self, name: str) -> tuple[tuple[int, int], ...]:
        value = self.get(name, list)
        if not value or not all(map(_is_range, value)) or any(a[1] >= b[0] for a, b in itertools.pairwise(value)):
            self.bad(name, "ranges [start, stop] with start < stop, ascending, with gaps between them")
        return tuple((start, stop) for start, stop in value)

    def file(self, root: Path) -> FileEntry:
        name: str = self.get("file", str)
        try:
            safe_join(root, name)
        except CorruptDataError as error:
            raise CorruptDataError(f"{self.path}: field '{self.prefix}file': {error}") from None
        return FileEntry(name, self.sha256("sha256"), self.count("bytes"))


def _is_range(value: Any) -> bool:
    return (
        isinstance(value, list)
        and len(value) == 2
        and all(isinstance(v, int) and not isinstance(v, bool) and 0 <= v < _MAX_COUNT for v in value)
        and value[0] < value[1]
    )
