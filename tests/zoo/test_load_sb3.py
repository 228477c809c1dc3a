"""Controllers of the zoo go on learning in stable-baselines3, in any NavRep environment."""

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO

from navrep_data import zoo
from navrep_data.envs import NavRepEnv, NavRepVectorEnv, make_sb3_vec
from navrep_data.errors import ConfigError
from navrep_data.models import Controller, ControllerConfig, EndToEnd, EndToEndConfig, checkpoint
from navrep_data.schema import SensorContract
from navrep_data.zoo.policy import Policy
from navrep_data.zoo.sb3 import ControllerPPO, to_sb3
from navrep_data.zoo.sb3_worlds import ControllerWorlds

SMALL = {"humans": 1, "obstacles": 1, "time_limit": 2.0}
FEW = {"n_steps": 16, "n_epochs": 2}


def with_memory():
    torch.manual_seed(0)
    settings = {"lidar": "1d", "z_size": 16, "n_blocks": 1, "n_heads": 2, "action_alignment": "taken"}
    model = checkpoint.make("transformer", settings).eval()
    return Policy(Controller(ControllerConfig(16 + 5 + 16, squash="tanh", max_speed=1.0)), "zh", "1d", None, model)


def end_to_end(lidar):
    torch.manual_seed(0)
    return Policy(EndToEnd(EndToEndConfig(lidar)), None, lidar, name=f"e2e_{lidar}")


def weights(model):
    return [p.detach().clone() for p in model.policy.parameters()]


def moved(before, model):
    return any(not torch.equal(a, b) for a, b in zip(before, model.policy.parameters(), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["transformer_rings_z.v1", "joint_1d_z.v1", "e2e_1d.v1"])
def test_a_shipped_controller_learns_and_is_saved_by_stable_baselines3(name, tmp_path):
    model = zoo.load_sb3(name, env="navrep-train", n_envs=4, device="cpu", **FEW)
    assert (model.n_envs, model.batch_size) == (4, 16)
    vae = model.driver.vae
    encoder = [] if vae is None else [p.clone() for p in vae.parameters()]
    before = weights(model)
    model.learn(256)
    assert model.num_timesteps == 256
    assert moved(before, model)
    assert all(torch.equal(a, b) for a, b in zip(encoder, vae.parameters() if vae else [], strict=True))
    model.save(tmp_path / "ppo.zip")
    features = model.env.reset()
    for kind in (ControllerPPO, PPO):
        again = kind.load(tmp_path / "ppo.zip", env=model.env, device="cpu")
        mine, theirs = (one.predict(features, deterministic=True)[0] for one in (model, again))
        np.testing.assert_array_equal(mine, theirs)
        kept = weights(again)
        again.learn(64)
        assert moved(kept, again)


@pytest.mark.slow
@pytest.mark.parametrize("lidar", ["rings", "1d"])
def test_end_to_end_networks_learn(lidar):
    model = to_sb3(end_to_end(lidar), "navrep-train", n_envs=2, **FEW)
    before = weights(model)
    model.learn(64)
    assert moved(before, model)


@pytest.mark.slow
def test_any_navrep_environment_can_be_set(tmp_path):
    """What used to fail: actions of three numbers, and another number of worlds than 6."""
    model = to_sb3(with_memory(), **FEW)
    with pytest.raises(ConfigError, match=r"no environment to learn in: load_sb3\(NAME, env='navrep-train'\)"):
        model.learn(16)
    made = [
        NavRepEnv("navrep-test", **SMALL), NavRepVectorEnv(2, "navrep-test", **SMALL),
        make_sb3_vec("navrep-test", 3, **SMALL), "navrep-test",
    ]  # fmt: skip
    for env, n in zip(made, (1, 2, 3, 3), strict=True):
        model.set_env(env)
        assert model.n_envs == n
        before = weights(model)
        model.learn(16 * n)
        assert moved(before, model)


@pytest.mark.slow
def test_observations_are_the_features_of_what_was_driven():
    """Replayed by the policy itself: memory fed the velocities that were executed, cleared where episodes start."""
    policy, other = with_memory(), with_memory()
    settings = {**SMALL, "max_velocity": (0.5, 0.5, 1.0)}
    worlds = ControllerWorlds(make_sb3_vec("navrep-test", 3, seed=1000, **settings), policy)
    plain = make_sb3_vec("navrep-test", 3, seed=1000, **settings)
    features, seen = worlds.reset(), plain.reset()
    other.reset(batch_size=3)
    np.testing.assert_array_equal(features, other.encode(seen["scan"], seen["robot_state"]))
    rng, cut = np.random.default_rng(0), 0
    for _ in range(24):
        actions = rng.uniform(-1.5, 1.5, (3, 2)).astype(np.float32)
        clipped = actions.clip(-1.0, 1.0)
        shortened = clipped / np.maximum(1.0, np.linalg.norm(clipped, axis=1, keepdims=True))
        features, rewards, done, infos = worlds.step(actions)
        seen, expected, over, plain_infos = plain.step(np.pad(shortened, ((0, 0), (0, 1))))
        np.testing.assert_allclose(rewards, expected, atol=1e-6)
        np.testing.assert_array_equal(done, over)
        for i in np.flatnonzero(done):
            last = plain_infos[i]["terminal_observation"]
            look = other.look(last["scan"][None], last["robot_state"][None])[0][0]
            np.testing.assert_allclose(infos[i]["terminal_observation"][: len(look)], look, atol=1e-6)
            cut += infos[i]["TimeLimit.truncated"]
        other.observe(0.5 * shortened)
        if done.any():
            other.reset(mask=done)
        np.testing.assert_allclose(features, other.encode(seen["scan"], seen["robot_state"]), atol=1e-6)
    assert cut > 0


def test_what_does_not_fit_is_said_in_one_line():
    policy = end_to_end("1d")
    with pytest.raises(ConfigError, match=r"e2e_1d cannot be trained in .* Box.*expected Dict"):
        to_sb3(policy, make_sb3_vec("navrep-test", 2, flat=True, **SMALL))
    slower = make_sb3_vec("navrep-test", 2, sensor=SensorContract(dt=0.1), **SMALL)
    with pytest.raises(ConfigError, match=r"sensor.dt is 0.1, but this memory was trained with steps of 0.2 s"):
        to_sb3(with_memory(), slower)
    with pytest.raises(ConfigError, match="env is a int, expected a name"):
        to_sb3(policy, 3)
