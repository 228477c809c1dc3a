"""From tiny trainings to shipped weights: files, records, names, cards, offline loading, results."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import ship
import torch
from model_cards import write_cards
from own_model_cards import own_card

from navrep_data import zoo
from navrep_data.cli.main import run
from navrep_data.errors import (
    CheckpointError,
    ConfigError,
    CorruptDataError,
    DatasetMismatchError,
    NavrepDataError,
    UnknownNameError,
)
from navrep_data.evaluate.sources import weights_of
from navrep_data.evaluate.world_model import world_model_error
from navrep_data.evaluate.world_model_results import save
from navrep_data.models import checkpoint
from navrep_data.shards import dataset_record
from navrep_data.train import controllers, default_controller_recipe, default_recipe, train_world_model
from navrep_data.train.half import rounding
from navrep_data.zoo import golden, names, registry
from navrep_data.zoo.describe import describe
from navrep_data.zoo.local import load_any_model

VARIANT = "transformer_1d"
COMMANDS = ["navrep-data generate --env soadrl --n 4 --out data", "navrep-data train transformer --lidar 1d ..."]

CONTROLLER = "navrep-data train controller --model models/w ..."


@pytest.fixture(scope="module")
def trained(dataset, tmp_path_factory):
    """A world model and a controller, a few steps each."""
    home = tmp_path_factory.mktemp("trained")
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    recipe = default_recipe("transformer", "1d").replace(
        z_size=16, steps=2, batch=2, micro_batch=2, validate_batches=1, warmup=1
    )
    train_world_model(recipe, dataset, home / "w", preload=True)
    model = checkpoint.load(home / "w")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(controllers, "VALIDATION_SEEDS", range(5000, 5002))
        settings = default_controller_recipe("z", "1d").replace(worlds=4, rollout=8, batch=32, steps=32)
        controllers.train_controller(settings, home / "c", model=model, model_name="models/w")
    torch.set_num_threads(before)
    return home


@pytest.fixture
def package(tmp_path, monkeypatch):
    """The zoo's folder without own weights, its recipes, nothing cached, no network."""
    root, recipes = tmp_path / "zoo", tmp_path / "recipes"
    shutil.copytree(registry.FOLDER / registry.RECORDS, root / registry.RECORDS)
    for path in (root / registry.RECORDS).glob(f"*.{names.OWN}.json"):
        path.unlink()
    shutil.copytree(ship.RECIPES, recipes)
    caches = (registry.records, registry.variants, registry.full_names)
    monkeypatch.setattr(registry, "FOLDER", root)
    monkeypatch.setattr(names, "UNTAGGED_ARE_OURS", names.UNTAGGED_ARE_OURS | {VARIANT, f"{VARIANT}_z"})
    monkeypatch.setattr(golden, "COMPACT", tmp_path / "goldens")  # the package's are of the weights that it ships
    monkeypatch.setenv("NAVREP_DATA_OFFLINE", "1")
    monkeypatch.setenv("NAVREP_DATA_HOME", str(tmp_path / "home"))
    for cached in caches:
        cached.cache_clear()
    yield root
    for cached in caches:
        cached.cache_clear()


def both_shipped(trained, package, dataset):
    recipes = package.parent / "recipes"
    w = ship.ship(trained / "w", VARIANT, dataset, commands=COMMANDS, root=package, recipes=recipes)
    c = ship.ship(trained / "c", f"{VARIANT}_z", dataset, commands=[CONTROLLER], root=package, recipes=recipes)
    return w, c


