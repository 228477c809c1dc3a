"""What a page of a dataset holds, how large it gets, and that nothing from a dataset becomes markup."""

import base64
import hashlib
import re
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from view_pages import HOSTILE, Reader

from navrep_data.errors import ConfigError, DatasetNotFoundError, FolderInUseError
from navrep_data.generate import generate
from navrep_data.observations import scan_to_rings
from navrep_data.schema import EVENT_NAMES
from navrep_data.shards import DatasetFolder, Manifest
from navrep_data.view import dataset_page


def rows_of(folder, sequence):
    index, _ = folder.manifest.place_of(sequence)
    rows = np.flatnonzero(folder.read("sequence", index, 0, folder.shard(index).rows) == sequence)
    return index, int(rows[0]), int(rows[-1]) + 1


@pytest.mark.slow
def test_the_page_holds_the_dataset_to_the_quantisation(dataset):
    page = Reader(dataset_page(dataset, [2]).html)
    (entry,) = page.meta["sequences"]
    arrays = page.arrays(entry)
    with DatasetFolder(dataset) as folder:
        index, first, stop = rows_of(folder, 2)
        column = {name: folder.read(name, index, first, stop) for name in folder.shard(index).columns}
        worlds = folder.worlds(index)
    assert (entry["sequence"], entry["rows"], entry["total"], entry["frame"]) == (2, 150, 150, "world")
    np.testing.assert_array_equal(np.rint(arrays["scan"] * 1000), column["scan"])
    cells = np.stack([(arrays["rings"] >> (2 * k)) & 3 for k in range(4)], axis=-1).reshape(150, 64, 64)
    np.testing.assert_array_equal(cells, column["rings"])
    for name, atol in (("robot_state", 0.51e-3), ("action", 0.51e-3), ("robot_pose", 0.6e-3)):
        np.testing.assert_allclose(arrays[name].T, column[name], atol=atol)
    assert entry["arrays"]["reward"]["step"] <= 130 / 65534
    np.testing.assert_allclose(arrays["reward"], column["reward"], atol=1.1e-3)

    # episodes, and the obstacles of each
    starts = np.flatnonzero(column["is_first"])
    assert [e["start"] for e in entry["episodes"]] == starts.tolist()
    ends = [e["start"] + e["length"] - 1 for e in entry["episodes"]]
    assert [e["event"] for e in entry["episodes"]] == [EVENT_NAMES[k] for k in column["event"][ends]]
    for e in entry["episodes"]:
        k = int(np.flatnonzero(worlds.arrays["row"] == first + e["start"])[0])
        world = worlds.episode(k)
        corners = arrays["corners"].T[e["corner"] : e["corner"] + sum(e["polygons"])]
        expected = np.concatenate([*world.polygons, world.border])
        np.testing.assert_allclose(corners, expected, atol=1e-3)
        assert e["border"]
        assert e["polygons"] == [*map(len, world.polygons), len(world.border)]

    # people, turned into the world by hand, row by row
    humans, pose = column["humans"].astype(float), column["robot_pose"].astype(float)
    for row in (0, 77, 149):
        c, s = np.cos(pose[row, 2]), np.sin(pose[row, 2])
        for k in range(humans.shape[1]):
            x, y = humans[row, k, :2]
            if k >= arrays["human_x"].shape[0] or np.isnan(x):
                assert np.isnan(x)
                continue
            assert arrays["human_x"][k, row] == pytest.approx(pose[row, 0] + c * x - s * y, abs=1e-3)
            assert arrays["human_y"][k, row] == pytest.approx(pose[row, 1] + s * x + c * y, abs=1e-3)
            assert arrays["human_visible"][k, row] == humans[row, k, 5]
            assert 0 < np.hypot(arrays["leg_x"][k, row], arrays["leg_y"][k, row]) < 0.5


def test_the_legs_are_where_rays_end(dataset):
    """Seen legs have ray ends within their radius: an end-to-end check on the dataset itself."""
    page = Reader(dataset_page(dataset, [0]).html)
    (entry,) = page.meta["sequences"]
    a, sensor = page.arrays(entry), page.meta["sensor"]
    angles = sensor["angle_min"] + sensor["angle_increment"] * np.arange(sensor["n_rays"])
    near = []
    for row in range(0, entry["rows"], 7):
        x, y, theta = a["robot_pose"][:, row]
        ends = np.column_stack(
            [x + a["scan"][row] * np.cos(theta + angles), y + a["scan"][row] * np.sin(theta + angles)]
        )
        for k in np.flatnonzero(a["human_visible"][:, row]):
            legs = [
                (a["human_x"][k, row] + side * a["leg_x"][k, row], a["human_y"][k, row] + side * a["leg_y"][k, row])
                for side in (1, -1)
            ]
            near.append(min(np.linalg.norm(ends - leg, axis=1).min() for leg in legs))
    assert len(near) > 20
    assert np.mean(np.array(near) < 0.04) > 0.9  # a leg has a radius of 0.03 m


