"""Compile kernels ahead of a first run, in two processes, and tell that they are being compiled.

``python -m navrep_data.generate.compiling DTYPE`` is the second process: DTYPE is how scans are stored, which is all
that the kernels' types depend on.
"""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from numba.core import event as numba_event
from tqdm import tqdm

from navrep_data.generate.worker import DatasetSpec, new_writer
from navrep_data.kernels import is_missing
from navrep_data.shards import SPLITS
from navrep_data.sim import RolloutSettings, ScriptedPolicy, ScriptedRollout, make_config
from navrep_data.sim._rollout import rollout_sequence

_events: Any = numba_event  # untyped
BLANK_ROWS = 10

_COMPILES = "numba:compile"  # not heard where a kernel comes from the cache


class Compiling(numba_event.Listener):
    """Within the block, say so once something is compiled, and count on stderr how many kernels are.

    Parameters
    ----------
    say : callable
        Is given one line when compiling begins; not called where all is compiled already.
    progress : bool
        Whether to count on stderr.
    """

    def __init__(self, say: Callable[[str], None], progress: bool) -> None:
        self._say = say
        self._progress = progress
        self._bar: tqdm[Any] | None = None
        self._collects = gc.isenabled()

    def __enter__(self) -> Compiling:
        _events.register(_COMPILES, self)
        return self

    def __exit__(self, *_: object) -> None:
        _events.unregister(_COMPILES, self)
        if self._bar is not None:
            self._bar.close()
            if self._collects:
                gc.enable()

    def on_start(self, event: Any) -> None:
        """Begin to tell, at the first kernel."""
        if self._bar is None:
            self._say("Compiling kernels for this machine (once, about half a minute)")
            self._bar = tqdm(
                desc="Compiling", unit=" kernels", disable=not self._progress, leave=False, dynamic_ncols=True
            )
            gc.disable()  # looking for garbage among a compiler's many objects takes a tenth of the time

    def on_end(self, event: Any) -> None:
        """Count a kernel."""
        if self._bar is not None:
            self._bar.update()


def compile_ahead(spec: DatasetSpec) -> None:
    """Compile what scripted rollouts in worlds of polygons need, half of it in another process; does nothing later on.

    Kernels are kept in a cache folder, so that this process finds there what the other one compiled. Where that fails,
    or ends early, this one compiles it all when it calls it.

    Parameters
    ----------
    spec : DatasetSpec
        What will be made: under a scripted policy, and not on maps.
    """
    if not is_missing(rollout_sequence) or (os.cpu_count() or 1) < 2:
        return
    helper = subprocess.Popen(
        [sys.executable, "-m", __name__, spec.settings.scan_dtype],
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        short = replace(spec, settings=replace(spec.settings, length=BLANK_ROWS))
        rollout = ScriptedRollout(short.config, short.settings, ScriptedPolicy("orca"), seed=0)
        for kernel, arguments in rollout.parts()[1]:
            kernel.prepare(arguments)
        writer = new_writer(short, SPLITS[0])
        writer.append(0, rollout.blank())
        writer.finish()
        helper.wait()
    finally:
        helper.kill()
        helper.wait()


if __name__ == "__main__":
    gc.disable()
    settings = RolloutSettings(length=BLANK_ROWS, scan_dtype=sys.argv[1])
    rollout = ScriptedRollout(make_config("soadrl"), settings, ScriptedPolicy("orca"), seed=0)
    for kernel, arguments in rollout.parts()[0]:
        kernel.prepare(arguments)
