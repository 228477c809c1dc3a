"""From episodes to scores: shares with Wilson's intervals, means with the bootstrap's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from navrep_data.evaluate.metrics import METRICS
from navrep_data.evaluate.results import Results
from navrep_data.evaluate.statistics import bootstrap, spread, wilson

SHARES = {"success": "S", "collision": "C", "timeout": "T"}


def score(results: Results, episodes: Sequence[int] | None = None) -> dict[str, Any]:
    """Return shares and means over some episodes, all of them by default.

    Parameters
    ----------
    results : Results
        Of one policy.
    episodes : sequence of int, optional
        Which ones.

    Returns
    -------
    dict
        ``episodes``; ``{success, collision, timeout}_rate`` each with ``_low`` and ``_high`` (Wilson, 95 %);
        every metric's mean over the episodes where it means something, with ``_low`` and ``_high`` (bootstrap, 95 %);
        None where there are none.
    """
    chosen = range(len(results.outcome)) if episodes is None else episodes
    played = [k for k in chosen if results.outcome[k] in SHARES.values()]
    row: dict[str, Any] = {"episodes": len(played)}
    for name, letter in SHARES.items():
        count = sum(results.outcome[k] == letter for k in played)
        row[f"{name}_rate"] = count / len(played) if played else None
        row[f"{name}_rate_low"], row[f"{name}_rate_high"] = wilson(count, len(played))
    for metric in METRICS:
        values = np.array([results.metrics[metric.name][k] for k in played])
        ends = zip(("", "_low", "_high"), bootstrap(values), strict=True)
        row |= {f"{metric.name}{end}": None if math.isnan(value) else value for end, value in ends}
    return row


def summary(results: Results) -> dict[str, Any]:
    """Return a policy's row of a table with everything below it: overall, per map and per scenario.

    Parameters
    ----------
    results : Results
        Of one policy.
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
        **score(results),
    }
    if len(suite.scenarios) > 1:
        row["per_map"] = {m: score(results, ks) for m, ks in by_map.items()}
        row["per_scenario"] = {name: score(results, ks) for name, ks in by_scenario.items()}
    return row


def by_variant(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return mean, least and greatest success over the runs of each variant of which there are several.

    Parameters
    ----------
    rows : sequence of dict
        What :func:`summary` returns.
    """
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["variant"], row["inference"]), []).append(row)
    found: list[dict[str, Any]] = []
    for (variant, inference), runs in groups.items():
        if len(runs) > 1:
            mean, low, high = spread([r["success_rate"] for r in runs])
            entry: dict[str, Any] = {"variant": variant, "inference": inference, "runs": [r["name"] for r in runs]}
            entry |= {"success_rate": mean, "success_rate_min": low, "success_rate_max": high}
            maps = {m: spread([r["per_map"][m]["success_rate"] for r in runs]) for m in runs[0].get("per_map", {})}
            names = ("success_rate", "success_rate_min", "success_rate_max")
            entry["per_map"] = {m: dict(zip(names, values, strict=True)) for m, values in maps.items()}
            found.append(entry)
    return found
