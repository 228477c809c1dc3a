"""``navrep-data view`` as a user meets it."""

import json
import os
import shutil
import subprocess
import sys
import types

import pytest

from navrep_data.cli import main, view
from navrep_data.errors import DatasetNotFoundError
from navrep_data.shards import Manifest
from navrep_data.testing import tiny_dataset
from navrep_data.view.page import MARK


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return tiny_dataset(tmp_path_factory.mktemp("view-cli") / "crowd", n=4, length=30)


def run(capsys, *arguments):
    with pytest.raises(SystemExit) as ended:
        main.run([str(a) for a in arguments])
    out, err = capsys.readouterr()
    return ended.value.code, out, err


@pytest.mark.slow
def test_it_writes_a_page_and_prints_where(dataset, tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "navrep_data", "view", str(dataset)],
        stdin=subprocess.DEVNULL, capture_output=True, text=True, cwd=tmp_path, env={**os.environ},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout == "crowd.view.html\n"
    assert done.stderr == "left out: 1 of 4 sequences; choose others with --sequence\n"
    assert (tmp_path / "crowd.view.html").read_text().startswith(MARK)


@pytest.mark.slow
def test_sequences_out_size_and_json(dataset, tmp_path, capsys):
    target = tmp_path / "page.html"
    code, out, _ = run(capsys, "view", dataset, "--sequence", 1, "--sequence", 3, "--out", target, "--json")
    assert code == 0
    assert json.loads(out) == {"file": str(target), "bytes": target.stat().st_size, "left_out": []}
    code, out, err = run(capsys, "view", dataset, "--out", target, "--max-mb", 0.1)
    assert (code, out) == (0, f"{target}\n")
    assert target.stat().st_size <= 100_000
    assert "left out: sequence 0: rows " in err


@pytest.mark.slow
def test_the_browser_opens_on_request_only(dataset, tmp_path, capsys, monkeypatch):
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    run(capsys, "view", dataset, "--out", tmp_path / "a.html")
    assert opened == []
    run(capsys, "view", dataset, "--out", tmp_path / "a.html", "--open")
    assert opened == [(tmp_path / "a.html").as_uri()]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ["nowhere/at/all"],
            "There is no nowhere/at/all; expected a dataset's folder, user/name, or benchmark results",
        ),
        (["{file}"], "is a file; expected a dataset's folder or benchmark results (.json)"),
        (["{dataset}", "--sequence", "9"], "Sequence 9 is not in"),
        (["{dataset}", "--out", "{file}"], "not a page of ours; choose another file with --out"),
        (["{empty}"], "manifest.json"),
        (["{results}", "--sequence", "1"], "benchmark results, which have no --sequence"),
    ],
)
def test_errors_are_one_line(dataset, tmp_path, capsys, arguments, words):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file.txt").write_text("x")
    (tmp_path / "results.json").write_text("{}")
    places = {
        "dataset": dataset, "file": tmp_path / "file.txt", "empty": tmp_path / "empty",
        "results": tmp_path / "results.json",
    }  # fmt: skip
    code, out, err = run(capsys, "view", *(a.format(**places) for a in arguments))
    assert (code, out) == (2, "")
    assert words in err
    assert len(err.splitlines()) == 1


@pytest.mark.slow
def test_a_dataset_of_the_hub_brings_the_shards_it_needs(dataset, tmp_path, capsys, monkeypatch):
    pulled = []

    def pull(repo, out, *, shards):
        pulled.append((repo, list(shards)))
        shutil.copytree(dataset, out, dirs_exist_ok=True)

    hub = types.ModuleType("navrep_data.datasets.hub")
    hub.pull = pull
    monkeypatch.setitem(sys.modules, "navrep_data.datasets.hub", hub)
    monkeypatch.chdir(tmp_path)
    assert run(capsys, "view", "someone/crowd")[:2] == (0, "crowd.view.html\n")
    assert pulled == [("someone/crowd", [0])]
    assert Manifest.read(dataset).shard_size == 2
    pulled.clear()
    assert run(capsys, "view", "someone/crowd@main", "--sequence", 3)[:2] == (0, "crowd.view.html\n")
    assert pulled == [("someone/crowd@main", [0]), ("someone/crowd@main", [1])]
    assert '"title":"someone/crowd@main"' in (tmp_path / "crowd.view.html").read_text()


def test_without_the_hub_the_error_says_so(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "navrep_data.datasets.hub", None)
    with pytest.raises(DatasetNotFoundError, match="There is no folder someone/crowd, and this version cannot fetch"):
        view._make("someone/crowd", None, 6_000_000)
