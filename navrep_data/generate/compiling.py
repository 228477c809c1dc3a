"""Tell that kernels are being compiled, while they are."""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import Any

from numba.core import event as numba_event
from tqdm import tqdm

_events: Any = numba_event  # untyped
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
