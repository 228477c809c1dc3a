"""The paper's figure of training: success on the validation episodes over steps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from navrep_data.evaluate.figures import PALETTE, new_figure
from navrep_data.evaluate.reproduce.drawn import Drawn, Missing
from navrep_data.io import read_json
from navrep_data.io.logs import LOG_FILE, read_log
from navrep_data.zoo import registry

_MARKERS = "osD^vPX*"
_MAX_BYTES = 1 << 20
_USUAL = "navrep-test, original physics, numpy seeds 5000 to 5099"
NOTE = (
    f"Validation, where a name says nothing else: 100 episodes of {_USUAL}, at the greatest difficulty.\n"
    "Contact-free: goals without touching anybody or anything; as released: all goals, one in the step of a contact, "
    "too. The authors released no curves."
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
    for i, (name, (steps, success, shipped, selected_on)) in enumerate(sorted(curves.items())):
        colour = PALETTE[i % len(PALETTE)]
        best = max(success)
        marker = _MARKERS[i % len(_MARKERS)]
        counted = _counted(selected_on)
        ax.plot(
            [s / 1e6 for s in steps], [100 * s for s in success], color=colour, linewidth=1.3, marker=marker,
            markersize=3.5, markevery=max(1, len(steps) // 12), label=f"{name} ({counted}; best {best:.0%})",
        )  # fmt: skip
        ax.axhline(100 * best, color=colour, linewidth=0.8, linestyle=":")
        source = "ours, shipped" if shipped else "ours, a training's log"
        sources.append({"name": name, "source": source, "steps": steps[-1], "best": best, "last": success[-1],
                        "validation": counted})  # fmt: skip
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


Curve = tuple[list[int], list[float], bool, str | None]
"""Steps, shares, whether the weights are shipped, and on what they were chosen, None where that is not written down."""


def _counted(selected_on: str | None) -> str:
    """Return which success a curve shows, and on what where that is not the usual."""
    if selected_on is None:
        return "which goals count is not recorded"
    where, _, rule = selected_on.partition(", by the share of ")
    success = "contact-free" if "without contact" in rule else "as released"
    return success if where == _USUAL else f"{success}, on {where}"


def _selected_on(training: Path) -> str | None:
    """Return on what a training's best weights were chosen, from the checkpoint that it keeps."""
    path = training / "config.json"
    if not path.is_file():
        return None
    config = read_json(path, _MAX_BYTES)
    metadata = config.get("metadata") if isinstance(config, dict) else None
    found = metadata.get("selected_on") if isinstance(metadata, dict) else None
    return found if isinstance(found, str) else None


def _recorded() -> dict[str, Curve]:
    found: dict[str, Curve] = {}
    for r in registry.records().values():
        points: Any = (r.training or {}).get("curve")
        if points:
            steps, shares = [int(p[0]) for p in points], [float(p[1]) for p in points]
            found[r.name] = (steps, shares, True, (r.training or {}).get("selected_on"))
    return found


def _logged(folder: Path) -> dict[str, Curve]:
    found: dict[str, Curve] = {}
    for path in sorted(folder.rglob(LOG_FILE)):
        points = [(int(r["step"]), float(r["val_success"])) for r in read_log(path.parent) if "val_success" in r]
        if points:
            name = path.parent.relative_to(folder).as_posix()
            curve = [p[0] for p in points], [p[1] for p in points], False, _selected_on(path.parent)
            found[folder.name if name == "." else name] = curve
    return found
