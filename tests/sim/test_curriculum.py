"""The adaptive curriculum: per world, from the outcomes of its own episodes."""

import numpy as np
import pytest
from numba import config as numba_config

from navrep_data.errors import ConfigError, SimulationError
from navrep_data.schema import Event
from navrep_data.sim import RolloutSettings, ScriptedPolicy, ScriptedRollout, Simulator, make_config
from navrep_data.sim import _layout as lay

PURE_PYTHON = bool(numba_config.DISABLE_JIT)
WORLDS = 30 if PURE_PYTHON else 200


def finish(sim, outcomes):
    """End every world's episode with the given event by putting its robot there, then reset; None: break it off."""
    a = sim.arrays
    for w, outcome in enumerate(outcomes):
        robot = a.agents[w, 0]
        if outcome == Event.GOAL:
            a.agents[w, 1:, [lay.A_X, lay.A_Y]] += 1000.0
            robot[[lay.A_X, lay.A_Y]] = robot[[lay.A_GX, lay.A_GY]]
        elif outcome == Event.COLLISION_HUMAN:
            a.scalars[w, lay.S_HUMANS] = max(a.scalars[w, lay.S_HUMANS], 1)
            a.agents[w, 1, [lay.A_X, lay.A_Y]] = robot[[lay.A_X, lay.A_Y]]
        elif outcome == Event.TIMEOUT:
            a.scalars[w, [lay.S_STEP, lay.S_TIME]] = 1000.0
    _, events = sim.step(np.zeros((sim.n_worlds, 3)))
    np.testing.assert_array_equal(events, [outcome or 0 for outcome in outcomes])
    sim.reset()


def test_difficulty_is_set_for_the_next_episodes():
    sim = Simulator(make_config("navrep-train", curriculum="adaptive"), n_worlds=WORLDS, seed=0)
    sim.reset()
    sim.set_difficulty(np.tile([0, 3], (WORLDS, 1)))
    np.testing.assert_array_equal(sim.difficulty(), np.tile([0, 3], (WORLDS, 1)))
    sim.reset()  # breaks the episodes off, which changes nothing
    np.testing.assert_array_equal(sim.difficulty(), np.tile([0, 3], (WORLDS, 1)))
    assert (sim.arrays.scalars[:, lay.S_HUMANS] == 0).all()
    for wrong in (
        [[0, 3]],
        np.tile([6, 0], (WORLDS, 1)),
        np.tile([0.5, 0], (WORLDS, 1)),
        np.tile([-1, 0], (WORLDS, 1)),
    ):
        with pytest.raises(SimulationError, match="difficulty has shape"):
            sim.set_difficulty(wrong)


@pytest.mark.parametrize("physics", ["consistent", "original"])
def test_one_more_after_the_goal_one_less_otherwise(physics):
    sim = Simulator(make_config("navrep-train", physics=physics), n_worlds=2, seed=0)
    rng = np.random.default_rng(1)
    kinds = [Event.GOAL, Event.COLLISION_HUMAN, Event.TIMEOUT, None]
    # navreptrainenv.py: counters of humans, walls and circles, clipped to [0, 5], [0, 10] and [0, 10]
    expected = np.array([[5, 10], [5, 10]])
    seen = set()
    for k in range(60):
        np.testing.assert_array_equal(sim.difficulty(), expected)
        low = 1 if k < 25 else 0  # mostly failures at first, so that the lower end is reached
        outcomes = [kinds[i] for i in rng.integers(low, 3 if k < 25 else 2, 2)] if k % 7 else [None, Event.GOAL]
        finish(sim, outcomes)
        for w, outcome in enumerate(outcomes):
            if outcome is not None:
                expected[w] += 1 if outcome == Event.GOAL else -1
        expected = np.clip(expected, 0, [5, 10])
        seen |= {tuple(row) for row in expected.tolist()}
    assert {(0, 0), (5, 10)} <= seen


