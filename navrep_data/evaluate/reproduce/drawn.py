"""What drawing returns, and what all figures share."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from navrep_data.evaluate.sources import SOURCES
from navrep_data.io import read_json
from navrep_data.zoo import registry

COLOURS = {
    "authors": "#9a9a9a", "released": "#0072B2", "released_as_fed": "#56B4E9", "ours": "#E69F00", "baseline": "#009E73",
    "other": "#CC79A7",
}  # fmt: skip
"""One colour per source, the same in all figures (Okabe and Ito's, which colour-blind readers can tell apart)."""
HATCHES = {source: "////" if source == "authors" else "" for source in COLOURS}
_MAX_BYTES = 1 << 20


@dataclass(frozen=True)
class Missing:
    """Results that a figure has room for and that are not there.

    Attributes
    ----------
    what : str
        In words.
    command : str
        What makes them.
    """

    what: str
    command: str


@dataclass
class Drawn:
    """A figure before it is written.

    Attributes
    ----------
    figure : matplotlib Figure or None
        None where there is nothing to draw.
    text : str or None
        Markdown, for a table.
    sources : list of dict
        What is on it: name, source, and numbers.
    missing : list of Missing
        What is not.
    """

    figure: Any = None
    text: str | None = None
    sources: list[dict[str, Any]] = field(default_factory=list)
    missing: list[Missing] = field(default_factory=list)


@dataclass(frozen=True)
class Reproduced:
    """A figure that was written.

    Attributes
    ----------
    figure : str
        Which one.
    file : pathlib.Path
        Where.
    sources, missing
        As in :class:`Drawn`.
    text : str or None
        The table's Markdown.
    """

    figure: str
    file: Path
    sources: list[dict[str, Any]]
    missing: list[Missing]
    text: str | None

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON values."""
        values: dict[str, Any] = json.loads(json.dumps({**asdict(self), "file": str(self.file)}))
        return values


@cache
def authors() -> dict[str, Any]:
    """Return the authors' own figure as numbers, with its source; not measured by us."""
    found: dict[str, Any] = read_json(Path(__file__).parents[1] / "authors_figure.json", _MAX_BYTES)
    return found


def shipped(kind: str) -> list[str]:
    """Return the full names of our own checkpoints of a kind."""
    return [r.name for r in registry.records().values() if r.ours and r.kind == kind]


def label(source: str, what: str = "") -> str:
    """Return what a legend says of a source."""
    return f"{SOURCES[source]}{f': {what}' if what else ''}"
