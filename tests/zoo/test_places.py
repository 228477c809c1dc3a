"""What people type for a model: a bare word is a name of the zoo, whatever lies in the working folder."""

import shlex

import pytest

from navrep_data import zoo
from navrep_data.errors import ModelNotFoundError, UnknownNameError
from navrep_data.evaluate.sources import full_name, weights_of
from navrep_data.generate.policy import make_policy
from navrep_data.models import VAE, EndToEnd
from navrep_data.policies import resolve_policy
from navrep_data.testing import tiny_checkpoint
from navrep_data.zoo.folders import place_of
from navrep_data.zoo.local import described, load_any_model


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    tiny_checkpoint("e2e_1d.v1", model="vae")  # shadows a name
    tiny_checkpoint("mine", model="e2e")
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("load", [zoo.load, load_any_model])
def test_the_zoo_wins_where_a_folder_has_its_name(here, load):
    assert load("e2e_1d.v1").name == "e2e_1d.v1"
    assert isinstance(load("./e2e_1d.v1"), VAE)
    assert isinstance(load("~/e2e_1d.v1"), VAE)
    assert isinstance(load(here / "e2e_1d.v1"), VAE)


@pytest.mark.slow
@pytest.mark.parametrize("find", [zoo.load, load_any_model, resolve_policy, full_name])
def test_a_folder_named_by_a_bare_word_is_refused_with_what_to_write(here, find):
    with pytest.raises(UnknownNameError, match=r"There is a \./mine here: to name that, write \./mine"):
        find("mine")


@pytest.mark.parametrize("place", ["./mine", "mine/model.safetensors", "./it's"])
def test_a_place_is_not_told_to_be_written_as_a_place(here, place):
    """What used to be said: There is a ././mine here: to name that, write ././mine."""
    (here / "it's").mkdir()
    with pytest.raises(UnknownNameError) as refused:
        zoo.show(place)
    assert "to name that, write" not in str(refused.value)
    assert f"navrep-data models show {shlex.quote(place)} tells what is there" in str(refused.value)


def test_a_place_is_described_without_its_weights(here):
    found = described(here / "mine")
    assert (found["kind"], list(found["files"])) == ("e2e", ["config.json", "model.safetensors"])
    zoo.save_policy(zoo.load("./mine"), "saved")
    (here / "saved" / "controller" / "model.safetensors").write_bytes(b"not read")
    found = described(here / "saved")
    assert (found["parts"], found["files"]["controller/model.safetensors"]) == (["controller"], 8)
    with pytest.raises(ModelNotFoundError, match=r"There is no .*gone, expected a folder with a checkpoint"):
        described(here / "gone")


def test_places(here, monkeypatch):
    monkeypatch.setattr("navrep_data.zoo.hub.fetch_model", lambda text: here / "mine")
    assert [place_of(name) for name in ("e2e_1d.v1", "mine")] == [None, None]
    assert place_of("hf://user/name@main") == here / "mine"
    assert isinstance(load_any_model("hf://user/name"), EndToEnd)
    assert full_name("hf://user/name") == "hf://user/name"
    assert weights_of("hf://user/name") == weights_of("./mine")
    assert full_name("./e2e_1d.v1") == "./e2e_1d.v1"
    assert full_name("e2e_1d") == "e2e_1d.v1"


def test_generate_takes_a_network_from_its_place(here, monkeypatch):
    monkeypatch.setattr("navrep_data.zoo.hub.fetch_model", lambda text: here / "mine")
    for name in ("./mine", "hf://user/name"):
        policy = make_policy(name, 64)
        assert policy.name == name
        assert len(policy.content()) == 64