@pytest.mark.parametrize("physics", ["consistent", "original"])
def test_worlds_are_as_difficult_as_the_counters_say(physics):
    sim = Simulator(make_config("navrep-train", physics=physics), n_worlds=WORLDS, seed=0)

    def counts():
        border = sim.arrays.scalars[:, lay.S_BORDER]
        return sim.arrays.scalars[:, lay.S_HUMANS], sim.arrays.scalars[:, lay.S_POLYGONS] - border

    humans, obstacles = counts()
    assert humans.max() == 7
    assert humans.min() in (2, 3)
    assert obstacles.max() > 12
    for left in (4, 3, 2, 1):
        finish(sim, [Event.TIMEOUT] * WORLDS)
        humans, obstacles = counts()
        assert humans.max() <= np.round(left * 1.5 - 1e-9)
        assert WORLDS < 100 or humans.max() == np.round(left * 1.5 - 1e-9)
        assert obstacles.max() <= 2 * (left + 5)
        assert obstacles.mean() == pytest.approx(left + 5, rel=0.2 if WORLDS > 100 else 0.5)
    for _ in range(6):
        finish(sim, [Event.TIMEOUT] * WORLDS)
    humans, obstacles = counts()
    assert humans.max() == obstacles.max() == 0


def test_a_world_adapts_by_itself_whatever_the_batch():
    outcomes = [Event.TIMEOUT, Event.TIMEOUT, Event.GOAL, Event.COLLISION_HUMAN, Event.TIMEOUT]
    config = make_config("navrep-train")
    many = Simulator(config, n_worlds=3, seed=8)
    one = Simulator(config, n_worlds=1, seed=8, first_sequence=1)
    for k, outcome in enumerate(outcomes):
        finish(many, [outcomes[k - 1], outcome, Event.GOAL])
        finish(one, [outcome])
        np.testing.assert_array_equal(many.arrays.agents[1], one.arrays.agents[0])
        np.testing.assert_array_equal(many.arrays.edges[1], one.arrays.edges[0])
    np.testing.assert_array_equal(many.difficulty()[1], [2, 7])


def test_only_the_first_event_of_an_episode_counts():
    sim = Simulator(make_config("navrep-train"), seed=0)
    sim.arrays.scalars[0, lay.S_STEP] = 1000
    sim.step(np.zeros((1, 3)))
    sim.step(np.zeros((1, 3)))
    finish(sim, [Event.GOAL])  # after it was over
    np.testing.assert_array_equal(sim.difficulty(), [[4, 9]])


def test_a_constant_curriculum_stays_where_it_is():
    sim = Simulator(make_config("navrep-train", curriculum="constant"), seed=0)
    finish(sim, [Event.TIMEOUT])
    np.testing.assert_array_equal(sim.difficulty(), [[5, 10]])


def test_starting_anew_forgets_the_curriculum():
    sim = Simulator(make_config("navrep-train"), n_worlds=2, seed=0)
    finish(sim, [Event.TIMEOUT, Event.TIMEOUT])
    sim.restart([5, 6], mask=[True, False])
    np.testing.assert_array_equal(sim.difficulty(), [[5, 10], [4, 9]])


def test_numbered_episodes_need_a_constant_curriculum():
    with pytest.raises(ConfigError, match="curriculum='adaptive' cannot play numbered episodes"):
        Simulator(make_config("navrep-test", curriculum="adaptive")).reset_seeded([1000])


def test_generated_sequences_adapt_to_robots_that_give_up():
    config = make_config("soadrl", humans=8, obstacles=6, curriculum="adaptive")
    gives_up = ScriptedPolicy("orca", stuck_speed=10.0)
    columns, worlds = ScriptedRollout(config, RolloutSettings(length=30, rings=False), gives_up, 0).run([0])[0]
    assert (columns["event"][:-1] == Event.STUCK).all()
    humans, obstacles = np.diff(worlds["human_offset"]), np.diff(worlds["episode_polygon_offset"]) - 1
    for k in range(30):
        assert humans[k] <= round(1.5 * max(8 - k, 0))
        assert obstacles[k] <= 2 * max(6 - k, 0)
    assert humans[:4].min() > 0


def test_generated_sequences_adapt_to_how_episodes_end():
    """Replayed from the stored events: as many humans as their number allows, never more."""
    config = make_config("soadrl", humans=12, obstacles=6, curriculum="adaptive")
    rollout = ScriptedRollout(
        config, RolloutSettings(length=300 if PURE_PYTHON else 2500, rings=False), ScriptedPolicy(), 0
    )
    columns, worlds = rollout.run([0])[0]
    ends = columns["event"][columns["event"] > 0]
    humans = np.diff(worlds["human_offset"])
    left, goals = 12, 0
    for k in range(len(humans)):
        assert round(0.5 * left) - 1 <= humans[k] <= round(1.5 * left)
        goals += ends[k] == Event.GOAL
        left = min(left + 1, 12) if ends[k] == Event.GOAL else max(left - 1, 0)
    assert PURE_PYTHON or 3 < goals < len(ends) - 10
