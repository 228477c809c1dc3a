"""What the operating system, the terminal and Ctrl-C do to the command line: one line, no traceback."""

import errno
import os
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import typer

from navrep_data import io
from navrep_data.cli import main as cli
from navrep_data.errors import CorruptDataError, DiskSpaceError, FileAccessError, FolderNotWritableError
from navrep_data.shards import verify
from navrep_data.shards.recipe import read_recipe
from navrep_data.shards.worlds import read_worlds
from navrep_data.sim.maps import load_map
from navrep_data.testing import tiny_dataset

ROOT_IS_REFUSED_NOTHING = ["setpriv", "--inh-caps=-all", "--bounding-set=-all"]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return tiny_dataset(tmp_path_factory.mktemp("surroundings") / "d", n=1, length=30)


def navrep(*arguments, cwd=None, prefix=(), env=None, stdout=subprocess.PIPE):
    done = subprocess.run(
        [*prefix, sys.executable, "-m", "navrep_data", *map(str, arguments)], stdin=subprocess.DEVNULL, stdout=stdout,
        stderr=subprocess.PIPE, text=True, cwd=cwd, timeout=300, env={**os.environ, **(env or {})},
    )  # fmt: skip
    return done.returncode, done.stdout, done.stderr


def called(arguments, capsys):
    """Run the command line in this process; return exit status and what it said."""
    with pytest.raises(SystemExit) as ended:
        cli.run([str(a) for a in arguments])
    said = capsys.readouterr()
    return ended.value.code, said.out, said.err


def check_one_line(code, err, words):
    assert (code, err.count("\n")) == (2, 1), err
    assert err.startswith("Error: ")
    assert words in err
    assert "again, or run the generate" not in err  # that is said of damage


# ---- files that the operating system refuses ----


@pytest.mark.parametrize("code", [errno.EACCES, errno.EIO, errno.EMFILE, errno.ENAMETOOLONG])
def test_a_file_that_cannot_be_read_is_not_called_damaged(dataset, tmp_path, monkeypatch, code):
    """Whichever reader asks: HDF5, npz, JSON, YAML, plain bytes."""
    shard, worlds = next((dataset / "data").iterdir()), next((dataset / "worlds").iterdir())
    (tmp_path / "m.yaml").write_text("image: m.png")

    def refuse(*_, **__):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr("h5py.File", refuse)
    monkeypatch.setattr("builtins.open", refuse)
    monkeypatch.setattr("io.open", refuse)
    for read in (
        lambda: read_recipe(shard),
        lambda: read_worlds(worlds),
        lambda: io.read_json(dataset / "manifest.json"),
        lambda: io.sha256_file(shard),
        lambda: verify(dataset),
        lambda: load_map(tmp_path / "m.yaml"),
    ):
        with pytest.raises(FileAccessError, match=os.strerror(code)) as caught:
            read()
        assert not isinstance(caught.value, CorruptDataError)


def test_what_only_damage_causes_is_still_damage(tmp_path):
    (tmp_path / "shard.h5").write_bytes(b"no HDF5 at all")
    with pytest.raises(CorruptDataError):
        read_recipe(tmp_path / "shard.h5")
    with pytest.raises(FileNotFoundError):
        io.read_json(tmp_path / "none.json")


def test_an_error_of_the_operating_system_has_one_home(tmp_path):
    for code, kind, words in (
        (errno.ENOSPC, DiskSpaceError, "free some space"),
        (errno.EACCES, FolderNotWritableError, "choose another with --out"),
        (errno.EIO, FileAccessError, "disk"),
        (errno.ENAMETOOLONG, FileAccessError, "shorter name"),
    ):
        told = io.translate_os_error(OSError(code, os.strerror(code), "name"), tmp_path)
        assert type(told) is kind
        assert words in str(told)
    assert type(io.translate_os_error(OSError(errno.EACCES, "no", "name"))) is FileAccessError
    for error in (OSError("of a library"), FileAccessError("told already")):
        assert io.translate_os_error(error) is error


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["verify", "doctor", "info", "view"])
def test_an_unreadable_dataset(dataset, tmp_path, verb):
    import shutil

    if subprocess.run([*ROOT_IS_REFUSED_NOTHING, "true"], capture_output=True).returncode:
        pytest.skip("there is no setpriv here to give up root's rights with")
    shutil.copytree(dataset, tmp_path / "d")
    for path in (tmp_path / "d").rglob("*.json" if verb == "info" else "*.*"):
        if path.is_file() and (verb == "info" or path.name != "manifest.json"):
            path.chmod(0)
    more = ["--out", tmp_path / "v.html"] if verb == "view" else []
    code, _, err = navrep(verb, tmp_path / "d", *more, prefix=ROOT_IS_REFUSED_NOTHING)
    check_one_line(code, err, "Permission denied")


