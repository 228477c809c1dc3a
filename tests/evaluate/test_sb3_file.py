"""A file of stable-baselines3 is not opened; the refusal says what to write, and that works as it stands."""

import json
import re
import subprocess
import sys
import zipfile

import numpy as np
import pytest

from navrep_data import zoo
from navrep_data.envs import make_sb3_vec
from navrep_data.errors import CheckpointError, PolicyError
from navrep_data.evaluate import benchmark
from navrep_data.generate.policy import make_policy
from navrep_data.policies import resolve_policy
from navrep_data.sb3_file import refuse_sb3_file
from navrep_data.zoo.importers import load_any
from navrep_data.zoo.local import load_any_model
from navrep_data.zoo.sb3 import ControllerPPO, from_sb3

pytestmark = pytest.mark.slow  # stable-baselines3 takes seconds to import

FORMS = [(lidar, flat) for lidar in ("scan", "1d", "rings") for flat in (False, True)]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    sys.modules.pop("sb3_policy", None)


def trained(path, lidar="scan", flat=False, algorithm="PPO", **options):
    import stable_baselines3

    worlds = make_sb3_vec("navrep-train", 2, lidar=lidar, flat=flat, seed=0)
    few = {"n_steps": 4, "batch_size": 4} if algorithm == "PPO" else options
    policy = "MlpPolicy" if flat else "MultiInputPolicy"
    model = getattr(stable_baselines3, algorithm)(policy, worlds, policy_kwargs={"net_arch": [8]}, seed=0, **few)
    model.save(path)
    return model, worlds


def refused(path):
    with pytest.raises(PolicyError, match="holds pickled objects") as found:
        resolve_policy(path)
    text = str(found.value)
    assert "\n" not in text
    return text


def written(text):
    """Write the function that a refusal prints, and return its name."""
    command = re.search(r"(echo .*) && navrep-data benchmark (\S+)$", text)
    subprocess.run(["sh", "-c", command[1]], check=True)
    return command[2]


def played(name):
    row = benchmark([name], episodes=2, workers=1, figures=False, out="played").rows[0]
    assert (row["name"].startswith("sb3_policy") or row["name"].endswith(".v1"), row["episodes"]) == (True, 2)


@pytest.mark.parametrize(("lidar", "flat"), FORMS)
def test_the_function_drives_whatever_form_of_observations_it_learnt_from(lidar, flat):
    model, worlds = trained("it's mine.zip", lidar, flat)
    text = refused("./it's mine.zip")
    assert f"takes {'flat ' if flat else ''}observations of {lidar}" in text
    assert ("range_max" in text) == (lidar == "1d"), "what the file does not say"
    name = written(text)
    played(name)
    import sb3_policy

    # the observations are those of training
    plain = make_sb3_vec("navrep-train", 2, seed=0).reset()
    expected = model.predict(worlds.reset(), deterministic=True)[0]
    np.testing.assert_allclose(sb3_policy.act(plain["scan"], plain["robot_state"]), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("algorithm", "options"), [("A2C", {}), ("SAC", {"buffer_size": 10}), ("TD3", {"buffer_size": 10})]
)
def test_other_algorithms_drive_too(algorithm, options):
    trained("other.zip", "scan", True, algorithm, **options)
    text = refused("./other.zip")
    assert f"import {algorithm};" in text
    written(text)
    import sb3_policy

    assert sb3_policy.act(np.full((64, 1080), 30.0, np.float32), np.zeros((64, 5), np.float32)).shape == (64, 3)


