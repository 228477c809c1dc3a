"""NavRepDream-v0 for every architecture."""

import gymnasium
import numpy as np
import pytest
import torch

from navrep_data.datasets import SequenceDataset
from navrep_data.errors import ConfigError
from navrep_data.models import checkpoint
from navrep_data.testing import tiny_dataset
from navrep_data.zoo.dream import DreamEnv

SMALL = {
    "transformer": {
        "lidar": "1d",
        "z_size": 16,
        "n_blocks": 1,
        "n_heads": 2,
        "action_alignment": "taken",
        "residual": True,
    },
    "joint": {"lidar": "rings", "z_size": 8, "h_size": 16},
    "modular": {"lidar": "1d", "z_size": 8, "h_size": 16},
}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return tiny_dataset(tmp_path_factory.mktemp("data") / "tiny", n=3)


def make(kind):
    torch.manual_seed(0)
    return checkpoint.make(kind, SMALL[kind])


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(SMALL))
def test_dreams_are_seeded_and_keep_to_their_spaces(kind, dataset):
    env = gymnasium.make("navrep_data.zoo.dream:NavRepDream-v0", model=make(kind), data=dataset, temperature=0.5)
    runs = []
    for _ in range(2):
        obs, info = env.reset(seed=4)
        rows = [obs]
        for _ in range(40):
            obs, reward, terminated, truncated, info = env.step(np.array([0.5, -0.5, 0.0], np.float32))
            assert env.observation_space.contains(obs)
            assert np.isfinite(reward)
            rows.append(obs)
            if terminated or truncated:
                break
        assert info["dreamed"] == len(rows) - 1
        runs.append(rows)
    for a, b in zip(*runs, strict=True):
        assert all(np.array_equal(a[name], b[name]) for name in a)


@pytest.mark.slow
def test_the_first_frame_is_the_datasets_and_reward_is_metres_towards_the_goal(dataset):
    model = make("transformer")
    env = DreamEnv(model, dataset, real_rows=4)
    obs, info = env.reset(options={"start": 2})
    windows = SequenceDataset(dataset, "1d", window=4, scan_unit="normalized", invalid="range_max")
    k = [i for i in range(len(windows)) if windows[i]["mask"].all()][2]
    torch.testing.assert_close(
        torch.tensor(info["z"]), model.encode(windows[k]["scan"][-1]).detach(), rtol=1e-4, atol=1e-5
    )
    np.testing.assert_allclose(obs["robot_state"], windows[k]["robot_state"][-1].numpy(), rtol=1e-5)
    before = np.linalg.norm(obs["robot_state"][:2])
    obs, reward, terminated, *_ = env.step(np.zeros(3, np.float32))
    assert not terminated
    assert reward == pytest.approx(before - np.linalg.norm(obs["robot_state"][:2]), abs=1e-5)


def test_without_temperature_a_modular_dream_takes_the_likeliest_change(dataset):
    model = make("modular")
    env = DreamEnv(model, dataset)
    z = torch.tensor(env.reset(options={"start": 0})[1]["z"])
    action = np.array([0.5, 0.0, 0.0], np.float32)
    changed = torch.tensor(env.step(action)[4]["z"])
    with torch.no_grad():
        h, _ = model.hidden(env._z[:, :-1], env._goal[:, :-1], led_to(env))
    torch.testing.assert_close(changed, z + model.memory.mixture(h[0, -1]).likeliest()[: len(z)])


def led_to(env):
    """The actions that led to the rows before the dreamed one."""
    return torch.cat([torch.zeros(1, 1, 3), env._taken[:, :-1]], dim=1)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "delay"), [("transformer", 0), ("joint", 1)])
def test_an_action_acts_at_once_where_the_model_is_fed_the_one_taken(kind, delay, dataset):
    def second_row(first):
        env = DreamEnv(make(kind), dataset)
        env.reset(options={"start": 0})
        codes = [env.step(np.array([first, 0, 0], np.float32))[4]["z"]]
        codes.append(env.step(np.zeros(3, np.float32))[4]["z"])
        return codes

    a, b = second_row(1.0), second_row(-1.0)
    assert [np.array_equal(x, y) for x, y in zip(a, b, strict=True)] == [delay == 1, False]


@pytest.mark.slow
def test_reaching_the_goal_ends_the_dream_and_time_cuts_it(dataset):
    env = DreamEnv(make("transformer"), dataset, goal_radius=25.0)
    env.reset(seed=0)
    assert env.step(np.zeros(3, np.float32))[1:4] == (100.0, True, False)
    env = DreamEnv(make("transformer"), dataset, goal_radius=1e-6)
    env.reset(seed=0)
    ends = [env.step(np.zeros(3, np.float32))[2:4] for _ in range(175)]
    assert ends[-1] == (False, True)
    assert not any(any(end) for end in ends[:-1])


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(SMALL))
def test_pictures(kind, dataset):
    env = DreamEnv(make(kind), dataset, render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    env.step(np.ones(3, np.float32))
    assert first.shape == env.render().shape
    assert not np.array_equal(first, env.render())


def test_bad_input(dataset):
    for options, words in (
        ({"temperature": -1.0}, "temperature"),
        ({"real_rows": 40}, "real_rows"),
        ({"render_mode": "human"}, "render_mode"),
    ):
        with pytest.raises(ConfigError, match=words):
            DreamEnv(make("transformer"), dataset, **options)
    with pytest.raises(ConfigError, match="expected a world model"):
        DreamEnv(checkpoint.make("vae", {}), dataset)
    with pytest.raises(ConfigError, match="before reset"):
        DreamEnv(make("transformer"), dataset).step(np.zeros(3))
