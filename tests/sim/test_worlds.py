"""Procedural worlds: what the recipe promises."""

import json

import numpy as np
import pytest

from navrep_data.errors import ConfigError, UnknownNameError
from navrep_data.schema import SensorContract
from navrep_data.sim import SimConfig, Simulator, environment_names, make_config
from navrep_data.sim import _layout as lay


@pytest.fixture(scope="module")
def many():
    """States of 300 fresh soadrl worlds."""
    sim = Simulator(make_config("soadrl"), n_worlds=300, seed=11)
    return sim, [sim.state(w) for w in range(300)]


def test_humans_start_and_end_free_of_obstacles_and_each_other(many):
    sim, states = many
    for w, state in enumerate(states):
        humans = state.humans
        assert (sim.clearance(humans[:, :2], w) > humans[:, 7]).all()
        assert (sim.clearance(humans[:, 5:7], w) > humans[:, 7]).all()
        everybody = np.vstack([state.robot[[0, 1, 5]], humans[:, [0, 1, 7]]])
        gap = np.hypot(*(everybody[:, None, :2] - everybody[None, :, :2]).transpose(2, 0, 1))
        gap -= everybody[:, None, 2] + everybody[None, :, 2]
        np.fill_diagonal(gap, 1.0)
        assert gap.min() >= 0.2 - 1e-9


def test_robot_starts_and_ends_free(many):
    sim, states = many
    for w, state in enumerate(states):
        clear = sim.clearance([state.robot[:2], state.robot[3:5]], w)
        assert (clear > state.robot[5] + 0.2 - 1e-9).all()
        np.testing.assert_allclose(state.robot[:2], -state.robot[3:5])


def test_counts_and_sizes_follow_the_original(many):
    _, states = many
    humans = np.array([len(s.humans) for s in states])
    assert humans.min() >= 10
    assert humans.max() <= 30
    assert abs(humans.mean() - 20) < 1.0  # 300 draws of a uniform with deviation 5.8: 3 sigma
    obstacles = np.array([len(s.polygons) - 1 for s in states])
    assert obstacles.max() <= 20
    assert abs(obstacles.mean() - 10) < 1.0
    radii = np.concatenate([s.humans[:, 7] for s in states])
    assert 0.3 <= radii.min() <= radii.max() <= 0.5
    assert abs(np.mean(np.concatenate([s.humans[:, 9] for s in states])) - 0.5) < 0.03
    assert min(2 * -s.robot[1] for s in states) >= 8.0
    assert max(2 * -s.robot[1] for s in states) <= 18.0
    nine = np.mean([s.robot[1] == -9.0 for s in states])
    assert abs(nine - 0.375) < 0.1


def test_start_headings_are_uniform(many):
    _, states = many
    heading = np.array([s.robot[2] for s in states])
    counts = np.histogram(heading, 8, (0, 2 * np.pi))[0]
    chi2 = ((counts - 37.5) ** 2 / 37.5).sum()
    assert chi2 < 24.3  # 7 degrees of freedom, p = 0.001; the original's headings would give about 60


def test_border_closes_the_world(many):
    sim, states = many
    for w, state in enumerate(states):
        border = state.polygons[-1]
        rest = np.vstack(
            [
                *state.polygons[:-1],
                state.humans[:, :2],
                state.humans[:, 5:7],
                state.robot[None, :2],
                state.robot[None, 3:5],
            ]
        )
        np.testing.assert_allclose(border.min(0), rest.min(0) - 1.0)
        np.testing.assert_allclose(border.max(0), rest.max(0) + 1.0)
        x, y = border.T
        assert (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() < 0, "clockwise"
        assert sim.clearance([border.max(0) + 0.1], w)[0] < 0


def test_worlds_are_functions_of_seed_and_sequence():
    config = make_config("soadrl", humans=5)
    together = Simulator(config, n_worlds=5, seed=4, first_sequence=10)
    alone = Simulator(config, n_worlds=1, seed=4, first_sequence=12)
    np.testing.assert_array_equal(together.arrays.agents[2], alone.arrays.agents[0])
    other = Simulator(config, n_worlds=1, seed=5, first_sequence=12)
    assert (other.arrays.agents[0] != alone.arrays.agents[0]).any()


def test_crowded_worlds_end_and_leave_out_who_does_not_fit():
    sim = Simulator(make_config("soadrl", humans=60, obstacles=20), n_worlds=20, seed=0)
    n = sim.arrays.scalars[:, lay.S_HUMANS]
    assert n.min() > 10
    assert n.max() <= 90


def test_empty_worlds_work():
    sim = Simulator(make_config("soadrl", humans=0, obstacles=0), n_worlds=3, seed=0)
    scans, states = sim.observe()
    assert scans.max() < 25.0
    assert states.shape == (3, 5)
    assert sim.humans().shape == (3, 0, 6)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"humans": -1}, "humans is -1, expected a whole number from 0 to 60"),
        ({"humans": 2.5}, "humans is 2.5"),
        ({"obstacles": 21}, "obstacles is 21"),
        ({"physics": "consistant"}, "Did you mean 'consistent'"),
        ({"rendering": "leg"}, "Did you mean 'legs'"),
        ({"time_limit": float("nan")}, "time_limit is nan"),
        ({"human": 3}, "Unknown setting 'human'. Did you mean 'humans'"),
    ],
)
def test_wrong_settings_are_refused_by_name(changes, words):
    with pytest.raises(ConfigError, match=words.replace("(", r"\(")):
        make_config("soadrl", **changes)


def test_unknown_environment_suggests_the_nearest():
    assert "soadrl" in environment_names()
    with pytest.raises(UnknownNameError, match="Did you mean 'soadrl'"):
        make_config("soadlr")


def test_config_survives_json():
    config = make_config("soadrl", humans=7, rendering="trunk")
    assert SimConfig.from_dict(config.to_dict()) == config
    with pytest.raises(ConfigError, match="does not fit"):
        SimConfig.from_dict({**config.to_dict(), "wheels": 4})


def test_numbers_of_numpy_are_stored_as_plain_ones():
    given = {"humans": np.int64(7), "obstacles": np.uint8(2), "time_limit": np.float32(20), "robot_jerk": np.ones(3)}
    plain = {"humans": 7, "obstacles": 2, "time_limit": 20.0, "robot_jerk": [1, 1, 1]}
    found = make_config("soadrl", **given)
    assert found == make_config("soadrl", **plain)
    assert json.dumps(found.full_dict()) == json.dumps(make_config("soadrl", **plain).full_dict())
    sensor = SensorContract(n_rays=np.int32(180), angle_increment=np.float32(0.03), range_max=np.int64(10))
    assert type(json.loads(json.dumps(make_config("soadrl", sensor=sensor).to_dict()))["sensor"]["n_rays"]) is int
