"""What a checkpoint is, in words: for `models show` and for cards."""

from __future__ import annotations

import re
from typing import Any

from navrep_data.zoo.measured import is_benchmark, played, share
from navrep_data.zoo.names import RELEASED
from navrep_data.zoo.registry import Record, records

_ARCHITECTURES = {
    "modular": "V and M trained one after the other: a variational autoencoder, then an LSTM with mixture outputs",
    "joint": "V and M trained as one: a variational autoencoder with an LSTM of two layers",
    "transformer": "V and M trained as one: a variational autoencoder with a causal transformer of {blocks} blocks",
    "e2e": "one network from observation to action, no world model",
}
_BLIND_PEOPLE = (
    "In the released training environment half of the people, drawn by chance, do not see the robot and walk as if it "
    "was not there."
)
_INIT = re.compile(r"--init (\S+)")
_FEATURES = {
    "z": "the code z of the current scan",
    "h": "the memory h of the world model",
    "zh": "the code z of the current scan and the memory h of the world model",
}
_SCANS = {
    "over_25": "scan / 25 m, not clipped, shape (1080,)",
    "rings": "rings {0 free, 0.5 unknown, 1 occupied}, shape (64 angles, 64 ranges)",
    "metres": "scan in metres as it is, shape (1080,)",
}


def summary(r: Record) -> str:
    """Return in a sentence what a checkpoint is."""
    architecture = _ARCHITECTURES[r.architecture].format(blocks=_blocks(r))
    if r.kind in ("policy", "controller"):
        reads = f"Controller on {_FEATURES[r.features]}, and the robot state. " if r.features else ""
        kind = "World model" if r.features else "Network"
        if r.variant == "e2e_1d_carch":
            architecture = "a plain perceptron on the raw numbers"
        return f"{reads}{kind}: {architecture}."
    what = {"vae": "V alone", "memory": "M alone", "world_model": "World model"}[r.kind]
    return f"{what}: {architecture}."


def inputs(r: Record) -> list[tuple[str, str, str]]:
    """Return name, shape and unit or meaning of what a checkpoint takes and gives."""
    sensor = r.sensor
    scan = (
        f"{sensor['n_rays']} rays, ray 0 straight ahead, anticlockwise, {sensor['range_max']:g} m where nothing is hit"
    )
    state = ("`robot_state`", "(B, 5)", "goal x, goal y [m], vx, vy [m/s], omega [rad/s], robot frame")
    if r.kind in ("policy", "controller"):
        rows = [("`scan`", f"(B, {sensor['n_rays']}) [m]", scan)] if r.kind == "policy" else []
        rows.append(state)
        rows.append(("features", f"(B, {r.n_inputs})", _feature_order(r)))
        rows.append(
            ("action (out)", "(B, 3)", "vx, vy in [-1, 1] times the robot's top speed (1 m/s in training); omega 0")
        )
        return rows
    shape = "(B, T, 64, 64)" if r.lidar == "rings" else f"(B, T, {sensor['n_rays']})"
    rows = [("`obs`", shape, _scan_words(r))] if r.kind != "memory" else [("`z`", f"(B, T, {r.z_size})", "code of V")]
    if r.kind != "vae":
        rows.append(("`goal`", "(B, T, 2) [m]", "goal x, goal y, robot frame"))
        which = "chosen at the row" if r.action_alignment == "taken" else "that led to the row"
        rows.append(("`action`", "(B, T, 3) [m/s, m/s, rad/s]", f"the action {which}"))
    return rows


def _scan_words(r: Record) -> str:
    if r.preprocessing is None:
        return "not known"
    words = _SCANS[r.preprocessing["scan"]]
    return words + ("; nearest range cell cleared" if r.preprocessing["zero_first_bin"] else "")


def _feature_order(r: Record) -> str:
    if r.features is None:
        return f"[{_scan_words(r)}, robot_state]"
    order = {"z": ("z", "robot_state"), "h": ("robot_state", "h"), "zh": ("z", "robot_state", "h")}[r.features]
    sizes = {"z": r.z_size, "robot_state": 5, "h": r.h_size}
    return "[" + ", ".join(f"{name} ({sizes[name]})" for name in order) + "]"


def _blocks(r: Record) -> int:
    """Return the blocks of a record's transformer; the authors' all have 8."""
    name = r.parts.get("world_model", r.name)
    settings = (records()[name].training or {}).get("settings", {}) if name in records() else {}
    return int(settings.get("n_blocks", 8))