LONG = "x" * 300


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [
        ["info", LONG],
        ["generate", "--n", "1", "--length", "20", "--workers", "1", "--out", LONG],
        ["generate", "--env", "map", "--map", f"./{LONG}", "--n", "1", "--out", "m"],
        ["filter", "DATASET", "--outcome", "cut", "--out", "y" * 252],
    ],
)
def test_names_that_are_too_long(arguments, dataset, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    code, _, err = called([str(dataset) if a == "DATASET" else a for a in arguments], capsys)
    check_one_line(code, err, "File name too long")
    assert not any(tmp_path.iterdir())


# ---- the terminal ----


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no /dev/full here")
@pytest.mark.slow
def test_output_on_a_full_disk(dataset):
    with open("/dev/full", "w") as full:
        code, _, err = navrep("info", dataset, stdout=full)
    check_one_line(code, err, "standard output: No space left")


@pytest.mark.slow
def test_a_terminal_without_the_characters(tmp_path):
    latin = {"PYTHONIOENCODING": "latin-1"}
    code, _, err = navrep("info", "карта", cwd=tmp_path, env=latin)
    check_one_line(code, err, "No dataset in \\u043a\\u0430")
    program = (
        "from navrep_data.cli import main, _common\n"
        "main._run = lambda _: _common.say('карта') or _common.print_json({'at': 'карта'}) or 0\nmain.run([])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], env={**os.environ, **latin}, capture_output=True, timeout=300, check=True
    )
    said, _, json_text = done.stdout.decode("ascii").partition("\n")
    assert said == "\\u043a\\u0430\\u0440\\u0442\\u0430"
    assert __import__("json").loads(json_text) == {"at": "карта"}  # exact: it is data


@pytest.mark.skipif(os.name == "nt", reason="Windows keeps a folder that is in use")
def test_a_working_folder_that_was_deleted(tmp_path, monkeypatch, capsys):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    code, _, err = called(["info", tmp_path], capsys)
    check_one_line(code, err, "The working folder does not exist any more")


@pytest.mark.slow
def test_a_reader_that_has_gone_is_no_error(dataset):
    process = subprocess.Popen(
        [sys.executable, "-m", "navrep_data", "info", dataset], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    process.stdout.close()
    err = process.stderr.read()
    process.stderr.close()
    assert process.wait(timeout=300) == 2
    assert err == b""


# ---- Ctrl-C ----


@pytest.fixture
def heard():
    """Ctrl-C reaches this process and those that it starts, also where the tests run in the background (nohup)."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def verbs(command=None, words=()):
    command = typer.main.get_command(cli.app) if command is None else command
    below = getattr(command, "commands", None)
    if not below:
        return [words]
    return [found for name, one in below.items() for found in verbs(one, (*words, name))]


@pytest.mark.slow
@pytest.mark.parametrize("words", verbs(), ids=" ".join)
def test_every_verb_says_once_that_it_was_interrupted(words, monkeypatch, capsys):
    command = typer.main.get_command(cli.app)
    verb = command
    for word in words:
        verb = verb.commands[word]

    def interrupted(**_):
        raise KeyboardInterrupt

    verb.callback = interrupted
    for parameter in verb.params:
        parameter.required = False
    monkeypatch.setattr(typer.main, "get_command", lambda _: command)
    before = signal.getsignal(signal.SIGINT)
    try:
        code, out, err = called(words, capsys)
    finally:
        signal.signal(signal.SIGINT, before)
    assert (code, out) == (130, "")
    assert err == "Interrupted. What was finished is intact; run the same command again to go on.\n"


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Windows has no process groups to signal")
@pytest.mark.parametrize("workers", [1, 2])
def test_ctrl_c_reaches_all_processes_and_is_told_once(workers, tmp_path, heard):
    """A terminal signals the whole group; workers still import, and would print tracebacks."""
    process = subprocess.Popen(
        [sys.executable, "-m", "navrep_data", "generate", "--n", "400", "--workers", str(workers), "--out", "d"],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    for line in process.stdout:
        if " rows, about " in line:
            break
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=300)
    assert process.returncode == 130
    assert err == "Interrupted. What was finished is intact; run the same command again to go on.\n"


@pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="signals cannot be blocked here")
def test_processes_start_deaf_to_ctrl_c_and_none_is_lost(heard):
    program = "import signal; print(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, []))"
    with io.without_interrupts():
        found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert found == "True\n"

    def meanwhile():
        with io.without_interrupts():
            signal.raise_signal(signal.SIGINT)
            seen.append("blocked")

    seen = []
    with pytest.raises(KeyboardInterrupt):
        meanwhile()
    assert seen == ["blocked"]


STARTS = {
    "python -m": "import runpy; runpy.run_module('navrep_data', run_name='__main__')",
    "script": "import importlib.metadata as m; m.EntryPoint('', SCRIPT, '').load()()",
}


@pytest.mark.slow
@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("at", ["navrep_data.cli.main", "typer", "navrep_data.cli.info", "run"])
def test_ctrl_c_while_modules_are_imported_is_one_line(start, at):
    """The process sends itself the signal when it comes to import a module, or to the first line of main's run()."""
    with open(Path(__file__).parents[2] / "pyproject.toml", "rb") as file:
        script = tomllib.load(file)["project"]["scripts"]["navrep-data"]
    program = f"""
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
class Interrupting:
    def find_spec(self, name, *_):
        if name == {at!r}:
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Interrupting())
def trace(frame, *_):
    if {at!r} == "run" == frame.f_code.co_name and frame.f_code.co_filename.endswith("main.py"):
        signal.raise_signal(signal.SIGINT)
sys.setprofile(trace)
sys.argv = ["navrep-data", "info", "d"]
SCRIPT = {script!r}
{STARTS[start]}
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == "Interrupted. What was finished is intact; run the same command again to go on.\n"
