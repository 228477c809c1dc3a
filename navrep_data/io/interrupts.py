"""Ctrl-C: one process answers it, whatever it has started."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator


@contextlib.contextmanager
def without_interrupts() -> Iterator[None]:
    """Start processes inside the ``with`` that Ctrl-C does not reach: their parent answers it and ends them.

    Notes
    -----
    A terminal sends Ctrl-C to all processes of a command, and one that is still importing would print a traceback. So
    the signal is blocked before they start, which they inherit from their first instruction on. One that comes
    meanwhile is not lost: it reaches this process at the end of the block.
    """
    can_block = hasattr(signal, "pthread_sigmask") and threading.current_thread() is threading.main_thread()
    if not can_block:  # not on Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
