"""Policies: the step-by-step golden files, batches, resets, refusals, and the same weights in stable-baselines3."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import oracles_models as oracles
import pytest
import torch
from recorded import golden

from navrep_data.errors import ArrayError, CheckpointError, ConfigError, PolicyError
from navrep_data.models import Controller, ControllerConfig, ModularWorldModel, VAEConfig, checkpoint
from navrep_data.models.observation import observation_from_scan
from navrep_data.models.vae import VAE
from navrep_data.policies import Driver, NetworkPolicy
from navrep_data.schema import SensorContract
from navrep_data.sim import DrivenRollout, RolloutSettings, make_config
from navrep_data.zoo.assemble import build
from navrep_data.zoo.importers import load_controller_zip, load_tf_json, load_torch_world_model
from navrep_data.zoo.policy import Policy

pytestmark = pytest.mark.slow  # seconds each; `make test` runs them

ENCODINGS = {"z": "V_ONLY", "zh": "VM", "h": "M_ONLY"}


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def made_up(tmp_path_factory):
    """M, and the modular world model for rings, of made-up weights."""
    tmp = tmp_path_factory.mktemp("made-up")
    m = oracles.write_integers(oracles.synthetic_integers(golden("synthetic_M"), "memory"), tmp / "m.json")
    v = oracles.write_integers(oracles.synthetic_integers(golden("synthetic_V_rings"), "vae_rings"), tmp / "v.json")
    memory = load_tf_json(m, "memory")
    return memory, ModularWorldModel.of(load_tf_json(v, "vae_rings"), memory)


@pytest.fixture(scope="module")
def world_models(made_up, released):
    """Encoder and memory of each ``encoder_*`` golden file."""
    models = released / "models"
    memory, rings = made_up
    return {
        "encoder_GPT1D_det": load_torch_world_model(models / "W" / "navreptraingpt1d"),
        "encoder_VAE1DLSTM_det": load_torch_world_model(models / "W" / "navreptrainvae1dlstm"),
        "encoder_VAE1D_LSTM": ModularWorldModel.of(load_tf_json(models / "V" / "navreptrainvae1d.json", None), memory),
        "encoder_VAE_LSTM": rings,
    }


MADE_UP = "encoder_VAE_LSTM"
ENCODERS = ["encoder_GPT1D_det", "encoder_VAE1DLSTM_det", "encoder_VAE1D_LSTM", MADE_UP]


def policy_of(world_model, features, seed=0, **options):
    """A policy with a controller of random weights."""
    torch.manual_seed(seed)
    n = 5 + ("z" in features) * world_model.z_size + ("h" in features) * world_model.h_size
    return Policy(Controller(ControllerConfig(n)), features, world_model.lidar, None, world_model, **options)


@pytest.mark.parametrize("features", ENCODINGS)
@pytest.mark.parametrize("name", [name for name in ENCODERS if name != MADE_UP])
def test_from_raw_scans_to_controller_inputs(world_models, name, features):
    check_inputs(policy_of(world_models[name], features), name, features)


@pytest.mark.parametrize("features", ENCODINGS)
def test_from_raw_scans_to_controller_inputs_with_made_up_weights(made_up, features):
    check_inputs(policy_of(made_up[1], features), MADE_UP, features)


def check_inputs(policy, name, features):
    g = golden(name)
    policy.reset(batch_size=2)
    for t in range(40):
        policy.observe(np.stack([g[f"seq{k}_actions"][t] for k in (0, 1)]))
        ours = policy.encode(*(np.stack([g[f"seq{k}_{w}"][t] for k in (0, 1)]) for w in ("scans", "robotstates")))
        theirs = np.stack([g[f"seq{k}_{ENCODINGS[features]}"][t] for k in (0, 1)])
        np.testing.assert_allclose(ours, theirs, atol=1e-4, rtol=0)


@pytest.mark.parametrize(
    ("encoder", "features", "stem"),
    [
        ("encoder_GPT1D_det", "z", "2020_09_16__23_54_21_PPO_GPT1D_V_ONLY_V64M64"),
        ("encoder_GPT1D_det", "h", "2020_10_15__12_11_47_PPO_GPT1D_M_ONLY_V64M64"),
        ("encoder_GPT1D_det", "zh", "2020_10_15__12_12_00_PPO_GPT1D_VM_V64M64"),
        ("encoder_VAE1DLSTM_det", "z", "2020_09_20__09_56_12_PPO_VAE1DLSTM_V_ONLY_V32M64"),
        ("encoder_VAE1DLSTM_det", "h", "2020_10_17__22_12_38_PPO_VAE1DLSTM_M_ONLY_V32M64"),
        ("encoder_VAE1DLSTM_det", "zh", "2020_10_17__22_15_08_PPO_VAE1DLSTM_VM_V32M64"),
        ("encoder_VAE1D_LSTM", "z", "2020_09_16__16_04_48_PPO_VAE1D_LSTM_V_ONLY_V32M512"),
    ],
)
def test_from_raw_scans_to_actions(released, world_models, encoder, features, stem):
    """Released encoder, memory and controller together, against what the original software did with these scans."""
    inputs = golden(encoder)
    g = golden(f"C_navreptrainencodedenv_{stem}_ckpt")
    model = world_models[encoder]
    gym = released / "models" / "gym"
    network = load_controller_zip(gym / f"navreptrainencodedenv_{stem}_ckpt.zip")
    policy = Policy(network, features, "1d", None, model, name=stem)
    for k in (0, 1):
        policy.reset(batch_size=1)
        largest = np.abs(g[f"encoder_seq{k}_action_mean"]).max()
        for t in range(40):
            scan, state = inputs[f"seq{k}_scans"][t : t + 1], inputs[f"seq{k}_robotstates"][t : t + 1]
            policy.observe(inputs[f"seq{k}_actions"][t : t + 1])
            mean, value = policy.controller(policy.encode(scan, state))
            np.testing.assert_allclose(mean[0], g[f"encoder_seq{k}_action_mean"][t], atol=1e-5 * largest, rtol=0)
            np.testing.assert_allclose(value[0], g[f"encoder_seq{k}_value"][t], atol=1e-4)
            np.testing.assert_allclose(mean[0].clip(-1, 1), g[f"encoder_seq{k}_action_clipped"][t], atol=1e-3)


def scenes(n, steps, seed=0):
    rng = np.random.default_rng(seed)
    walls = rng.uniform(1, 20, (steps, n, 1)) + np.sin(np.linspace(0, 6.28, 1080)) * rng.uniform(0, 0.9, (steps, n, 1))
    return walls.astype(np.float32).clip(0.1, 25), rng.normal(0, 2, (steps, n, 5)).astype(np.float32)


@pytest.mark.parametrize("features", ENCODINGS)
@pytest.mark.parametrize("name", ENCODERS)
def test_a_batch_acts_as_one_by_one(world_models, name, features):
    """36 steps, so that contexts fill up; two robots restart on the way."""
    policy = policy_of(world_models[name], features)
    scan, state = scenes(6, 36)
    restarts = {9: np.array([0, 1, 0, 0, 0, 0], bool), 20: np.array([0, 1, 0, 0, 1, 0], bool)}

    def run(robots):
        policy.reset(batch_size=len(robots))
        means = []
        for t in range(36):
            if t in restarts:
                policy.reset(mask=restarts[t][robots])
            features = policy.encode(scan[t, robots], state[t, robots])
            mean, _ = policy.controller(features)
            policy.observe(mean.clip(-1, 1))
            means.append(mean)
        return np.stack(means)

    together = run(np.arange(6))
    alone = np.concatenate([run(np.array([k])) for k in range(6)], axis=1)
    np.testing.assert_allclose(together, alone, atol=1e-5 * np.abs(together).max(), rtol=0)
    assert np.abs(together[1:] - together[:-1]).max() > 1e-3


def test_act_is_encode_controller_clip_and_observe(world_models):
    policy = policy_of(world_models["encoder_GPT1D_det"], "zh")
    torch.nn.init.normal_(policy.network.mean.weight, std=3.0)
    scan, state = scenes(4, 12)
    policy.reset(batch_size=4)
    acted = [policy.act(scan[t], state[t]) for t in range(12)]
    policy.reset(batch_size=4)
    for t in range(12):
        mean, value = policy.controller(policy.encode(scan[t], state[t]))
        executed = np.concatenate([mean.clip(-1, 1), np.zeros((4, 1), np.float32)], axis=1)
        policy.observe(executed[:, :2])
        np.testing.assert_array_equal(acted[t], executed)
        assert value.shape == (4,)
    assert acted[0].dtype == np.float32
    assert np.any(np.abs(acted) < 1)
    assert np.any(np.abs(acted) == 1)


def test_what_was_executed_changes_h_and_not_z(world_models):
    policy = policy_of(world_models["encoder_GPT1D_det"], "zh")
    scan, state = scenes(2, 2)
    seen = []
    for executed in (np.zeros((2, 2)), np.array([[1, 0], [0, -1.0]])):
        policy.reset(batch_size=2)
        policy.encode(scan[0], state[0])
        policy.observe(executed)
        seen.append(policy.encode(scan[1], state[1]))
    np.testing.assert_array_equal(seen[0][:, :69], seen[1][:, :69])
    assert np.abs(seen[0][:, 69:] - seen[1][:, 69:]).max() > 1e-3


def test_h_after_the_context_is_full_needs_no_eyes(world_models):
    """The shortcut of h policies: nothing is encoded any more, and nothing changes by that."""
    fast = policy_of(world_models["encoder_GPT1D_det"], "h")
    full = policy_of(world_models["encoder_GPT1D_det"], "zh")
    scan, state = scenes(3, 36)
    for policy in (fast, full):
        policy.reset(batch_size=3)
    calls = []
    fast._encoder.register_forward_hook(lambda *_: calls.append(1))
    for t in range(36):
        for policy in (fast, full):
            policy.observe(np.full((3, 2), 0.1 * (t % 5)))
        h = fast.encode(scan[t], state[t])
        np.testing.assert_allclose(h, full.encode(scan[t], state[t])[:, 64:], atol=1e-6)
    assert len(calls) == 32
    fast.reset(mask=np.array([True, False, False]))
    fast.encode(scan[0], state[0])
    assert len(calls) == 33


def test_as_released_is_noisy_under_its_seed(world_models):
    scan, state = scenes(2, 4)

    def run(seed, name):
        policy = policy_of(world_models[name], "zh", inference="as_released")
        policy.reset(batch_size=2, seed=seed)
        return np.stack([policy.encode(scan[t], state[t]) for t in range(4)])

    for name, z in (("encoder_GPT1D_det", 64), ("encoder_VAE1DLSTM_det", 32)):
        first, other = run(1, name), run(2, name)
        np.testing.assert_array_equal(first, run(1, name))
        np.testing.assert_array_equal(first[..., : z + 5], other[..., : z + 5])
        assert np.abs(first - other).max() > 1e-3
    np.testing.assert_array_equal(run(1, "encoder_VAE1D_LSTM"), run(2, "encoder_VAE1D_LSTM"))


def test_bf16_moves_features_little(world_models):
    for name in ("encoder_GPT1D_det", "encoder_VAE_LSTM"):
        scan, state = scenes(8, 1)
        exact = policy_of(world_models[name], "z").encode(scan[0], state[0])[:, :-5]
        rounded = policy_of(world_models[name], "z", dtype="bfloat16").encode(scan[0], state[0])[:, :-5]
        difference = np.abs(exact - rounded).max() / np.abs(exact).max()
        assert 0 < difference < 0.03
        assert rounded.dtype == np.float32


def test_tensors_give_tensors(world_models):
    policy = policy_of(world_models["encoder_VAE_LSTM"], "z")
    scan, state = scenes(3, 1)
    from_numpy = policy.act(scan[0], state[0])
    from_torch = policy.act(torch.tensor(scan[0]), torch.tensor(state[0]))
    assert isinstance(from_torch, torch.Tensor)
    assert not from_torch.requires_grad
    np.testing.assert_array_equal(from_numpy, from_torch)
    read_only = scan[0].copy()
    read_only.flags.writeable = False
    np.testing.assert_array_equal(policy(read_only, state[0]), from_numpy)
    np.testing.assert_array_equal(scan, scenes(3, 1)[0])


def test_a_policy_without_memory_takes_any_number_of_robots(world_models):
    policy = policy_of(world_models["encoder_GPT1D_det"], "z")
    for n in (3, 1, 5):
        scan, state = scenes(n, 1)
        assert policy.act(scan[0], state[0]).shape == (n, 3)


# --- refusals ---------------------------------------------------------------------------------------------------


@pytest.fixture
def small():
    torch.manual_seed(0)
    return Policy(Controller(ControllerConfig(37)), "z", "1d", VAE(VAEConfig("1d", 32)), name="small_1d_z.test")


def test_scans_of_another_contract_are_refused(small):
    good, state = (x[0] for x in scenes(2, 1))
    millimetres = (good * 1000).astype(np.uint16)
    holes = good.copy()
    holes[0, 5] = np.nan
    behind = good.copy()
    behind[1, 7] = -np.inf
    for bad in (good[:, :720], good[0], holes, behind, -good, good * 1000, np.zeros((0, 1080), np.float32)):
        for take in (small.act, small.encode, small.look):
            with pytest.raises(ArrayError, match=r"ScanAdapter|at least one row"):
                take(bad, state)
    with pytest.raises(ArrayError, match=r"expected 0 to 1000 m, with 25 or more \(or inf\) where nothing is hit"):
        small.act(good * 1000, state)
    with pytest.raises(ArrayError, match="metres_from_millimetres"):
        small.act(millimetres, state)
    with pytest.raises(ConfigError, match=r"small_1d_z\.test takes scans with n_rays = 1080, got 720.*ScanAdapter"):
        small.check_sensor(SensorContract(n_rays=720))
    small.check_sensor(SensorContract())


@pytest.mark.parametrize("ranges", ["contract", "as_released"])
def test_infinite_ranges_are_rays_that_hit_nothing(small, ranges):
    scan, state = (x[0] for x in scenes(2, 1))
    scan[0, 5:9] = 25.0
    endless = scan.copy()
    endless[0, 5:9] = np.inf
    policy = Policy(small.network, "z", "1d", small.vae, ranges=ranges)
    for take in (policy.act, policy.encode, lambda *rows: policy.look(*rows)[0]):
        np.testing.assert_array_equal(take(endless, state), take(scan, state))
    assert np.isinf(endless[0, 5]), "what was given stays as it was"


def test_other_arrays_are_refused(small, world_models):
    scan, state = (x[0] for x in scenes(2, 1))
    for bad in (state[:1], state[:, :3], np.full_like(state, np.nan)):
        with pytest.raises(ArrayError, match="robot_state has shape"):
            small.act(scan, bad)
    with pytest.raises(ArrayError, match=r"expected \(B, 37\)"):
        small.controller(np.zeros((2, 36), np.float32))
    policy = policy_of(world_models["encoder_GPT1D_det"], "zh")
    policy.reset(batch_size=2)
    with pytest.raises(PolicyError, match=r"call reset\(batch_size=1\)"):
        policy.act(scan[:1], state[:1])
    with pytest.raises(PolicyError, match=r"expected bool of shape \(2,\)"):
        policy.reset(mask=np.array([True]))
    with pytest.raises(PolicyError, match="batch_size is 0"):
        policy.reset(batch_size=0)
    with pytest.raises(PolicyError, match="one row per robot"):
        policy.observe(np.zeros((3, 2)))


def test_parts_that_do_not_belong_together_are_refused(world_models):
    gpt = world_models["encoder_GPT1D_det"]
    with pytest.raises(CheckpointError, match="has 37 inputs, expected 69"):
        Policy(Controller(ControllerConfig(37)), "z", "1d", gpt.vae)
    with pytest.raises(CheckpointError, match="is for rings, its V for 1d"):
        Policy(Controller(ControllerConfig(69)), "z", "rings", gpt.vae)
    with pytest.raises(ConfigError, match="expected a world model for its memory"):
        Policy(Controller(ControllerConfig(69)), "h", "1d", gpt.vae)
    with pytest.raises(ConfigError, match="expected one of: deterministic, as_released"):
        Policy(Controller(ControllerConfig(69)), "z", "1d", gpt.vae, inference="noisy")
    with pytest.raises(ConfigError, match="expected one of: float32, bfloat16"):
        Policy(Controller(ControllerConfig(69)), "z", "1d", gpt.vae, dtype="float16")


def test_a_controller_without_eyes_still_controls(released):
    name = "navreptrainencodedenv_2020_08_26__15_48_33_PPO_ckpt"
    record = {"name": "x", "kind": "controller", "format": "sb2-zip", "features": "z", "lidar": None, "sensor": None}
    path = released / "models" / "gym" / f"{name}.zip"
    policy = build(record, {"a": path}, {})
    g = golden(f"C_{name}")
    mean, _ = policy.controller(g["obs"])
    np.testing.assert_allclose(mean, g["action_mean"], atol=1e-5 * np.abs(g["action_mean"]).max())
    with pytest.raises(PolicyError, match="its encoder is not known"):
        policy.act(*(x[0] for x in scenes(1, 1)))


def test_files_that_are_mixed_up_are_refused(released):
    models = released / "models"
    record = {"name": "x", "kind": "world_model", "format": None, "lidar": "rings", "z_size": 64, "h_size": 64}
    with pytest.raises(CheckpointError, match="x has lidar 1d, expected rings"):
        build(record, {"a": models / "W" / "navreptraingpt1d"}, {})
    with pytest.raises(CheckpointError, match="x is a VAE, expected a WorldModel"):
        build(record, {"a": models / "V" / "navreptrainvae1d.json"}, {})
    with pytest.raises(CheckpointError, match="needs its part 'vae'"):
        build({**record, "name": "y"}, {}, {})


# --- end to end, and in the package's own loops -------------------------------------------------------------------


def test_end_to_end_inputs_are_metres_and_rings_as_measured():
    g = golden("rings")
    scans = g["scans"].clip(0, 25)
    assert np.array_equal(scans, g["scans"])
    state = np.random.default_rng(0).normal(size=(len(scans), 5)).astype(np.float32)
    torch.manual_seed(0)
    for lidar, expected in (("1d", scans), ("rings", g["rings_obs_e2e"].reshape(len(scans), -1))):
        policy = Policy(checkpoint.make("e2e", {"lidar": lidar}), None, lidar)
        inputs = policy.encode(scans, state)
        np.testing.assert_array_equal(inputs, np.concatenate([expected, state], axis=1))
        mean, _ = policy.controller(inputs)
        np.testing.assert_allclose(policy.act(scans, state)[:, :2], mean.clip(-1, 1), atol=1e-5)
    near = scans[:1].copy()
    near[0, :40] = 0.2  # in the nearest cell, which only the end-to-end networks see
    assert policy.encode(near, state[:1])[0, 0] == 1.0
    other = policy_of(checkpoint.make("joint", {"lidar": "rings"}), "z")
    assert observation_from_scan(near, "rings")[0, 0, 0] == 0.0
    assert other.encode(near, state[:1]).shape == (1, 37)


def test_a_policy_rolls_out_sequences_reproducibly(world_models):
    config = make_config("soadrl")
    policy = policy_of(world_models["encoder_VAE1DLSTM_det"], "zh", inference="as_released")
    torch.nn.init.normal_(policy.network.mean.weight, std=2.0)
    runs = []
    for _ in range(2):
        rollout = DrivenRollout(config, RolloutSettings(length=30), Driver(NetworkPolicy(policy, 4)), seed=3, batch=4)
        runs.append([columns for columns, _ in rollout.run([0, 1])])
    for first, second in zip(*runs, strict=True):
        for name, column in first.items():
            np.testing.assert_array_equal(column, second[name])
        assert np.abs(first["action"][:, :2]).max() <= 1.0
        assert np.ptp(first["action"][:, 0]) > 0


@pytest.mark.slow
def test_the_control_loop_of_the_examples_reaches_its_goal(released):
    root = Path(__file__).resolve().parents[2]
    command = [sys.executable, str(root / "examples" / "control_loop.py"), "--source", str(released)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("e2e_1d.")
    assert "goal after" in done.stdout
