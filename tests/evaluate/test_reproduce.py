"""The paper's figures from results files: what is drawn from whom, and what is told where results are missing."""

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from recorded import reference

from navrep_data.errors import ConfigError, CorruptDataError, DatasetNotFoundError
from navrep_data.evaluate.metrics import METRICS, Contacts
from navrep_data.evaluate.reproduce import FIGURES, reproduce
from navrep_data.evaluate.reproduce.drawn import authors
from navrep_data.evaluate.reproduce.testing import PARTS, scores
from navrep_data.evaluate.results import Results, file_name, header_of
from navrep_data.evaluate.scores import SUCCESSES
from navrep_data.evaluate.sources import find_benchmarks, source_of
from navrep_data.evaluate.suites import get_suite
from navrep_data.evaluate.world_model import WorldModelError
from navrep_data.evaluate.world_model_results import save
from navrep_data.policies import PolicySpec
from navrep_data.testing import tiny_dataset


def results(folder, name, outcome, suite="navrep27", variant=None, physics="original", **how):
    """Write a results file with the given outcome per episode."""
    spec = PolicySpec(name, "scan", variant or name.partition(".")[0], "zoo", **how)
    found = Results(header_of(spec, get_suite(suite), physics))
    n = len(outcome)
    found.outcome, found.events, found.steps = list(outcome), ["goal"] * n, [10] * n
    found.metrics = {m.name: [1.0] * n for m in METRICS}
    # every third success came after a contact
    found.contacts = [
        Contacts(human=int(c == "C" or (c == "S" and k % 3 == 0)), speed=0.3) for k, c in enumerate(outcome)
    ]
    found.trajectories = {k: np.array([[0.0, 0.0], [1.0, 0.1 * k]]) for k in range(n)}
    home = folder / f"{suite}-{physics}"
    home.mkdir(parents=True, exist_ok=True)
    found.save(home / file_name(spec))


@pytest.fixture
def measured(tmp_path, maps):
    """Two runs of one released variant, one of another, one of ours, and a baseline; 27 episodes each."""
    results(tmp_path, "e2e_1d.20201026", "S" * 9 + "C" * 18)
    results(tmp_path, "e2e_1d.20201027", "S" * 18 + "C" * 9)
    results(tmp_path, "transformer_rings_z.20201004", "S" * 3 + "T" * 24)
    results(tmp_path, "transformer_rings_z.v1", "S" * 21 + "T" * 6, variant="transformer_rings_z.v1")
    results(tmp_path, "goal", "S" * 5 + "C" * 22)
    return tmp_path


def test_whose_numbers():
    names = ("e2e_1d.20201026", "transformer_rings_z.v1", "goal", "./models/x", "my.module:drive")
    assert [source_of(name) for name in names] == ["released", "ours", "baseline", "other", "other"]


def test_runs_of_a_variant_are_one_bar_and_ours_is_never_among_them(measured):
    found = scores(find_benchmarks(measured, "navrep27"))
    two = found["e2e_1d"]["released"]["all"]
    rates = tuple(two[f"success_rate{end}"] for end in ("", "_low", "_high"))
    assert (rates, len(two["runs"])) == ((0.5, 1 / 3, 2 / 3), 2)
    assert set(found["transformer_rings_z"]) == {"released", "ours"}
    assert found["transformer_rings_z"]["ours"]["all"]["success_rate"] == pytest.approx(21 / 27)
    assert (
        found["transformer_rings_z"]["released"]["all"]["success_rate_low"]
        < 3 / 27
        < found["transformer_rings_z"]["released"]["all"]["success_rate_high"]
    )
    assert set(found["e2e_1d"]["released"]) == set(PARTS)


def test_results_are_found_at_any_depth_and_the_longer_counts(measured):
    results(measured / "more" / "again", "e2e_1d.20201026", "S" * 54)
    results(measured, "e2e_1d.20201026", "S" * 27, inference="as_released")
    found = {r.name: r for r in find_benchmarks(measured, "navrep27")}
    assert len(found["e2e_1d.20201026"].outcome) == 54
    assert scores(list(found.values()))["e2e_1d"]["released"]["all"]["episodes"] == 81, "noisy runs are not drawn"