@pytest.mark.parametrize("name", ["transformer_1d_z.v1", "e2e_1d.v1"])
def test_a_controller_of_load_sb3_drives_with_the_encoder_it_was_loaded_with(name, folder):
    import torch

    model = zoo.load_sb3(name, env="navrep-train", n_envs=2, n_steps=8, n_epochs=1, device="cpu")
    model.learn(16)
    with torch.no_grad():
        for weights in model.policy.parameters():
            weights.mul_(0.9)  # far enough from where it started to be told apart
    model.save("real.zip")
    text = refused("./real.zip")
    assert f"zoo.load({name!r})" in text.replace("'\"'\"'", "'")
    function = written(text)
    played(function)
    import sb3_policy

    scan, state = np.full((3, 1080), 4.0, np.float32), np.ones((3, 5), np.float32)
    before = zoo.load(name)
    expected = model.predict(before.encode(scan, state), deterministic=True)[0]
    np.testing.assert_allclose(sb3_policy.policy(scan, state)[:, :2], expected, atol=1e-5)
    assert np.abs(before.act(scan, state)[:, :2] - expected).max() > 1e-3
    # and it is a folder that all commands take
    zoo.save_policy(sb3_policy.policy, "./folder")
    np.testing.assert_allclose(load_any_model("./folder").act(scan, state)[:, :2], expected, atol=1e-5)


def test_where_a_file_does_not_say_whose_encoder_it_needs_neither_does_the_advice(folder):
    zoo.load_sb3("joint_1d_z.v1").save("real.zip")
    edited("real.zip", lambda data: data.pop("navrep_data_origin"))
    text = refused("./real.zip")
    assert "with what load_sb3 was given in place of NAME" in text
    with pytest.raises(
        CheckpointError, match=r"takes observations \(\d+,\), but .*e2e_1d.v1 \(1085,\): give the policy"
    ):
        from_sb3(ControllerPPO.load("real.zip"), zoo.load("e2e_1d.v1"))


def edited(path, change):
    with zipfile.ZipFile(path) as found:
        members = {name: found.read(name) for name in found.namelist()}
    data = json.loads(members["data"])
    change(data)
    members["data"] = json.dumps(data)
    with zipfile.ZipFile(path, "w") as new:
        for name, content in members.items():
            new.writestr(name, content)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda d: d.update(observation_space={"spaces": "{'camera': Box(0, 255, (3, 84, 84), uint8)}"}),
            "observations",
        ),
        (
            lambda d: d["observation_space"].update(spaces=d["observation_space"]["spaces"].replace("1080", "720")),
            "obs",
        ),
        (lambda d: d["observation_space"].update(spaces=d["observation_space"]["spaces"].replace("25.0", "x")), "obs"),
        (lambda d: d.update(observation_space=None), "observations"),
        (lambda d: d["policy_class"].update(__module__="sb3_contrib.common.recurrent.policies"), "algorithm"),
        (lambda d: d.pop("policy_class"), "algorithm"),
        (dict.clear, "algorithm"),
    ],
)
def test_what_cannot_be_told_apart_is_said_so(change, said):
    trained("own.zip")
    edited("own.zip", change)
    text = refused("./own.zip")
    assert f"Its {said}" in text
    assert "no function to print for it: write sb3_policy.py with act(scan, robot_state)" in text
    assert "echo" not in text


def test_data_that_is_no_json_or_too_large_is_not_read(monkeypatch):
    with zipfile.ZipFile("bad.zip", "w") as new:
        new.writestr("_stable_baselines3_version", "2.3.2")
    assert "Its algorithm is not said" in refused("./bad.zip")
    for text in ("[" * 100_000, "5", "{"):
        with zipfile.ZipFile("bad.zip", "w") as new:
            new.writestr("_stable_baselines3_version", "2.3.2")
            new.writestr("data", text)
        assert "Its algorithm is not said" in refused("./bad.zip")
    trained("big.zip")
    monkeypatch.setattr("navrep_data.sb3_file._MAX_DATA_BYTES", 1000)
    assert "Its algorithm is not said" in refused("./big.zip")


def test_everything_that_takes_a_model_gives_the_same_answer(folder):
    trained("real.zip")
    text = refused("./real.zip")
    for take in (zoo.load, load_any_model, load_any):
        with pytest.raises(PolicyError) as found:
            take("./real.zip")
        assert str(found.value) == text
    with pytest.raises(PolicyError) as found:
        make_policy("./real.zip", 1)
    assert str(found.value) == text.replace("navrep-data benchmark", "navrep-data generate --policy")


def test_other_files_and_folders_pass(folder):
    refuse_sb3_file(folder)
    refuse_sb3_file(folder / "missing")
    (folder / "text.zip").write_text("no zip")
    refuse_sb3_file(folder / "text.zip")