@pytest.mark.slow
def test_shipped_weights_load_by_name_offline_and_say_whose_they_are(trained, package, dataset, capsys):
    w, c = both_shipped(trained, package, dataset)
    capsys.readouterr()
    policy = zoo.load(f"{VARIANT}_z")
    assert capsys.readouterr().err == (
        f"{VARIANT}_z -> {VARIANT}_z.v1: trained by navrep-data, NOT the NavRep authors' weights "
        f"(those: {VARIANT}_z.released)\n"
    )
    assert policy.name == f"{VARIANT}_z.v1"
    original = load_any_model(trained / "c")
    scan = np.random.default_rng(0).uniform(0.5, 25, (5, 1080)).astype(np.float32)
    state = np.random.default_rng(1).normal(size=(5, 5)).astype(np.float32)
    for one in (policy, original):
        one.reset(batch_size=5)
    np.testing.assert_allclose(policy.act(scan, state), original.act(scan, state), atol=2e-3)
    assert zoo.load(f"{VARIANT}.v1").z_size == 16
    assert (w.kind, w.action_alignment, w.context_rule, w.parts) == ("world_model", "taken", "newest-32", {})
    assert (c.kind, c.n_inputs, c.features, c.context_rule, c.parts) == (
        "policy", 21, "z", None, {"world_model": f"{VARIANT}.v1"},
    )  # fmt: skip


@pytest.mark.slow
def test_output_folders_load_by_path(trained, dataset, tmp_path):
    policy = zoo.load(trained / "c")
    assert (policy.name, policy.features, policy.context) == ("c", "z", None)
    saved = zoo.save_policy(policy, tmp_path / "saved").parent
    scan, state = np.full((2, 1080), 5, np.float32), np.zeros((2, 5), np.float32)
    actions = [
        p.act(scan, state) for p in (policy, load_any_model(trained / "c"), zoo.load(saved), load_any_model(saved))
    ]
    for action in actions[1:]:
        np.testing.assert_array_equal(action, actions[0])
    assert zoo.load(trained / "w").z_size == 16


@pytest.mark.slow
def test_the_world_model_is_stored_once_in_half_precision(trained, package, dataset):
    w, c = both_shipped(trained, package, dataset)
    files = sorted(str(p.relative_to(package)) for p in (package / "weights").rglob("*") if p.is_file())
    assert files == [f"weights/{n}/{f}" for n in (w.name, c.name) for f in ("config.json", "model.safetensors")]
    whole = (trained / "w" / "model.safetensors").stat().st_size
    assert (package / w.files[0].path).stat().st_size < 0.55 * whole
    assert checkpoint.read_config(package / w.files[0].path)["weights_dtype"] == "float16"
    text = "".join((package / f.path).read_text() for f in (w.files[1], c.files[1])) + json.dumps(
        [w.to_dict(), c.to_dict()]
    )
    assert str(trained) not in text, "no path of this machine"


@pytest.mark.slow
def test_the_record_says_how_it_was_made(trained, package, dataset):
    w, c = both_shipped(trained, package, dataset)
    assert registry.records()[w.name] == w
    assert w.training["commands"] == COMMANDS
    assert w.training["dataset"]["content_hash"] == dataset_record(dataset)["content_hash"]
    assert (w.training["seed"], w.training["step"], w.training["steps"]) == (0, 2, 2)
    assert {"cores", "threads", "torch"} <= set(w.training["machine"])
    assert w.training["seconds"] >= 0
    cost = w.training["half_precision"]
    assert 0 < cost["z_change"] < 0.05 * cost["z_spread"]
    assert cost["reconstruction_mse_stored"] == pytest.approx(cost["reconstruction_mse"], rel=1e-2)
    assert 0 < c.training["half_precision"]["action_change"] < 2e-3
    assert c.training["curve"] == [[32, pytest.approx(c.training["curve"][0][1])]]
    assert "5000" in c.training["selected_on"]
    recipe = json.loads((package.parent / "recipes" / f"{VARIANT}.json").read_text())
    assert recipe["commands"] == COMMANDS
    assert recipe["settings"]["z_size"] == 16
    assert recipe["machine"] == w.training["machine"]


