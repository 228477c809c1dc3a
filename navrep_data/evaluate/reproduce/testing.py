"""The paper's test figures and a table: success in the 27 scenarios, by variant and by whose number it is."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from navrep_data.evaluate.figures import MAX_ROWS, comparison, new_figure
from navrep_data.evaluate.reproduce.drawn import COLOURS, HATCHES, Drawn, Missing, authors, label, shipped
from navrep_data.evaluate.results import NOT_PLAYED, Results
from navrep_data.evaluate.sources import find_benchmarks, source_of
from navrep_data.evaluate.statistics import spread, wilson
from navrep_data.schema import fed_as
from navrep_data.sim.scenarios import MAP_GROUPS

PARTS = ("all", *MAP_GROUPS)
_MEASURED = ("released", "ours", "other", "baseline")
_WIDTH = 0.27
_AUTHORS_WAY = fed_as({"ranges": "as_released"})
Score = dict[str, Any]


def scores(found: Sequence[Results]) -> dict[str, dict[str, dict[str, Score]]]:
    """Return success by variant, source and part (all, maps).

    Several runs of a variant are one score, from the least to the greatest of them; a single one has Wilson's interval.
    Beside the authors' numbers stand runs of their networks that were fed as their software does it, where there are.
    """
    fed: dict[tuple[str, str], dict[str, list[Results]]] = {}
    for results in found:
        settings = results.header["settings"]
        if settings["inference"] == "deterministic":
            source, name = source_of(results.header["name"]), results.header["variant"]
            name = results.header["name"].partition(".")[0] if source == "ours" else name.partition(" (")[0]
            fed.setdefault((name, source), {}).setdefault(fed_as(settings), []).append(results)
    runs = {key: of.get(_AUTHORS_WAY) or of.get("") for key, of in fed.items()}
    merged: dict[str, dict[str, dict[str, Score]]] = {}
    for (variant, source), of in runs.items():
        if of is None:  # only as trained
            continue
        parts = ("all", *of[0].suite.maps)
        merged.setdefault(variant, {})[source] = {part: _merge(of, part) for part in parts}
    return merged


def _count(results: Results, part: str = "all") -> tuple[int, int]:
    """Return the episodes that reached the goal, and those played, of all scenarios or of one map's."""
    suite = results.suite
    letters = [
        letter
        for k, letter in enumerate(results.outcome)
        if letter != NOT_PLAYED and part in ("all", suite.scenarios[suite.scenario(k)].map)
    ]
    return letters.count("S"), len(letters)


def _merge(runs: Sequence[Results], part: str) -> Score:
    counts = [_count(r, part) for r in runs]
    names, episodes = [r.name for r in runs], sum(n for _, n in counts)
    counts = [c for c in counts if c[1]]
    if not counts:
        return {"value": None, "low": None, "high": None, "runs": names, "episodes": episodes}
    rates = [won / n for won, n in counts]
    value, low, high = spread(rates) if len(rates) > 1 else (rates[0], *wilson(*counts[0]))
    return {"value": value, "low": low, "high": high, "runs": names, "episodes": episodes}


def missing(folder: Path, suite: str, have: Sequence[str]) -> list[Missing]:
    """Return what of released policies and our own has not been measured in a suite."""
    command = f"navrep-data benchmark {{}} --suite {suite} --out {folder}"
    lacks = []
    if not any(source_of(name) == "released" for name in have):
        names = "e2e_1d.released e2e_rings.released transformer_1d_z.released"
        lacks.append(Missing(f"released policies in {suite}", command.format(names)))
    absent = [name for name in shipped("policy") if name not in have]
    if absent:
        lacks.append(Missing(f"our policies in {suite}", command.format(" ".join(absent))))
    return lacks


def _names(found: Sequence[Results]) -> list[str]:
    return [r.header["name"] for r in found]


def _order(measured: dict[str, Any]) -> list[str]:
    """Return the variants as the authors' figure has them, then what only we measured."""
    theirs = authors()["all"]
    others = [v for v in ("soadrl", "guldenring") if v in theirs]
    known = [v for v in theirs if v not in others]
    return [*known, *others, *sorted(v for v in measured if v not in theirs)]


# --- bars ----------------------------------------------------------------------------------------------------------


