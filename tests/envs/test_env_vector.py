"""The vectorised environment: single stepping bit for bit, automatic resets, gymnasium's infos."""

import gymnasium
import numpy as np
import pytest
import torch
from env_cases import CASES, KINDS, is_numbered, labelled, make, make_vec, param, same
from gymnasium.vector import AutoresetMode

from navrep_data.envs import NavRepEnv, NavRepVectorEnv
from navrep_data.errors import ConfigError
from navrep_data.policies import to_goal
from navrep_data.schema import Event

STEPS = 60


def actions_of(rng, env):
    """Return fast actions that mostly go one way, so that episodes end."""
    shape = env.action_space.shape
    return np.clip(
        rng.uniform(-1.0, 1.0, shape) + np.linspace(-1.0, 1.0, shape[0]).reshape(-1, *[1] * (len(shape) - 1)), -1, 1
    )


@pytest.mark.slow
@pytest.mark.parametrize(("env", "physics"), CASES)
@pytest.mark.parametrize("n", [1, 4])
def test_equals_single_stepping_bit_for_bit(env, physics, n):
    """World i: seed + i; later episodes of numbered environments step by n."""
    vector = make_vec(env, n, physics=physics, time_limit=6.0)
    singles = [make(env, physics=physics, time_limit=6.0, pad_humans=True) for _ in range(n)]
    plays = [90 + i for i in range(n)]
    observations, infos = vector.reset(seed=90)
    infos = labelled(infos, vector.config)
    rng, ended = np.random.default_rng(0), 0
    first = [single.reset(seed=seed) for single, seed in zip(singles, plays, strict=True)]
    for i, (observation, info) in enumerate(first):
        assert same(observation, {k: v[i] for k, v in observations.items()})
        assert all(np.array_equal(infos[k][i], info[k], equal_nan=k == "humans") for k in info)
    for _ in range(STEPS):
        actions = actions_of(rng, vector)
        observations, rewards, terminations, truncations, infos = vector.step(actions)
        infos = labelled(infos, vector.config)
        for i, single in enumerate(singles):
            observation, reward, terminated, truncated, info = single.step(actions[i])
            assert (rewards[i], terminations[i], truncations[i]) == (reward, terminated, truncated)
            if terminated or truncated:
                ended += 1
                assert infos["_final_obs"][i]
                assert infos["_final_info"][i]
                assert same(infos["final_obs"][i], observation)
                assert all(np.array_equal(infos["final_info"][k][i], info[k], equal_nan=k == "humans") for k in info)
                plays[i] += n
                observation, info = single.reset(**({"seed": plays[i]} if is_numbered(env) else {}))
            elif "final_obs" in infos:
                assert infos["final_obs"][i] is None
                assert not infos["_final_info"][i]
            assert same(observation, {k: v[i] for k, v in observations.items()})
            assert all(np.array_equal(infos[k][i], info[k], equal_nan=k == "humans") for k in info)
    # the released software knows no time limit with several robots
    assert ended >= n or (env.startswith("crowdmove") and physics == "original")


@pytest.mark.slow
@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
@pytest.mark.parametrize("env", ["navrep-train", "soadrl"])
def test_infos_are_those_of_gymnasiums_own_vector_environment(env, mode):
    """Keys, masks, dtypes and fillers, recursively, but for labels: strings there, codes here."""
    ours = make_vec(env, 3, time_limit=4.0, autoreset_mode=mode)
    theirs = gymnasium.make_vec(
        "NavRepTrain-v0" if env == "navrep-train" else "SOADRL-v0",
        num_envs=3, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode},
        pad_humans=True, time_limit=4.0,
    )  # fmt: skip
    assert ours.single_observation_space == theirs.single_observation_space
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.metadata["autoreset_mode"] is mode
    a, b = ours.reset(seed=5), theirs.reset(seed=5)
    assert same(a[0], b[0])
    assert same(labelled(a[1], ours.config), b[1])
    rng, ends = np.random.default_rng(1), 0
    for _ in range(50):
        actions = rng.uniform(-1.0, 1.0, (3, 3)).astype(np.float32)
        a, b = ours.step(actions), theirs.step(actions)
        ends += int((a[2] | a[3]).sum())
        assert ("final_obs" in a[4]) == ((a[2] | a[3]).any() and mode is AutoresetMode.SAME_STEP)
        for x, y in zip(a[:4], b[:4], strict=True):
            assert same(x, y)
        assert same(labelled(a[4], ours.config), b[4])
    assert ends > 2