@pytest.mark.slow
@pytest.mark.parametrize("max_bytes", [100_000, 150_000, 250_000])
def test_the_size_is_bounded_and_the_page_says_what_was_left_out(dataset, max_bytes):
    page = dataset_page(dataset, [0, 1, 3], max_bytes=max_bytes)
    assert len(page.html) <= max_bytes
    reader = Reader(page.html)
    assert reader.meta["notes"] == list(page.notes) != []
    whole = Reader(dataset_page(dataset, [0, 1, 3]).html)
    for entry in reader.meta["sequences"]:
        assert 0 < entry["rows"] < entry["total"] == 150
        other = next(e for e in whole.meta["sequences"] if e["sequence"] == entry["sequence"])
        full = whole.arrays(other)["scan"]
        np.testing.assert_array_equal(reader.arrays(entry)["scan"], full[: entry["rows"]])
        assert sum(e["length"] for e in entry["episodes"]) == entry["rows"]


@pytest.mark.slow
def test_a_page_of_three_sequences_by_default_and_all_that_were_asked_for(dataset):
    page = dataset_page(dataset)
    assert [e["sequence"] for e in Reader(page.html).meta["sequences"]] == [0, 1, 2]
    assert page.notes == ("1 of 4 sequences; choose others with --sequence",)
    assert [e["sequence"] for e in Reader(dataset_page(dataset, [3, 1, 3]).html).meta["sequences"]] == [3, 1]


@pytest.mark.slow
def test_equal_data_give_equal_pages(dataset):
    assert dataset_page(dataset).html == dataset_page(dataset).html


@pytest.mark.parametrize(
    ("sequences", "max_bytes", "words"),
    [([4], 6_000_000, "Sequence 4 is not in .*it has 4 from 0 to 3"), ([-1], 6_000_000, "Sequence -1"),
     (range(60), 6_000_000, "60 sequences were asked for"), (None, 1000, "expected at least 100,000")],
)  # fmt: skip
def test_what_cannot_be_shown_is_an_error(dataset, sequences, max_bytes, words):
    with pytest.raises(ConfigError, match=words):
        dataset_page(dataset, sequences, max_bytes=max_bytes)


def test_labels_are_on_the_page_where_the_dataset_has_them(dataset, tmp_path):
    generate(env="soadrl", n=1, length=60, out=tmp_path / "d", labels=True)
    page = Reader(dataset_page(tmp_path / "d").html)
    (entry,) = page.meta["sequences"]
    with DatasetFolder(tmp_path / "d") as folder:
        stored = folder.read("scan_label", 0, 0, entry["rows"])
    np.testing.assert_array_equal(page.arrays(entry)["scan_label"], stored)
    assert stored.max() > 2
    plain = Reader(dataset_page(dataset).html)
    assert not any("scan_label" in entry["arrays"] for entry in plain.meta["sequences"])


def test_imports_have_scan_rings_and_curves(imported):
    page = Reader(dataset_page(imported).html)
    (entry,) = page.meta["sequences"]
    arrays = page.arrays(entry)
    assert entry["frame"] == "robot"
    assert {"scan", "rings", "robot_state", "action", "reward"} <= set(arrays)
    assert not {"human_x", "corners", "robot_pose", "leg_x"} & set(arrays)
    with DatasetFolder(imported) as folder:
        scan = folder.read("scan", 0, 0, entry["rows"])
    np.testing.assert_allclose(arrays["scan"], scan, atol=0.51e-3)


@pytest.fixture(scope="module")
def hostile(dataset, tmp_path_factory):
    root = tmp_path_factory.mktemp("hostile") / "x'\"><img src=y onerror=alert(2)>"
    shutil.copytree(dataset, root)
    manifest = Manifest.read(root)
    changes = {"env": HOSTILE, "command": HOSTILE * 50, "policy": {"name": HOSTILE}, "physics": HOSTILE}
    replace(manifest, **changes).save(root)
    return root


