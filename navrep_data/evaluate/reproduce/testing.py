"""The paper's test figures and a table: success in the 27 scenarios, by variant and by whose number it is."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from navrep_data.evaluate.figures import MAX_ROWS, comparison, new_figure
from navrep_data.evaluate.reproduce.drawn import COLOURS, HATCHES, Drawn, Missing, authors, label, shipped
from navrep_data.evaluate.results import NOT_PLAYED, Results
from navrep_data.evaluate.scores import SUCCESSES
from navrep_data.evaluate.sources import find_benchmarks, source_of, source_of_results
from navrep_data.evaluate.statistics import spread, wilson
from navrep_data.schema import fed_as, noise_of
from navrep_data.sim.scenarios import MAP_GROUPS

PARTS = ("all", *MAP_GROUPS)
_MEASURED = ("released_as_fed", "released", "ours", "other", "baseline")
_WIDTH = 0.22  # four of them stand side by side: the authors', released as fed, released, ours
_PALE = 0.35
"""Opacity of the success as released, behind that without contact."""
_FREE, _SUCCESS = (tuple(f"{name}_rate{end}" for end in ("", "_low", "_high")) for name in SUCCESSES)
Score = dict[str, Any]


def scores(found: Sequence[Results]) -> dict[str, dict[str, dict[str, Score]]]:
    """Return both successes by variant, source and part (all, maps).

    Several runs of a variant are one score, from the least to the greatest of them; a single one has Wilson's interval.
    Released networks that were fed as the authors' software does it are a source of their own, ``released_as_fed``;
    runs with noise, and of networks that were not scaled otherwise, are left out. ``success_rate``, with ``_low`` and
    ``_high``, is the success as released, which is what the authors' numbers are of; ``contact_free_rate`` that without
    contact.
    """
    runs: dict[tuple[str, str], list[Results]] = {}
    for results in found:
        settings, source = results.header["settings"], source_of_results(results)
        if noise_of(settings) or (fed_as(settings) and source != "released_as_fed"):
            continue
        name = results.header["variant"].partition(" (")[0]
        name = results.header["name"].partition(".")[0] if source == "ours" else name
        runs.setdefault((name, source), []).append(results)
    merged: dict[str, dict[str, dict[str, Score]]] = {}
    for (variant, source), of in runs.items():
        parts = ("all", *of[0].suite.maps)
        merged.setdefault(variant, {})[source] = {part: _merge(of, part) for part in parts}
    return merged


def _count(results: Results, part: str = "all") -> tuple[int, int, int]:
    """Return the episodes that reached the goal, those without contact, and all, of all scenarios or of one map's."""
    suite = results.suite
    played = [
        k
        for k, letter in enumerate(results.outcome)
        if letter != NOT_PLAYED and part in ("all", suite.scenarios[suite.scenario(k)].map)
    ]
    free = sum(results.contact_free(k) for k in played)
    return sum(results.outcome[k] == "S" for k in played), free, len(played)


def _merge(runs: Sequence[Results], part: str) -> Score:
    counts = [_count(r, part) for r in runs]
    names, episodes = [r.name for r in runs], sum(n for *_, n in counts)
    counts = [c for c in counts if c[-1]]
    found: Score = {}
    for which, keys in enumerate((_SUCCESS, _FREE)):
        ends: Sequence[float | None] = (None, None, None)
        if counts:
            rates = [c[which] / c[-1] for c in counts]
            ends = spread(rates) if len(rates) > 1 else (rates[0], *wilson(counts[0][which], counts[0][-1]))
        found |= dict(zip(keys, ends, strict=True))
    return {**found, "runs": names, "episodes": episodes}


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
    """Draw both successes per variant, overall and per map, a bar per source: filled contact-free, pale as released."""
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
        for key, style in (("contact_free_rate", "--"), ("success_rate", "-.")):
            level = goal.get(part, {}).get(key)
            if level is not None:
                ax.axhline(100 * level, color="black", linestyle=style, linewidth=0.8, zorder=1)
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
    figure.supxlabel(_note(found, kinds), fontsize=7)
    return Drawn(figure, sources=_sources(measured, goal), missing=lacks)


