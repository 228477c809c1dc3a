"""What other software computed, as recorded in ``tests/data`` (its README says by what and how)."""

import json
import os
from pathlib import Path

import numpy as np

DATA = Path(__file__).parent / "data"
AUTHORS = Path(os.environ.get("NAVREP_RELEASED_DIR") or Path(__file__).resolve().parents[2] / "shared" / "released")
"""The NavRep authors' weights, where somebody has them; they are not part of the repository."""
_SHARED_INPUTS = {"encoder_": "encoder.", "V_": "W.", "W_": "W."}


def reference(name):
    """The content of a JSON file."""
    return json.loads((DATA / name).read_text(encoding="utf-8"))


def arrays(path):
    with np.load(path) as npz:
        return {name: npz[name] for name in npz.files}


def golden(name):
    """All arrays of a golden file, with the inputs that it has in common with others."""
    found = arrays(DATA / "golden" / f"{name}.npz")
    for start, group in _SHARED_INPUTS.items():
        if name.startswith(start):
            inputs = arrays(DATA / "golden" / "inputs.npz")
            common = {key.removeprefix(group): value for key, value in inputs.items() if key.startswith(group)}
            if start == "V_":
                common = {"lidar_obs": common["lidar_obs"]}
            found |= common
    return found


def golden_names(pattern="*"):
    """Names of golden files, those of networks first."""
    return sorted(path.stem for path in (DATA / "golden").glob(f"{pattern}.npz") if path.stem != "inputs")


def write_golden(folder):
    """Write every golden file with all of its inputs, as ``models verify --golden`` takes them."""
    folder.mkdir(parents=True)
    for name in golden_names():
        np.savez(folder / f"{name}.npz", **golden(name))
    return folder


def write_original_npz(folder):
    """Write the two files of the original's data generator; their scans are the first forty, over and over."""
    folder.mkdir(parents=True)
    recorded = arrays(DATA / "original_npz.npz")
    for k in (0, 1):
        found = {name: recorded[f"{name}{k}"] for name in ("robotstates", "actions", "rewards", "dones")}
        scans = np.resize(recorded[f"scans{k}"], (len(found["dones"]), 1080))
        np.savez_compressed(folder / f"{k:03d}_scans_robotstates_actions_rewards_dones.npz", scans=scans, **found)
    return folder
