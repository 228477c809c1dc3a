"""Names to working models: parts resolved, checked and joined; what is missing named before anything is built."""

import numpy as np
import pytest

from navrep_data import zoo
from navrep_data.errors import ConfigError, CorruptDataError, OfflineError, PolicyError
from navrep_data.zoo import registry
from navrep_data.zoo.fetching import Source, missing_here

pytestmark = pytest.mark.slow  # seconds each; `make test` runs them

RUNS = {r.name: r for r in registry.records().values() if not r.ours}
WHOLE = sorted(
    name
    for name, r in RUNS.items()
    if r.kind == "policy"
    and (r.architecture == "e2e" or (r.lidar == "1d" and (r.architecture != "modular" or r.features == "z")))
)
WAITING = sorted({r.name for r in RUNS.values() if r.kind == "policy"} - set(WHOLE))


@pytest.fixture(autouse=True)
def empty_home(monkeypatch, tmp_path):
    monkeypatch.setenv("NAVREP_DATA_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("NAVREP_DATA_OFFLINE", "1")
    monkeypatch.delenv("NAVREP_RELEASED_DIR", raising=False)


@pytest.fixture
def folder(released, monkeypatch):
    monkeypatch.setenv("NAVREP_RELEASED_DIR", str(released))
    return released


def scans(n):
    r = np.random.default_rng(0)
    state = np.concatenate([r.uniform(-5, 5, (n, 2)), r.uniform(-1, 1, (n, 2)), np.zeros((n, 1))], axis=1)
    return r.uniform(0.5, 25.0, (n, 1080)).astype(np.float32), state.astype(np.float32)


def test_nineteen_policies_are_whole_and_thirty_three_wait():
    assert (len(WHOLE), len(WAITING)) == (19, 33)


@pytest.mark.parametrize("name", WHOLE)
def test_whole_policies_load_and_act(folder, name):
    policy = zoo.load(name)
    assert policy.name == name
    policy.reset(batch_size=3)
    for _ in range(2):
        action = policy.act(*scans(3))
    assert action.shape == (3, 3)
    assert (np.abs(action) <= 1.0).all()
    assert (action[:, 2] == 0.0).all()
    assert policy.encode(*scans(3)).shape == (3, RUNS[name].n_inputs)


@pytest.mark.parametrize("name", WAITING)
def test_the_others_name_the_missing_file(name):
    absent = {entry.path for _, entry in missing_here(RUNS[name], Source.of(None))}
    with pytest.raises(OfflineError) as caught:
        zoo.load(name)
    assert any(path in str(caught.value) for path in absent)
    assert "(git blob " in str(caught.value) or "(sha256 " in str(caught.value)


@pytest.mark.parametrize("name", ["transformer_1d.released", "joint_1d.released", "modular_1d_v.released"])
def test_world_models_and_v(folder, name):
    model = zoo.load(name)
    import torch

    assert not model.training
    z = model.encode(torch.rand(2, 1080))
    assert z.shape == (2, RUNS[name].z_size)
    assert model.decode(z).shape == (2, 1080)


def test_the_unlabelled_run_is_a_bare_controller(folder):
    policy = zoo.load("transformer_unlabelled_z.20200826")
    mean, value = policy.controller(np.zeros((2, 69), np.float32))
    assert (mean.shape, value.shape) == ((2, 2), (2,))
    with pytest.raises(PolicyError, match="encoder is not known"):
        policy.act(*scans(1))


def test_as_released_is_noisy_under_its_seed(folder):
    def features(**options):
        policy = zoo.load("transformer_1d_zh.released", **options)
        policy.reset(batch_size=2)
        return policy.encode(*scans(2))

    calm = features()
    assert np.array_equal(calm, features())
    noisy = features(inference="as_released", seed=1)
    assert np.array_equal(noisy, features(inference="as_released", seed=1))
    assert not np.array_equal(noisy, features(inference="as_released", seed=2))
    assert np.allclose(noisy[:, :69], calm[:, :69], atol=1e-5), "z and robot state have no noise"
    assert np.abs(noisy[:, 69:] - calm[:, 69:]).max() > 0.05


def test_bad_inference_is_told():
    with pytest.raises(ConfigError, match="inference is 'sampled'"):
        zoo.load("e2e_1d.v1", inference="sampled")


def test_a_tampered_part_is_refused(folder, tmp_path):
    import shutil

    mine = tmp_path / "mine"
    mine.mkdir()
    for r in registry.with_parts(RUNS["transformer_1d_z.20201015"]):
        for f in r.files:
            shutil.copyfile(folder / f.path, mine / f.path.split("/")[-1])
    assert zoo.load("transformer_1d_z.20201015", mine).name == "transformer_1d_z.20201015"
    data = bytearray((mine / "navreptraingpt1d").read_bytes())
    data[len(data) // 2] ^= 4
    (mine / "navreptraingpt1d").write_bytes(data)
    with pytest.raises(CorruptDataError, match=r"navreptraingpt1d is not the file that transformer_1d\.released needs"):
        zoo.load("transformer_1d_z.20201015", mine)
    report = zoo.verify("transformer_1d*", source=mine)
    status = {c.name: c.status for c in report.checks}
    assert status["transformer_1d.released"] == "wrong"
    assert status["transformer_1d_z.20201015"] == "ok"
    assert not report.ok
    assert "transformer_1d_z.20201015" in report.cannot_run


def test_load_sb3_predicts_what_the_policy_does(folder):
    policy = zoo.load("transformer_1d_z.released")
    model = zoo.load_sb3("transformer_1d_z.released")
    policy.reset(batch_size=4)
    features = policy.encode(*scans(4))
    mean, _ = policy.controller(features)
    predicted, _ = model.predict(features, deterministic=True)
    assert np.allclose(predicted[:, :2], np.clip(mean, -1, 1), atol=1e-3)