def test_the_authors_numbers_are_those_of_the_reference():
    theirs = reference("original_scores.json")["authors_figure_27_scenarios"]
    assert {part: authors()[part] for part in PARTS} == {part: theirs[part] for part in PARTS}
    assert "guldenring_test.png" in authors()["source"]
    assert "Not measured by navrep-data" in authors()["what"]


def picture(path):
    pixels = np.asarray(Image.open(path).convert("L"))
    assert pixels.std() > 10, "empty"
    return pixels.shape


@pytest.mark.slow
def test_testing_keeps_three_sources_apart(measured):
    done = reproduce("fig-testing", measured)
    assert done.file == measured / "fig-testing.png"
    picture(done.file)
    assert {(s["name"], s["source"]) for s in done.sources if s["part"] == "all"} >= {
        ("transformer_rings_z", "released"), ("transformer_rings_z", "ours"), ("transformer_rings_z", "authors"),
        ("e2e_1d", "released"), ("goal", "baseline"), ("soadrl", "authors"),
    }  # fmt: skip
    assert json.dumps(done.to_dict())


def test_table_has_a_column_per_source_and_the_goal_beside(measured):
    results(measured, "transformer_rings_z.v1", "S" * 6 + "C" * 4, suite="navreptest", variant="transformer_rings_z.v1")
    results(measured, "goal", "S" * 3 + "C" * 7, suite="navreptest")
    done = reproduce("table", measured, measured / "t.md")
    text = (measured / "t.md").read_text()
    assert text == done.text
    lines = {
        cells[1]: cells[2:-1]
        for line in text.split("\n## ")[0].splitlines()
        if (cells := [c.strip() for c in line.split("|")])[1:]
    }
    assert lines["policy"][:5] == [
        "authors' own figure (as released)",
        "released weights, measured by us: contact-free", "as released",
        "our weights, measured by us: contact-free", "as released",
    ]  # fmt: skip
    row = lines["transformer_rings_z"]
    assert row[0] == "39.1 %"
    assert [cell.partition(" (")[0] for cell in row[1:5]] == ["7.4 %", "11.1 %", "51.9 %", "77.8 %"]
    assert row[5:] == ["-", "-", "11.1 %", "18.5 %"]
    assert lines["e2e_1d"][2] == "50.0 % (33.3 to 66.7; 2 runs)"
    assert "| transformer_rings_z | - | - | 40.0 % (" in text
    assert "| 20.0 % | 30.0 % |" in text
    assert "76 %" in text
    assert "V was also trained with the true positions of people" in text


AS_FED = {"ranges": "as_released", "scaling": "none"}
WORDS = "ranges as the authors fed them"


def test_the_table_names_runs_fed_as_the_authors_do_it(measured):
    assert WORDS not in reproduce("table", measured).text
    results(measured, "e2e_1d.20201026", "S" * 27, variant=f"e2e_1d ({WORDS})", **AS_FED)
    done = reproduce("table", measured)
    head, _, *lines = [line.split("|")[1:-1] for line in done.text.splitlines() if line.startswith("|")]
    assert head[2].strip() == f"released weights, {WORDS}, measured by us: contact-free"
    row = next(line for line in lines if line[0].strip() == "e2e_1d")
    assert [row[k].strip().partition(" (")[0] for k in (3, 5)] == ["100.0 %", "50.0 %"]
    assert "ranges uncut and nothing scaled" in done.text
    assert {s["source"] for s in done.sources if s["name"] == "e2e_1d"} == {"released_as_fed", "released", "authors"}


