"""Tables in Markdown, for terminals, files and the README."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from navrep_data.evaluate.metrics import CONTACT_TEXT, METRICS, RATIOS, Metric
from navrep_data.sim.scenarios import MAP_GROUPS

Row = dict[str, Any]

MANY_DIGITS = 0.1
"""Values whose interval ends below this have a third decimal: shares of time and contacts would read 0.00."""
SIGNIFICANT = 0.05


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
    digits = 3 if abs(row[f"{name}_high"]) < MANY_DIGITS else 2
    return f"{row[name]:.{digits}f} ({row[f'{name}_low']:.{digits}f} to {row[f'{name}_high']:.{digits}f})"


def _grid(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table with columns as wide as their texts."""
    widths = [max(len(line[i]) for line in [head, *lines]) for i in range(len(head))]
    shown = ["| " + " | ".join(f"{t:{w}}" for t, w in zip(line, widths, strict=True)) + " |" for line in [head, *lines]]
    shown.insert(1, "|" + "|".join("-" * (w + 2) for w in widths) + "|")
    return "\n".join(shown)


def _start(row: Row, baseline: Row | None, part: Row | None = None, of: Row | None = None) -> list[str]:
    """Return the columns that every table has: who, what it sees, physics, episodes, both successes and the goal's."""
    mine = part or row
    other = of or baseline
    goal = "-" if other is None else _both(other)
    episodes = f"{mine['episodes']} (rounds {row['rounds']})"
    shares = [_share(mine, "contact_free"), _share(mine, "success")]
    return [row["name"], row["sees"], row["physics"], episodes, *shares, goal]


def _both(row: Row) -> str:
    return f"{_share(row, 'contact_free', False)} / {_share(row, 'success', False)}"


_SUCCESS = ["success, contact-free", "success, as released"]
_HEAD = ["policy", "sees", "physics", "episodes", *_SUCCESS, "`goal`, both"]


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


def _titled(metric: Metric) -> str:
    return f"{metric.name.replace('_', ' ')}{f' [{metric.unit}]' if metric.unit else ''}"


def means(rows: Sequence[Row], baseline: Row | None) -> str:
    """Return the table of means and ratios with bootstrap intervals: one line per policy."""
    shown = (*RATIOS, *METRICS)
    lines = [[*_start(r, baseline), *(_mean(r, m.name) for m in shown)] for r in rows]
    return _grid([*_HEAD, *map(_titled, shown)], lines)


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
        start = _start(run, baseline)
        shares = [_spread(g, "contact_free"), _spread(g, "success")]
        lines.append([g["variant"], str(len(g["runs"])), *start[1:4], *shares, start[6]])
    head = [
        "variant",
        "runs",
        "sees",
        "physics",
        "episodes of each",
        *(f"{s}, mean (least to greatest)" for s in _SUCCESS),
    ]
    return _grid([*head, "`goal`, both"], lines)


def _spread(group: Row, name: str) -> str:
    value, low, high = (100 * group[f"{name}_rate{end}"] for end in ("", "_min", "_max"))
    return f"{value:.1f} % ({low:.1f} to {high:.1f})"


def over_scenarios(rows: Sequence[Row]) -> str:
    """Return the table of both intervals, over episodes and over scenarios; empty where there is one scenario."""
    if not rows or "success_rate_scenarios_low" not in rows[0]:
        return ""
    lines = [
        [r["name"], *(text for name in ("contact_free", "success") for text in (_share(r, name), _scenarios(r, name)))]
        for r in rows
    ]  # fmt: skip
    head = ["policy", *(text for s in _SUCCESS for text in (f"{s} (over episodes)", "over scenarios"))]
    return _grid(head, lines)


def _scenarios(row: Row, name: str) -> str:
    ends = [row[f"{name}_rate_scenarios_{end}"] for end in ("low", "high")]
    return "-" if ends[0] is None else f"{100 * ends[0]:.1f} to {100 * ends[1]:.1f} %"


