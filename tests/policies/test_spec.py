"""One parser of what people type: the same text means the same in every command."""

import sys

import h5py
import numpy as np
import pytest

from navrep_data.errors import ConfigError, ModelNotFoundError, PolicyError, UnknownNameError
from navrep_data.generate import generate, regenerate
from navrep_data.generate.policy import make_policy
from navrep_data.policies import BASELINES, BasePolicy, FunctionPolicy, NetworkPolicy, resolve_policy
from navrep_data.shards import Manifest
from navrep_data.testing import tiny_checkpoint

OWN = """
import numpy as np
from navrep_data.policies import BasePolicy

class Ahead(BasePolicy):
    name, sees, sees_on_maps = "ahead", "its goal", "its goal, map"
    needs = frozenset({"waypoint"})
    def act(self, observation):
        way = observation.waypoint
        return np.pad(way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1.0), ((0, 0), (0, 1)))

def slowly(scan, robot_state):
    return np.tile([0.25, 0.0], (len(scan), 1))

class Asked:
    def act(self, scan, robot_state):
        return np.tile([0.5, 0.0], (len(scan), 1))

class Picky(Asked):
    def __init__(self, speed):
        self.speed = speed

class Plain(BasePolicy):
    needs = frozenset({"scan", "pose"})
    def act(self, observation):
        return np.zeros((len(observation.pose), 3))

number = 3
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    """Return a folder with a module of somebody's policies, the working folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "my_drives.py").write_text(OWN)
    yield tmp_path
    sys.modules.pop("my_drives", None)


def test_kinds(own):
    tiny_checkpoint(own / "mine")
    found = {
        text: resolve_policy(text)
        for text in ("dwa", "e2e_1d.v1", "./mine", "my_drives:slowly", "my_drives:Ahead", "my_drives:Asked")
    }
    assert [spec.kind for spec in found.values()] == ["baseline", "zoo", "folder", *["function"] * 3]
    assert found["dwa"].files == {}
    assert found["dwa"].content() == ""
    assert all(len(found[text].content()) == 64 for text in list(found)[1:])
    assert isinstance(found["dwa"].make(), BASELINES["dwa"])
    assert isinstance(found["./mine"].make(), NetworkPolicy)
    assert isinstance(found["my_drives:slowly"].make(2), FunctionPolicy)
    assert type(found["my_drives:Ahead"].make()).__name__ == "Ahead"
    assert resolve_policy("my_drives:Ahead", on_maps=True).sees == "its goal, map"
    assert resolve_policy("my_drives:Plain").sees == "pose, scan"
    assert resolve_policy("orca", on_maps=True).sees == "true humans, map"


def test_objects_in_python(own):
    import my_drives

    for given, name in (
        (my_drives.slowly, "my_drives:slowly"),
        (my_drives.Asked(), "my_drives:Asked"),
        (my_drives.Ahead(), "my_drives:Ahead"),
    ):
        spec = resolve_policy(given)
        assert (spec.name, spec.kind) == (name, "function")
        made = spec.make(2)
        assert made is given if isinstance(given, BasePolicy) else isinstance(made, FunctionPolicy)


@pytest.mark.parametrize("parse", [resolve_policy, lambda text: make_policy(text, 4)])
def test_refusals_are_the_same_everywhere(parse, own):
    (own / "dwaa").mkdir()
    with pytest.raises(UnknownNameError, match=r"Unknown policy 'dwaa'\. Did you mean 'dwa'\? There is a \./dwaa here"):
        parse("dwaa")
    with pytest.raises(UnknownNameError, match="Baselines: goal, random, orca, dwa"):
        parse("nobody")
    with pytest.raises(PolicyError, match=r"transformer_rings\.v1 is a world model, expected a policy"):
        parse("transformer_rings.v1")
    with pytest.raises(ModelNotFoundError, match=r"There is no \S*gone, expected a folder"):
        parse("./gone")
    with pytest.raises(PolicyError, match=r"Policy 'my_drives:nobody' cannot be imported"):
        parse("my_drives:nobody")
    with pytest.raises(PolicyError, match=r"Policy 'my_drives:number' is a int, expected a callable"):
        parse("my_drives:number")
    with pytest.raises(
        PolicyError, match=r"'my_drives:Picky' cannot be made .*'speed'.*a class that takes no arguments"
    ):
        parse("my_drives:Picky")
    (own / "broken_drives.py").write_text("1 / 0\n")
    with pytest.raises(PolicyError, match=r"cannot be imported \(ZeroDivisionError: division by zero\)"):
        parse("broken_drives:drive")
    with pytest.raises(PolicyError, match=r"policy is 3, expected a name, a function"):
        parse(3)


def test_inference_is_checked():
    with pytest.raises(ConfigError, match="inference is 'often', expected one of"):
        resolve_policy("goal", inference="often")


SETTINGS = {"humans": 2, "obstacles": 1, "length": 40, "shard_size": 4}


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["goal", "random", "dwa", "my_drives:Ahead", "my_drives:slowly"])
def test_generate_takes_what_benchmark_takes_and_rows_do_not_depend_on_groups(policy, own):
    together = generate(n=3, out="a", policy=policy, policy_batch=3, **SETTINGS)
    generate(n=3, out="b", policy=policy, policy_batch=1, **SETTINGS)
    assert together.rows == 120
    a, b = Manifest.read("a"), Manifest.read("b")
    assert [e.sequence_hashes for e in a.shards] == [e.sequence_hashes for e in b.shards]
    assert a.policy == {"name": policy, "batch": 3}
    assert set(a.inputs) == ({"policy"} if ":" in policy else set())
    assert regenerate("a", 3).ok


@pytest.mark.slow
def test_a_network_records_from_its_name_and_its_folder(own):
    tiny_checkpoint(own / "mine")
    for name in ("e2e_1d", "./mine"):
        folder = name.strip("./")
        generate(n=2, out=f"data_{folder}", policy=name, policy_batch=2, **SETTINGS)
        manifest = Manifest.read(f"data_{folder}")
        assert manifest.policy["name"] == ("e2e_1d.v1" if name == "e2e_1d" else name)
        assert len(manifest.inputs["policy"]) == 64
        assert regenerate(f"data_{folder}", 1).ok


@pytest.mark.slow
def test_actions_are_shares_of_this_robots_speed(own, hall):
    for name, settings, speed in (("a", SETTINGS, 0.25), ("b", {**hall, "env": "map", "length": 4}, 0.1375)):
        generate(n=1, out=name, policy="my_drives:slowly", policy_batch=1, **settings)
        with h5py.File(own / name / Manifest.read(name).shards[0].file) as file:
            np.testing.assert_allclose(file["action"][0], [speed, 0.0, 0.0], rtol=1e-6)
