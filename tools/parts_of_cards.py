"""What all model cards share: tables, front matter, how to load."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from navrep_data.zoo.registry import Record


def table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Return a table in Markdown; None is a dash."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join(lines + ["| " + " | ".join("-" if v is None else str(v) for v in row) + " |" for row in rows])


def front_matter(name: str, r: Record) -> str:
    """Return the YAML that the Hub reads."""
    task = "reinforcement-learning" if r.kind in ("policy", "controller") else "feature-extraction"
    tags = ["navrep", "robot-navigation", "lidar", "crowd", r.architecture]
    tags += ["ppo"] if r.kind in ("policy", "controller") else ["world-models"]
    lines = ["---", "license: mit", "library_name: navrep-data", f"pipeline_tag: {task}", "tags:"]
    return "\n".join([*lines, *(f"- {tag}" for tag in tags), f"model_name: {name}", "---"])


def use(name: str, r: Record) -> str:
    """Return how a checkpoint is loaded and called."""
    load = f'model = navrep_data.zoo.load("{name}")'
    if r.kind == "policy":
        load = load.replace("model", "policy", 1)
        more = ["policy.reset(batch_size=1)", "action = policy.act(scan, robot_state)"]
    elif r.kind == "controller":
        more = ["mean, value = model.controller(features)"]
    else:
        more = {
            "vae": ["z = model.encode(obs)", "again = model.decode(z)"],
            "memory": [],
            "world_model": ["z = model.encode(obs)", "ahead = model.predict(obs, goal, action)"],
        }[r.kind]
    return "\n".join(["```python", "import navrep_data", "", load, *more, "```"])
