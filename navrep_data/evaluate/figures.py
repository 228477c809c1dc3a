"""Figures as the paper's two test figures: bars of success, and trajectories coloured by outcome.

Everything is drawn from results files; colours are those of Okabe and Ito, which colour-blind readers can tell apart.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from navrep_data.evaluate.backdrops import Backdrop, backdrop
from navrep_data.evaluate.pictures import save
from navrep_data.evaluate.results import Results
from navrep_data.evaluate.statistics import wilson
from navrep_data.sim.scenarios import MAP_GROUPS

Row = dict[str, Any]

PALETTE = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442", "#7F7F7F")
SUCCESS, COLLISION, TIMEOUT = "#0072B2", "#D55E00", "#E69F00"
TOUCHED = "#CC79A7"
OUTCOMES = {
    "S": (SUCCESS, "goal, contact-free", ""),
    "K": (TOUCHED, "goal after contact", "^"),
    "C": (COLLISION, "collision", "x"),
    "T": (TIMEOUT, "timeout", "s"),
}
"""Colour, label and the marker at the end of a trajectory, so that outcomes differ without colour too."""
PAPER_SCENARIOS = ("rlasl_office_j1", "irosasl_office_j2", "irosunity_scene_map3", "irosasl2")
"""Columns of the paper's figure: simplest and global planning on the realistic map, everything on the complex one,
global planning on the simple one."""
MAX_ROWS = 8
PANEL_CELLS = 220
"""Cells of a map across a panel: about as many as it has pixels."""


def draw(
    found: Sequence[Results], rows: Sequence[Row], groups: Sequence[Row], baseline: Row, folder: Path
) -> list[Path]:
    """Draw all figures of one suite's results into `folder` and return their files.

    Parameters
    ----------
    found : sequence of Results
        Policies, in the order of `rows`.
    rows, groups, baseline
        As for :func:`navrep_data.evaluate.tables.report`.
    folder : pathlib.Path
        Where to.
    """
    files = [save(bars(rows, groups, baseline), folder / "success.png")]
    if len(found[0].suite.scenarios) == 1:
        return [*files, save(overlay(found, rows), folder / "trajectories.png")]
    files.append(save(comparison(found[:MAX_ROWS]), folder / "trajectories.png"))
    for results in found:
        plain = "".join(c if c.isalnum() or c in "._-" else "-" for c in results.name)
        files.append(save(grid(results), folder / f"trajectories-{plain}.png"))
    return files


def new_figure(width: float, height: float) -> Any:
    """Return an empty figure of this size [inch]."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


# --- bars ----------------------------------------------------------------------------------------------------------


def _bar(label: str, row: Row, ends: tuple[str, str] = ("low", "high")) -> Row:
    keys = {"value": "contact_free_rate", "released": "success_rate"}
    keys |= {key: f"contact_free_rate_{end}" for key, end in zip(("low", "high"), ends, strict=True)}
    return {"label": label, **{key: row[name] for key, name in keys.items()}}


def _series(rows: Sequence[Row], groups: Sequence[Row], part: str | None) -> list[Row]:
    """Return bars with interval: variants of several runs as one bar from least to greatest, others with Wilson's."""
    grouped = {name: g for g in groups for name in g["runs"]}
    bars_, seen = [], set()
    for row in rows:
        group = grouped.get(row["name"])
        if group is None:
            bars_.append(_bar(row["name"], row if part is None else row["per_map"][part]))
        elif (group["variant"], group["inference"]) not in seen:
            seen.add((group["variant"], group["inference"]))
            g = group if part is None else group["per_map"][part]
            bars_.append(_bar(f"{group['variant']} ({len(group['runs'])} runs)", g, ("min", "max")))
    return bars_