@pytest.mark.slow
def test_stages_before_count(trained, package, dataset):
    recipes = package.parent / "recipes"
    options = {"commands": ["a", "b"], "root": package, "recipes": recipes}
    alone = ship.ship(trained / "w", VARIANT, dataset, **options).training
    both = ship.ship(trained / "w", VARIANT, dataset, before=[trained / "w"], **options).training
    assert both["settings"] == alone["settings"]
    assert both["stages_before"] == [alone["settings"]]
    assert both["seconds"] >= alone["seconds"]
    assert "stages_before" not in alone


def test_the_last_v_before_an_m_is_part_of_its_settings(tmp_path):
    def stage(seed, model=None):
        recipe = default_recipe("m" if model else "v", "1d").replace(seed=seed).to_dict()
        return ship._Training(tmp_path, model, None, {"recipe": recipe}, 10, 2.0)

    joined = checkpoint.make("modular", {"lidar": "1d", "z_size": 8, "h_size": 8})
    stages = [stage(1), stage(2)]
    found = ship._recipe(tmp_path / "none.json", "modular_1d", stage(3, joined), ["..."], stages)
    assert (found["settings"]["v"]["seed"], found["settings"]["m"]["seed"]) == (2, 3)
    assert [one["seed"] for one in found["stages_before"]] == [1]
    assert found["wall_time_s"] == 6
    stages.append(stage(4, joined))  # M too went on from an earlier one
    found = ship._recipe(tmp_path / "none.json", "modular_1d", stage(3, joined), ["..."], stages)
    assert (found["settings"]["v"]["seed"], found["settings"]["m"]["seed"]) == (2, 3)
    assert [(one["model"], one["seed"]) for one in found["stages_before"]] == [("v", 1), ("m", 4)]


@pytest.mark.slow
def test_a_v_alone_may_be_the_stage_before(trained, package, dataset, tmp_path):
    settings = default_recipe("v", "1d").replace(steps=1, batch=8, micro_batch=8, validate_batches=1)
    train_world_model(settings, dataset, tmp_path / "v", preload=True)
    options = {"commands": ["a", "b"], "root": package, "recipes": package.parent / "recipes"}
    found = ship.ship(trained / "w", VARIANT, dataset, before=[tmp_path / "v"], **options).training
    assert found["stages_before"] == [settings.to_dict()]
    with pytest.raises(CheckpointError, match="holds no training"):
        ship.ship(trained / "w", VARIANT, dataset, before=[tmp_path], **options)


@pytest.mark.slow
def test_names_lists_and_checks_know_them(trained, package, dataset, capsys):
    with pytest.raises(UnknownNameError, match=rf"means {VARIANT}\.v1.*does not contain it.*{VARIANT}\.released"):
        zoo.load(VARIANT)
    w, c = both_shipped(trained, package, dataset)
    assert {w.name, f"{VARIANT}.released"} <= set(zoo.list_models(f"{VARIANT}*"))
    with pytest.raises(UnknownNameError, match=rf"here: {VARIANT}\.v1, {VARIANT}_z\.v1"):
        zoo.load("transformer_rings_z")
    assert zoo.show(f"{VARIANT}.released").tag == "released"
    assert [p.is_relative_to(package) for p in zoo.fetch(c.name)] == [True] * 4
    report = zoo.verify(f"{VARIANT}*.v1")
    assert [(check.name, check.status) for check in report.checks] == [(w.name, "ok"), (c.name, "ok")]
    assert "trained by navrep-data" in "\n".join(describe(c))
    with pytest.raises(SystemExit):
        run(["models", f"{VARIANT}_z*"])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("  = ")[1] for line in lines if line.startswith(c.name)] == [f"{VARIANT}_z, ours"]


@pytest.mark.slow
def test_a_damaged_file_is_refused(trained, package, dataset):
    w, c = both_shipped(trained, package, dataset)
    path = package / w.files[0].path
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(
        CorruptDataError, match=r"transformer_1d\.v1 needs weights/.*expected .*: reinstall navrep-data"
    ):
        zoo.load(c.name)
    assert [check.status for check in zoo.verify(w.name).checks] == ["wrong"]
    path.unlink()
    with pytest.raises(CorruptDataError, match="which is missing: reinstall navrep-data"):
        zoo.load(c.name)


