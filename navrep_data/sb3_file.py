"""Files of stable-baselines3: never opened here, but what to write instead is said, for the observations they take.

Such a zip holds pickled objects beside plain JSON. Only the JSON is read, and only what it says in plain text.
"""

from __future__ import annotations

import json
import re
import shlex
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from navrep_data.errors import PolicyError
from navrep_data.schema import N_RAYS, RANGE_MAX, RINGS_SHAPE, ROBOT_STATE_SIZE

ORIGIN = "navrep_data_origin"
"""Attribute of a model of ``load_sb3`` that says, in the saved file too, which policy's encoder it sees through."""
# The JSON holds the last observations of all worlds: 64 of rings take 1.5 MB.
_MAX_DATA_BYTES = 1 << 26
_MAX_ORIGIN = 300
# what make_sb3_vec puts beside the robot state
_FRONTS = {"scan": (N_RAYS,), "1d": (N_RAYS,), "rings": RINGS_SHAPE}
_BOX = re.compile(r"'(\w+)'(?:: |, )Box\(([^,()]+), ([^,()]+), \(([\d, ]+)\)")
_NAMES = re.compile(r"'(\w+)'(?:: |, )\w+\(")
_BROKEN = (OSError, zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError, KeyError, ValueError)


def refuse_sb3_file(path: Path, command: str = "navrep-data benchmark") -> None:
    """Raise if a file is one of stable-baselines3, saying what to write to drive with it.

    Parameters
    ----------
    path : Path
        Any file or folder; others than files of stable-baselines3 pass.
    command : str
        What the function's name is to be given to, in the advice.

    Raises
    ------
    PolicyError
        If it is a file of stable-baselines3.
    """
    data = _plain_data(path)
    if data is None:
        return
    what, code, name, remark = _advice(path, data)
    refusal = (
        f"{path.name} is a file of stable-baselines3: it holds pickled objects, which run code when loaded, so "
        "navrep-data does not open it."
    )
    if code is None:
        raise PolicyError(
            f"{refusal} {what}, so there is no function to print for it: write sb3_policy.py with act(scan, "
            f"robot_state), which takes (B, {N_RAYS}) [m] and (B, {ROBOT_STATE_SIZE}) and returns (B, 3) in [-1, 1], "
            f"and name it: {command} sb3_policy:act"
        )
    raise PolicyError(
        f"{refusal} {what}. If it is yours, write one line of Python and name that{remark}: echo {shlex.quote(code)} > "
        f"sb3_policy.py && {command} sb3_policy:{name}"
    )


def _plain_data(path: Path) -> dict[str, Any] | None:
    """Return the JSON of a file of stable-baselines3, empty where it cannot be read; None for any other file."""
    try:
        with zipfile.ZipFile(path) as found:
            if "_stable_baselines3_version" not in found.namelist():
                return None
            try:
                with found.open("data") as member:
                    text = member.read(_MAX_DATA_BYTES + 1)
                data = json.loads(text) if len(text) <= _MAX_DATA_BYTES else {}
            except (*_BROKEN, RecursionError):
                return {}
    except _BROKEN:
        return None
    return data if isinstance(data, dict) else {}


def _advice(path: Path, data: Mapping[str, Any]) -> tuple[str, str | None, str, str]:
    """Return what a file is in words, the code that drives with it (None: unknown), its name, and a remark."""
    algorithm, form = _algorithm(data), _form(_mapping(data, "observation_space"))
    features = form is not None and form[0] == "features"
    if features and _mapping(data, "action_space").get("_shape") == [2]:
        return _controller(path, data)
    if algorithm is None:
        return "Its algorithm is not said in plain text", None, "", ""
    if form is None or features:
        return "Its observations are not said in plain text, or are none that make_sb3_vec gives", None, "", ""
    front, flat, range_max = form
    near = f"scan.clip(0, {range_max:.9g})"
    if front == "scan":
        imports, seen, n_axes = "", near, 1
    elif front == "1d":
        imports = "from navrep_data.observations import fill_blind, scan_to_1d; "
        seen, n_axes = f"scan_to_1d(fill_blind({near}), {range_max:.9g})", 1
    else:
        imports, n_axes = "from navrep_data.observations import rings_to_float, scan_to_rings; ", 2
        seen = f"rings_to_float(scan_to_rings({near}))"
    if flat:
        imports = f"import numpy as np; {imports}"
        seen = seen if n_axes == 1 else f"{seen}.reshape(len(scan), -1)"
        observation = f"np.concatenate([{seen}, robot_state], axis=1)"
    else:
        observation = f'{{"{front}": {seen}, "robot_state": robot_state}}'
    code = (
        f"{imports}from stable_baselines3 import {algorithm}; model = {algorithm}.load({str(path.absolute())!r}); "
        f"act = lambda scan, robot_state: model.predict({observation}, deterministic=True)[0]"
    )
    # a line of numbers from 0 to 1 does not tell what they were divided by
    remark = f" (put your sensor's range_max in place of {range_max:g} if it was another)" if front == "1d" else ""
    return f"It takes {'flat ' if flat else ''}observations of {front}", code, "act", remark


