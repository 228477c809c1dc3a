"""The command ``navrep-data``: one thin module per verb, heavy imports inside the verbs."""

from __future__ import annotations

import contextlib
import io
import os
import signal
import sys
import threading
import traceback
from typing import Annotated, Any

import typer
import typer.main

from navrep_data._version import __version__
from navrep_data.cli import (
    benchmark,
    doctor,
    encode,
    evaluate,
    generate,
    hub,
    import_npz,
    info,
    merge_manifest,
    models,
    play,
    reproduce,
    tools,
    train,
    verify,
    view,
)
from navrep_data.cli._common import refused_output
from navrep_data.cli.interrupt import INTERRUPTED, INTERRUPTED_LINE
from navrep_data.errors import FileAccessError, NavrepDataError, did_you_mean, one_line
from navrep_data.io import translate_os_error

app = typer.Typer(
    name="navrep-data",
    help="Datasets and pretrained models for robots that navigate among people.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("generate", rich_help_panel="Make and check data")(generate.generate_command)
app.command("merge-manifest", rich_help_panel="Make and check data")(merge_manifest.merge_manifest_command)
app.command("info", rich_help_panel="Make and check data")(info.info_command)
app.command("verify", rich_help_panel="Make and check data")(verify.verify_command)
app.command("doctor", rich_help_panel="Make and check data")(doctor.doctor_command)
app.command("view", rich_help_panel="Make and check data")(view.view_command)
app.command("merge", rich_help_panel="Change and convert data")(tools.merge_command)
app.command("split", rich_help_panel="Change and convert data")(tools.split_command)
app.command("filter", rich_help_panel="Change and convert data")(tools.filter_command)
app.command("stats", rich_help_panel="Change and convert data")(tools.stats_command)
app.command("sample", rich_help_panel="Change and convert data")(tools.sample_command)
app.command("export", rich_help_panel="Change and convert data")(tools.export_command)
app.command("import-npz", rich_help_panel="Change and convert data")(import_npz.import_npz_command)
app.command("import-rosbag", rich_help_panel="Change and convert data")(tools.import_rosbag_command)
app.command("push", rich_help_panel="Share")(hub.push_command)
app.command("pull", rich_help_panel="Share")(hub.pull_command)
app.command("push-model", rich_help_panel="Share")(hub.push_model_command)
app.add_typer(models.models_app, name="models", rich_help_panel="Models")
app.add_typer(train.train_app, name="train", rich_help_panel="Models")
app.command("encode", rich_help_panel="Models")(encode.encode_command)
app.add_typer(evaluate.evaluate_app, name="evaluate", rich_help_panel="Models")
app.command("benchmark", rich_help_panel="Drive and score")(benchmark.benchmark_command)
app.command("reproduce", rich_help_panel="Drive and score")(reproduce.reproduce_command)
app.command("play", rich_help_panel="Drive and score")(play.play_command)

# Newer typers carry their own click; these are the classes that the installed one raises, whichever that is.
_UsageError: type[Any] = typer.BadParameter.__mro__[1]
_ClickException: type[Any] = _UsageError.__mro__[1]
USAGE_ERROR = 2


def _print_version(value: bool) -> None:
    if value:
        typer.echo(f"navrep-data {__version__}")
        raise typer.Exit


@app.callback()
def _main(
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit."),
    ] = False,
) -> None:
    """Run one of the verbs below."""


def run(arguments: list[str] | None = None) -> None:
    """Run the command line and exit: 0 all well, 1 a check failed, 2 an error of input or surroundings, 130 Ctrl-C.

    Errors are one line on stderr; ``--debug`` shows the traceback as well.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    # a folder's name may have characters that the terminal has not
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="backslashreplace")
    code = USAGE_ERROR
    try:
        code = _run(arguments)
        sys.stdout.flush()
    except (KeyboardInterrupt, typer.Abort):
        _die_of_the_next_interrupt()
        typer.echo(INTERRUPTED_LINE, err=True)
        code = INTERRUPTED
    except BrokenPipeError:  # the reader of our output has gone, as in `navrep-data info DIR | head`
        pass
    except Exception as error:
        text = _explain(error)
        if text is None or "--debug" in arguments:
            traceback.print_exc()
        if text:
            typer.echo(text, err=True)
    _give_up_stdout_if_stuck()
    sys.exit(code)


def _run(arguments: list[str]) -> int:
    """Run a verb and return its exit status; whatever it raises comes out, which typer's own ways would swallow."""
    if not _folder_exists():
        raise FileAccessError("The working folder does not exist any more; change to one that does: cd ~")
    command = typer.main.get_command(app)
    try:
        with command.make_context("navrep-data", list(arguments)) as context:
            command.invoke(context)
    except typer.Exit as ended:
        return int(ended.exit_code)
    return 0


def _folder_exists() -> bool:
    """Return whether there is a working folder: half of all libraries ask for it when they are imported."""
    try:
        os.getcwd()
    except FileNotFoundError:
        return False
    return True


def _die_of_the_next_interrupt() -> None:
    """Let a second Ctrl-C end the process at once, without a traceback out of whatever is being closed."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_DFL)


def _give_up_stdout_if_stuck() -> None:
    """Send what cannot be written nowhere, or Python would try again while it ends, and report that."""
    try:
        sys.stdout.flush()
    except (OSError, ValueError):  # a full disk, or nobody reads
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _explain(error: Exception) -> str | None:
    """Return one line for an error that has an explanation, None for one that is a bug of ours."""
    if isinstance(error, OSError):
        error = _explain_os_error(error)
    if isinstance(error, NavrepDataError):
        return f"Error: {error}"
    if not isinstance(error, _ClickException):
        return None
    text = one_line(error.format_message()).rstrip(".")
    context = getattr(error, "ctx", None)
    if type(error).__name__ == "NoArgsIsHelpError":
        return text
    if context is None:
        return f"Error: {text}."
    if text.startswith("No such command"):
        text = text.split(". ")[0] + "." + did_you_mean(text.split("'")[1], context.command.commands)
    end = "" if text.endswith("?") else "."
    return f"Error: {text.rstrip('.')}{end} See: {context.command_path} --help"


def _explain_os_error(error: OSError) -> Exception:
    """Return an error of ours for one of the operating system, whoever raised it."""
    if error.filename is None and not isinstance(error, NavrepDataError):
        try:
            sys.stdout.flush()
        except OSError as stuck:  # so it was typer, printing help
            return refused_output(stuck)
    return translate_os_error(error)


if __name__ == "__main__":
    run()
