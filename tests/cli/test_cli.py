"""The command line as a user meets it: processes of their own, closed stdin."""

import json
import os
import subprocess
import sys

import pytest
import warm_process

FLAGS = ["--humans", "3", "--obstacles", "2", "--length", "20", "--workers", "1"]


def run(*arguments, cwd=None):
    return warm_process.shared().run(arguments, cwd, {**os.environ, "COLUMNS": "200"})


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    root = tmp_path_factory.mktemp("cli") / "d"
    done = run("generate", "--n", 4, "--out", root, *FLAGS)
    assert done.returncode == 0, done.stderr
    return root, done.stdout


@pytest.mark.slow
def test_generate_tells_plan_outcome_and_what_to_do_next(dataset):
    root, out = dataset
    lines = out.splitlines()
    assert any(line.startswith("4 sequences x 20 steps = 80 rows, about ") for line in lines)
    assert any("80 rows, 3 shards" in line for line in lines)
    assert lines[-1] == f"next: navrep-data info {root}"


@pytest.mark.slow
def test_json_is_one_object_on_stdout(tmp_path):
    done = run("generate", "--n", 2, "--out", tmp_path / "d", "--json", *FLAGS)
    found = json.loads(done.stdout)
    assert {"rows", "sequences", "shards", "bytes", "seconds", "rows_per_s", "outcomes"} <= set(found)
    assert (found["rows"], found["sequences"]) == (40, 2)
    assert "2 sequences x 20 steps" in done.stderr


@pytest.mark.slow
def test_default_folder_is_data_env(tmp_path):
    assert run("generate", "--n", 1, *FLAGS, cwd=tmp_path).returncode == 0
    assert (tmp_path / "data" / "soadrl" / "manifest.json").exists()


@pytest.mark.slow
def test_info(dataset):
    text = run("info", dataset[0]).stdout
    assert "soadrl, consistent physics, seed 0 (complete)" in text
    assert "4 sequences, 80 rows in 3 shards" in text
    found = json.loads(run("info", dataset[0], "--json").stdout)
    assert found["rows"] == 80
    assert found["splits"] == {"train": 2, "val": 1, "test": 1}


@pytest.mark.slow
def test_verify_finds_a_flipped_byte(dataset, tmp_path):
    import shutil

    done = run("verify", dataset[0])
    assert done.returncode == 0
    assert "all well" in done.stdout
    shutil.copytree(dataset[0], tmp_path / "d")
    shard = tmp_path / "d" / "data" / "train-00000.h5"
    data = bytearray(shard.read_bytes())
    data[5000] ^= 8
    shard.write_bytes(data)
    done = run("verify", tmp_path / "d")
    assert done.returncode == 2
    assert "data/train-00000.h5" in done.stdout
    assert not json.loads(run("verify", tmp_path / "d", "--json").stdout)["ok"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["generate", "--env", "soadlr"], "Unknown environment 'soadlr'. Did you mean 'soadrl'?"),
        (["generate", "--n", "-1"], "--n is -1, expected a whole number from 1"),
        (["generate", "--n", "many"], "Invalid value for '--n'"),
        (["generate", "--workers", "0"], "--workers is 0"),
        (["generate", "--policy", "nobody:home"], "Policy 'nobody:home' cannot be imported"),
        (["generat"], "No such command 'generat'. Did you mean 'generate'?"),
        (["generate", "--nn", "3"], "No such option: --nn"),
        (["info", "nowhere"], "No dataset in nowhere"),
        (["info"], "Missing argument 'DIR'"),
    ],
)
def test_mistakes_give_one_line_and_exit_2(arguments, words, tmp_path):
    done = run(*arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert words in done.stderr
    assert done.stderr.startswith("Error: ")
    assert done.stderr.count("\n") == 1
    assert done.stdout == ""
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_debug_shows_the_traceback(tmp_path):
    done = run("--debug", "info", "nowhere", cwd=tmp_path)
    assert "Traceback" in done.stderr
    assert "DatasetNotFoundError" in done.stderr


@pytest.mark.slow
def test_no_arguments_show_help():
    done = run()
    assert "generate" in done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    assert run("--version").stdout.startswith("navrep-data 0.")


@pytest.mark.slow
def test_help_is_quick_and_does_not_load_torch():
    code = (
        "import sys\nfrom navrep_data.cli.main import run\n"
        "try:\n    run(['generate', '--help'])\nexcept SystemExit: pass\n"
        "heavy = {'torch', 'numba', 'h5py', 'stable_baselines3', 'huggingface_hub'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_import_is_light_and_touches_nothing(tmp_path):
    code = "import sys, navrep_data\n"
    code += "assert not {'torch', 'numba', 'numpy'} & set(sys.modules)\nassert navrep_data.schema.DT == 0.2\n"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert not list(tmp_path.iterdir())


def test_help_texts_keep_their_brackets():
    """Rich takes [m] and [ray] for markup and swallows them, unless they are escaped."""
    from rich.text import Text
    from typer.main import get_command

    from navrep_data.cli.main import app

    def verbs(command, name):
        yield name, command
        for below, one in getattr(command, "commands", {}).items():
            yield from verbs(one, f"{name} {below}")

    seen = 0
    for name, command in verbs(get_command(app), "navrep-data"):
        texts = [command.help or "", *(getattr(p, "help", None) or "" for p in command.params)]
        for text in texts:
            seen += 1
            shown = Text.from_markup(text).plain
            assert shown == text.replace("\\[", "["), f"{name}: {text!r} is shown as {shown!r}"
    assert seen > 100