def _controller(path: Path, data: Mapping[str, Any]) -> tuple[str, str | None, str, str]:
    """Return the advice for a controller of load_sb3, which sees through the encoder of a policy of the zoo."""
    origin = data.get(ORIGIN)
    known = isinstance(origin, str) and 0 < len(origin) <= _MAX_ORIGIN and origin.isprintable()
    code = (
        "from navrep_data import zoo; from navrep_data.zoo.sb3 import ControllerPPO, from_sb3; policy = "
        f"from_sb3(ControllerPPO.load({str(path.absolute())!r}), zoo.load({origin if known else 'NAME'!r}))"
    )
    remark = "" if known else ", with what load_sb3 was given in place of NAME"
    return (
        'It is a controller as load_sb3 makes them; zoo.save_policy(policy, "./folder") then makes a folder of it that '
        "all commands take",
        code,
        "policy",
        remark,
    )


def _mapping(data: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    found = data.get(name)
    return found if isinstance(found, dict) else {}


def _algorithm(data: Mapping[str, Any]) -> str | None:
    """Return the class that wrote a file, by the settings that it alone has; None where that is not clear."""
    # RecurrentPPO and others have PPO's settings
    if str(_mapping(data, "policy_class").get("__module__", "sb3_contrib")).startswith("sb3_contrib"):
        return None
    for name, setting in (("PPO", "clip_range"), ("SAC", "target_entropy"), ("TD3", "policy_delay")):
        if setting in data:
            return name
    return "A2C" if "rollout_buffer_class" in data else None


def _form(space: Mapping[str, Any]) -> tuple[str, bool, float] | None:
    """Return (scan, 1d or rings; whether flat; range_max [m]) of an observation space, "features" for an unbounded one.

    A space that is none of these gives None: other keys, sizes and bounds, such as those of normalised observations.
    """
    text = space.get("spaces")
    if isinstance(text, str):
        boxes = {name: (low, high, shape) for name, low, high, shape in _BOX.findall(text[:10_000])}
        names = set(_NAMES.findall(text[:10_000]))
        front = next((name for name in _FRONTS if names == {name, "robot_state"}), None)
        if front is None or front not in boxes:
            return None
        low, high, sizes = boxes[front]
        shape = tuple(int(n) for n in sizes.replace(",", " ").split())
        return _front(front, False, _number(low), _number(high)) if shape == _FRONTS[front] else None
    shapes, lows, highs = (space.get(name) for name in ("_shape", "low", "high"))
    if not (isinstance(shapes, list) and len(shapes) == 1 and isinstance(lows, str) and isinstance(highs, str)):
        return None
    low, high = (_number(text.strip("[ ")[:40].split(" ")[0].strip("]")) for text in (lows, highs))
    if low == -float("inf") and high == float("inf"):
        return "features", True, high
    if shapes == [N_RAYS + ROBOT_STATE_SIZE]:
        return _front("1d" if high == 1.0 else "scan", True, low, high)
    if shapes == [RINGS_SHAPE[0] * RINGS_SHAPE[1] + ROBOT_STATE_SIZE]:
        return _front("rings", True, low, high)
    return None


def _front(front: str, flat: bool, low: float, high: float) -> tuple[str, bool, float] | None:
    if low != 0.0 or not 0.0 < high < float("inf") or (front != "scan" and high != 1.0):
        return None
    return front, flat, high if front == "scan" else RANGE_MAX


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")
