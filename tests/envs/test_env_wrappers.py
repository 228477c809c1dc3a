"""Observations for networks: rings, 1d, flat; single and vectorised."""

import dataclasses

import gymnasium
import numpy as np
import pytest
from env_cases import make, make_vec, same
from gymnasium.utils.env_checker import check_env

from navrep_data import envs
from navrep_data.errors import ConfigError
from navrep_data.observations import scan_to_rings
from navrep_data.schema import SensorContract

SINGLE = {
    "rings": [envs.RingsObservation],
    "1d": [envs.Scan1dObservation],
    "flat": [envs.FlatObservation],
    "flat rings": [envs.RingsObservation, envs.FlatObservation],
    "flat 1d": [envs.Scan1dObservation, envs.FlatObservation],
}
VECTOR = {
    name: [getattr(envs, "Vector" + wrapper.__name__) for wrapper in wrappers] for name, wrappers in SINGLE.items()
}
KINDS = list(SINGLE)


def wrapped(env, wrappers):
    for wrapper in wrappers:
        env = wrapper(env)
    return env


def expected(kind, observation):
    """Return what a wrapper should make, from its definition."""
    scan, state = observation["scan"], observation["robot_state"]
    rings = scan_to_rings(scan).astype(np.float32) / 2
    return {
        "rings": lambda: {"rings": rings, "robot_state": state},
        "1d": lambda: {"1d": scan / np.float32(25), "robot_state": state},
        "flat": lambda: np.concatenate([scan, state]),
        "flat rings": lambda: np.concatenate([rings.ravel(), state]),
        "flat 1d": lambda: np.concatenate([scan / np.float32(25), state]),
    }[kind]()


@pytest.mark.parametrize("kind", KINDS)
def test_single(kind):
    plain, env = make("navrep-test"), wrapped(make("navrep-test"), SINGLE[kind])
    a, b = plain.reset(seed=5)[0], env.reset(seed=5)[0]
    assert same(b, expected(kind, a))
    assert b in env.observation_space
    for _ in range(3):
        a, b = plain.step(np.full(3, 0.4))[0], env.step(np.full(3, 0.4))[0]
        assert same(b, expected(kind, a))


@pytest.mark.parametrize("kind", KINDS)
def test_vector_equals_single_last_observations_included(kind):
    vector = wrapped(make_vec("navrep-test", 3, time_limit=1.0), VECTOR[kind])
    plain = make_vec("navrep-test", 3, time_limit=1.0)
    single = wrapped(make("navrep-test", time_limit=1.0), SINGLE[kind])
    assert vector.single_observation_space == single.observation_space
    assert vector.observation_space == gymnasium.vector.utils.batch_space(single.observation_space, 3)
    a, b = plain.reset(seed=5)[0], vector.reset(seed=5)[0]
    finals = 0
    for _ in range(12):
        for i in range(3):
            mine = {k: v[i] for k, v in b.items()} if isinstance(b, dict) else b[i]
            assert same(mine, expected(kind, {k: v[i] for k, v in a.items()}))
        actions = np.full((3, 3), 0.3)
        a, _, _, _, infos_a = plain.step(actions)
        b, _, _, _, infos_b = vector.step(actions)
        if "final_obs" in infos_a:
            for i in np.flatnonzero(infos_a["_final_obs"]):
                finals += 1
                assert same(infos_b["final_obs"][i], expected(kind, infos_a["final_obs"][i]))
    assert finals >= 3
    assert b in vector.observation_space


def test_sizes_are_those_of_the_end_to_end_policies():
    assert wrapped(make("navrep-train"), SINGLE["flat"]).observation_space.shape == (1085,)
    assert wrapped(make("navrep-train"), SINGLE["flat rings"]).observation_space.shape == (4101,)


def test_zero_first_bin():
    env = envs.RingsObservation(make("navrep-test", humans=20), zero_first_bin=True)
    other = envs.RingsObservation(make("navrep-test", humans=20))
    a, b = env.reset(seed=5)[0]["rings"], other.reset(seed=5)[0]["rings"]
    assert (a[:, 0] == 0).all()
    assert same(a[:, 1:], b[:, 1:])


@pytest.mark.parametrize("kind", KINDS)
def test_a_wrapped_environment_can_be_made_again_from_its_spec(kind):
    env = wrapped(make("navrep-test"), SINGLE[kind])
    again = gymnasium.make(env.spec)
    assert same(again.reset(seed=5)[0], env.reset(seed=5)[0])


def test_flat_passes_gymnasiums_checker():
    env = envs.FlatObservation(make("navrep-train"))
    with pytest.warns(UserWarning, match="different from the unwrapped version"):
        check_env(env)


def test_misuse_says_what_to_do():
    flat = envs.FlatObservation(make("navrep-test"))
    with pytest.raises(ConfigError, match="put rings and 1d around the environment itself, and flat outermost"):
        envs.RingsObservation(flat)
    with pytest.raises(ConfigError, match="The observation has no scan but rings, robot_state"):
        envs.Scan1dObservation(envs.RingsObservation(make("navrep-test")))
    with pytest.raises(ConfigError, match="is no environment of navrep-data"):
        envs.Scan1dObservation(gymnasium.wrappers.TransformObservation(
            gymnasium.make("CartPole-v1"), lambda o: o, make("navrep-test").observation_space,
        ))  # fmt: skip
    half = dataclasses.replace(SensorContract(), n_rays=540)
    with pytest.raises(ConfigError, match="rings need a scan of a full turn"):
        envs.RingsObservation(make("navrep-test", sensor=half))
    assert envs.FlatObservation(make("navrep-test", sensor=half)).observation_space.shape == (545,)
