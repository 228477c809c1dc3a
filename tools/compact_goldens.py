"""Write the compact golden files of the package: ``python tools/compact_goldens.py --golden DIR --from DIR``.

A maintainers' script, for when a checkpoint is added. ``navrep_data/zoo/goldens/NAME.npz`` holds a few rows of what is
known of a checkpoint, in the names of the full golden files:

* where the original software's outputs were recorded (``--golden DIR``, the files that the checkpoint's record names),
  evenly spaced rows of them, with the recorded inputs: ``original`` is true;
* of all others, our own weights among them, what this package computes on made-up inputs: ``original`` is false. They
  tell whether a later version still computes the same, not whether the original software would have.

Made-up inputs are whole multiples of small fractions from ``numpy.random.RandomState(0)``, which numpy never changes.
Of rows that are longer than 64 numbers evenly spaced values are stored (:func:`navrep_data.zoo.golden.thin`). A file
that is there is only replaced with ``--again``: what an earlier version recorded is worth keeping.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from navrep_data.io.npz import read_npz
from navrep_data.zoo import golden as outputs_of
from navrep_data.zoo.fetching import Source, locate
from navrep_data.zoo.registry import Record, records
from navrep_data.zoo.verification import compare_compact, open_alone

Arrays = dict[str, NDArray[Any]]

ROWS, STEPS = 3, 4
"""Rows of controllers, and steps of sequences."""
V_ROWS = 2


def main() -> int:
    """Run the command line; returns 1 where a file just written is not within tolerance."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--golden", type=Path, required=True, help="recorded outputs of the original software")
    parser.add_argument("--from", dest="source", type=Path, required=True, help="the authors' files")
    parser.add_argument("--again", action="store_true", help="replace files that are there")
    options = parser.parse_args()
    torch.set_num_threads(1)
    outputs_of.COMPACT.mkdir(exist_ok=True)
    where, bad = Source.of(options.source), 0
    for record in records().values():
        out = outputs_of.COMPACT / f"{record.name}.npz"
        if not record.is_checkpoint or (out.exists() and not options.again):
            continue
        path = next((path for path, _ in (locate(entry, where) for entry in record.files[:1]) if path), None)
        if path is None:
            print(f"{record.name}: its file is not here")
            continue
        module = open_alone(record, path)
        arrays = recorded(record, options.golden) or computed(record, module)
        kept: dict[str, Any] = {**arrays, "weights": outputs_of.weight_sums(module)[0]}
        np.savez_compressed(out, **kept)
        found = compare_compact(record, module)
        worst = max(found, key=lambda c: c.error / c.tolerance)
        bad += not all(c.ok for c in found)
        whose = "the original's" if arrays["original"] else "ours"
        print(
            f"{record.name}: {out.stat().st_size:,} bytes, {len(found)} outputs, {whose}; the worst, {worst.output}, "
            f"at {worst.error / worst.tolerance:.2f} of its tolerance",
            flush=True,
        )
    total = sum(path.stat().st_size for path in outputs_of.COMPACT.glob("*.npz"))
    print(f"{total:,} bytes in all")
    return int(bad > 0)


def recorded(record: Record, golden: Path) -> Arrays:
    """Return rows of what the original software computed; nothing where that was not recorded."""
    names = [name for name in record.golden if not name.startswith("encoder_")]
    if not names:
        return {}
    with open(golden / names[0], "rb") as file:
        full = read_npz(file, 256 << 20)
    if record.kind == "vae":
        found = _recorded_v(full)
    elif record.kind == "world_model":
        found = _recorded_v(full) | _recorded_sequence(full)
    else:
        rows = np.linspace(
            0, len(full["obs"]) - 1, 2 if full["obs"].size > 16 * 1000 and record.lidar == "1d" else ROWS
        )
        found = {name: full[name][rows.astype(int)] for name in ("obs", "action_mean", "value")}
        found["obs"] = found["obs"].reshape(len(found["obs"]), -1)
        found["logstd"] = full["logstd"]
    return {**found, "original": np.array(True)}


