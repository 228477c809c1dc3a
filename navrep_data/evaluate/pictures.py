"""Matplotlib figures in files: PNG, PDF or SVG by the suffix; equal results give equal bytes."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from navrep_data.errors import ConfigError
from navrep_data.io import atomic_write_bytes

PICTURES = (".png", ".pdf", ".svg")
TABLES = (".md", ".tex", ".csv")
DPI = 150


def save(figure: Any, path: Path) -> Path:
    """Write a figure as PNG and return the path."""
    from PIL import Image

    drawn, packed = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, format="png", dpi=DPI)
    # a palette halves the size; and nothing of matplotlib's version is in it, so that equal results give equal bytes
    picture = Image.open(drawn).convert("RGB")
    picture.quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(packed, "png", optimize=True)
    atomic_write_bytes(path, packed.getvalue())
    return path


def check_suffix(path: Path, is_table: bool, flag: str = "--out") -> None:
    """Refuse a file whose suffix names no format; `flag` is what the file was given by.

    Raises
    ------
    ConfigError
        Naming those that there are.
    """
    known = TABLES if is_table else PICTURES
    if path.suffix.lower() not in known:
        what = "a table" if is_table else "a figure"
        raise ConfigError(f"{flag} is {path}, expected a name for {what} that ends in {', '.join(known)}.")


def write_picture(figure: Any, path: Path) -> None:
    """Write a matplotlib figure, in the format of the suffix."""
    suffix = path.suffix.lower()
    if suffix == ".png":
        save(figure, path)
    else:
        atomic_write_bytes(path, _vector(figure, suffix[1:]))


def _vector(figure: Any, kind: str) -> bytes:
    import matplotlib

    # equal results give equal bytes: no date, and identifiers that are not random
    with matplotlib.rc_context({"svg.hashsalt": "navrep-data", "pdf.fonttype": 42}):
        buffer = io.BytesIO()
        figure.savefig(buffer, format=kind, metadata={"Date": None} if kind == "svg" else {"CreationDate": None})
    return buffer.getvalue()
