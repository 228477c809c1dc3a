"""gymnasium ids: strings that cost nothing until somebody makes an environment."""

import subprocess
import sys

import gymnasium
import pytest
from PIL import Image

import navrep_data.envs  # registers
from navrep_data.registration import ENVIRONMENTS, camel_case, register
from navrep_data.sim import environment_names, gymnasium_id


def python(code):
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_every_environment_of_the_simulator_has_an_id():
    assert sorted(ENVIRONMENTS) == environment_names()
    for env in ENVIRONMENTS:
        spec = gymnasium.spec(gymnasium_id(env))
        assert spec.kwargs == {"env": env}
        assert spec.entry_point == "navrep_data.envs:NavRepEnv"
        assert spec.vector_entry_point == "navrep_data.envs:NavRepVectorEnv"


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("navrep-train", "NavRepTrain-v0"), ("navrep-test", "NavRepTest-v0"), ("soadrl", "SOADRL-v0"),
        ("cadrl", "CADRL-v0"), ("ian", "IAN-v0"), ("mark-test-2", "MarkTest2-v0"), ("crowdmove-6", "CrowdMove6-v0"),
        ("empty", "Empty-v0"), ("map", "Map-v0"),
    ],
)  # fmt: skip
def test_ids_are_spelt_as_in_the_paper(name, expected):
    assert f"{camel_case(name)}-v0" == expected


def test_registering_twice_changes_nothing():
    before = dict(gymnasium.registry)
    register()
    assert dict(gymnasium.registry) == before


def test_importing_the_package_loads_neither_gymnasium_nor_numpy():
    heavy = ("gymnasium", "numpy", "numba", "torch")
    assert python(f"import sys, navrep_data; print([m for m in {heavy} if m in sys.modules])") == "[]"


@pytest.mark.slow
@pytest.mark.parametrize(
    "code",
    [
        "import gymnasium; env = gymnasium.make('navrep_data:NavRepTest-v0')",
        "import gymnasium, navrep_data; env = gymnasium.make('NavRepTest-v0')",
        "import navrep_data, sys, gymnasium; env = gymnasium.make('NavRepTest-v0')"
        "; assert all(type(f).__name__ != '_WhenGymnasiumComes' for f in sys.meta_path)",
        "import navrep_data.envs; env = navrep_data.envs.NavRepEnv('navrep-test')",
    ],
)
def test_ids_work_in_any_order_of_imports_and_without_torch(code):
    end = "; import sys; print(env.reset(seed=1000)[1]['seed'], 'torch' in sys.modules, 'matplotlib' in sys.modules)"
    assert python(code + end) == "1000 False False"


def test_there_is_one_word_for_each_public_thing():
    assert all(hasattr(navrep_data.envs, name) for name in navrep_data.envs.__all__)


@pytest.mark.parametrize("make", [gymnasium.make, lambda spec, **kw: gymnasium.make_vec(spec, num_envs=2, **kw)])
def test_a_spec_finds_its_maps_from_any_working_folder(make, tmp_path, monkeypatch):
    folder = tmp_path / "mm"
    folder.mkdir()
    Image.new("L", (60, 60), 254).save(folder / "m.png")
    (folder / "m.yaml").write_text(
        "image: m.png\nresolution: 0.2\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    monkeypatch.chdir(tmp_path)
    spec = make("Map-v0", maps=("./mm",), humans=2).spec
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir("elsewhere")
    again = make(spec)
    assert again.unwrapped.config.map_files == (str(folder),)
    again.reset(seed=0)
