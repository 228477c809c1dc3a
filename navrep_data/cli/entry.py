"""Where the command ``navrep-data`` starts: with next to no imports, so that Ctrl-C is answered from the beginning."""

from __future__ import annotations

import os
import sys
from typing import NoReturn

INTERRUPTED = 130
INTERRUPTED_LINE = "Interrupted. What was finished is intact; run the same command again to go on."


def run() -> None:
    """Run the command line, see :func:`navrep_data.cli.main.run`; Ctrl-C while modules are imported ends it as later.

    Importing them takes some tenths of a second, and Python would answer Ctrl-C with a traceback out of their midst.
    """
    try:
        from navrep_data.cli.main import run as run_main

        run_main()
    except KeyboardInterrupt:  # before `run_main` was ready to answer it
        stop()


def stop(*_: object) -> NoReturn:
    """Say that Ctrl-C ends the process, and end it at once; can be a signal's handler.

    Not by ``sys.exit``: that waits for threads; and where the signal came while Python executed text, as it does to
    make named tuples, Python would forget the exit status and die of the signal.
    """
    sys.stderr.write(f"{INTERRUPTED_LINE}\n")
    sys.stderr.flush()
    os._exit(INTERRUPTED)
