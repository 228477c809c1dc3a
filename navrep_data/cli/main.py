"""The command ``navrep-data``: one thin module per verb, heavy imports inside the verbs."""

from __future__ import annotations

import sys
import traceback
from typing import Annotated, Any

import typer

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
from navrep_data.cli._common import INTERRUPTED, INTERRUPTED_LINE
from navrep_data.errors import NavrepDataError, did_you_mean, one_line

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
    """Run the command line and exit: 0 all well, 1 a check failed, 2 an error of input or surroundings.

    Errors are one line on stderr; ``--debug`` shows the traceback as well.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        code = app(arguments, standalone_mode=False)
    except (KeyboardInterrupt, typer.Abort):
        typer.echo(INTERRUPTED_LINE, err=True)
        code = INTERRUPTED
    except BrokenPipeError:  # the reader of our output has gone, as in `navrep-data info DIR | head`
        sys.stderr.close()
        code = USAGE_ERROR
    except Exception as error:
        text = _explain(error)
        if text is None or "--debug" in arguments:
            traceback.print_exc()
        if text:
            typer.echo(text, err=True)
        code = USAGE_ERROR
    sys.exit(code if isinstance(code, int) else 0)


def _explain(error: Exception) -> str | None:
    """Return one line for an error that has an explanation, None for one that is a bug of ours."""
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


if __name__ == "__main__":
    run()
