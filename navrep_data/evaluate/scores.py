"""From episodes to scores: shares with Wilson's intervals, means with the bootstrap's, pairs with McNemar's test."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from navrep_data.evaluate.metrics import METRES_PER_KM, METRICS
from navrep_data.evaluate.results import NOT_PLAYED, Results
from navrep_data.evaluate.statistics import bootstrap, bootstrap_ratio, mcnemar, spread, wilson

Row = dict[str, Any]

SHARES: dict[str, Callable[[Results, int], bool]] = {
    "contact_free": lambda r, k: r.contact_free(k),
    "success": lambda r, k: r.outcome[k] == "S",
    "collision": lambda r, k: r.outcome[k] == "C",
    "timeout": lambda r, k: r.outcome[k] == "T",
}
"""Shares of episodes; success is that of the environment as released, contact-free that of the paper's definition."""
SUCCESSES = ("contact_free", "success")
"""The two ways to count a success, the paper's definition first."""


def score(results: Results, episodes: Sequence[int] | None = None) -> Row:
    """Return shares and means over some episodes, all of them by default.

    Parameters
    ----------
    results : Results
        Of one policy.
    episodes : sequence of int, optional
        Which ones, by index into the lists of `results`.

    Returns
    -------
    dict
        ``episodes``; ``{contact_free, success, collision, timeout}_rate`` each with ``_low`` and ``_high`` (Wilson,
        95 %); every metric's mean over the episodes where it means something, and every ratio, with ``_low`` and
        ``_high`` (bootstrap, 95 %); None where there are none.
    """
    chosen = range(len(results.outcome)) if episodes is None else episodes
    played = [k for k in chosen if results.outcome[k] != NOT_PLAYED]
    row: Row = {"episodes": len(played)}
    for name, holds in SHARES.items():
        count = sum(holds(results, k) for k in played)
        row[f"{name}_rate"] = count / len(played) if played else None
        row[f"{name}_rate_low"], row[f"{name}_rate_high"] = wilson(count, len(played))
    for metric in METRICS:
        row |= _triple(metric.name, bootstrap([results.metrics[metric.name][k] for k in played]))
    of = {m.name: np.array([results.metrics[m.name][k] for k in played], np.float64) for m in METRICS}
    contacts = np.array([results.contacts[k].total for k in played], np.float64)
    row |= _triple("contacts_per_km", bootstrap_ratio(METRES_PER_KM * contacts, of["path_length"]))
    seconds = results.dt * np.array([results.steps[k] for k in played], np.float64)
    return row | _triple("personal_space_share", bootstrap_ratio(of["personal_space_time"], seconds))


def _triple(name: str, values: tuple[float, float, float]) -> Row:
    ends = zip(("", "_low", "_high"), values, strict=True)
    return {f"{name}{end}": None if math.isnan(value) else value for end, value in ends}


