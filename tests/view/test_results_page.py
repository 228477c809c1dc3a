"""Pages of benchmark results."""

import json

import numpy as np
import pytest
from view_pages import HOSTILE, Reader, write_results

from navrep_data.errors import ConfigError, CorruptDataError, DatasetError, DatasetNotFoundError, SchemaVersionError
from navrep_data.evaluate.metrics import METRICS
from navrep_data.view import Scene, is_results, results_page
from navrep_data.view.results import coarser


def test_a_page_holds_tables_and_trajectories(results):
    page = Reader(results_page(results).html)
    meta = page.meta
    assert sorted(p["name"] for p in meta["policies"]) == ["first", "second"]
    rates = [
        sum(e == "goal" and not t for e, t in zip(p["columns"]["event"], p["columns"]["touched"], strict=True))
        for p in meta["policies"]
    ]
    assert rates == sorted(rates, reverse=True), "best first, by success without contact"
    assert [s["name"] for s in meta["scenarios"]] == ["place 0", "place 1", "place 2"]
    for policy in meta["policies"]:
        file = results / ("0.json" if policy["name"] == "first" else "1.json")
        source, columns = json.loads(file.read_text()), policy["columns"]
        assert columns["event"] == source["episodes"]["event"]
        assert columns["steps"] == source["episodes"]["steps"]
        human, obstacle = source["episodes"]["contacts_human"], source["episodes"]["contacts_obstacle"]
        assert columns["touched"] == [int(h + o > 0) for h, o in zip(human, obstacle, strict=True)]
        assert columns["scenario"] == [k % 3 for k in range(60)]
        xy, at = page.arrays(policy)["xy"], 0
        for number, points in zip(columns["number"], columns["points"], strict=True):
            expected = source["trajectories_cm"].get(str(number), [])
            assert 2 * points == len(expected)
            np.testing.assert_allclose(xy[:, at : at + points].T.ravel() * 100, expected, atol=0.6)
            at += points


def test_one_file_is_one_policy(results):
    meta = Reader(results_page(results / "1.json").html).meta
    assert [p["name"] for p in meta["policies"]] == ["second"]


def test_scenes_share_maps_and_lie_the_right_way_up(results):
    occupied = np.zeros((4, 3), bool)
    occupied[3, 0] = True  # right column, bottom row

    def scene(name):
        if name == "place 2":
            return None
        return Scene(occupied, (0.0, 4.0, 0.0, 3.0), np.array([1.0, 2.0]), np.array([3.0, 2.0]), np.zeros((2, 2)))

    page = Reader(results_page(results, scene=scene).html)
    scenes = [s["scene"] for s in page.meta["scenarios"]]
    assert [s and s["map"] for s in scenes] == [0, 0, None]
    assert scenes[0]["extent"] == [0.0, 0.0, 4.0, 3.0]
    assert scenes[0]["start"] == [[1.0, 2.0]]
    assert scenes[0]["goal"] == [[3.0, 2.0]]
    picture = page.arrays(page.meta["maps"])["map_0"]
    np.testing.assert_array_equal(picture, [[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1]])
    assert ["maps", "asl-pepper-2d-sim, which states no licence"] in page.meta["facts"]
    assert "maps" not in dict(Reader(results_page(results).html).meta["facts"])


def test_large_maps_become_coarser_without_losing_walls():
    fine = np.zeros((2500, 30), bool)
    fine[1234, 17] = True
    coarse = coarser(fine, 1000)
    assert coarse.shape == (834, 10)
    assert coarse.sum() == 1
    assert coarse[1234 // 3, 17 // 3]


def test_metrics_have_their_units(results):
    units = {metric.name: metric.unit.replace("^3", "\u00b3") for metric in METRICS if metric.unit}
    units["contact_speed"] = "m/s"
    assert Reader(results_page(results / "0.json").html).meta["units"] == units


@pytest.mark.slow
def test_the_size_is_bounded(tmp_path):
    for k in range(4):
        write_results(tmp_path / "r", f"p{k}", n=500, seed=k)
    page = results_page(tmp_path / "r", max_bytes=150_000)
    assert len(page.html) <= 150_000
    assert any("trajectories but the first" in note for note in page.notes)


def test_hostile_names_are_text(tmp_path, results):
    file = write_results(tmp_path / "r", HOSTILE, suite=HOSTILE)
    value = json.loads(file.read_text())
    value["episodes"]["scenario"] = [HOSTILE] * 60
    value["episodes"]["event"][0] = HOSTILE
    value["episodes"][HOSTILE] = value["episodes"].pop("path_length")
    file.write_text(json.dumps(value))
    page, harmless = Reader(results_page(file).html), Reader(results_page(results / "0.json").html)
    assert page.tags == harmless.tags
    assert page.meta["policies"][0]["name"] == HOSTILE
    assert page.meta["policies"][0]["columns"]["event"][0] == "none"


def _break(name, new):
    def change(value):
        target = value
        *path, last = name.split(".")
        for part in path:
            target = target[part]
        if new is None:
            del target[last]
        else:
            target[last] = new

    return change


@pytest.mark.parametrize(
    "change",
    [_break("version", 3), _break("episodes.contacts_human", None),
     _break("format", "x"), _break("episodes", None), _break("episodes.steps", [1]),
     _break("episodes.seed", ["x"] * 60), _break("trajectories_cm.0", [1, 2, 3]), _break("outcome", 3),
     _break("trajectories_cm.0", [1e300, 1]), _break("trajectories_cm.x", [1, 2]), _break("settings", [1])],
)  # fmt: skip
def test_damaged_results_are_refused_in_one_line(tmp_path, change):
    file = write_results(tmp_path / "r", "p")
    value = json.loads(file.read_text())
    change(value)
    file.write_text(json.dumps(value))
    with pytest.raises(CorruptDataError, match="not a results file of this version") as caught:
        results_page(file)
    assert "\n" not in str(caught.value)


def test_results_that_do_not_know_of_contacts_are_refused_with_the_command(tmp_path):
    file = write_results(tmp_path / "r", "p")
    file.write_text(json.dumps({**json.loads(file.read_text()), "version": 1}))
    with pytest.raises(SchemaVersionError, match="play it again, navrep-data benchmark NAME --suite SUITE"):
        results_page(file)


def test_what_is_no_results(tmp_path, results, dataset):
    assert is_results(results)
    assert is_results(results / "0.json")
    assert not is_results(dataset)
    assert not is_results(tmp_path)
    with pytest.raises(DatasetNotFoundError, match="holds no results"):
        results_page(tmp_path)
    (tmp_path / "a.json").write_text("{")
    with pytest.raises(DatasetError):
        results_page(tmp_path / "a.json")
    write_results(tmp_path / "mixed", "p", seed=0)
    write_results(tmp_path / "mixed", "q", seed=1, physics="consistent")
    with pytest.raises(ConfigError, match="several suites, physics or first rounds"):
        results_page(tmp_path / "mixed")
