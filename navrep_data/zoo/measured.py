"""Measured results in a record: what tells them apart, and how cards and lists say it.

Notes
-----
An entry is a share of episodes of :func:`navrep_data.evaluate.benchmark` (``suite``, ``physics``, ``rounds``,
``inference``, ``ranges``, ``scaling``, rates), or an error of a world model (``split``). Older entries lack the four
after ``physics``: they were measured from round 0 on, without noise, before networks were fed by their contract. A
default run of today takes their place.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from navrep_data.schema import INFERENCE, RANGES, SCALING, fed_as, noise_of

Entry = Mapping[str, Any]
HOW = {"ranges": RANGES[0], "scaling": SCALING[0], "inference": INFERENCE[0]}
"""Settings of a run that decide what a network is fed, with the default of each."""
BY_CONTRACT = "contract, scaled"
"""How networks are fed by default, in words."""


def is_benchmark(entry: Entry) -> bool:
    """Return whether a result is a share of episodes, and not a world-model error."""
    return "success_rate" in entry


def first_round(entry: Entry) -> int:
    """Return the first round that was played."""
    return int(str(entry["rounds"]).split()[0])


def key(entry: Entry) -> tuple[Any, ...]:
    """Return what tells a result from all others of its record: of two with the same one the later counts.

    More episodes from the same round on are the same result, measured longer.
    """
    if not is_benchmark(entry):
        return (entry.get("suite"), entry.get("split"))
    return (
        entry["suite"], entry["physics"], first_round(entry),
        *(entry.get(name, default) for name, default in HOW.items()),
    )  # fmt: skip


def merged(old: Sequence[Entry], new: Sequence[Entry]) -> list[dict[str, Any]]:
    """Return the results of a record after `new` were measured, each in the place of the one it replaces."""
    return [dict(entry) for entry in {key(entry): entry for entry in (*old, *new)}.values()]


def main_result(results: Sequence[Entry], suite: str, physics: str) -> Entry | None:
    """Return the result that stands for a policy in a list: rounds from 0, fed as by default."""
    wanted = (suite, physics, 0, *HOW.values())
    return next((entry for entry in results if is_benchmark(entry) and key(entry) == wanted), None)


def other_result(results: Sequence[Entry], suite: str, physics: str) -> Entry | None:
    """Return the result of rounds from 0 that was fed in another way than by default: that of most episodes."""
    found = [r for r in results if is_benchmark(r) and key(r)[:3] == (suite, physics, 0)]
    return max(found, key=lambda r: int(r["episodes"]), default=None)


def feeding(entry: Entry) -> str:
    """Return in words how a network was fed."""
    return ", ".join(word for word in (fed_as(entry) or BY_CONTRACT, noise_of(entry)) if word)


def episodes(entry: Entry) -> str:
    """Return how many episodes were played, and in which rounds."""
    return f"{entry['episodes']} ({entry['rounds']})"


def played(entry: Entry) -> str:
    """Return in words what was played, and fed how: no two results of a record have the same."""
    how = f"{entry['physics']} physics, {entry['episodes']} episodes, rounds {entry['rounds']}"
    return f"{entry['suite']}, {how}, feeding: {feeding(entry)}"


def share(entry: Entry, name: str, interval: bool = False) -> str:
    """Return a share of a result in percent, "-" where it was not measured."""
    if entry.get(name) is None:
        return "-"
    text = f"{entry[name]:.1%}"
    return f"{text} ({entry[f'{name}_low']:.1%} to {entry[f'{name}_high']:.1%})" if interval else text
