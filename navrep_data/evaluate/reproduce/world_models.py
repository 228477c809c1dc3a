"""The paper's figure of the world-model error: next step, lidar and goal apart, rings above and 1D below."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

from navrep_data.evaluate.figures import new_figure
from navrep_data.evaluate.reproduce.drawn import COLOURS, Drawn, Missing, label, shipped
from navrep_data.evaluate.sources import find_world_models, source_of
from navrep_data.evaluate.world_model import WorldModelError

ARCHITECTURES = ("joint", "modular", "transformer")
_LIDARS = {"rings": "rings, values {0, 0.5, 1}", "1d": "1D, ranges / 25 m"}
_ORDER = ("released", "ours", "other")
_SHORT = 28

Found = tuple[WorldModelError, dict[str, Any]]


def world_models(folder: Path) -> Drawn:
    """Draw the world-model errors below `folder`: those on one split of one dataset, the one with most results."""
    found = [f for f in find_world_models(folder) if f[0].scan_mse is not None]
    missing = _missing(folder, [r.name for r, _ in found])
    if not found:
        return Drawn(missing=missing)
    keys = Counter((about["data"].get("content_hash"), r.split) for r, about in found)
    # the paper takes the training split, so that wins a draw
    chosen = max(keys, key=lambda key: (keys[key], key[1] == "train"))
    mine = [(r, about) for r, about in found if (about["data"].get("content_hash"), r.split) == chosen]
    mine.sort(key=lambda f: (_ORDER.index(source_of(f[0].name)), f[0].name))
    figure = _draw(mine, left_out=len(found) - len(mine))
    sources = [
        {"name": r.name, "source": source_of(r.name), "lidar": r.lidar, "split": r.split, "rows": r.rows,
         "scan_mse": r.scan_mse, "goal_mse": r.goal_mse, "data": about["data"].get("content_hash")}
        for r, about in mine
    ]  # fmt: skip
    return Drawn(figure, sources=sources, missing=missing)


def _missing(folder: Path, have: list[str]) -> list[Missing]:
    command = "navrep-data evaluate world-model {} --data DIR --split train --out " + str(folder)
    missing = []
    if not any(source_of(name) == "released" for name in have):
        names = "joint_1d.released transformer_1d.released"
        missing.append(
            Missing("released world models (those of rings are not to be had everywhere)", command.format(names))
        )
    absent = [name for name in shipped("world_model") if name not in have]
    if absent:
        missing.append(Missing("our world models", command.format(" ".join(absent))))
    return missing


def _draw(found: list[Found], left_out: int) -> Any:
    lidars = [lidar for lidar in _LIDARS if any(r.lidar == lidar for r, _ in found)]
    figure = new_figure(8.6, 0.6 + 2.7 * len(lidars))
    axes = figure.subplots(len(lidars), 2, squeeze=False)
    for row, lidar in zip(axes, lidars, strict=True):
        results = [r for r, _ in found if r.lidar == lidar]
        for ax, kind in zip(row, ("scan", "goal"), strict=True):
            _bars(ax, results, kind)
        row[0].set_ylabel(
            f"{lidar if lidar == 'rings' else '1D'}\nMSE ({_LIDARS[lidar].split(', ', 1)[1]})", fontsize=8
        )
        row[1].set_ylabel("MSE [m$^2$]", fontsize=8)
    axes[0, 0].set_title("lidar state $s_l$", fontsize=9)
    axes[0, 1].set_title("goal of $s_r$", fontsize=9)
    _legend(figure, sorted({source_of(r.name) for r, _ in found}, key=_ORDER.index))
    r, about = found[0]
    note = f"{r.split} split of {about['data'].get('name')}, {r.rows:,} rows; each step is predicted from real ones."
    other = f"{left_out} results of other data or splits are not drawn. " if left_out else ""
    figure.supxlabel(f"{note}\n{other}The authors' own values are known as a picture only.", fontsize=6.5)
    return figure


def _bars(ax: Any, results: list[WorldModelError], kind: str) -> None:
    """Draw one panel; the scale is logarithmic where models are orders apart."""
    values = [float(getattr(r, f"{kind}_mse")) for r in results]
    still = float(getattr(results[0], f"still_{kind}_mse"))
    for i, (r, value) in enumerate(zip(results, values, strict=True)):
        ax.bar(i, value, 0.7, color=COLOURS[source_of(r.name)], zorder=2)
        ax.annotate(
            f"{value:.3g}", (i, value), (0, 3), textcoords="offset points", ha="center", fontsize=7, zorder=4,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.6},
        )  # fmt: skip
    ax.axhline(still, color="black", linestyle="--", linewidth=0.8, zorder=3)
    positive = [v for v in (*values, still) if v > 0]
    if max(positive) > 20 * min(positive):
        ax.set_yscale("log")
        ax.set_ylim(min(positive) / 2, 3 * max(positive))
    else:
        ax.set_ylim(0, 1.18 * max(positive))
    ax.set_xticks(range(len(results)), [_short(r.name) for r in results], rotation=20, ha="right", fontsize=7,
                  rotation_mode="anchor")  # fmt: skip
    ax.set_xlim(-0.6, max(len(results), 3) - 0.4)
    ax.tick_params(axis="y", labelsize=7)
    ax.grid(axis="y", linewidth=0.4, alpha=0.5, zorder=0)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)


def _short(name: str) -> str:
    """Return a name, or the end of a path, that fits under a bar."""
    name = name.rstrip("/").rpartition("/")[2]
    return name if len(name) <= _SHORT else f"...{name[3 - _SHORT :]}"


def _legend(figure: Any, sources: list[str]) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = [Patch(color=COLOURS[source], label=label(source)) for source in sources]
    handles.append(Line2D([], [], color="black", linestyle="--", linewidth=0.8, label="nothing changes"))
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), fontsize=7.5, frameon=False)