def testing(folder: Path) -> Drawn:
    """Draw success per variant, overall and per map, one bar per source."""
    found = find_benchmarks(folder, "navrep27")
    lacks = missing(folder, "navrep27", _names(found))
    if not found:
        return Drawn(missing=lacks)
    measured = scores(found)
    goal = measured.pop("goal", {}).get("baseline", {})
    order = _order(measured)
    figure = new_figure(12.5, 9.0)
    axes = figure.subplots(len(PARTS), 1, sharex=True)
    for ax, part in zip(axes, PARTS, strict=True):
        for i, variant in enumerate(order):
            _bars(ax, i, measured.get(variant, {}), authors()[part].get(variant), part)
        level = goal.get(part, {}).get("value")
        if level is not None:
            ax.axhline(100 * level, color="black", linestyle="--", linewidth=0.8, zorder=1)
        if part == "all":
            ax.axhline(100 * authors()["teb"]["success"], color="black", linestyle=":", linewidth=0.9, zorder=1)
        ax.set_ylim(0, 100)
        ax.set_xlim(-0.7, len(order) - 0.3)
        ax.set_ylabel("success [%]", fontsize=8)
        ax.set_title(
            "all 27 scenarios" if part == "all" else f"{MAP_GROUPS[part]} map ({part})", fontsize=9, loc="left"
        )
        ax.tick_params(labelsize=8)
        ax.grid(axis="y", linewidth=0.4, alpha=0.5, zorder=0)
        for side in ("top", "right"):
            ax.spines[side].set_visible(False)
    axes[-1].set_xticks(range(len(order)), order, rotation=40, ha="right", rotation_mode="anchor", fontsize=8)
    kinds = [s for s in _MEASURED if any(s in of for of in measured.values())]
    _legend(figure, kinds, bool(goal))
    figure.supxlabel(_note(found), fontsize=7)
    return Drawn(figure, sources=_sources(measured, goal), missing=lacks)