def bars(rows: Sequence[Row], groups: Sequence[Row], baseline: Row) -> Any:
    """Return the figure of both successes per policy, overall and per map: filled contact-free, outline as released.

    Whiskers are those of the contact-free success; `goal` is the dashed line (contact-free) and the dotted one.
    """
    parts = [None, *rows[0].get("per_map", {})]
    n = len(_series(rows, groups, None))
    figure = new_figure(max(5.0, (0.55 * n + 0.6) * len(parts) + 1.0), 4.6)
    axes = figure.subplots(1, len(parts), sharey=True, squeeze=False)[0]
    for ax, part in zip(axes, parts, strict=True):
        for i, bar in enumerate(_series(rows, groups, part)):
            if bar["value"] is None:
                continue
            value, low, high, released = (100 * bar[key] for key in ("value", "low", "high", "released"))
            colour = PALETTE[i % len(PALETTE)]
            ax.bar(i, released, facecolor="white", edgecolor=colour, linewidth=1.2, width=0.75, zorder=2)
            ax.bar(i, value, color=colour, width=0.75, zorder=2)
            error = [[max(0.0, value - low)], [max(0.0, high - value)]]
            ax.errorbar(i, value, error, color="black", capsize=3, linewidth=1, zorder=3)
            # on white, since the dashed line may pass behind it
            white = {"boxstyle": "square,pad=0.05", "facecolor": "white", "edgecolor": "none"}
            ax.annotate(
                f"{value:.0f} / {released:.0f}", (i, max(high, released)), (0, 3), textcoords="offset points",
                ha="center", fontsize=7.5, bbox=white,
            )  # fmt: skip
        of = baseline if part is None else baseline["per_map"][part]
        for share, style, words in (("contact_free", "--", "contact-free"), ("success", ":", "as released")):
            level = of[f"{share}_rate"]
            if level is not None:
                label = f"goal, {words}"
                ax.axhline(100 * level, color="black", linestyle=style, linewidth=0.8, zorder=1, label=label)
        # what a name says of feeding in brackets goes below it
        labels = [str(bar["label"]).replace(" (", "\n(", 1) for bar in _series(rows, groups, part)]
        ax.set_xticks(range(n), labels, rotation=45, ha="right", rotation_mode="anchor", fontsize=8)
        ax.set_xlim(-0.6, n - 0.4)
        ax.set_title("all" if part is None else f"{MAP_GROUPS[part]} ({part})", fontsize=9)
        ax.grid(axis="y", linewidth=0.4, alpha=0.5, zorder=0)
        for side in ("top", "right"):
            ax.spines[side].set_visible(False)
    axes[0].set_ylabel("success [%]")
    axes[0].set_ylim(0, 108)
    axes[0].legend(loc="upper left", fontsize=7, frameon=False)
    row = rows[0]
    played = f"{row['episodes']:,} episodes per policy, rounds {row['rounds']}"
    figure.suptitle(f"{row['suite']}, {row['physics']} physics, {played}", fontsize=10)
    note = "Filled: contact-free, outline: as released. Whiskers, contact-free: 95 % intervals (Wilson)"
    note += "; several runs: least to greatest" if groups else ""
    figure.supxlabel(f"{note}.\nDashed and dotted: straight to the goal.", fontsize=7)
    return figure


# --- trajectories --------------------------------------------------------------------------------------------------


def _kind(results: Results, k: int) -> str:
    """Return the key of :data:`OUTCOMES` for an episode; none of them where it was not played."""
    if k >= len(results.outcome):
        return ""
    return "K" if results.outcome[k] == "S" and not results.contact_free(k) else results.outcome[k]


def _paths(ax: Any, results: Results, episodes: Sequence[int], linewidth: float = 0.8, alpha: float = 0.7) -> None:
    """Draw the stored trajectories of some episodes; failures lie above, so that few are not hidden by many."""
    kinds = {k: _kind(results, k) for k in episodes if k in results.trajectories}
    for letter in "SKTC":
        for k, kind in kinds.items():
            if kind == letter:
                xy = results.trajectories[k]
                ax.plot(*xy.T, color=OUTCOMES[letter][0], linewidth=linewidth, alpha=alpha, zorder=4)
                end = {"color": OUTCOMES[letter][0], "marker": OUTCOMES[letter][2], "fillstyle": "none"}
                ax.plot(*xy[-1], markersize=3.5, markeredgewidth=0.9, zorder=5, **end)


CORNERS = (("right", "bottom"), ("left", "bottom"), ("right", "top"), ("left", "top"))
CORNER_SHARE = (0.45, 0.22)
"""Width and height that a written success takes of a panel."""


def _free_corner(frame: Sequence[float], marks: Any, lines: Any) -> tuple[str, str]:
    """Return the corner of a panel where least is drawn; marks, (n, 2), count more than points of lines, (m, 2)."""
    x0, x1, y0, y1 = frame
    weight = np.concatenate([np.full(len(marks), 1000.0), np.ones(len(lines))])
    x, y = ((np.concatenate([marks, lines]) - (x0, y0)) / (x1 - x0, y1 - y0)).T
    taken = []
    for side, end in CORNERS:
        near_x = x > 1.0 - CORNER_SHARE[0] if side == "right" else x < CORNER_SHARE[0]
        near_y = y > 1.0 - CORNER_SHARE[1] if end == "top" else y < CORNER_SHARE[1]
        taken.append(float(weight[near_x & near_y].sum()))
    return CORNERS[taken.index(min(taken))]


