"""Speed and size of navrep-data on this machine: every row of part 1's table, as a figure and as a ratio.

    python benchmarks/run.py [--quick] [--only CASE ...] [--write] [--json]

Each group of rows runs in a fresh process with one thread, in turns with a reference (see harness.py). ``--write``
puts the table into benchmarks/RESULTS.md. The exit code is 1 if a row fails its "must".
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

from cases import CASES, OUTSIDE, QUICK, Effort, Row
from harness import machine, run_child
from report import describe, number, table, write_section
from targets import TARGETS

HEADER = (
    "what", "measured", "spread", "per wall s", "must", "aim", "verdict", "reference", "reference's", "ratio", "how",
)  # fmt: skip
INTRODUCTION = """## Speed and size

{machine}

Median over turns. Per core = per second of CPU time; "per wall s" is the same by the clock on the wall, which suffers
from other work on the machine. The ratio is ours / reference within a turn: for seconds, bytes and GB, less is better.
"""


def collect(names: list[str], effort: Effort) -> list[Row]:
    """Measure the named cases; one that fails gives a row that says so."""
    rows: list[Row] = []
    for name in names:
        print(f"measuring {name} ...", file=sys.stderr, flush=True)
        if name in CASES:
            settings = json.dumps(dataclasses.asdict(effort))
            found = run_child([Path(__file__), "--case", name, "--effort", settings])
            rows += found.get("rows") or [{"key": name, "error": found["error"]}]
            continue
        try:
            rows += OUTSIDE[name](effort)
        except (RuntimeError, OSError, ValueError) as error:
            rows.append({"key": name, "error": str(error)})
    return rows


def judge(row: Row) -> Row:
    """Return the row with its target and verdict."""
    target = TARGETS.get(row["key"])
    if "error" in row or target is None:
        return {**row, "verdict": "FAIL"}
    return {**row, **dataclasses.asdict(target), "verdict": target.verdict(row["value"])}


def cells(row: Row) -> list[str]:
    """Return a judged row as the cells of the table."""
    if "error" in row:
        return [row["key"], *["-"] * 5, "FAIL", *["-"] * 3, row["error"]]
    value = f"{number(row['value'])} {row['unit']}"
    between = f"{number(row['low'])} to {number(row['high'])}" if row["low"] != row["high"] else "-"
    return [
        row["what"], value, between, number(row.get("wall")), number(row["must"]), number(row["aim"]), row["verdict"],
        row["reference"], number(row["reference_value"]), f"{row['ratio']:.3g}", row["note"],
    ]  # fmt: skip


def arguments() -> argparse.Namespace:
    names = [*CASES, *OUTSIDE]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="shorter; generate with n=100, scaled and labelled so")
    parser.add_argument("--only", nargs="+", choices=names, default=names, metavar="CASE", help=", ".join(names))
    parser.add_argument("--write", action="store_true", help="update benchmarks/RESULTS.md")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of the table")
    parser.add_argument("--case", choices=list(CASES), help=argparse.SUPPRESS)
    parser.add_argument("--effort", type=json.loads, help=argparse.SUPPRESS)
    return parser.parse_args()


def main() -> int:
    options = arguments()
    if options.case:  # the child's side of `collect`
        print(json.dumps({"rows": CASES[options.case](Effort(**options.effort))}))
        return 0
    where: dict[str, Any] = machine()
    rows = [judge(row) for row in collect(options.only, QUICK if options.quick else Effort())]
    order = list(TARGETS)
    rows.sort(key=lambda row: order.index(row["key"]) if row["key"] in order else len(order))
    text = INTRODUCTION.format(machine=describe(where)) + "\n" + table(HEADER, map(cells, rows))
    if options.quick:
        text += "\n\nMeasured with --quick: short turns, small datasets."
    if options.json:
        print(json.dumps({"benchmark": "run", "quick": options.quick, "machine": where, "rows": rows}))
    else:
        print(text)
    if options.write:
        write_section("run.py", text)
    return int(any(row["verdict"] == "FAIL" for row in rows))


if __name__ == "__main__":
    sys.exit(main())