def _recorded_v(full: Arrays) -> Arrays:
    rows = np.linspace(0, len(full["lidar_obs"]) - 1, V_ROWS).astype(int)
    found = {"lidar_obs": full["lidar_obs"][rows].reshape(V_ROWS, -1), "z": full["z"][rows]}
    return found | {name: outputs_of.thin(full[name][rows]) for name in ("mu", "logvar", "decode_mu", "decode_z")}


def _recorded_sequence(full: Arrays) -> Arrays:
    found = {
        "seq0_obs": full["seq0_obs"][:STEPS].reshape(STEPS, -1), "seq0_actions": full["seq0_actions"][:STEPS],
        "seq0_robotstates": full["seq0_robotstates"][:STEPS],
    }  # fmt: skip
    outputs = ("seq0_h_det", "seq0_next_obs_det", "seq0_next_state_det")
    return found | {name: outputs_of.thin(full[name][:STEPS]) for name in outputs}


@torch.no_grad()
def computed(record: Record, module: Any) -> Arrays:
    """Return what this package computes on made-up inputs."""
    draw = np.random.RandomState(0)
    if record.kind == "world_model":
        return {**_computed_world_model(module, str(record.lidar), draw), "original": np.array(False)}
    obs = (draw.randint(-8, 9, (ROWS, int(record.n_inputs or 0))) / 4).astype(np.float32)
    if record.architecture == "e2e":
        scan = _observations(str(record.lidar), ROWS, draw).reshape(ROWS, -1)
        obs[:, : scan.shape[1]] = scan * (25 if record.lidar == "1d" else 1)  # metres
    mean, value = module(torch.from_numpy(obs))
    found = {"obs": obs, "action_mean": mean.numpy(), "value": value.numpy().reshape(-1)}
    return {**found, "logstd": module.logstd.detach().numpy(), "original": np.array(False)}


def _observations(lidar: str, n: int, draw: np.random.RandomState) -> NDArray[np.float32]:
    """Return walls of 40 rays, or blocks of 8 x 8 cells."""
    if lidar == "1d":
        return np.repeat(draw.randint(1, 51, (n, 27)) / 50, 40, axis=1).astype(np.float32)
    return np.kron(draw.randint(0, 3, (n, 8, 8)) / 2, np.ones((1, 8, 8))).astype(np.float32)


def _computed_world_model(model: Any, lidar: str, draw: np.random.RandomState) -> Arrays:
    z_size = int(model.vae.config.z_size)
    found: Arrays = {
        "lidar_obs" if lidar == "1d" else "rings_obs": _observations(lidar, V_ROWS, draw),
        "z": (draw.randint(-8, 9, (V_ROWS, z_size)) / 4).astype(np.float32),
        "seq0_obs": _observations(lidar, STEPS, draw),
        "seq0_robotstates": (draw.randint(-8, 9, (STEPS, 5)) / 2).astype(np.float32),
        "seq0_actions": (draw.randint(-4, 5, (STEPS, 3)) / 4).astype(np.float32),
    }
    mu, logvar = model.vae.distribution(torch.from_numpy(found["lidar_obs" if lidar == "1d" else "rings_obs"]))
    ahead = outputs_of.predicted(model, found["seq0_obs"], found["seq0_robotstates"], found["seq0_actions"])
    outputs = {
        "mu": mu, "logvar": logvar, "decode_mu": model.vae.decode(mu),
        "decode_z": model.vae.decode(torch.from_numpy(found["z"])), "seq0_h_det": ahead.h[0],
        "seq0_next_obs_det": ahead.obs[0], "seq0_next_state_det": ahead.goal[0],
    }  # fmt: skip
    return found | {name: outputs_of.thin(values.numpy()) for name, values in outputs.items()}


if __name__ == "__main__":
    sys.exit(main())
