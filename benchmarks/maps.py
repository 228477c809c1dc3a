"""How fast maps are: lidar scans, time-to-goal fields, distances and ORCA's tables, each beside a slow oracle.

Run ``python benchmarks/maps.py [MAP ...] [--json]``; default the three maps of the IAN scenarios, which need the extra
[maps]. A map may also be the path of a YAML file.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from harness import in_turns, machine, ratio, spread

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from oracles_maps import arrival_times, walk_ranges

from navrep_data.schema import SensorContract
from navrep_data.sim import _fast_marching, _grid_lidar
from navrep_data.sim.gridmap import GridMap
from navrep_data.sim.lidar import ray_directions
from navrep_data.sim.map_obstacles import orca_tables
from navrep_data.sim.maps import load_map, planning_map, planning_speeds

MAPS = ("asl", "asl_office_j", "unity_scene_map")
POSES = 64
# Scans in a row from nearly the same place, as a robot takes them: 0.11 m a step.
STEPS, WAY = 8, 0.11
ORACLE_RAYS = 27
CLEARANCE = 0.5
# Time horizon of 2 s at 0.8 m/s, and a radius of 0.3 m.
REACH = 1.9


def sensor_poses(grid: GridMap) -> np.ndarray:
    """Return poses (N, 3) on free ground, in short walks."""
    rng = np.random.default_rng(0)
    places = np.argwhere(grid.signed_distance() > CLEARANCE)
    starts = grid.centre_of(places[rng.integers(len(places), size=POSES)])
    poses = np.repeat(np.column_stack([starts, rng.uniform(0.0, 2 * np.pi, POSES)]), STEPS, axis=0)
    way = np.tile(np.arange(STEPS) * WAY / STEPS, POSES)
    poses[:, 0] += way * np.cos(poses[:, 2])
    poses[:, 1] += way * np.sin(poses[:, 2])
    return poses


def lidar_works(grid: GridMap) -> list[Callable[[], float]]:
    """Return what scans with the kernel, and with the oracle that walks from cell to cell; both return rays."""
    contract = SensorContract()
    directions, poses = ray_directions(contract), sensor_poses(grid)
    out = np.empty((len(poses), contract.n_rays), np.float32)
    angles = contract.angle_min + np.arange(contract.n_rays) * contract.angle_increment

    def kernel() -> float:
        _grid_lidar.grid_scans(
            grid.free_squares, *grid.origin, grid.resolution, poses, directions, contract.range_max, out
        )  # fmt: skip
        return out.size

    def oracle() -> float:
        x, y = (poses[0, :2] - grid.origin) / grid.resolution
        walk_ranges(grid.occupied, x, y, angles[:: contract.n_rays // ORACLE_RAYS] + poses[0, 2])
        return len(angles[:: contract.n_rays // ORACLE_RAYS])

    return [kernel, oracle]


def field_works(grid: GridMap) -> list[Callable[[], float]]:
    """Return what solves for a goal with the kernel, and with the oracle on a heap of tuples; both return fields."""
    coarse = planning_map(grid)
    speeds = planning_speeds(coarse)
    i, j = (int(k) for k in np.argwhere(coarse.signed_distance() > CLEARANCE)[0])
    field = np.empty(coarse.shape, np.float32)

    def kernel() -> float:
        _fast_marching.march(speeds, i, j, _fast_marching.UPWIND_ORIGINAL, field)
        return 1.0

    def oracle() -> float:
        arrival_times(speeds, (i, j))
        return 1.0

    return [kernel, oracle]


def once(work: Callable[[], Any]) -> float:
    """Return the CPU seconds of one call."""
    started = time.process_time()
    work()
    return time.process_time() - started


def measure(name: str, repeats: int, seconds: float) -> dict[str, Any]:
    """Return the figures of one map."""
    grid = load_map(name)
    rows: dict[str, Any] = {"map": grid.name, "cells": list(grid.shape)}
    # what a map costs once per process, without the cache on disk
    rows["distance_s"] = once(grid._distance)
    rows["free_squares_s"] = once(lambda: grid.free_squares)
    rows["orca_tables_s"] = once(lambda: orca_tables(grid, REACH))
    tables = orca_tables(grid, REACH)
    rows["edges"] = sum(map(len, grid.contours()))
    rows["edges_per_table"] = [float(tables.counts[1:].mean()), int(tables.counts.max())]
    rays = SensorContract().n_rays
    kernel, oracle = in_turns(lidar_works(grid), repeats, seconds)
    rows["scans_per_cpu_s"] = spread([value / rays for value in kernel.cpu])
    rows["scan_us"] = 1e6 / rows["scans_per_cpu_s"]["median"]
    rows["scan_against_oracle"] = ratio(kernel.cpu, oracle.cpu)
    kernel, oracle = in_turns(field_works(grid), repeats, seconds)
    rows["goal_field_ms"] = 1e3 / spread(kernel.cpu)["median"]
    rows["goal_field_against_oracle"] = ratio(kernel.cpu, oracle.cpu)
    return rows


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("maps", nargs="*", default=MAPS, metavar="MAP")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=0.3, help="per turn")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    # compiles, so that it is not measured
    orca_tables(GridMap("small", np.eye(9), 1.0, (0.0, 0.0)), REACH)
    _grid_lidar.free_squares(np.eye(9, dtype=bool), np.empty((_grid_lidar.QUADRANTS, 10, 10), np.uint8))
    results = [measure(name, given.repeats, given.seconds) for name in given.maps]
    if given.json:
        print(json.dumps({"machine": machine(), "results": results}))
        return
    for row in results:
        print(f"{row['map']}: {row['cells'][0]} x {row['cells'][1]} cells")
        print(f"  scan of 1080 rays      {row['scan_us']:8.1f} us   {row['scan_against_oracle']:7.0f} x oracle")
        field = f"{row['goal_field_ms']:8.2f} ms   {row['goal_field_against_oracle']:7.0f} x oracle"
        print(f"  time-to-goal field     {field}")
        print(f"  once: distances {row['distance_s']:.2f} s, leap tables {row['free_squares_s']:.3f} s, "
              f"ORCA tables {row['orca_tables_s']:.2f} s")  # fmt: skip
        mean, most = row["edges_per_table"]
        print(f"  outline {row['edges']} edges; ORCA sees {mean:.0f} on average, {most} at most")


if __name__ == "__main__":
    main()