def _overlaid(
    ax: Any, results: Results, episodes: Sequence[int], size: float = 9, corner: tuple[str, str] = CORNERS[0]
) -> None:
    """Write both successes in percent over a panel, contact-free first; its interval below, where there is room."""
    played = [kind for k in episodes if (kind := _kind(results, k)) in OUTCOMES]
    if not played:
        return
    free = played.count("S")
    low, high = (100 * end for end in wilson(free, len(played)))
    text = f"{100 * free / len(played):.0f} / {100 * (free + played.count('K')) / len(played):.0f} %"
    if size > 8:
        text += f"\n({low:.0f} to {high:.0f})"
    box = {"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
    x, y = (0.97 if corner[0] == "right" else 0.03), (0.97 if corner[1] == "top" else 0.03)
    ax.text(x, y, text, transform=ax.transAxes, ha=corner[0], va=corner[1], fontsize=size, bbox=box, zorder=8)


def _legend(figure: Any) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=colour, label=label, marker=marker, fillstyle="none", markersize=5)
        for colour, label, marker in OUTCOMES.values()
    ]
    figure.legend(handles=handles, loc="outside upper right", ncols=len(handles), fontsize=7.5, frameon=False)


def overlay(found: Sequence[Results], rows: Sequence[Row]) -> Any:
    """Return one panel per policy with all trajectories of a suite whose worlds differ from episode to episode."""
    columns = min(4, len(found))
    lines = math.ceil(len(found) / columns)
    figure = new_figure(2.6 * columns + 0.6, 2.75 * lines + 0.6)
    axes = figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True)
    for ax, results in zip(axes.flat, found, strict=False):
        episodes = range(len(results.outcome))
        _paths(ax, results, episodes, 0.6, 0.5)
        _overlaid(ax, results, episodes)
        ax.set_title(results.name, fontsize=8)
        ax.set_aspect("equal")
        ax.set_xlim(-11, 11)
        ax.set_ylim(-11, 11)
        ax.tick_params(labelsize=7)
    for ax in list(axes.flat)[len(found) :]:
        ax.set_visible(False)
    for ax in axes[:, 0]:
        ax.set_ylabel("y [m]", fontsize=8)
    for ax in axes[-1]:
        ax.set_xlabel("x [m]", fontsize=8)
    row = rows[0]
    title = f"{row['suite']}, {row['physics']} physics: robots start below and head upwards"
    figure.suptitle(title, fontsize=9, x=0.02, ha="left")
    _legend(figure)
    return figure