def quirks(r: Record) -> list[str]:
    """Return what a user of this checkpoint should know beforehand."""
    found = []
    if r.ours:
        return _own_quirks(r)
    if r.kind in ("policy", "controller") and r.variant != "e2e_1d_carch":
        size = "from 600 up to 10^5" if r.architecture == "e2e" else "typically 300 to 1000"
        found.append(
            f"Bang-bang control: means are {size} before they are clipped to [-1, 1], so vx and vy are nearly always "
            "exactly -1 or 1. Use the mean; a sampled action flips signs."
        )
    if r.context_rule == "oldest-32" and r.kind != "world_model":
        found.append(
            "Frozen context: the memory was trained on the first 32 rows of an episode (6.4 s) and h stands still "
            "afterwards. The default keeps to that."
        )
        found.append(
            "Noisy h: the authors' software never left training mode, so dropout"
            + (", a sampled z and a random LSTM start" if r.architecture == "joint" else " and a sampled z")
            + ' were in every h that this controller saw. The default is deterministic; inference="as_released" brings '
            "the noise back under a seed."
        )
    if r.architecture == "transformer":
        found.append("z has 64 numbers; the paper says 32.")
    if r.architecture == "modular" and (r.h_size and (r.features is None or "h" in r.features)) and r.kind != "vae":
        found.append("h has 512 numbers (all LSTM cells); the paper says 64.")
    if r.action_alignment == "leading":
        found.append("Action alignment `leading`: a row goes with the action that led to it, (0, 0, 0) at the start.")
    if r.architecture == "e2e" and r.preprocessing:
        found.append(
            "Ranges are fed in metres; the paper says normalised."
            if r.lidar == "1d"
            else "The nearest range cell is fed as measured; the encoders of the world models clear it."
        )
    found.append(_BLIND_PEOPLE)
    return found


def _own_quirks(r: Record) -> list[str]:
    found = []
    if r.kind == "policy":
        settings = (r.training or {})["settings"]
        found.append(f"Trained to drive at {settings['max_speed']:g} m/s at most; omega is always 0.")
        before = _INIT.search(r.training["commands"][0]) if r.training else None
        if before is not None and before[1] in records():
            found.append(
                f"Its controller went on from that of `{before[1]}`: their scores do not say what each representation "
                "brings by itself."
            )
    if r.action_alignment == "taken":
        found.append(
            "Action alignment `taken`: a row goes with the action chosen at it"
            + ("; h is that after the row before." if r.features and "h" in r.features else ".")
        )
    return found


def describe(r: Record) -> list[str]:
    """Return a record in words, one fact per line, for a terminal."""
    lines = [r.name + (f"  (= {r.variant}.{RELEASED})" if r.released and r.tag != RELEASED else ""), summary(r)]
    for name, shape, meaning in inputs(r):
        lines.append(f"{name.strip('`')}: {shape} {meaning}")
    sizes = {"z": r.z_size, "h": r.h_size, "inputs": r.n_inputs, "parameters": r.n_parameters}
    lines.append("sizes: " + ", ".join(f"{key} {value:,}" for key, value in sizes.items() if value is not None))
    for f in r.files:
        lines.append(f"file: {f.path} ({'size not known' if f.bytes is None else f'{f.bytes:,} bytes'}, {f.id})")
    lines += [f"needs: {name}" for name in r.parts.values()]
    if r.started:
        lines.append(f"run started {r.started}, file written {r.saved}")
    if r.ours:
        lines.append(f"trained by {r.source['trained_by']}, NOT the NavRep authors' weights; {r.source['license']}")
        lines += [f"made by: {command}" for command in (r.training or {})["commands"]]
    else:
        lines.append(f"from {r.source['repository']} at {r.source['commit']}, {r.source['license']}")
    lines += [f"quirk: {text}" for text in quirks(r)] + [f"note: {text}" for text in r.notes]
    lines += [f"result: {_result_words(x)}" for x in r.results] or ["results: not measured yet"]
    return lines


def _result_words(x: dict[str, Any]) -> str:
    if not is_benchmark(x):
        ahead = "" if x["scan_mse"] is None else f"next frame {x['scan_mse']:.4g}, goal {x['goal_mse']:.4g} m2, "
        return f"MSE, {x['split']} split, {x['rows']:,} rows: {ahead}V {x['reconstruction_mse']:.4g}; {x['command']}"
    return (
        f"{played(x)}: success contact-free "
        f"{share(x, 'contact_free_rate')}, as released {share(x, 'success_rate')}; `goal` on the same episodes "
        f"{share(x, 'goal_contact_free_rate')} and {share(x, 'goal_success_rate')}; {x['command']}"
    )