def _by_scenario(results: Results, of: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the sums of a number per episode, NaN where it was not played, and of episodes, per scenario."""
    scenario = np.arange(len(of)) % len(results.suite.scenarios)
    played = ~np.isnan(of)
    size = len(results.suite.scenarios)
    sums = np.bincount(scenario[played], of[played], size).astype(np.float64)
    counts = np.bincount(scenario[played], minlength=size).astype(np.float64)
    return sums[counts > 0], counts[counts > 0]


def _held(results: Results, name: str) -> NDArray[np.float64]:
    """Return 1, 0, or NaN where it was not played, per episode."""
    holds = SHARES[name]
    letters = enumerate(results.outcome)
    return np.array([math.nan if c == NOT_PLAYED else float(holds(results, k)) for k, c in letters], np.float64)


def summary(results: Results) -> Row:
    """Return a policy's row of a table with everything below it: overall, per map and per scenario.

    Parameters
    ----------
    results : Results
        Of one policy.

    Notes
    -----
    Where there are several scenarios, ``{contact_free, success}_rate_scenarios_low`` and ``_high`` are the cluster
    bootstrap's 95 % interval over scenarios: what other scenarios of this kind might give. The plain interval is that
    of more episodes of these scenarios.
    """
    suite = results.suite
    everything = range(len(results.outcome))
    by_scenario = {
        s.name: [k for k in everything if suite.scenario(k) == i] for i, s in enumerate(suite.scenarios)
    }  # fmt: skip
    by_map = {
        m: [k for k in everything if suite.scenarios[suite.scenario(k)].map == m] for m in suite.maps
    }  # fmt: skip
    row = {
        "name": results.name,
        "suite": suite.name,
        "physics": results.physics,
        "sees": results.header["sees"],
        "variant": results.header["variant"],
        "inference": results.header["settings"]["inference"],
        "first_round": results.first_round,
        "rounds": results.rounds,
        **score(results),
    }
    if len(suite.scenarios) > 1:
        for name in SUCCESSES:
            _, low, high = bootstrap_ratio(*_by_scenario(results, _held(results, name)))
            ends = {"low": low, "high": high}
            row |= {f"{name}_rate_scenarios_{k}": None if math.isnan(v) else v for k, v in ends.items()}
        row["per_map"] = {m: score(results, ks) for m, ks in by_map.items()}
        row["per_scenario"] = {name: score(results, ks) for name, ks in by_scenario.items()}
    return row


def compare(found: Sequence[Results]) -> list[Row]:
    """Return McNemar's test of any two policies on the episodes that both played.

    Parameters
    ----------
    found : sequence of Results
        Of one suite, physics and first round.

    Returns
    -------
    list of dict
        ``first``, ``second``: names; ``episodes``: those that both played; for ``contact_free`` and ``success``: in how
        many episodes ``NAME_first_only`` and ``NAME_second_only`` succeeded (the discordant ones), the p-value
        ``NAME_p``, and the difference of the shares ``NAME_difference`` (first - second); with several scenarios
        ``NAME_difference_scenarios_low`` and ``_high``, the cluster bootstrap's interval over scenarios.
    """
    held = {name: [_held(r, name) for r in found] for name in SUCCESSES}
    return [_pair(found[i], found[j], {n: (h[i], h[j]) for n, h in held.items()})
            for i, j in combinations(range(len(found)), 2)]  # fmt: skip


def _pair(a: Results, b: Results, held: dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]) -> Row:
    n = min(len(a.outcome), len(b.outcome))
    row: Row = {"first": a.name, "second": b.name}
    for name, (mine, other) in held.items():
        difference = mine[:n] - other[:n]  # NaN where one of them was not played
        row["episodes"] = int((~np.isnan(difference)).sum())
        first, second = int((difference > 0).sum()), int((difference < 0).sum())
        row |= {f"{name}_first_only": first, f"{name}_second_only": second, f"{name}_p": mcnemar(first, second)}
        row[f"{name}_difference"] = float(np.nanmean(difference)) if row["episodes"] else None
        if len(a.suite.scenarios) > 1:
            _, low, high = bootstrap_ratio(*_by_scenario(a, difference))
            ends = {"low": low, "high": high}
            row |= {f"{name}_difference_scenarios_{k}": None if math.isnan(v) else v for k, v in ends.items()}
    return row


def by_variant(rows: Sequence[Row]) -> list[Row]:
    """Return mean, least and greatest of both successes over the runs of each variant of which there are several.

    Parameters
    ----------
    rows : sequence of dict
        What :func:`summary` returns.
    """
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["variant"], row["inference"]), []).append(row)
    found: list[Row] = []
    for (variant, inference), runs in groups.items():
        if len(runs) > 1:
            entry: Row = {"variant": variant, "inference": inference, "runs": [r["name"] for r in runs]}
            entry |= _spreads(runs)
            maps = runs[0].get("per_map", {})
            entry["per_map"] = {m: _spreads([r["per_map"][m] for r in runs]) for m in maps}
            found.append(entry)
    return found


def _spreads(rows: Sequence[Row]) -> Row:
    """Return mean, least and greatest of both shares of success."""
    found: Row = {}
    for name in SUCCESSES:
        values = spread([r[f"{name}_rate"] for r in rows])
        found |= {f"{name}_rate{end}": v for end, v in zip(("", "_min", "_max"), values, strict=True)}
    return found