@pytest.mark.slow
def test_cards_say_first_whose_weights_they_are(trained, package, dataset, tmp_path):
    w, c = both_shipped(trained, package, dataset)
    written = {path.name: path.read_text() for path in write_cards(tmp_path / "cards")}
    for record in (w, c):
        text = written[f"{record.name}.md"]
        body = text.split("---\n", 2)[2]
        lines = [line for line in body.splitlines() if line]
        assert lines[:2] == [f"# {record.name}", "Retrained by navrep-data; not the authors' checkpoint."]
        assert all(command in text for command in record.training["commands"])
        assert "Not measured yet." in text
        assert str(tmp_path) not in text
    assert f"[`{w.name}`]({w.name}.md)" in written[f"{VARIANT}.md"]


def results_of(record, folder, dataset):
    model = zoo.load(record.name)
    found = world_model_error(model, dataset, split="val", steps=2, name=record.name)
    return save(found, folder, dataset_record(dataset), weights_of(record.name)), found


@pytest.mark.slow
def test_measured_errors_reach_record_and_card(trained, package, dataset, tmp_path):
    w, _ = both_shipped(trained, package, dataset)
    with pytest.raises(ConfigError, match="has no results of"):
        ship.add_results(w.name, tmp_path, root=package)
    path, found = results_of(w, tmp_path, dataset)
    for _ in range(2):  # the second replaces the first
        record = ship.add_results(w.name, tmp_path, root=package)
    assert len(record.results) == 1
    assert record.results[0]["scan_mse"] == pytest.approx(found.scan_mse, rel=1e-4)
    assert f"`navrep-data evaluate world-model {w.name} --data DIR --split val`" in own_card(record)
    save(found, tmp_path, dataset_record(dataset), weights_of(w.name), 9)
    record = ship.add_results(w.name, tmp_path, root=package)
    assert f"{w.name} --data DIR --split val --limit 9`" in own_card(record)
    assert "MSE, val split" in "\n".join(describe(record))
    value = json.loads(path.read_text())
    value["files"] = dict.fromkeys(value["files"], "0" * 64)
    path.write_text(json.dumps(value))
    with pytest.raises(DatasetMismatchError, match="other weights"):
        ship.add_results(w.name, tmp_path, root=package)


@pytest.mark.slow
def test_benchmarks_reach_record_and_card_with_the_goal_beside(trained, package, dataset, tmp_path):
    from navrep_data.evaluate import benchmark

    _, c = both_shipped(trained, package, dataset)
    benchmark([c.name], "navreptest", episodes=3, out=tmp_path / "b", figures=False)
    record = ship.add_results(c.name, tmp_path / "b", root=package)
    (entry,) = record.results
    assert entry["command"] == f"navrep-data benchmark {c.name} --suite navreptest --episodes 3"
    assert entry["episodes"] == 3
    assert 0 <= entry["goal_success_rate"] <= 1
    card = own_card(record)
    assert "| navreptest | original | 3 (0 to 2) |" in card
    assert 0 <= entry["contact_free_rate"] <= entry["success_rate"]
    (tmp_path / "b" / "navreptest-original" / "goal.json").unlink()
    with pytest.raises(CorruptDataError, match="no results of 'goal'"):
        ship.add_results(c.name, tmp_path / "b", root=package)