def _thick(solid: Any, extent: Sequence[float], width: float) -> tuple[Any, tuple[float, float, float, float]]:
    """Return a map and its extent in blocks of cells, solid where one cell is: walls of one cell would not be seen."""
    x0, x1, y0, _ = extent
    resolution = (x1 - x0) / solid.shape[0]
    block = max(1, round(width / resolution / PANEL_CELLS))
    columns, rows = (-(-n // block) for n in solid.shape)
    padded = np.zeros((columns * block, rows * block), np.bool_)
    padded[: solid.shape[0], : solid.shape[1]] = solid
    blocks = padded.reshape(columns, block, rows, block).any(axis=(1, 3))
    side = block * resolution
    return blocks, (x0, x0 + columns * side, y0, y0 + rows * side)


def _scene(ax: Any, scene: Backdrop, frame: Any) -> None:
    """Draw a scenario's map, humans' starts, start and goal, cut to `frame` (x0, x1, y0, y1)."""
    if scene.occupied is not None:
        solid, extent = _thick(scene.occupied, scene.extent, frame[1] - frame[0])
        ax.imshow(np.where(solid.T, 0.35, 1.0), origin="lower", extent=extent, cmap="gray", vmin=0, vmax=1, zorder=1)
    from matplotlib.patches import Circle

    for (x, y), moves in zip(scene.humans, scene.moves, strict=True):
        face = "#b0b0b0" if moves else "#dcdcdc"
        ax.add_patch(Circle((x, y), 0.3, facecolor=face, edgecolor="#808080", linewidth=0.4, zorder=2))
    ax.plot(*scene.start, "o", color="black", markersize=3, zorder=7)
    ax.plot(*scene.goal, "*", color="#009E73", markeredgecolor="black", markeredgewidth=0.4, markersize=8, zorder=7)
    ax.set_xlim(*frame[:2])
    ax.set_ylim(*frame[2:])
    ax.set_aspect("equal")
    ax.set_xticks([])
    ax.set_yticks([])


def _frame(scene: Backdrop, paths: Sequence[Any]) -> tuple[float, float, float, float]:
    """Return a square (x0, x1, y0, y1) around everything that a panel shows."""
    points = np.concatenate([scene.start[None], scene.goal[None], scene.humans, *paths])
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    # wide enough that marks at the edge are whole
    half = max(2.5, 0.54 * float(np.ptp(points, axis=0).max()) + 1.0)
    return centre[0] - half, centre[0] + half, centre[1] - half, centre[1] + half


def _marks(scene: Backdrop) -> Any:
    """Return the places that must not be written over, (n, 2)."""
    return np.stack([scene.start, scene.goal])


def _joined(paths: Sequence[Any]) -> Any:
    return np.concatenate([np.zeros((0, 2)), *paths])


def _episodes(results: Results, scenario: int) -> list[int]:
    return [k for k in range(len(results.outcome)) if results.suite.scenario(k) == scenario]


def grid(results: Results) -> Any:
    """Return one panel per scenario with the trajectories of one policy over the map, and its success."""
    suite = results.suite
    columns = 9
    lines = math.ceil(len(suite.scenarios) / columns)
    figure = new_figure(1.75 * columns, 2.0 * lines + 0.7)
    axes = figure.subplots(lines, columns, squeeze=False)
    # one row per map, scenarios in the paper's order
    order = sorted(range(len(suite.scenarios)), key=lambda i: suite.maps.index(suite.scenarios[i].map))
    for ax, i in zip(axes.flat, order, strict=True):
        episodes = _episodes(results, i)
        scene = backdrop(suite.scenarios[i].name)
        stored = [results.trajectories[k] for k in episodes if k in results.trajectories]
        frame = _frame(scene, stored)
        _scene(ax, scene, frame)
        _paths(ax, results, episodes)
        _overlaid(ax, results, episodes, 8, _free_corner(frame, _marks(scene), _joined(stored)))
        ax.set_title(suite.scenarios[i].name, fontsize=6.5)
    figure.suptitle(f"{results.name}: {suite.name}, {results.physics} physics", fontsize=10, x=0.01, ha="left")
    figure.supxlabel(_NOTE, fontsize=7)
    _legend(figure)
    return figure


_NOTE = (
    "Lines: a scenario's first 20 episodes. Per cent: success over all its episodes, contact-free / as released. "
    "Dot: start, star: goal, circles:\nwhere humans start (dark: those that walk). Maps: asl-pepper-2d-sim, which "
    "states no licence."
)


def comparison(found: Sequence[Results], labels: Sequence[str] | None = None) -> Any:
    """Return the paper's figure: a row per policy, a column for each of four telling scenarios.

    Parameters
    ----------
    found : sequence of Results
        One per row, of ``navrep27``.
    labels : sequence of str, optional
        Of the rows; the policies' names by default.
    """
    suite = found[0].suite
    names = [s.name for s in suite.scenarios]
    figure = new_figure(2.1 * len(PAPER_SCENARIOS) + 0.6, 2.0 * len(found) + 0.9)
    axes = figure.subplots(len(found), len(PAPER_SCENARIOS), squeeze=False)
    for column, name in enumerate(PAPER_SCENARIOS):
        i = names.index(name)
        scene = backdrop(name)
        stored = [r.trajectories[k] for r in found for k in _episodes(r, i) if k in r.trajectories]
        frame = _frame(scene, stored)
        corner = _free_corner(frame, _marks(scene), _joined(stored))
        for ax, results in zip(axes[:, column], found, strict=True):
            _scene(ax, scene, frame)
            episodes = _episodes(results, i)
            _paths(ax, results, episodes)
            _overlaid(ax, results, episodes, corner=corner)
        axes[0, column].set_title(f"{name}\n({MAP_GROUPS[suite.scenarios[i].map]} map)", fontsize=7.5)
    for ax, label in zip(axes[:, 0], labels or [r.name for r in found], strict=True):
        ax.set_ylabel(label, fontsize=7)
    figure.supxlabel(_NOTE, fontsize=6.5)
    _legend(figure)
    return figure
