"""How a checkpoint of ours was trained, stage by stage, and what it was told: read from its record."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from typing import Any

from parts_of_cards import table

from navrep_data.zoo.registry import Record, records

_TRAINS = re.compile(r"navrep-data train (\S+)")
_INIT = re.compile(r"--init (\S+)")
_STOPPED = re.compile(r"--stop-after (\d+)")
_HEAD = ("stage", "trains", "goes on from", "steps", "learning rate", "cue: people", "cue: ranges")
_CONTROLLER_HEAD = (
    "stage",
    "trains",
    "goes on from",
    "steps",
    "learning rate",
    "epochs",
    "`least_std`",
    "`timeouts_end`",
)


@dataclass(frozen=True)
class Stage:
    """One training command of a checkpoint's recipe.

    Attributes
    ----------
    command : str
        The command line.
    settings : dict
        All settings it ran with; a setting that did not exist yet is missing.
    """

    command: str
    settings: dict[str, Any]

    @property
    def trains(self) -> str:
        """What the command trains: v, m, joint, transformer, controller or e2e."""
        found = _TRAINS.search(self.command)
        return found[1] if found else "?"

    @property
    def init(self) -> str | None:
        """What it went on from, None for random weights."""
        found = _INIT.search(self.command)
        return found[1] if found else None

    @property
    def steps(self) -> int:
        """Optimiser steps (world models) or steps of the environments (controllers) after which it ended."""
        found = _STOPPED.search(self.command)
        return int(found[1]) if found else int(self.settings["steps"])

    @property
    def people_weight(self) -> float:
        """Weight of the true positions of people in the loss; before the setting existed there was none."""
        return float(self.settings.get("people_weight", 0.0))

    @property
    def ranges_weight(self) -> float:
        """Weight of the nearness of the scan's own returns in the loss."""
        return float(self.settings.get("ranges_weight", 0.0))


def stages(r: Record) -> list[Stage]:
    """Return the trainings that made a checkpoint of ours, first to last, without those of what it sees through.

    Parameters
    ----------
    r : Record
        Of a checkpoint that this project trained.
    """
    t = r.training or {}
    last, before = t["settings"], list(t.get("stages_before", ()))
    if "v" in last:  # modular: all of V's stages come before those of M
        earlier_v = [s for s in before if s["model"] == "v"]
        earlier_m = [s for s in before if s["model"] == "m"]
        settings = [*earlier_v, last["v"], *earlier_m, last["m"]]
    else:
        settings = [*before, last]
    commands = [command for command in t["commands"] if _TRAINS.search(command)]
    return [Stage(*pair) for pair in zip(commands, settings, strict=True)]


def supervision(r: Record) -> str:
    """Return in a few sentences what a checkpoint of ours was told beyond what it sees.

    Parameters
    ----------
    r : Record
        Of a checkpoint that this project trained.
    """
    if r.kind == "policy":
        reward = (
            "The controller learned by reinforcement from the simulator's reward; it is given the scan and the robot "
            "state only."
        )
        if "world_model" not in r.parts:
            return f"{reward} It was never told where people are."
        model = r.parts["world_model"]
        told = any(stage.people_weight for stage in stages(records()[model]))
        how = "was trained with true positions of people (see its card)" if told else "was not told where people are"
        return f"{reward} Its code z comes from `{model}`, whose V {how}."
    found = stages(r)
    people = [f"{k} of {len(found)} (weight {s.people_weight:g})" for k, s in enumerate(found, 1) if s.people_weight]
    ranges = any(stage.ranges_weight for stage in found)
    text = (
        f"V was trained with true positions of people from the simulator, in {_stage_words(people)}: a linear head on "
        "z, thrown away after training, had to tell them. So its z is not unsupervised in the sense of the paper."
        if people
        else "V was not told where people are."
    )
    if ranges:
        text += " The head was also asked how near the scan's returns are, which needs no labels."
    return text


def _stage_words(named: list[str]) -> str:
    return ("stage " if len(named) == 1 else "stages ") + " and ".join(named)


def stages_table(r: Record) -> str:
    """Return the stages as a table, and all their settings to unfold.

    Parameters
    ----------
    r : Record
        Of a checkpoint that this project trained.
    """
    found = stages(r)
    rows: list[tuple[Any, ...]] = []
    for k, s in enumerate(found, 1):
        first = (
            k,
            s.trains,
            "random weights" if s.init is None else f"`{s.init}`",
            f"{s.steps:,}",
            f"{s.settings['lr']:g}",
        )
        if r.kind == "policy":
            end = [s.settings.get(key) for key in ("epochs", "least_std", "timeouts_end")]
            rows.append((*first, *(_plain(value) for value in end)))
        elif s.trains == "m":  # works on codes of V: no cues
            rows.append((*first, "-", "-"))
        else:
            rows.append((*first, f"{s.people_weight:g}", f"{s.ranges_weight:g}"))
    settings = "\n".join(f"{k}: {json.dumps(s.settings, ensure_ascii=False)}" for k, s in enumerate(found, 1))
    return (
        f"{table(_CONTROLLER_HEAD if r.kind == 'policy' else _HEAD, rows)}\n\n"
        f"<details><summary>All settings of each stage</summary>\n\n```\n{settings}\n```\n\n</details>"
    )


def earlier_stages(r: Record) -> str:
    """Return what the checkpoint had learned that a training went on from, with a link to its card, as a paragraph.

    Parameters
    ----------
    r : Record
        Of a checkpoint that this project trained.

    Returns
    -------
    str
        Empty where it began from random weights, or from a folder whose stages the table has.
    """
    init = stages(r)[0].init
    if init is None or init not in records():
        return ""
    steps = [stage.steps for stage in stages(records()[init])]
    sums = f", {' + '.join(f'{n:,}' for n in steps)}" if len(steps) > 1 else ""
    return f"[`{init}`]({init}.md) had been trained for {sum(steps):,} steps before{sums}: these come on top.\n\n"


def _plain(value: Any) -> str:
    """Return a setting as in the command line; what did not exist yet is a dash."""
    return "-" if value is None else str(value).lower() if isinstance(value, bool) else f"{value:g}"