def paired(pairs: Sequence[Row]) -> str:
    """Return the table of paired comparisons, see :func:`navrep_data.evaluate.scores.compare`; empty without any."""
    if not pairs:
        return ""
    scenarios = "success_difference_scenarios_low" in pairs[0]
    lines = []
    for p in pairs:
        cells = [p["first"], p["second"], str(p["episodes"])]
        for name in ("contact_free", "success"):
            cells += [_difference(p, name, scenarios), _discordant(p, name), _said(p, name)]
        lines.append(cells)
    head = ["first", "second", "episodes"]
    for what in ("contact-free", "as released"):
        over = " (over scenarios)" if scenarios else ""
        head += [f"{what}: difference{over}", "discordant: only first + only second", "McNemar"]
    return _grid(head, lines)


def _difference(pair: Row, name: str, scenarios: bool) -> str:
    value = pair[f"{name}_difference"]
    if value is None:
        return "-"
    text = f"{100 * value:+.1f}"
    low, high = (pair.get(f"{name}_difference_scenarios_{end}") for end in ("low", "high"))
    if not scenarios or low is None or high is None:
        return text
    return f"{text} ({100 * low:+.1f} to {100 * high:+.1f})"


def _discordant(pair: Row, name: str) -> str:
    first, second = pair[f"{name}_first_only"], pair[f"{name}_second_only"]
    return f"{first + second}: {first} + {second}"


def _said(pair: Row, name: str) -> str:
    p = pair[f"{name}_p"]
    value = "p < 0.0001" if p < 1e-4 else f"p = {p:.2g}"
    if p >= SIGNIFICANT:
        return f"{value}: statistically indistinguishable on these episodes"
    better = "first" if pair[f"{name}_first_only"] > pair[f"{name}_second_only"] else "second"
    return f"{value}: {pair[better]} succeeds more often"


_INTRODUCTION = (
    "Success, contact-free: the share of all episodes that end at the goal with no contact at all, the paper's "
    "definition of success. Success, as released: the share that end at the goal by the rules of the environment that "
    "the authors released; scores of the paper stand beside this one only. Shares with Wilson's 95 % intervals, means "
    "with the bootstrap's: they are of these weights in these scenarios. `goal` drives straight to the goal; its "
    "column has its success contact-free / as released on the same episodes."
)
_SCENARIOS = (
    "Over episodes: Wilson's interval, what more episodes of these scenarios might give. Over scenarios: a bootstrap "
    "that draws whole scenarios, what other scenarios of this kind might give."
)
_PAIRS = (
    "Any two policies on the episodes that both played, in percentage points (first - second). Discordant episodes are "
    "those in which only one of the two succeeded; McNemar's exact test asks whether they are shared out evenly. It "
    "takes episodes as independent and is not corrected for the number of pairs{more}."
)
_MORE = (
    "; rounds of one scenario are alike, so where the interval over scenarios holds 0 a small p is of these scenarios "
    "alone"
)


def report(
    rows: Sequence[Row], groups: Sequence[Row], baseline: Row | None, text: str, pairs: Sequence[Row] = ()
) -> str:
    """Return the whole report of one suite as Markdown."""
    definitions = "\n".join(f"* {m.name.replace('_', ' ')}: {m.text}" for m in (*RATIOS, *METRICS))
    several = "per_scenario" in rows[0]
    parts = [
        f"# {rows[0]['suite']}: {text}",
        _INTRODUCTION,
        overall(rows, baseline),
        variants(groups, rows, baseline),
        "## Per map" if "per_map" in rows[0] else "",
        per_part(rows, baseline, "per_map"),
        *(["## Over scenarios", _SCENARIOS, over_scenarios(rows)] if several else []),
        *(["## Pairs", _PAIRS.format(more=_MORE if several else ""), paired(pairs)] if pairs else []),
        "## Means",
        means(rows, baseline),
        f"{definitions}\n* {CONTACT_TEXT}",
        "## Per scenario" if several else "",
        per_part(rows, baseline, "per_scenario"),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"
