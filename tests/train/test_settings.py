"""Settings of trainings: all are listed, usual names are understood, worlds take every setting."""

import dataclasses
import json

import numpy as np
import pytest
from test_controllers import few_episodes, world_model  # noqa: F401  a fixture

from navrep_data.cli.main import run
from navrep_data.errors import ConfigError, NavrepDataError
from navrep_data.sim import Simulator, make_config, velocity_commands
from navrep_data.train import Recipe, train_controller
from navrep_data.train.controller_recipe import (
    ControllerRecipe,
    default_controller_recipe,
    environment,
    validation_environment,
)
from navrep_data.train.settings import DESCRIPTIONS, STAGES, USUAL, hint, list_settings, parse, sim_settings

SHORT = {"worlds": 4, "rollout": 16, "batch": 32, "epochs": 1, "steps": 128, "validate_every": 64}
FLAGS = {"model", "features", "lidar", "original", "env", "sim"}


def test_every_setting_is_described():
    fields = {field.name for kind in (Recipe, ControllerRecipe) for field in dataclasses.fields(kind)}
    assert set(DESCRIPTIONS) == (fields - FLAGS) | set(sim_settings())
    assert set(USUAL.values()) <= set(DESCRIPTIONS)
    assert all(stage in STAGES for stages, _, _ in DESCRIPTIONS.values() for stage in stages)


@pytest.mark.parametrize("stage", STAGES)
def test_the_list_has_each_setting_of_a_stage_with_its_default(stage):
    lines = list_settings(stage)
    names = [line.split()[0] for line in lines[1:]]
    assert names == [name for name, (stages, _, _) in DESCRIPTIONS.items() if stage in stages]
    values = {line.split()[0]: line.split()[1] for line in lines}
    assert values["lr"] == {"controller": "0.0005", "e2e": "0.0003"}.get(stage, "0.001")
    assert all(len(line.splitlines()) == 1 for line in lines)


@pytest.mark.slow
def test_the_command_lists_and_ends(capsys):
    with pytest.raises(SystemExit) as stop:
        run(["train", "controller", "--list-settings"])
    out = capsys.readouterr().out
    assert stop.value.code == 0
    assert "rollout" in out
    assert "drive" in out
    with pytest.raises(SystemExit):
        run(["train", "--list-settings"])
    out = capsys.readouterr().out
    assert all(f"[{stage}]" in out for stage in STAGES)


@pytest.mark.parametrize("name", ["beta", "latent_dim"])
def test_a_usual_name_of_what_a_stage_lacks_is_not_taken_for_what_is_spelt_like_it(name):
    assert hint(name, [n for n, (stages, _, _) in DESCRIPTIONS.items() if "controller" in stages]) == ""


@pytest.mark.parametrize(
    ("stage", "name", "ours"),
    [
        ("e2e", "gae", "gae_lambda"), ("v", "beta", "kl_weight"),
        ("controller", "learning_rate", "lr"), ("controller", "n_steps", "rollout"), ("e2e", "batch_size", "batch"),
        ("e2e", "n_envs", "worlds"), ("controller", "ent_coef", "entropy"), ("v", "learning_rate", "lr"),
        ("v", "latent_dim", "z_size"), ("v", "n_epochs", "steps"), ("joint", "hidden_size", "h_size"),
        ("controller", "hidden_size", "hidden"), ("v", "grad_clip", "clip_norm"), ("e2e", "grad_clip", "max_grad_norm"),
        ("controller", "roll_out", "rollout"), ("controller", "dt", "sensor.dt"),
    ],
)  # fmt: skip
def test_usual_names_are_hinted_at(stage, name, ours):
    known = [known for known, (stages, _, _) in DESCRIPTIONS.items() if stage in stages]
    assert hint(name, known) == f" Did you mean {ours!r}?"


def test_values_are_read_by_kind():
    known = {**sim_settings(), "timeouts_end": False, "worlds": 1}
    pairs = ["maps=a,b", "max_velocity=0.5,0.5,1", "goal_radius=none", "timeouts_end=true", "sensor.n_rays=90"]
    assert parse([*pairs, "drive=differential"], known, "e2e") == {
        "maps": ["a", "b"], "max_velocity": [0.5, 0.5, 1.0], "goal_radius": None, "timeouts_end": True,
        "sensor.n_rays": 90, "drive": "differential",
    }  # fmt: skip
    for pair, words in [
        ("driv=x", r"--set 'driv=x' is no setting. Did you mean 'drive'\?.*train e2e --list-settings"),
        ("worlds=many", "--set worlds=many is no int, as worlds is"),
        ("max_velocity=a,b", "is no list with commas, as max_velocity is"),
        ("goal_radius=wide", "is no number or none"),
    ]:
        with pytest.raises(ConfigError, match=words):
            parse([pair], known, "e2e")