@pytest.mark.slow
def test_figures_name_runs_fed_as_the_authors_do_it_and_draw_each_policy_once(measured, maps, monkeypatch):
    from navrep_data.evaluate.reproduce import testing

    drawn = []
    monkeypatch.setattr(testing, "comparison", lambda chosen, labels: drawn.extend(r.name for r in chosen))
    results(measured, "e2e_1d.20201026", "S" * 27, variant=f"e2e_1d ({WORDS})", **AS_FED)
    results(measured, "soadrl.20200101", "S" * 27, variant=f"soadrl ({WORDS})", **AS_FED)
    testing.trajectories(measured)
    assert sum(name.startswith("e2e_1d.20201026") for name in drawn) == 1
    assert "e2e_1d.20201026" in drawn
    assert f"soadrl.20200101 ({WORDS})" in drawn, "the only results of a policy are shown, and say how it was fed"
    figure = testing.testing(measured).figure
    said = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
    assert f"released weights, {WORDS}, measured by us" in said
    assert "released weights, measured by us" in said
    assert "ranges uncut and nothing scaled" in figure.get_supxlabel()


@pytest.mark.slow
def test_trajectories_say_whose_they_are(measured, maps):
    done = reproduce("fig-trajectories", measured, measured / "sub" / "t.png")
    picture(measured / "sub" / "t.png")
    assert [s["source"] for s in done.sources] == ["ours", "released", "released", "released", "baseline"]


def world_model(folder, name, lidar, split="train", data="d", scan=0.01):
    curve = [scan]
    result = WorldModelError(
        name, split, lidar, 100, scan, 0.01, 0.005, 0.02, 0.03, 16, curve, curve, curve, curve, [10]
    )  # fmt: skip
    save(result, folder, {"name": "soadrl", "content_hash": data}, {})


@pytest.mark.slow
def test_world_models_are_compared_on_the_same_rows_only(tmp_path):
    world_model(tmp_path, "transformer_1d.released", "1d")
    world_model(tmp_path, "joint_1d.released", "1d", scan=0.5)
    world_model(tmp_path, "models/mine", "rings")
    world_model(tmp_path, "transformer_1d.v1", "1d", data="another")
    world_model(tmp_path, "joint_1d.v1", "1d", split="val")
    done = reproduce("fig-worldmodel", tmp_path)
    picture(done.file)
    assert [(s["name"], s["source"]) for s in done.sources] == [
        ("joint_1d.released", "released"), ("transformer_1d.released", "released"), ("models/mine", "other"),
    ]  # fmt: skip


@pytest.mark.slow
def test_training_curves(tmp_path):
    for name, rates in (("a_z", [0.1, 0.4, 0.3]), ("deep/b_zh", [0.2, 0.2, 0.5])):
        folder = tmp_path / name
        folder.mkdir(parents=True)
        lines = ["step,success,val_success", "50,0.5,", *(f"{100 * (i + 1)},,{r}" for i, r in enumerate(rates))]
        (folder / "log.csv").write_text("\n".join(lines) + "\n")
    chosen = "ian, consistent physics, numpy seeds 5000 to 5099, by the share of goals without contact"
    (tmp_path / "a_z" / "config.json").write_text(json.dumps({"metadata": {"selected_on": chosen}}))
    done = reproduce("fig-training", tmp_path)
    picture(done.file)
    logged = [s for s in done.sources if "log" in s["source"]]
    assert [(s["name"], s["best"], s["last"], s["steps"]) for s in logged] == [
        ("a_z", 0.4, 0.3, 300), ("deep/b_zh", 0.5, 0.5, 300),
    ]  # fmt: skip
    said = {s["name"]: s["validation"] for s in done.sources}
    assert said["a_z"] == "contact-free, on ian, consistent physics, numpy seeds 5000 to 5099"
    assert said["deep/b_zh"] == "which goals count is not recorded"
    assert said["transformer_rings_z.v1"] == "as released"


@pytest.mark.slow
def test_state(tmp_path):
    tiny_dataset(tmp_path / "results" / "data")
    done = reproduce("fig-state", tmp_path / "results")
    picture(done.file)
    assert done.sources[0]["name"] == "soadrl, consistent physics, seed 0"


