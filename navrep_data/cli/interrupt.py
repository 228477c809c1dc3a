"""How Ctrl-C ends a command; next to no imports, since it is needed while everything else is imported."""

from __future__ import annotations

import os
import sys
from typing import NoReturn

INTERRUPTED = 130
INTERRUPTED_LINE = "Interrupted. What was finished is intact; run the same command again to go on."


def stop(*_: object) -> NoReturn:
    """Say that Ctrl-C ends the process, and end it at once; can be a signal's handler.

    Not by ``sys.exit``: that waits for threads; and where the signal came while Python executed text, as it does to
    make named tuples, Python would forget the exit status and die of the signal.
    """
    sys.stderr.write(f"{INTERRUPTED_LINE}\n")
    sys.stderr.flush()
    os._exit(INTERRUPTED)
