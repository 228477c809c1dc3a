"""PPO on groups of worlds: the rollouts are what the worlds gave, the update is stable-baselines3's."""

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import CallbackList
from test_controllers import world_model

from navrep_data.train import learner
from navrep_data.train.controller_recipe import default_controller_recipe, environment
from navrep_data.train.ppo import GroupedPPO, log_density
from navrep_data.train.worlds import TrainingWorlds, WorldGroups
from navrep_data.zoo.sb3 import BoundedPolicy

WORLDS, ROLLOUT = 12, 30
RECIPE = default_controller_recipe("z", "1d").replace(
    worlds=WORLDS, rollout=ROLLOUT, batch=WORLDS * ROLLOUT, precision="float32", entropy=0.02, target_kl=0.0, epochs=3
)


def worlds_of(network, model, n_groups, truncate=True):
    def make(n_worlds, first_sequence):
        policy = learner.make_policy(RECIPE, network, model)
        return TrainingWorlds(
            environment(RECIPE), policy, n_worlds, seed=4, first_sequence=first_sequence, max_speed=1.0,
            reward_scale=0.1, progress=2.0, truncate=truncate,
        )  # fmt: skip

    return WorldGroups(make, WORLDS, n_groups)


@pytest.fixture(scope="module")
def parts():
    model = world_model()
    return learner.make_network(RECIPE, model), model


def started(parts, n_groups, rollout=ROLLOUT):
    network, model = parts
    recipe = RECIPE.replace(rollout=rollout, batch=WORLDS * rollout)
    ppo = learner.make_ppo(recipe, worlds_of(network, model, n_groups), network, "cpu")
    assert isinstance(ppo, GroupedPPO)
    ppo._last_obs = ppo.env.reset()
    ppo._last_episode_starts = np.ones(WORLDS, bool)
    return ppo


def collect(ppo):
    callback = CallbackList([])
    callback.init_callback(ppo)
    torch.manual_seed(3)
    assert ppo.collect_rollouts(ppo.env, callback, ppo.rollout_buffer, ppo.n_steps)
    return ppo.rollout_buffer


@pytest.mark.slow
def test_a_rollout_is_what_the_worlds_gave(parts):
    """Replayed through VecEnv's calls: same observations, rewards and ends, and truncations that are bootstrapped."""
    ppo = started(parts, 3, 200)  # long enough for timeouts: the untrained policy hardly arrives
    buffer = collect(ppo)
    assert ppo.num_timesteps == WORLDS * 200
    assert buffer.full
    replay = worlds_of(*parts, 1)
    obs, starts, cut = replay.reset(), np.ones(WORLDS, bool), 0
    for t in range(200):
        np.testing.assert_allclose(buffer.observations[t], obs, atol=1e-4)
        np.testing.assert_array_equal(buffer.episode_starts[t], starts)
        values, log_prob, _ = ppo.policy.evaluate_actions(
            torch.from_numpy(buffer.observations[t]), torch.from_numpy(buffer.actions[t])
        )
        np.testing.assert_allclose(buffer.values[t], values.detach().flatten(), atol=1e-5)
        np.testing.assert_allclose(buffer.log_probs[t], log_prob.detach(), atol=1e-4)
        replay.step_async(buffer.actions[t])
        obs, rewards, starts, infos = replay.step_wait()
        for world, info in enumerate(infos):
            if info.get("TimeLimit.truncated"):
                cut += 1
                end = torch.from_numpy(info["terminal_observation"][None])
                rewards[world] += ppo.gamma * float(ppo.policy.predict_values(end).detach())
        np.testing.assert_allclose(buffer.rewards[t], rewards, atol=1e-4)
    assert cut > 0
    np.testing.assert_allclose(ppo._last_obs, obs, atol=1e-4)
    np.testing.assert_array_equal(ppo._last_episode_starts, starts)


@pytest.mark.slow
def test_a_rollout_does_not_depend_on_the_groups(parts):
    torch.manual_seed(0)
    whole, split = started(parts, 1), started(parts, 3)
    split.policy.load_state_dict(whole.policy.state_dict())
    one, other = collect(whole), collect(split)
    for name in ("observations", "actions", "rewards", "values", "log_probs", "advantages", "returns"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-3, err_msg=name)
    assert np.std(one.actions - one.actions.mean(), axis=1).min() > 0.1  # every world draws its own noise


@pytest.mark.slow
def test_an_update_is_that_of_stable_baselines3(parts):
    ours = started(parts, 2)
    buffer = collect(ours)
    theirs = PPO(
        BoundedPolicy, worlds_of(*parts, 1), n_steps=ROLLOUT, batch_size=RECIPE.batch, n_epochs=RECIPE.epochs,
        learning_rate=RECIPE.lr, ent_coef=RECIPE.entropy, vf_coef=RECIPE.value_weight, device="cpu",
        max_grad_norm=RECIPE.max_grad_norm, policy_kwargs=ours.policy_kwargs,
    )  # fmt: skip
    theirs.policy.load_state_dict(ours.policy.state_dict())
    theirs.rollout_buffer.reset()
    for name in ("observations", "actions", "rewards", "values", "log_probs", "advantages", "returns"):
        setattr(theirs.rollout_buffer, name, getattr(buffer, name).copy())
    theirs.rollout_buffer.full = True
    before = {name: value.clone() for name, value in ours.policy.state_dict().items()}
    for ppo in (ours, theirs):
        ppo._setup_learn(1, None)
        ppo.train()
    for name, value in ours.policy.state_dict().items():
        assert not torch.equal(value, before[name]), name
        torch.testing.assert_close(value, theirs.policy.state_dict()[name], atol=2e-6, rtol=1e-4)
    mine, other = ours.logger.name_to_value, theirs.logger.name_to_value
    for name in ("policy_gradient_loss", "value_loss", "clip_fraction", "explained_variance"):
        assert mine[f"train/{name}"] == pytest.approx(float(other[f"train/{name}"]), abs=1e-5), name


def test_an_update_stops_where_the_policy_moved_too_far(parts):
    ppo = started(parts, 1)
    collect(ppo)
    ppo._setup_learn(1, None)
    ppo.target_kl, ppo.batch_size, ppo.n_epochs = 1e-9, 36, 5
    steps = []
    take = ppo.policy.optimizer.step
    ppo.policy.optimizer.step = lambda: (steps.append(0), take())
    ppo.train()
    assert 1 <= len(steps) < 10  # of 50


def test_log_density_is_that_of_a_normal_distribution():
    torch.manual_seed(0)
    actions, mean, log_width = torch.randn(5, 2), torch.randn(5, 2), torch.tensor([-1.0, 0.3])
    expected = torch.distributions.Normal(mean, log_width.exp()).log_prob(actions).sum(1)
    torch.testing.assert_close(log_density(actions, mean, log_width), expected)
