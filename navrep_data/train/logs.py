"""What a training leaves to look at: a CSV file, TensorBoard, pictures of input, reconstruction and prediction."""

from __future__ import annotations

import csv
import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from navrep_data.io import atomic_write_bytes
from navrep_data.io.logs import LOG_FILE, read_log

__all__ = ["LOG_FILE", "Logger", "curve", "picture", "read_log"]


class Logger:
    """Rows of numbers by step, to ``log.csv`` and, where it is installed, to TensorBoard.

    Parameters
    ----------
    out : Path
        Output folder.
    after : int
        Rows of later steps are dropped: a resumed training writes them again.
    """

    def __init__(self, out: Path, after: int) -> None:
        self.path = out / LOG_FILE
        self._rows = [row for row in read_log(out) if int(row["step"]) <= after]
        self._columns = list(dict.fromkeys(name for row in self._rows for name in row))
        self._rewrite()
        self._board = _tensorboard(out / "tensorboard", after)

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Add numbers of a step."""
        row = {"step": str(step), **{name: f"{value:.9g}" for name, value in values.items()}}
        self._rows.append(row)
        if set(row) <= set(self._columns):
            with open(self.path, "a", newline="") as handle:
                csv.DictWriter(handle, self._columns).writerow(row)
        else:
            self._columns = list(dict.fromkeys([*self._columns, *row]))
            self._rewrite()
        if self._board is not None:
            for name, value in values.items():
                if math.isfinite(value):
                    self._board.add_scalar(name, value, step)

    def picture(self, name: str, step: int, image: NDArray[np.uint8]) -> None:
        """Show an image (H, W, 3) in TensorBoard."""
        if self._board is not None:
            self._board.add_image(name, image, step, dataformats="HWC")

    def _rewrite(self) -> None:
        lines = [",".join(self._columns)] if self._columns else []
        lines += [",".join(row.get(name, "") for name in self._columns) for row in self._rows]
        atomic_write_bytes(self.path, ("\n".join(lines) + "\n" if lines else "").encode())

    def close(self) -> None:
        """Flush and close."""
        if self._board is not None:
            self._board.close()


def _tensorboard(folder: Path, after: int) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:  # an optional part
        print("No TensorBoard logs, only log.csv: pip install 'navrep-data[train]'", file=sys.stderr)
        return None
    return SummaryWriter(str(folder), purge_step=after + 1)


def picture(columns: Mapping[str, NDArray[Any]], lidar: str, title: str) -> tuple[bytes, NDArray[np.uint8]]:
    """Draw observations beside what a model makes of them.

    Parameters
    ----------
    columns : dict of str to ndarray of shape (N, 64, 64) or (N, 1080)
        What to draw in each column: input, reconstruction, next, prediction; one row per frame.
    lidar : str
        ``"rings"`` or ``"1d"``.
    title : str
        Above all.

    Returns
    -------
    png : bytes
    image : ndarray of shape (H, W, 3), uint8
    """
    import io

    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    n = len(next(iter(columns.values())))
    figure = Figure(figsize=(2.2 * len(columns), 2.1 * n + 0.4), dpi=80, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=9)
    axes = figure.subplots(
        n, len(columns), squeeze=False, subplot_kw=None if lidar == "rings" else {"projection": "polar"}
    )
    angles = np.arange(1080) / 1080 * 2 * np.pi
    for j, (name, values) in enumerate(columns.items()):
        for i in range(n):
            axis = axes[i, j]
            if lidar == "rings":
                axis.imshow(values[i].T, origin="lower", vmin=0, vmax=1, cmap="gray_r", aspect="auto")
            else:
                axis.plot(angles, values[i] * 25.0, ".", markersize=0.8, color="#1f4e79")
                axis.set_ylim(0, 12)
            axis.set_xticks([])
            axis.set_yticks([])
            if i == 0:
                axis.set_title(name, fontsize=9)
            if j == 0 and lidar == "rings":
                axis.set_xlabel("angle", fontsize=7)
                axis.set_ylabel("range", fontsize=7)
    buffer = io.BytesIO()
    canvas.print_png(buffer)  # type: ignore[no-untyped-call]
    image = np.asarray(canvas.buffer_rgba())[..., :3].copy()  # type: ignore[no-untyped-call]
    return buffer.getvalue(), image


def curve(out: Path) -> Path | None:
    """Draw a training's success rates over steps into ``training.png``; None where nothing was logged yet."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = read_log(out)
    if not rows:
        return None
    figure = Figure(figsize=(6.4, 3.6), dpi=120, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axis = figure.subplots()
    for name, label, style in (
        ("success", "training, at the worlds' own difficulty", "-"),
        ("val_success", "validation, greatest difficulty", ".-"),
    ):
        points = [(int(r["step"]), float(r[name])) for r in rows if name in r]
        if points:
            axis.plot([p[0] / 1e6 for p in points], [100 * p[1] for p in points], style, label=label)
    axis.set_xlabel("million steps")
    axis.set_ylabel("episodes that reach the goal [%]")
    axis.set_ylim(0, 100)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)
    path = out / "training.png"
    canvas.print_png(str(path))  # type: ignore[no-untyped-call]
    return path
