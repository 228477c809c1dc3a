"""What the tests of the environments share."""

import gymnasium
import numpy as np

from navrep_data.registration import ENVIRONMENTS, gymnasium_id
from navrep_data.sim import numpy_seed

PHYSICS = ("consistent", "original")
CASES = [(env, physics) for env in ENVIRONMENTS for physics in PHYSICS]


def is_numbered(env):
    try:
        numpy_seed(env, 0)
    except ValueError:
        return False
    return True


NUMBERED = [env for env in ENVIRONMENTS if is_numbered(env)]
STREAMED = [env for env in ENVIRONMENTS if not is_numbered(env)]


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