def _bars(ax: Any, i: int, measured: dict[str, dict[str, Score]], theirs: float | None, part: str) -> None:
    """Draw one variant's bars side by side, the authors' first."""
    entries: list[tuple[str, Score]] = [] if theirs is None else [("authors", {"value": theirs})]
    entries += [(s, measured[s][part]) for s in _MEASURED if s in measured and part in measured[s]]
    entries = [(source, score) for source, score in entries if score["value"] is not None]
    for j, (source, score) in enumerate(entries):
        x = i + (j - (len(entries) - 1) / 2) * _WIDTH
        value = 100 * score["value"]
        style: dict[str, Any] = {"color": COLOURS[source]}
        if source == "authors":  # an outline: it is not ours to vouch for
            style = {"facecolor": "white", "edgecolor": COLOURS[source], "hatch": HATCHES[source], "linewidth": 0.8}
        ax.bar(x, value, _WIDTH * 0.94, zorder=2, **style)
        top = value
        if source != "authors":
            top = 100 * score["high"]
            error = [[max(0.0, value - 100 * score["low"])], [max(0.0, top - value)]]
            ax.errorbar(x, value, error, color="black", capsize=2, linewidth=0.8, zorder=3)
        box = {"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.75}
        ax.annotate(
            f"{value:.0f}", (x, top), (0, 2), textcoords="offset points", ha="center", fontsize=6, bbox=box, zorder=4
        )


def _legend(figure: Any, kinds: Sequence[str], goal: bool) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = [
        Patch(facecolor="white", edgecolor=COLOURS["authors"], hatch=HATCHES["authors"], label=label("authors"))
    ]
    handles += [Patch(color=COLOURS[kind], label=label(kind)) for kind in kinds]
    if goal:
        handles.append(Line2D([], [], color="black", linestyle="--", linewidth=0.8, label="goal, measured by us"))
    handles.append(Line2D([], [], color="black", linestyle=":", linewidth=0.9, label="TEB planner, the paper's text"))
    figure.legend(handles=handles, loc="outside upper center", ncols=3, fontsize=8, frameon=False)


def _note(found: Sequence[Results]) -> str:
    played = sorted({sum(c != "-" for c in r.outcome) for r in found})
    each = f"{played[0]:,}" if len(played) == 1 else f"{played[0]:,} to {played[-1]:,}"
    seen = sorted({f"{r.name} sees {r.header['sees']}" for r in found if source_of(r.header["name"]) == "baseline"})
    baselines = f" {'; '.join(seen)}." if seen else ""
    return (
        f"Measured: {each} episodes per policy, original physics; intervals of 95 % (Wilson), or least to greatest of "
        "several runs. The authors' bars are read off their figure (+-0.5), theirs are of other episodes."
        + (f"\n{baselines.strip()}" if baselines else "")
    )


def _sources(measured: dict[str, dict[str, dict[str, Score]]], goal: dict[str, Score]) -> list[dict[str, Any]]:
    rows = [
        {"name": variant, "source": source, "part": part, **score}
        for variant, of in measured.items()
        for source, parts in of.items()
        for part, score in parts.items()
    ]
    rows += [{"name": "goal", "source": "baseline", "part": part, **score} for part, score in goal.items()]
    return rows + [
        {"name": name, "source": "authors", "part": part, "value": value}
        for part in PARTS
        for name, value in authors()[part].items()
    ]


# --- trajectories --------------------------------------------------------------------------------------------------


def trajectories(folder: Path) -> Drawn:
    """Draw trajectories of the best policies of every source in the paper's four scenarios."""
    found = find_benchmarks(folder, "navrep27")
    lacks = missing(folder, "navrep27", _names(found))
    if not found:
        return Drawn(missing=lacks)
    rate = {r.name: _merge([r], "all")["value"] or 0.0 for r in found}
    ranked = sorted(found, key=lambda r: -rate[r.name])
    most = {"ours": 3, "released": 3, "other": 1, "baseline": 1}
    chosen: list[Results] = []
    for source, n in most.items():
        chosen += [r for r in ranked if source_of(r.header["name"]) == source][:n]
    chosen = chosen[:MAX_ROWS]
    labels = [f"{r.name}\n({label(source_of(r.header['name'])).split(',')[0]})" for r in chosen]
    sources = [{"name": r.name, "source": source_of(r.header["name"]), "success_rate": rate[r.name]} for r in chosen]
    return Drawn(comparison(chosen, labels), sources=sources, missing=lacks)


# --- table ---------------------------------------------------------------------------------------------------------


_COLUMNS = {"released": ("released",), "ours": ("ours",), "other": ("baseline", "other")}
_TITLES = {
    "navrep27": "The paper's 27 test scenarios",
    "navreptest": "navreptest: the training environment's 200 test episodes",
}


def table(folder: Path) -> Drawn:
    """Return the tables of success, one per suite, a column per source and `goal` beside."""
    suites = {suite: find_benchmarks(folder, suite) for suite in _TITLES}
    lacks = [m for suite, found in suites.items() for m in missing(folder, suite, _names(found))]
    if not any(suites.values()):
        return Drawn(missing=lacks)
    parts, sources = [], []
    for suite, found in suites.items():
        if found:
            text, rows = _one_table(suite, scores(found))
            parts.append(f"## {_TITLES[suite]}\n\n{text}")
            sources += rows
    teb = authors()["teb"]
    parts.append(
        f"Success. {label('authors').capitalize()}: {authors()['source']}; other episodes than ours. Measured: in "
        "original physics; one run with its 95 % interval, several with mean and least to greatest. TEB: "
        f"{100 * teb['success']:.0f} % in the 27 scenarios ({teb['source']})."
    )
    return Drawn(text="\n\n".join(parts) + "\n", sources=sources, missing=lacks)


def _one_table(suite: str, measured: dict[str, dict[str, dict[str, Score]]]) -> tuple[str, list[dict[str, Any]]]:
    theirs = authors()["all"] if suite == "navrep27" else {}
    goal = _cell(measured.get("goal", {}).get("baseline", {}).get("all"), interval=False)
    head = ["policy", *([label("authors")] if theirs else [])]
    head += [label("released"), label("ours"), "baselines and others, measured by us", "`goal`, same episodes"]
    lines = [head, ["---"] * len(head)]
    sources: list[dict[str, Any]] = []
    for variant in [v for v in _order(measured) if v in theirs or v in measured]:
        cells = [variant]
        if theirs:
            cells.append(f"{100 * theirs[variant]:.1f} %" if variant in theirs else "-")
        for kinds in _COLUMNS.values():
            of = next((measured[variant][k] for k in kinds if k in measured.get(variant, {})), None)
            cells.append(_cell(None if of is None else of["all"]))
        sources += [{"name": variant, "suite": suite, "source": k, **of["all"]}
                    for k, of in measured.get(variant, {}).items()]  # fmt: skip
        if variant in theirs:
            sources.append({"name": variant, "suite": suite, "source": "authors", "value": theirs[variant]})
        lines.append([*cells, goal])
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines), sources


def _cell(score: Score | None, interval: bool = True) -> str:
    if score is None or score["value"] is None:
        return "-"
    text = f"{100 * score['value']:.1f} %"
    if not interval:
        return text
    text += f" ({100 * score['low']:.1f} to {100 * score['high']:.1f}"
    return text + (f"; {len(score['runs'])} runs)" if len(score["runs"]) > 1 else ")")