@pytest.mark.slow
def test_hostile_names_are_text(hostile, dataset):
    page, harmless = Reader(dataset_page(hostile).html), Reader(dataset_page(dataset).html)
    assert page.tags == harmless.tags
    assert [a for a in page.attributes if a[1] != "content"] == [a for a in harmless.attributes if a[1] != "content"]
    assert page.policy == harmless.policy
    facts = dict(page.meta["facts"])
    assert HOSTILE in facts["environment"]
    assert facts["policy"] == HOSTILE
    assert len(facts["made by"]) <= 300
    assert page.meta["title"] == hostile.name


def test_the_policy_allows_this_script_and_style_and_nothing_else(page_file):
    html = page_file.read_bytes()
    page = Reader(html)

    def digest(text):
        return "'sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() + "'"

    code = [text for attributes, text in page.scripts if "type" not in attributes]
    assert len(code) == len(page.styles) == 1
    assert all(set(attributes) == {"type", "id"} for attributes, _ in page.scripts if attributes)
    rules = dict(rule.strip().split(" ", 1) for rule in page.policy.split(";"))
    assert rules["default-src"] == "'none'"
    assert rules["script-src"] == digest(code[0])
    assert rules["style-src"] == digest(page.styles[0])
    assert set(rules) == {
        "default-src", "script-src", "style-src", "img-src", "base-uri", "form-action", "require-trusted-types-for",
        "trusted-types",
    }  # fmt: skip
    assert rules["img-src"] == "data:"
    assert rules["base-uri"] == rules["form-action"] == rules["trusted-types"] == "'none'"
    assert not any(name.startswith("on") or name == "style" for _, name, _ in page.attributes)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["page_file", "results_file"])
def test_nothing_in_the_page_points_elsewhere(kind, request):
    html = request.getfixturevalue(kind).read_text()
    assert not re.search(r"(?i)\b(https?|wss?|ftp):", html)
    assert not re.search(r"(?i)@import|url\(|fetch\(|XMLHttpRequest|sendBeacon|EventSource|WebSocket|import\(", html)
    assert not re.search(r"(?i)innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(|new Function", html)
    targets = [
        value for _, name, value in Reader(html.encode()).attributes if name in ("src", "href", "action", "data")
    ]
    assert targets == ["data:,"]


def test_only_our_own_pages_are_replaced(dataset, tmp_path):
    page = dataset_page(dataset, [0])
    target = page.write(tmp_path / "page.html")
    assert target.read_bytes() == page.html
    page.write(target)
    other = tmp_path / "thesis.html"
    other.write_text("<!doctype html>\nmine")
    with pytest.raises(FolderInUseError, match="not a page of ours; choose another file with --out"):
        page.write(other)
    with pytest.raises(FolderInUseError, match="not a page of ours"):
        page.write(tmp_path)
    with pytest.raises(DatasetNotFoundError, match="There is no folder"):
        page.write(tmp_path / "none" / "page.html")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["page.html", "thesis.html"]


@pytest.mark.slow
def test_view_never_imports_torch():
    heavy = "{'torch', 'stable_baselines3', 'huggingface_hub'}"
    code = f"import sys, navrep_data.view; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_without_rings_people_or_worlds_the_rest_is_shown(tmp_path):
    root = tmp_path / "bare"
    generate(n=1, out=root, length=40, humans=3, obstacles=2, rings=False, humans_column=False)
    whole = Reader(dataset_page(root).html)
    (entry,) = whole.meta["sequences"]
    arrays = whole.arrays(entry)
    assert not {"human_x", "leg_x"} & set(arrays)
    with DatasetFolder(root) as folder:
        rings = scan_to_rings(folder.read("scan", 0, 0, 40))
    cells = np.stack([(arrays["rings"] >> (2 * k)) & 3 for k in range(4)], axis=-1).reshape(rings.shape)
    np.testing.assert_array_equal(cells, rings)
    manifest = Manifest.read(root)
    replace(manifest, shards=tuple(replace(s, worlds=None) for s in manifest.shards)).save(root)
    page = Reader(dataset_page(root).html)
    (entry,) = page.meta["sequences"]
    assert "corners" not in entry["arrays"]
    assert all(e["polygons"] == [] and not e["border"] for e in entry["episodes"])
    assert "robot_pose" in entry["arrays"]
