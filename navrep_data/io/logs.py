"""Logs of numbers by step, as trainings leave them: ``log.csv``."""

from __future__ import annotations

import csv
from pathlib import Path

LOG_FILE = "log.csv"


def read_log(out: Path | str) -> list[dict[str, str]]:
    """Return the rows of a training's ``log.csv`` as written; empty where there is none."""
    path = Path(out) / LOG_FILE
    if not path.is_file():
        return []
    with open(path, newline="") as handle:
        # a killed run may have cut the last line short
        return [
            {name: value for name, value in row.items() if value}
            for row in csv.DictReader(handle)
            if None not in row and None not in row.values() and str(row.get("step", "")).isdecimal()
        ]
