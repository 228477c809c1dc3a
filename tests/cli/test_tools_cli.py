"""The verbs on datasets as a user meets them: what they print, and that their flags reach the functions."""

import json

import pytest

from navrep_data.cli import main
from navrep_data.shards import Manifest
from navrep_data.testing import tiny_dataset


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return tiny_dataset(tmp_path_factory.mktemp("tools-cli") / "crowd", n=4, length=120)


@pytest.fixture
def run(capsys):
    def call(*arguments):
        with pytest.raises(SystemExit) as ended:
            main.run([str(a) for a in arguments])
        out, err = capsys.readouterr()
        return ended.value.code, out, err

    return call


@pytest.mark.slow
def test_filter_merge_and_verify(run, dataset, tmp_path):
    code, out, err = run("filter", dataset, "--outcome", "goal", "--out", tmp_path / "goals")
    assert (code, err) == (0, "")
    assert out.splitlines()[-1] == f"next: navrep-data verify {tmp_path / 'goals'}"
    assert "episodes: goal " in out
    others = [
        f for name in ("collision_human", "collision_obstacle", "timeout", "stuck", "cut") for f in ("--outcome", name)
    ]
    code, out, _ = run(
        "filter", dataset, *others, "--min-steps", 1, "--max-humans", 99, "--out", tmp_path / "rest", "--json"
    )
    found = json.loads(out)
    assert code == 0
    assert "goal" not in found["episodes"]
    assert found["rows"] == Manifest.read(tmp_path / "rest").rows
    assert "--min-steps 1" in Manifest.read(tmp_path / "rest").command
    code, out, _ = run("merge", tmp_path / "goals", tmp_path / "rest", "--out", tmp_path / "all")
    assert code == 0
    assert run("verify", tmp_path / "all")[0] == 0
    code, out, _ = run("info", tmp_path / "all")
    assert "made out of: soadrl, consistent physics, seed 0, content " in out
    assert str(tmp_path) not in (tmp_path / "all" / "manifest.json").read_text()


@pytest.mark.slow
def test_split(run, dataset, tmp_path):
    code, out, _ = run("split", dataset, "--out", tmp_path / "s", "--json")
    assert code == 0
    assert {name: found["sequences"] for name, found in json.loads(out).items()} == {"train": 2, "val": 1, "test": 1}
    code, out, _ = run("split", dataset, "--out", tmp_path / "t", "--shares", "0.5,0.5,0", "--seed", 4)
    assert code == 0
    assert out.splitlines()[-1] == f"next: navrep-data verify {tmp_path / 't' / 'train'}"
    assert sorted(p.name for p in (tmp_path / "t").iterdir()) == ["train", "val"]
    assert "seed 4" in Manifest.read(tmp_path / "t" / "val").split_rule


@pytest.mark.slow
def test_stats_and_sample(run, dataset, tmp_path):
    code, out, _ = run("stats", dataset, "--split", "val")
    lines = out.splitlines()
    assert code == 0
    assert lines[0].startswith(f"{dataset}, split val: 1 sequences, ")
    assert any(line.startswith("robot_state[4] ") for line in lines)
    assert json.loads(run("stats", dataset, "--json")[1])["sequences"] == 4
    code, out, _ = run("sample", dataset, "--n", 1, "--seed", 2, "--out", tmp_path / "p")
    assert code == 0
    assert out.splitlines() == [str(p) for p in (tmp_path / "p").iterdir()]


@pytest.mark.slow
def test_export(run, dataset, tmp_path):
    code, out, _ = run("export", dataset, "--format", "npz", "--out", tmp_path / "npz", "--json")
    assert code == 0
    assert json.loads(out)["files"] == len(list((tmp_path / "npz").iterdir())) == 4
    pytest.importorskip("minari")
    code, out, _ = run("export", dataset, "--format", "minari", "--id", "me/crowd-v2", "--out", tmp_path / "m")
    assert code == 0
    assert "minari.load_dataset('me/crowd-v2')" in out.splitlines()[-1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("filter", "--outcome", "gaol"), "Error: Unknown outcome 'gaol'; expected some of goal, "),
        (("filter", "--min-steps", "9999"), "Error: Nothing is left: none of the "),
        (
            ("split", "--shares", "80/10/10"),
            "Error: --shares is '80/10/10'; expected train,val,test as in 0.7,0.2,0.1.",
        ),
        (("export", "--format", "tfds"), "Error: Unknown format 'tfds'; expected npz or minari."),
        (("merge",), "Error: 1 datasets were given, expected at least two to merge."),
        (("import-rosbag", "--mount", "1"), "Error: --mount is '1'; expected x,y,yaw"),
    ],
)
def test_errors_are_one_line(run, dataset, tmp_path, arguments, words):
    code, out, err = run(arguments[0], dataset, *arguments[1:], "--out", tmp_path / "out")
    assert (code, out) == (2, "")
    assert err.startswith(words)
    assert err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_import_rosbag(run, tmp_path):
    pytest.importorskip("rosbags")
    import sys
    from pathlib import Path

    sys.path.insert(0, str(Path(__file__).parents[1] / "datasets"))
    try:
        from test_import_rosbag import record
    finally:
        sys.path.pop(0)
    bag = record(tmp_path / "lab", "ros1", seconds=2.0)
    code, out, _ = run(
        "import-rosbag", bag, "--out", tmp_path / "d", "--env", "lab", "--length", 6, "--dt", 0.1, "--json"
    )
    assert code == 0
    found = json.loads(out)
    assert (found["sequences"], found["rows"]) == (4, 21)
    assert Manifest.read(tmp_path / "d").sensor.dt == 0.1
    code, _, err = run("import-rosbag", bag, "--goal-topic", "/gaol", "--out", tmp_path / "e")
    assert (code, err.count("\n")) == (2, 1)
    assert "has no topic '/gaol'; it has /move_base_simple/goal" in err