def _bars(ax: Any, i: int, measured: dict[str, dict[str, Score]], theirs: float | None, part: str) -> None:
    """Draw one variant's bars side by side, the authors' first."""
    entries: list[tuple[str, Score]] = [] if theirs is None else [("authors", {"success_rate": theirs})]
    entries += [(s, measured[s][part]) for s in _MEASURED if s in measured and part in measured[s]]
    entries = [(source, score) for source, score in entries if score["success_rate"] is not None]
    for j, (source, score) in enumerate(entries):
        x = i + (j - (len(entries) - 1) / 2) * _WIDTH
        value = 100 * score["success_rate"]
        style: dict[str, Any] = {"color": COLOURS[source], "alpha": _PALE}
        if source == "authors":  # an outline: it is not ours to vouch for
            style = {"facecolor": "white", "edgecolor": COLOURS[source], "hatch": HATCHES[source], "linewidth": 0.8}
        ax.bar(x, value, _WIDTH * 0.94, zorder=2, **style)
        top, text = value, f"{value:.0f}"
        if source != "authors":
            free, low, high = (100 * score[key] for key in _FREE)
            ax.bar(x, free, _WIDTH * 0.94, color=COLOURS[source], zorder=2)
            ax.errorbar(x, free, [[max(0.0, free - low)], [max(0.0, high - free)]], color="black", capsize=2,
                        linewidth=0.8, zorder=3)  # fmt: skip
            top, text = max(high, value), f"{free:.0f}/{value:.0f}"
        box = {"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.75}
        ax.annotate(text, (x, top), (0, 2), textcoords="offset points", ha="center", fontsize=5.5, bbox=box, zorder=4)


def _legend(figure: Any, kinds: Sequence[str], goal: bool) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = [
        Patch(facecolor="white", edgecolor=COLOURS["authors"], hatch=HATCHES["authors"], label=label("authors"))
    ]
    handles += [Patch(color=COLOURS[kind], label=label(kind)) for kind in kinds]
    if goal:
        lines: list[tuple[Any, str]] = [("--", "contact-free"), ("-.", "as released")]
        for style, what in lines:
            handles.append(
                Line2D([], [], color="black", linestyle=style, linewidth=0.8, label=f"goal, {what}, measured by us")
            )
    handles.append(Line2D([], [], color="black", linestyle=":", linewidth=0.9, label="TEB planner, the paper's text"))
    figure.legend(handles=handles, loc="outside upper center", ncols=3, fontsize=8, frameon=False)


_AS_FED = (
    f"{label('released_as_fed').capitalize()}: as their software runs them, ranges uncut and nothing scaled; "
    f"{label('released')}: ranges cut at the 25 m of their training, in proportion to the robot."
)


_OURS_DIFFER = (
    "Our weights differ from the authors' of the same name in more than the episodes: V was also trained with the true "
    "positions of people (e2e_1d has no V), the recipe was changed after scores on these episodes had been seen, and "
    "in the 27 scenarios what networks see is scaled to the slower robot."
)


def _note(found: Sequence[Results], kinds: Sequence[str]) -> str:
    played = sorted({sum(c != "-" for c in r.outcome) for r in found})
    each = f"{played[0]:,}" if len(played) == 1 else f"{played[0]:,} to {played[-1]:,}"
    seen = sorted({f"{r.name} sees {r.header['sees']}" for r in found if source_of(r.header["name"]) == "baseline"})
    baselines = f" {'; '.join(seen)}." if seen else ""
    return (
        f"Measured: {each} episodes per policy, original physics. Filled: success without contact, with intervals of "
        "95 % (Wilson) or least to greatest of several runs; pale: success as released.\nThe authors' bars are read "
        "off their figure (+-0.5): of other episodes, and to be held against success as released."
        + (f"\n{_lines(_OURS_DIFFER)}" if "ours" in kinds else "")
        + (f"\n{_AS_FED}" if "released_as_fed" in kinds else "")
        + (f"\n{baselines.strip()}" if baselines else "")
    )


def _lines(text: str) -> str:
    """Return a text in lines that fit below the figure."""
    return textwrap.fill(text, 190)


def _sources(measured: dict[str, dict[str, dict[str, Score]]], goal: dict[str, Score]) -> list[dict[str, Any]]:
    rows = [
        {"name": variant, "source": source, "part": part, **score}
        for variant, of in measured.items()
        for source, parts in of.items()
        for part, score in parts.items()
    ]
    rows += [{"name": "goal", "source": "baseline", "part": part, **score} for part, score in goal.items()]
    return rows + [
        {"name": name, "source": "authors", "part": part, "success_rate": value}
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
    shown: dict[str, Results] = {}  # one of each policy: the one that was run and fed as by default, where there is one
    for r in sorted(found, key=lambda r: r.name != r.header["name"]):
        shown.setdefault(r.header["name"], r)
    scored = {r.name: _merge([r], "all") for r in shown.values()}
    rate = {name: score["contact_free_rate"] or 0.0 for name, score in scored.items()}
    ranked = sorted(shown.values(), key=lambda r: -rate[r.name])
    most = {"ours": 3, "released": 3, "other": 1, "baseline": 1}
    chosen: list[Results] = []
    for source, n in most.items():
        chosen += [r for r in ranked if source_of(r.header["name"]) == source][:n]
    chosen = chosen[:MAX_ROWS]
    labels = [
        f"{r.name}\n({label(source_of(r.header['name'])).split(',')[0]})" for r in chosen
    ]  # the name says how fed
    sources = [
        {"name": r.name, "source": source_of_results(r), "contact_free_rate": rate[r.name],
         "success_rate": scored[r.name]["success_rate"] or 0.0}
        for r in chosen
    ]  # fmt: skip
    return Drawn(comparison(chosen, labels), sources=sources, missing=lacks)


# --- table ---------------------------------------------------------------------------------------------------------


_OTHERS = ("baseline", "other")
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
    there = {row["source"] for row in sources}
    parts.append(
        "Success: contact-free (the goal without touching anybody or anything), then as released (by the rules of the "
        "environment, which allow contacts in the 27 scenarios). "
        f"{label('authors').capitalize()}: {authors()['source']}; as released, of other episodes than ours. Measured: "
        "in original physics; one run with its 95 % interval, several with mean and least to greatest. TEB: "
        f"{100 * teb['success']:.0f} % in the 27 scenarios, as released ({teb['source']})."
        + (f" {_OURS_DIFFER}" if "ours" in there else "")
        + (f" {_AS_FED}" if "released_as_fed" in there else "")
    )
    return Drawn(text="\n\n".join(parts) + "\n", sources=sources, missing=lacks)


def _one_table(suite: str, measured: dict[str, dict[str, dict[str, Score]]]) -> tuple[str, list[dict[str, Any]]]:
    theirs = authors()["all"] if suite == "navrep27" else {}
    goal = _cells(measured.get("goal", {}).get("baseline", {}).get("all"), interval=False)
    head = ["policy", *([f"{label('authors')} (as released)"] if theirs else [])]
    # networks that were fed as the authors do it have a column where there are any
    as_fed = any("released_as_fed" in of for of in measured.values())
    columns = [*([("released_as_fed",)] if as_fed else []), ("released",), ("ours",), _OTHERS]
    titles = ["baselines and others, measured by us" if kinds == _OTHERS else label(kinds[0]) for kinds in columns]
    for what in (*titles, "`goal`, same episodes"):
        head += [f"{what}: contact-free", "as released"]
    lines = [head, ["---"] * len(head)]
    sources: list[dict[str, Any]] = []
    for variant in [v for v in _order(measured) if v in theirs or v in measured]:
        cells = [variant]
        if theirs:
            cells.append(f"{100 * theirs[variant]:.1f} %" if variant in theirs else "-")
        for kinds in columns:
            of = next((measured[variant][k] for k in kinds if k in measured.get(variant, {})), None)
            cells += _cells(None if of is None else of["all"])
        sources += [{"name": variant, "suite": suite, "source": k, **of["all"]}
                    for k, of in measured.get(variant, {}).items()]  # fmt: skip
        if variant in theirs:
            sources.append({"name": variant, "suite": suite, "source": "authors", "success_rate": theirs[variant]})
        lines.append([*cells, *goal])
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines), sources


def _cells(score: Score | None, interval: bool = True) -> list[str]:
    """Return the texts of the success without contact and of that as released."""
    return [_cell(score, keys, interval) for keys in (_FREE, _SUCCESS)]


def _cell(score: Score | None, keys: tuple[str, ...], interval: bool) -> str:
    value, low, high = keys
    if score is None or score[value] is None:
        return "-"
    text = f"{100 * score[value]:.1f} %"
    if not interval:
        return text
    text += f" ({100 * score[low]:.1f} to {100 * score[high]:.1f}"
    return text + (f"; {len(score['runs'])} runs)" if len(score["runs"]) > 1 else ")")