@pytest.mark.slow
@pytest.mark.parametrize("env", ["navrep-train", "navrep-test", param("ian")])
def test_episodes_are_the_same_in_every_autoreset_mode(env):
    modes = ["SameStep", "NextStep", "Disabled"]
    starts = {}
    for mode in modes:
        vector = make_vec(env, 3, autoreset_mode=mode, time_limit=2.0)
        observations, _ = vector.reset(seed=11)
        found = [[row.tobytes()] for row in observations["robot_state"]]
        actions, waiting = np.full((3, 3), 0.4), np.zeros(3, bool)
        for _ in range(36):
            observations, _, terminations, truncations, infos = vector.step(actions)
            done = terminations | truncations
            fresh = waiting if mode == "NextStep" else done
            if mode == "Disabled" and done.any():
                with pytest.raises(gymnasium.error.ResetNeeded, match=r"have ended: call reset\(options="):
                    vector.step(actions)
                observations, infos = vector.reset(options={"reset_mask": done})
            for i in np.flatnonzero(fresh):
                found[i].append(observations["robot_state"][i].tobytes())
            assert infos["event"].dtype == np.uint8
            assert (infos["event"][fresh] == 0).all()
            waiting = done
        starts[mode] = [one[:3] for one in found]
    assert all(len(one) == 3 for one in starts["NextStep"])
    assert starts["SameStep"] == starts["NextStep"] == starts["Disabled"]


def test_a_world_that_waits_is_left_alone():
    """In NEXT_STEP mode an episode ends on other steps in each world; the others' steps do not move it."""
    vector = make_vec("soadrl", 4, autoreset_mode="NextStep", time_limit=3.0)
    singles = [make("soadrl", pad_humans=True, time_limit=3.0) for _ in range(4)]
    vector.reset(seed=3)
    for i, single in enumerate(singles):
        single.reset(seed=3 + i)
    rng, waiting = np.random.default_rng(2), np.zeros(4, bool)
    for _ in range(40):
        actions = rng.uniform(-1.0, 1.0, (4, 3))
        observations, rewards, terminations, truncations, _ = vector.step(actions)
        for i, single in enumerate(singles):
            if waiting[i]:
                expected = (single.reset()[0], 0.0, False, False)
            else:
                expected = single.step(actions[i])[:4]
            assert same({k: v[i] for k, v in observations.items()}, expected[0])
            assert (rewards[i], terminations[i], truncations[i]) == expected[1:]
        waiting = terminations | truncations


def test_episodes_can_be_cut_after_some_steps():
    vector = make_vec("navrep-test", 2, max_episode_steps=3, humans=0, obstacles=0)
    assert vector.spec.max_episode_steps == 3
    vector.reset(seed=0)
    events = []
    for _ in range(6):
        _, _, terminations, truncations, infos = vector.step(np.zeros((2, 3)))
        assert not terminations.any()
        events.append(infos["final_info"]["event"].tolist() if truncations.any() else None)
    assert events == [None, None, [Event.CUT] * 2] * 2


def test_numbered_episodes_are_shared_out_and_wrap():
    env = make_vec("navrep-test", 3, episode=499, time_limit=0.4, humans=0, obstacles=0)
    _, infos = env.reset()
    assert infos["seed"].tolist() == [1499, 1000, 1001]
    seen = [infos["seed"]]
    for _ in range(8):
        infos = env.step(np.zeros((3, 3)))[4]
        if "final_info" in infos:
            assert infos["final_info"]["event"].tolist() == [Event.TIMEOUT] * 3
            assert infos["final_info"]["seed"].tolist() == seen[-1].tolist()
            seen.append(infos["seed"])
    assert [s.tolist() for s in seen[1:3]] == [[1002, 1003, 1004], [1005, 1006, 1007]]
    assert env.reset(options={"episode": 498})[1]["seed"].tolist() == [1498, 1499, 1000]


@pytest.mark.slow
@pytest.mark.parametrize(("env", "physics"), CASES)
def test_same_seed_same_episodes_whatever_the_batch(env, physics):
    few, many = make_vec(env, 2, physics=physics), make_vec(env, 5, physics=physics)
    for seed in (3, 800):
        a, b = few.reset(seed=seed)[0], many.reset(seed=seed)[0]
        assert same(a, {k: v[:2] for k, v in b.items()})
        assert not np.array_equal(a["robot_state"][0], a["robot_state"][1])