@pytest.mark.slow
def test_what_does_not_belong_together_is_not_shipped(trained, package, dataset, tmp_path, monkeypatch):
    recipes = package.parent / "recipes"
    options = {"root": package, "recipes": recipes}
    with pytest.raises(CheckpointError, match="is not shipped: ship that first"):
        ship.ship(trained / "c", f"{VARIANT}_z", dataset, commands=["c"], **options)
    with pytest.raises(ConfigError, match=r"other settings than transformer_1d\.json has \(.*z_size"):
        ship.ship(trained / "w", VARIANT, dataset, **options)
    with pytest.raises(CheckpointError, match="holds a transformer_1d, expected a joint_1d"):
        ship.ship(trained / "w", "joint_1d", dataset, commands=["w"], **options)
    with pytest.raises(CheckpointError, match="holds no training"):
        ship.ship(tmp_path, VARIANT, dataset, commands=["w"], **options)
    with monkeypatch.context() as patch:
        patch.setattr(ship, "SHIPPED_BYTES", 100_000)
        with pytest.raises(ConfigError, match=r"expected 100,000 at most"):
            ship.ship(trained / "w", VARIANT, dataset, commands=["w"], **options)
    assert not any(path.is_file() for path in (package / "weights").rglob("*")), "refused weights leave nothing"
    w = ship.ship(trained / "w", VARIANT, dataset, commands=["w"], **options)
    torch.manual_seed(9)
    other = checkpoint.make("transformer", checkpoint.load(trained / "w").config)
    checkpoint.save(other, package / "weights" / w.name, storage="float16")
    with pytest.raises(CheckpointError, match="another world model than"):
        ship.ship(trained / "c", f"{VARIANT}_z", dataset, commands=["c"], **options)
    shipped = {path: path.read_bytes() for path in package.rglob("*") if path.is_file()}
    with pytest.raises(NavrepDataError):  # its cost cannot be measured
        ship.ship(trained / "w", VARIANT, tmp_path / "nothing", commands=["again"], **options)
    assert {path: path.read_bytes() for path in package.rglob("*") if path.is_file()} == shipped
    # a controller on z alone goes with any memory behind the same V
    other = checkpoint.load(trained / "w")
    with torch.no_grad():
        other.z_head.weight += 1.0
    checkpoint.save(other, package / "weights" / w.name, storage="float16")
    assert ship.ship(trained / "c", f"{VARIANT}_z", dataset, commands=["c"], **options).parts == {"world_model": w.name}


@pytest.mark.slow
def test_rounding_sees_what_changed(trained, dataset):
    model = checkpoint.load(trained / "w")
    assert rounding(model, model, dataset).z_change == 0
    other = checkpoint.load(trained / "w")
    with torch.no_grad():
        other.vae.fc1.bias += 0.25
    assert rounding(model, other, dataset).z_change == pytest.approx(0.25, rel=1e-4)


# --- what this checkout ships ---

OWN = [r for r in registry.records().values() if r.ours]


def test_the_package_holds_what_records_say_and_not_too_much():
    there = {p for p in (registry.FOLDER / registry.WEIGHTS).rglob("*") if p.is_file()}
    assert there == {registry.FOLDER / f.path for r in OWN for f in r.files}
    assert sum(p.stat().st_size for p in there) <= names.SHIPPED_BYTES == 45_000_000


@pytest.mark.slow
@pytest.mark.parametrize("record", OWN, ids=lambda r: r.name)
def test_shipped_weights(record, monkeypatch, tmp_path):
    monkeypatch.setenv("NAVREP_DATA_OFFLINE", "1")
    monkeypatch.setenv("NAVREP_DATA_HOME", str(tmp_path))
    assert record.variant in names.UNTAGGED_ARE_OURS
    assert zoo.verify(record.name).ok
    loaded = zoo.load(record.name)
    if record.kind == "policy":
        loaded.reset(batch_size=2)
        action = loaded.act(np.full((2, 1080), 5.0, np.float32), np.tile(np.float32([4, 0, 0, 0, 0]), (2, 1)))
        assert np.linalg.norm(action, axis=1).max() <= 1 + 1e-5
    assert {"commands", "settings", "seed", "seconds", "machine", "half_precision"} <= set(record.training)
    assert record.results, "measure it: navrep-data benchmark, then python tools/ship.py results"
    recipe = json.loads((ship.RECIPES / f"{record.variant}.json").read_text())
    assert (recipe["settings"], recipe["commands"]) == (record.training["settings"], record.training["commands"])
    assert str(Path.home()) not in json.dumps(record.to_dict())