@pytest.mark.parametrize("figure", sorted(set(FIGURES) - {"fig-training"}))
def test_what_is_missing_is_told_with_its_command(figure, tmp_path):
    command = {
        "fig-state": "navrep-data generate --env soadrl",
        "fig-worldmodel": r"navrep-data evaluate world-model joint_1d\.released transformer_1d\.released",
    }.get(figure, r"navrep-data benchmark e2e_1d\.released .* --suite navrep27 --out")
    with pytest.raises(DatasetNotFoundError, match=f"has nothing for {figure}, expected results made by: {command}"):
        reproduce(figure, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_the_rest_is_missing_beside_what_is_there(measured):
    for name in ("e2e_1d.20201026", "e2e_1d.20201027", "transformer_rings_z.20201004"):
        (measured / "navrep27-original" / f"{name}.json").unlink()
    done = reproduce("table", measured)
    assert any("released policies in navrep27" in m.what and "--suite navrep27" in m.command for m in done.missing)


def test_bad_input(measured, tmp_path):
    with pytest.raises(ConfigError, match="Did you mean 'fig-testing'"):
        reproduce("fig-test", measured)
    shutil.move(measured / "navrep27-original" / "goal.json", measured / "navrep27-original" / "x.json")
    (measured / "navrep27-original" / "x.json").write_text('{"format": "other"}')
    with pytest.raises(CorruptDataError, match="is not a results file"):
        reproduce("table", measured)
    assert not Path(measured / "table.md").exists()


def test_the_table_is_what_its_suffix_says(measured):
    for name in ("t.tex", "t.csv"):
        reproduce("table", measured, measured / name)
    tex = (measured / "t.tex").read_text()
    assert r"\begin{tabular}{lr" in tex
    assert r"transformer\_rings\_z & 39.1 \% & " in tex
    assert "|" not in tex.split("end{tabular}")[0]
    with open(measured / "t.csv", newline="") as file:
        rows = {(r["name"], r["source"]): r for r in csv.DictReader(file) if r["suite"] == "navrep27"}
    assert float(rows["transformer_rings_z", "authors"]["success_rate"]) == pytest.approx(0.391, abs=5e-4)
    ends = ("", "_low", "_high")
    shares = [float(rows["e2e_1d", "released"][f"{name}_rate{end}"]) for name in SUCCESSES for end in ends]
    assert shares == pytest.approx([1 / 3, 6 / 27, 12 / 27, 0.5, 1 / 3, 2 / 3])
    assert rows["e2e_1d", "released"]["runs"].split("; ") == ["e2e_1d.20201026", "e2e_1d.20201027"]


@pytest.mark.slow
def test_figures_are_drawn_for_papers_too(tmp_path):
    (tmp_path / "a_z").mkdir()
    (tmp_path / "a_z" / "log.csv").write_text("step,success,val_success\n100,,0.1\n200,,0.2\n")
    for name, begins in (("f.pdf", b"%PDF-"), ("f.svg", b"<?xml"), ("f.PNG", b"\x89PNG")):
        reproduce("fig-training", tmp_path, tmp_path / name)
        data = (tmp_path / name).read_bytes()
        assert data.startswith(begins)
        reproduce("fig-training", tmp_path, tmp_path / name)
        assert (tmp_path / name).read_bytes() == data  # no date, no random identifiers


@pytest.mark.parametrize(
    ("figure", "name", "words"),
    [
        ("table", "t.png", r"\.md, \.tex, \.csv"),
        ("fig-training", "f.jpg", r"\.png, \.pdf, \.svg"),
        ("table", "t", r"\.md"),
    ],
)
def test_a_suffix_that_names_no_format_is_refused(figure, name, words, tmp_path):
    with pytest.raises(ConfigError, match=f"ends in .*{words}"):
        reproduce(figure, tmp_path, tmp_path / name)
    assert list(tmp_path.iterdir()) == []
