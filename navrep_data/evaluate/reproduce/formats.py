"""Figures and tables in the format that a file's suffix asks for."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Callable
from pathlib import Path

from navrep_data.evaluate.pictures import write_picture
from navrep_data.evaluate.reproduce.drawn import Drawn
from navrep_data.io import atomic_write_bytes

_LATEX = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
_LATEX |= {c: f"\\{c}" for c in "&%$#_{}"}
_UNSAFE = re.compile("[" + re.escape("".join(_LATEX)) + "]")


def write(drawn: Drawn, path: Path) -> None:
    """Write what was drawn, in the format of the suffix."""
    suffix = path.suffix.lower()
    if drawn.text is not None:
        as_text: dict[str, Callable[[Drawn], str]] = {".md": lambda d: d.text or "", ".tex": latex, ".csv": numbers}
        atomic_write_bytes(path, as_text[suffix](drawn).encode())
    else:
        write_picture(drawn.figure, path)


def numbers(drawn: Drawn) -> str:
    """Return the numbers of a table as CSV, a row per policy, suite and source; shares of 1, `runs` joined by "; "."""
    fields = list(dict.fromkeys(key for row in drawn.sources for key in row))
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, fields, lineterminator="\n")
    writer.writeheader()
    for row in drawn.sources:
        writer.writerow({key: _plain(value) for key, value in row.items()})
    return buffer.getvalue()


def _plain(value: object) -> object:
    if isinstance(value, list | tuple):
        return "; ".join(map(str, value))
    return json.dumps(value) if isinstance(value, dict) else value


def latex(drawn: Drawn) -> str:
    """Return a table's text as LaTeX for a paper: needs the package booktabs."""
    blocks: list[str] = []
    title = ""
    for block in (drawn.text or "").strip().split("\n\n"):
        if block.startswith("#"):
            title = block.lstrip("# ")
        elif block.startswith("|"):
            blocks.append(_table(block, title))
        else:
            blocks.append(_escaped(block))
    return "% needs \\usepackage{booktabs}\n" + "\n\n".join(blocks) + "\n"


def _table(block: str, title: str) -> str:
    rows = [[cell.strip() for cell in line.strip().strip("|").split("|")] for line in block.splitlines()]
    head, body = rows[0], rows[2:]
    lines = [" & ".join(map(_escaped, row)) + r" \\" for row in (head, *body)]
    return "\n".join(
        [
            r"\begin{table}",
            f"\\caption{{{_escaped(title)}}}",
            f"\\begin{{tabular}}{{l{'r' * (len(head) - 1)}}}",
            r"\toprule",
            lines[0],
            r"\midrule",
            *lines[1:],
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table}",
        ]
    )


def _escaped(text: str) -> str:
    code = re.split(r"`([^`]*)`", text)  # every second one was code
    parts = [_UNSAFE.sub(lambda found: _LATEX[found[0]], part) for part in code]
    return "".join(f"\\texttt{{{part}}}" if k % 2 else part for k, part in enumerate(parts))
