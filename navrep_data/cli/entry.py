"""Where the command ``navrep-data`` starts: with next to no imports, so that Ctrl-C is answered from the beginning."""

from __future__ import annotations

from navrep_data.cli.interrupt import stop


def run() -> None:
    """Run the command line, see :func:`navrep_data.cli.main.run`; Ctrl-C while modules are imported ends it as later.

    Importing them takes some tenths of a second, and Python would answer Ctrl-C with a traceback out of their midst.
    """
    try:
        from navrep_data.cli.main import run as run_main

        run_main()
    except KeyboardInterrupt:  # before `run_main` was ready to answer it
        stop()