def test_some_worlds_can_be_reset_alone():
    env = NavRepVectorEnv(3, "navrep-train")
    before, _ = env.reset(seed=[4, None, 9])
    assert same(env.reset(seed=[4, None, 9])[0]["scan"][2], before["scan"][2])
    for _ in range(5):
        moved, *_ = env.step(np.full((3, 3), 0.5))
    mask = np.array([False, True, False])
    after, _ = env.reset(seed=[None, 4, None], options={"reset_mask": mask})
    assert same(after["scan"][1], before["scan"][0])
    assert same(after["scan"][[0, 2]], moved["scan"][[0, 2]])


def test_returned_arrays_are_the_callers():
    env = NavRepVectorEnv(2, "navrep-test")
    observations, infos = env.reset(seed=1)
    kept = observations["scan"].copy()
    for _ in range(3):
        env.step(to_goal(observations["robot_state"]))
    assert same(observations["scan"], kept)
    infos["robot"][:] = np.nan
    assert np.isfinite(env.step(np.zeros((2, 3)))[4]["robot"]).all()


def test_pictures_of_all_worlds():
    env = make_vec("navrep-test", 2, render_mode="rgb_array")
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.render()
    env.reset(seed=0)
    env.step(np.zeros((2, 3)))
    frames = env.render()
    single = NavRepEnv("navrep-test", render_mode="rgb_array")
    single.reset(seed=1)
    single.step(np.zeros(3))
    assert same(frames[1], single.render())
    assert make_vec("navrep-test", 2).render() is None


def test_wrong_calls_say_so_in_one_line():
    env = NavRepVectorEnv(2, "navrep-test")
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros((2, 3)))
    with pytest.raises(ConfigError, match="3 seeds were given, expected one number or 2 of them"):
        env.reset(seed=[1, 2, 3])
    with pytest.raises(ConfigError, match="reset_mask has shape"):
        env.reset(options={"reset_mask": np.zeros(2, bool)})
    with pytest.raises(ConfigError, match="render_mode is 'human', expected one of: rgb_array"):
        NavRepVectorEnv(2, "navrep-test", render_mode="human")
    with pytest.raises(ConfigError, match="num_envs is 0"):
        NavRepVectorEnv(0)
    with pytest.raises(ConfigError, match=r"autoreset_mode is 'NextSteps', expected one of: .*mean 'NextStep'"):
        NavRepVectorEnv(1, autoreset_mode="NextSteps")
    with pytest.raises(ConfigError, match="max_episode_steps is 0, expected a whole number of at least 1"):
        NavRepVectorEnv(1, max_episode_steps=0)
    assert "navrep-test" in str(env) or "num_envs=2" in str(env)


@pytest.mark.parametrize("kind", KINDS)
def test_whole_numbers_of_any_kind(kind):
    plain, other = NavRepVectorEnv(2, "empty"), NavRepVectorEnv(kind(2), "empty")
    for expected, seeds in ((3, kind(3)), (3, [kind(3), kind(4)]), (3, np.array([3, 4])), ([None, 4], [None, kind(4)])):
        a, b = plain.reset(seed=expected)[0], other.reset(seed=seeds)[0]
        assert same(a["scan"], b["scan"])
        assert same(a["robot_state"], b["robot_state"])
    assert same(other.state(kind(1)).robot, plain.state(-1).robot)
    assert same(other.frame(kind(1), 64), plain.frame(-1, 64))


@pytest.mark.parametrize("seed", [2.5, True, -1, [0, -1], [None, 1.0], torch.tensor(1.0), np.array([0.5, 1.0])])
def test_what_is_no_seed_is_refused(seed):
    with pytest.raises(ConfigError, match=r"seed is .*, expected (a|one) whole number"):
        NavRepVectorEnv(2, "empty").reset(seed=seed)


@pytest.mark.parametrize("world", [2, -3, 1.0, True])
def test_what_is_no_world_is_refused(world):
    env = NavRepVectorEnv(2, "empty")
    env.reset(seed=1)
    for ask in (env.state, env.frame):
        with pytest.raises(ConfigError, match=r"world is .*, expected a whole number from -2 to 1"):
            ask(world)