def test_recipes_without_worlds_of_their_own_are_as_before():
    plain = default_controller_recipe("z", "1d")
    assert not {"env", "sim"} & set(plain.to_dict())
    assert environment(plain) == make_config("navrep-train", physics="consistent", curriculum="adaptive")
    assert validation_environment(plain) == validation_environment() == make_config("navrep-test", physics="original")
    other = plain.replace(env="navrep-test", sim={"drive": "differential", "sensor.n_rays": 90})
    assert ControllerRecipe(**json.loads(json.dumps(other.to_dict()))) == other
    assert (environment(other).drive, environment(other).sensor.n_rays) == ("differential", 90)
    assert validation_environment(other) == environment(other)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"env": "navrep-tset"}, "Unknown environment 'navrep-tset'. Did you mean 'navrep-test'"),
        ({"sim": {"drive": "tank"}}, "drive is 'tank', expected one of: holonomic, differential"),
        ({"sim": {"robots": 2}}, "robots is 2, expected 1: controllers drive one robot"),
        ({"env": "crowdmove-1"}, "robots is 10, expected 1"),
        ({"sim": {"world": "map"}}, "cannot be combined"),
    ],
)
def test_worlds_that_cannot_be_are_refused_in_one_line(changes, words):
    with pytest.raises(NavrepDataError, match=words) as caught:
        default_controller_recipe("z", "1d").replace(**changes)
    assert "\n" not in str(caught.value)


def test_a_differential_robot_gets_where_its_controller_wants_to_go():
    """Wanted velocities towards the goal bring it there: it cannot move sideways, so it has to turn."""
    config = make_config("empty", drive="differential", time_limit=60.0)
    simulator = Simulator(config, 8, seed=3)
    ended = np.zeros(8, np.uint8)
    for _ in range(300):
        goal = simulator.observe()[1][:, :2]
        wanted = goal / np.maximum(1.0, np.linalg.norm(goal, axis=1, keepdims=True))
        _, events = simulator.step(velocity_commands(config, wanted))
        ended = np.where(ended == 0, events, ended)
    assert (ended == 1).all()
    np.testing.assert_allclose(velocity_commands(config, [0.0, 1.0]), [0.0, 0.0, 1.0], atol=1e-12)
    plain = make_config("empty")
    np.testing.assert_array_equal(velocity_commands(plain, [0.3, -0.2]), [0.3, -0.2, 0.0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("features", "env", "sim"),
    [
        ("e2e", "navrep-train", {"drive": "differential", "max_velocity": [0.5, 0.5, 1.0], "inertia": "limited"}),
        ("z", "navrep-train", {"sensor.n_rays": 181, "sensor.angle_min": -1.57, "sensor.angle_increment": 0.01745}),
        ("zh", "map", {"humans": 1, "time_limit": 6.0}),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore::navrep_data.errors.BlindSectorWarning")
def test_controllers_train_in_other_worlds(features, env, sim, few_episodes, tmp_path):  # noqa: F811
    if env == "map":
        pytest.importorskip("asl_pepper_2d_sim_maps")
        sim = {**sim, "maps": ["asl_office_j"]}
    recipe = default_controller_recipe(features, "1d").replace(env=env, sim=sim, precision="float32", **SHORT)
    model = None if features == "e2e" else world_model()
    done = train_controller(recipe, tmp_path / "out", model=model, model_name="made")
    assert done.steps == 128
    kept = json.loads((tmp_path / "out" / "recipe.json").read_text())["settings"]
    assert (kept.get("env", "navrep-train"), kept["sim"]) == (env, sim)
    config = json.loads((tmp_path / "out" / "config.json").read_text())["metadata"]
    assert config["environment"] == environment(recipe).to_dict()
    assert config["selected_on"].startswith(f"{env}, consistent physics, numpy seeds 5000")
    with pytest.raises(ConfigError, match=r"was started with (sim|env) = .*, this resume has None"):
        train_controller(recipe.replace(env="navrep-train", sim={}), tmp_path / "out", model=model, resume=True)
