"""Functions of scans and robot states as policies, and how they are imported by name."""

from __future__ import annotations

import hashlib
import importlib
import inspect
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from navrep_data.errors import PolicyError
from navrep_data.policies.baselines import BASELINES
from navrep_data.policies.protocol import BasePolicy, Context, Observation
from navrep_data.schema import ACTION_SIZE

F64 = NDArray[np.float64]

PolicyFunction = Callable[[NDArray[np.float32], NDArray[np.float32]], ArrayLike]
"""``function(scan (B, n_rays) [m], robot_state (B, 5)) -> action (B, 2) or (B, 3)`` in [-1, 1]."""

BLOCK = 64
"""Rows that a function or network sees unless told otherwise, so that its numbers do not depend on how many robots
there are."""


class FunctionPolicy(BasePolicy):
    """A callable ``function(scan, robot_state) -> action`` that always sees the same number of rows.

    Rows beyond those of the robots are copies of the first.

    Parameters
    ----------
    name : str
        As in results.
    function : callable
        Takes scans (B, n_rays) [m] and robot states (B, 5), returns (B, 2) or (B, 3) in [-1, 1]: shares of the robot's
        largest velocities, two numbers mean no rotation. If it has a method ``reset`` that is called as
        ``reset(batch_size=B)`` at first and ``reset(mask=...)`` where episodes begin; a method ``observe`` is called
        with (B, 3) after every step: what the robots were sent [m/s, m/s, rad/s]. An object that is no function is
        asked by its method ``act(scan, robot_state)``.
    rows : int
        B.
    """

    sees = "scan"
    needs = frozenset({"scan"})
    steers = False

    def __init__(self, name: str, function: Any, rows: int = BLOCK) -> None:
        self.name = name
        self.rows = self.max_rows = rows
        self.use(function if callable(function) else function.act, function)
        self._fresh = True

    def use(self, function: Callable[[Any, Any], Any], owner: Any, listens: bool = True) -> None:
        """Ask this function from now on; its owner has the memory, if any."""
        self._function = function
        self._reset: Callable[..., Any] | None = getattr(owner, "reset", None)
        self._observe: Callable[[Any], Any] | None = getattr(owner, "observe", None) if listens else None

    def start(self, context: Context) -> None:
        """Have the memory of a function begun anew at the next :meth:`reset`."""
        self._fresh = True

    def reset(self, mask: NDArray[np.bool_], seeds: NDArray[np.int64]) -> None:
        """Tell a function with memory where episodes begin."""
        if self._reset is not None:
            if self._fresh:
                self._reset(batch_size=self.rows)
            else:
                rows = np.zeros(self.rows, np.bool_)
                rows[: len(mask)] = mask
                self._reset(mask=rows)
        self._fresh = False

    def act(self, observation: Observation) -> F64:
        """Return actions (B, 3)."""
        n = len(observation.robot_state)
        found = self._function(self._fill_up(observation.scan), self._fill_up(observation.robot_state))
        actions = np.asarray(found, np.float64)
        if actions.shape not in ((self.rows, 2), (self.rows, ACTION_SIZE)):
            raise PolicyError(
                f"Policy {self.name!r} returned shape {actions.shape}, expected ({self.rows}, 3) or ({self.rows}, 2): "
                "vx, vy, omega in [-1, 1], one row per scan."
            )
        if not np.isfinite(actions).all():
            raise PolicyError(f"Policy {self.name!r} returned NaN or infinity, expected numbers in [-1, 1].")
        padded = np.zeros((n, ACTION_SIZE))
        padded[:, : actions.shape[1]] = actions[:n]
        return padded

    def observe(self, executed: F64) -> None:
        """Tell a function with memory what the robots were sent."""
        if self._observe is not None:
            self._observe(self._fill_up(executed).astype(np.float32))

    def _fill_up(self, rows: NDArray[Any]) -> NDArray[Any]:
        return np.concatenate([rows, np.repeat(rows[:1], self.rows - len(rows), axis=0)])


def load_attribute(name: str) -> Any:
    """Import ``module:attribute``; the current folder is searched first, as ``python -m`` does.

    Parameters
    ----------
    name : str
        ``module:attribute``. A class is called without arguments.

    Raises
    ------
    PolicyError
        If the module or attribute cannot be imported, or is no policy.
    """
    module_name, _, attribute = name.partition(":")
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.insert(0, here)
    try:
        found: Any = importlib.import_module(module_name)
        for part in attribute.split("."):
            found = getattr(found, part)
    except Exception as error:  # somebody's module: anything may be wrong in it
        said = str(error) if isinstance(error, ImportError | AttributeError) else f"{type(error).__name__}: {error}"
        raise PolicyError(
            f"Policy {name!r} cannot be imported ({said}). Expected module:function, importable from {here}, or one "
            f"of: {', '.join(BASELINES)}."
        ) from error
    if isinstance(found, type):
        try:
            found = found()
        except TypeError as error:
            raise PolicyError(
                f"Policy {name!r} cannot be made ({error}), expected a class that takes no arguments: give its "
                "settings defaults, or name an object that your module makes of it."
            ) from error
    if not callable(found) and not hasattr(found, "act"):
        raise PolicyError(
            f"Policy {name!r} is a {type(found).__name__}, expected a callable (scan, robot_state), or an object with "
            "act(scan, robot_state)."
        )
    return found


def source_hash(function: Any) -> str:
    """Return the SHA-256 of what a policy is: its own ``content_hash()``, else the file that it comes from.

    Empty where there is neither, as for functions typed into an interpreter. What that file imports is not in it.
    """
    own = getattr(function, "content_hash", None)
    if callable(own):
        return str(own())
    try:
        file = inspect.getsourcefile(function if inspect.isroutine(function) else type(function))
        return hashlib.sha256(Path(file).read_bytes()).hexdigest() if file else ""
    except (TypeError, OSError):
        return ""
