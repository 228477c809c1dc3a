"""The paper's figure of training: success on the validation episodes over steps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from navrep_data.evaluate.figures import PALETTE, new_figure
from navrep_data.evaluate.reproduce.drawn import Drawn, Missing
from navrep_data.io.logs import LOG_FILE, read_log
from navrep_data.zoo import registry

_MARKERS = "osD^vPX*"
NOTE = (
    "Validation: 100 episodes of navrep-test at its greatest difficulty, original physics, numpy seeds 5000 to 5099. "
    "The authors released no curves."
)


def training(folder: Path) -> Drawn:
    """Draw the curves of trainings below `folder`, and those that shipped weights recorded."""
    curves = _recorded() | _logged(folder)
    if not curves:
        commands = "navrep-data train controller --features z --world-model NAME|DIR --out"
        return Drawn(missing=[Missing("a controller's training", f"{commands} {folder / 'transformer_rings_z'}")])
    figure = new_figure(7.6, 4.4)
    ax = figure.subplots()
    sources = []
    for i, (name, (steps, success, shipped)) in enumerate(sorted(curves.items())):
        colour = PALETTE[i % len(PALETTE)]
        best = max(success)
        marker = _MARKERS[i % len(_MARKERS)]
        ax.plot(
            [s / 1e6 for s in steps], [100 * s for s in success], color=colour, linewidth=1.3, marker=marker,
            markersize=3.5, markevery=max(1, len(steps) // 12), label=f"{name} (best {best:.0%})",
        )  # fmt: skip
        ax.axhline(100 * best, color=colour, linewidth=0.8, linestyle=":")
        source = "ours, shipped" if shipped else "ours, a training's log"
        sources.append({"name": name, "source": source, "steps": steps[-1], "best": best, "last": success[-1]})
    ax.set_xlabel("million steps of all worlds")
    ax.set_ylabel("validation episodes that reach the goal [%]")
    ax.set_ylim(0, 100)
    ax.set_xlim(left=0)
    ax.grid(linewidth=0.4, alpha=0.5)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    ax.legend(fontsize=8, frameon=False, title="trained by navrep-data; dotted: the best", title_fontsize=8)
    figure.supxlabel(NOTE, fontsize=6.5)
    return Drawn(figure, sources=sources)


Curve = tuple[list[int], list[float], bool]


def _recorded() -> dict[str, Curve]:
    found: dict[str, Curve] = {}
    for r in registry.records().values():
        points: Any = (r.training or {}).get("curve")
        if points:
            found[r.name] = ([int(p[0]) for p in points], [float(p[1]) for p in points], True)
    return found


def _logged(folder: Path) -> dict[str, Curve]:
    found: dict[str, Curve] = {}
    for path in sorted(folder.rglob(LOG_FILE)):
        points = [(int(r["step"]), float(r["val_success"])) for r in read_log(path.parent) if "val_success" in r]
        if points:
            name = path.parent.relative_to(folder).as_posix()
            found[folder.name if name == "." else name] = ([p[0] for p in points], [p[1] for p in points], False)
    return found
