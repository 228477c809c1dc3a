"""Tables in Markdown, for terminals, files and the README."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from navrep_data.evaluate.metrics import METRICS
from navrep_data.sim.scenarios import MAP_GROUPS

Row = dict[str, Any]


def _share(row: Row, name: str, interval: bool = True) -> str:
    if row[f"{name}_rate"] is None:
        return "-"
    text = f"{100 * row[f'{name}_rate']:.1f} %"
    if interval:
        text += f" ({100 * row[f'{name}_rate_low']:.1f} to {100 * row[f'{name}_rate_high']:.1f})"
    return text


def _mean(row: Row, name: str) -> str:
    if row[name] is None:
        return "-"
    return f"{row[name]:.2f} ({row[f'{name}_low']:.2f} to {row[f'{name}_high']:.2f})"


def _grid(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table with columns as wide as their texts."""
    widths = [max(len(line[i]) for line in [head, *lines]) for i in range(len(head))]
    shown = ["| " + " | ".join(f"{t:{w}}" for t, w in zip(line, widths, strict=True)) + " |" for line in [head, *lines]]
    shown.insert(1, "|" + "|".join("-" * (w + 2) for w in widths) + "|")
    return "\n".join(shown)


def _start(row: Row, baseline: Row | None, part: Row | None = None, of: Row | None = None) -> list[str]:
    """Return the columns that every table has: who, what it sees, physics, episodes, and success beside the goal's."""
    mine = part or row
    other = of or baseline
    goal = "-" if other is None else _share(other, "success", interval=False)
    return [row["name"], row["sees"], row["physics"], str(mine["episodes"]), _share(mine, "success"), goal]


_HEAD = ["policy", "sees", "physics", "episodes", "success", "`goal`"]


def overall(rows: Sequence[Row], baseline: Row | None) -> str:
    """Return the table of shares: one line per policy, the `goal` baseline's success beside each.

    Parameters
    ----------
    rows : sequence of dict
        What :func:`navrep_data.evaluate.summary` returns.
    baseline : dict or None
        The same of `goal`.
    """
    lines = [[*_start(r, baseline), _share(r, "collision"), _share(r, "timeout")] for r in rows]
    return _grid([*_HEAD, "collision", "timeout"], lines)


def means(rows: Sequence[Row], baseline: Row | None) -> str:
    """Return the table of means with bootstrap intervals: one line per policy."""
    head = [f"{m.name.replace('_', ' ')}{f' [{m.unit}]' if m.unit else ''}" for m in METRICS]
    lines = [[*_start(r, baseline), *(_mean(r, m.name) for m in METRICS)] for r in rows]
    return _grid([*_HEAD, *head], lines)


def per_part(rows: Sequence[Row], baseline: Row | None, parts: str) -> str:
    """Return the table per map or per scenario; empty where the suite has none.

    Parameters
    ----------
    rows, baseline
        As for :func:`overall`.
    parts : str
        ``"per_map"`` or ``"per_scenario"``.
    """
    if not rows or parts not in rows[0]:
        return ""
    lines = []
    for name in rows[0][parts]:
        for r in rows:
            part = r[parts][name]
            of = baseline[parts][name] if baseline else None
            label = f"{name} ({MAP_GROUPS[name]})" if name in MAP_GROUPS else name
            lines.append(
                [label, *_start(r, baseline, part, of), _share(part, "collision"), _share(part, "timeout")]
            )  # fmt: skip
    return _grid(["map" if parts == "per_map" else "scenario", *_HEAD, "collision", "timeout"], lines)


def variants(groups: Sequence[Row], rows: Sequence[Row], baseline: Row | None) -> str:
    """Return the table of variants with several runs: mean and least to greatest success; empty without any."""
    if not groups:
        return ""
    lines = []
    for g in groups:
        run = next(r for r in rows if r["name"] == g["runs"][0])
        low, high = (100 * g[f"success_rate_{end}"] for end in ("min", "max"))
        text = f"{100 * g['success_rate']:.1f} % ({low:.1f} to {high:.1f})"
        start = _start(run, baseline)
        lines.append([g["variant"], str(len(g["runs"])), *start[1:4], text, start[5]])
    head = ["variant", "runs", "sees", "physics", "episodes of each", "success, mean (least to greatest)", "`goal`"]
    return _grid(head, lines)


def report(rows: Sequence[Row], groups: Sequence[Row], baseline: Row | None, text: str) -> str:
    """Return the whole report of one suite as Markdown."""
    definitions = "\n".join(f"* {m.name.replace('_', ' ')}: {m.text}" for m in METRICS)
    parts = [
        f"# {rows[0]['suite']}: {text}",
        "Shares with Wilson's 95 % intervals, means with the bootstrap's; `goal` drives straight to the goal.",
        overall(rows, baseline),
        variants(groups, rows, baseline),
        "## Per map" if "per_map" in rows[0] else "",
        per_part(rows, baseline, "per_map"),
        "## Means",
        means(rows, baseline),
        definitions,
        "## Per scenario" if "per_scenario" in rows[0] else "",
        per_part(rows, baseline, "per_scenario"),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"
