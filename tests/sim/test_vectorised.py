"""A batch gives what single worlds give, bit for bit, for every setting; same seed, same episodes."""

import math

import numpy as np
import pytest
from numba import config as numba_config

from navrep_data.errors import ConfigError
from navrep_data.schema import SensorContract
from navrep_data.sim import SimConfig, Simulator, make_config
from navrep_data.sim import _layout as lay

PURE_PYTHON = bool(numba_config.DISABLE_JIT)
STEPS = 6 if PURE_PYTHON else 40
CASES = 12 if PURE_PYTHON else 60
SENSORS = [
    SensorContract(n_rays=64, angle_increment=2 * math.pi / 64),
    SensorContract(n_rays=91, angle_min=-math.pi / 4, angle_increment=math.pi / 180, range_max=9.0),
]
CHOICES = {
    "physics": ("consistent", "consistent", "original"),
    "crossing": ("circle", "square"),
    "rendering": ("legs", "trunk", "ellipse"),
    "humans": (0, 2, 6),
    "obstacles": (0, 3),
    "time_limit": (1.5, 35.0),
    "sensor": SENSORS,
    "world": ("polygons", "polygons", "empty"),
    "human_policy": ("orca", "static", "constant-velocity"),
    "robots": (1, 1, 2, 5),
    "drive": ("holonomic", "differential"),
    "inertia": ("none", "limited"),
    "on_collision": ("end", "damage"),
    "max_damage": (1.0, 5.0),
    "goal_radius": (None, 3.0),
    "curriculum": ("constant", "adaptive"),
    "scan_noise": (0.0, 0.05),
    "scan_dropout": (0.0, 0.1),
}


def random_config(rng):
    """Draw settings until they are not refused."""
    while True:
        fields = {name: values[rng.integers(len(values))] for name, values in CHOICES.items()}
        try:
            return SimConfig(**fields)
        except ConfigError:
            continue


def play(sim, actions):
    """Step with resets where episodes end; returns all that can be seen, world by world."""
    seen = []
    for action in actions:
        rewards, events = sim.step(action)
        seen.append((rewards, events, *sim.observe(), sim.humans(), sim.robot_events(), sim.damage()))
        if events.any():
            sim.reset(events > 0)
            seen.append((sim.arrays.agents.copy(), sim.difficulty(), *sim.observe()))
        else:
            seen.append((sim.arrays.agents.copy(), sim.difficulty()))
    return seen


@pytest.mark.slow
@pytest.mark.parametrize("case", range(CASES))
def test_a_batch_is_made_of_single_worlds(case):
    rng = np.random.default_rng(case)
    config = random_config(rng)
    n = 3
    shape = (STEPS, n, 3) if config.robots == 1 else (STEPS, n, config.robots, 3)
    actions = rng.uniform(-1.5, 1.5, shape)
    seed = int(rng.integers(2**40))
    batch = play(Simulator(config, n, seed=seed, first_sequence=2), actions)
    for w in range(n):
        single = play(Simulator(config, 1, seed=seed, first_sequence=2 + w), actions[:, w : w + 1])
        for many, one in zip(batch, single, strict=True):
            for a, b in zip(many, one, strict=False):  # another world's reset adds columns at the end
                np.testing.assert_array_equal(a[w], b[0], err_msg=str(config))


def test_the_random_settings_cover_every_choice():
    seen = {name: set() for name in CHOICES}
    for case in range(CASES):
        config = random_config(np.random.default_rng(case))
        for name, values in seen.items():
            values.add(getattr(config, name))
    for name, values in CHOICES.items():
        if not PURE_PYTHON:
            assert seen[name] == set(values), name


@pytest.mark.parametrize("env", ["navrep-test", "navrep-val", "cadrl"])
@pytest.mark.parametrize("physics", ["consistent", "original"])
def test_numbered_episodes_do_not_depend_on_the_batch(env, physics):
    config = make_config(env, physics=physics, scan_noise=0.02)
    batch = Simulator(config, 3, seed=1)
    batch.reset_seeded([1000, 1007, 3])
    single = Simulator(config, 1, seed=77)
    single.step(np.zeros((1, 3)))
    single.reset_seeded([1007])
    for _ in range(STEPS // 2):
        np.testing.assert_array_equal(batch.observe()[0][1], single.observe()[0][0])
        n = int(batch.arrays.scalars[1, lay.S_HUMANS]) + 1
        np.testing.assert_array_equal(batch.arrays.agents[1, :n], single.arrays.agents[0, :n])
        batch.step(np.full((3, 3), 0.4))
        single.step(np.full((1, 3), 0.4))


def test_restarting_with_a_seed_is_a_new_simulator_of_that_seed():
    config = make_config("navrep-train", scan_noise=0.1)
    sim = Simulator(config, 3, seed=0)
    for _ in range(4):
        sim.step(np.full((3, 3), 0.2))
        sim.reset([True, False, True])
    before = sim.arrays.agents[1].copy()
    sim.restart([11, 0, 2**63 - 1], mask=[True, False, True])
    np.testing.assert_array_equal(sim.arrays.agents[1], before)
    for w, seed in ((0, 11), (2, 2**63 - 1)):
        fresh = Simulator(config, 1, seed=seed)
        np.testing.assert_array_equal(sim.observe()[0][w], fresh.observe()[0][0])
        np.testing.assert_array_equal(sim.arrays.rng[w], fresh.arrays.rng[0])
    with pytest.raises(ConfigError, match="seeds have shape"):
        sim.restart([1, 2])
    with pytest.raises(ConfigError, match="seed is -1"):
        sim.restart([1, -1, 2])
