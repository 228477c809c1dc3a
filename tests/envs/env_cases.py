"""What the tests of the environments share."""

import gymnasium
import numpy as np
import pytest
import torch

from navrep_data.errors import MissingExtraError
from navrep_data.registration import ENVIRONMENTS
from navrep_data.schema import Event
from navrep_data.sim import gymnasium_id, make_config
from navrep_data.sim.maps import map_names

PHYSICS = ("consistent", "original")
NUMBERED = ["navrep-test", "navrep-val"]
"""Environments whose episodes are numpy seeds from a list."""
KINDS = [np.int64, np.uint8, np.array, torch.tensor]
"""What whole numbers come as, besides Python's own."""
try:
    HAS_MAPS = bool(map_names())
except MissingExtraError:
    HAS_MAPS = False


def is_numbered(env):
    return env == "ian" or env in NUMBERED


def param(env, *more):
    needs_maps = make_config(env).world == "map"
    marks = [pytest.mark.skipif(needs_maps and not HAS_MAPS, reason="needs the maps: pip install 'navrep-data[maps]'")]
    # one of each kind is enough for the quick tests
    if env.startswith(("mark-t", "crowdmove-")) and env not in ("mark-test-2", "crowdmove-1"):
        marks.append(pytest.mark.slow)
    return pytest.param(env, *more, marks=marks)


ALL = [param(env) for env in ENVIRONMENTS]
CASES = [param(env, physics) for env in ENVIRONMENTS for physics in PHYSICS]
STREAMED = [case for case in CASES if not is_numbered(case.values[0])]


def make(env, **kwargs):
    return gymnasium.make(f"navrep_data:{gymnasium_id(env)}", **kwargs)


def make_vec(env, n, **kwargs):
    return gymnasium.make_vec(
        f"navrep_data:{gymnasium_id(env)}", num_envs=n, vectorization_mode="vector_entry_point", **kwargs
    )


def same(a, b):
    """Return whether two observations or infos are equal bit for bit, NaN included."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, np.ndarray) and a.dtype == object:
        return a.shape == b.shape and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    return type(a) is type(b) and a == b


def labelled(infos, config):
    """Return a vector environment's infos with the labels that a single environment's info has for codes."""
    out = {}
    for key, value in infos.items():
        known = infos.get(f"_{key}")
        if isinstance(value, dict):
            out[key] = labelled(value, config)
        elif key == "event":
            out[key] = np.array([Event(v).label if k else None for v, k in zip(value, known, strict=True)], object)
        elif key == "scenario":
            names = [config.scenarios[v] if k else None for v, k in zip(value, known, strict=True)]
            out[key] = np.array(names, object)
        else:
            out[key] = value
    return out
