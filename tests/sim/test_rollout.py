"""Rows: their meaning, and that they are a function of (seed, sequence) alone."""

import numpy as np
import pytest

from navrep_data.errors import PolicyError, UnknownNameError
from navrep_data.observations import scan_to_rings
from navrep_data.policies import Driver, FunctionPolicy
from navrep_data.schema import Event
from navrep_data.sim import DrivenRollout, RolloutSettings, ScriptedPolicy, ScriptedRollout, make_config
from navrep_data.sim.lidar import scan_polygons

CONFIG = make_config("soadrl", humans=6, obstacles=4)
SETTINGS = RolloutSettings(length=150)


def roll(policy="orca", sequence=0, seed=0, config=CONFIG, settings=SETTINGS):
    return ScriptedRollout(config, settings, ScriptedPolicy(policy), seed).run([sequence])[0]


def driven(settings, function, seed, batch):
    return DrivenRollout(CONFIG, settings, Driver(FunctionPolicy("f", function, batch)), seed, batch)


def to_goal(scan, robot_state):
    """Drive straight to the goal at up to 1 m/s."""
    goal = robot_state[:, :2]
    return goal / np.maximum(np.linalg.norm(goal, axis=1, keepdims=True), 1.0)


@pytest.mark.parametrize("policy", ["orca", "goal-momentum", "random-momentum", "constant-velocity"])
def test_rows_follow_rlds(policy):
    columns, _ = roll(policy)
    first, last, event = columns["is_first"], columns["is_last"], columns["event"]
    assert first[0]
    assert last[-1]
    np.testing.assert_array_equal(first[1:], last[:-1])
    np.testing.assert_array_equal(last, event > 0)
    np.testing.assert_array_equal(columns["is_terminal"], np.isin(event, [1, 2, 3]))
    assert (columns["action"][last] == 0).all()
    assert (columns["reward"][last] == 0).all()
    np.testing.assert_array_equal(columns["episode"], np.cumsum(first) - 1)
    assert event[-1] != Event.NONE
    np.testing.assert_array_equal(columns["rings"], scan_to_rings(columns["scan"]))


@pytest.mark.parametrize("policy", ["orca", "goal-momentum", "random-momentum", "constant-velocity"])
def test_action_of_a_row_moves_the_robot_to_the_next(policy):
    columns, _ = roll(policy, sequence=3)
    pose, action = columns["robot_pose"].astype(float), columns["action"].astype(float)
    going = ~columns["is_last"][:-1]
    assert going.sum() > 50
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    step = 0.2 * np.column_stack([c * action[:, 0] - s * action[:, 1], s * action[:, 0] + c * action[:, 1]])
    np.testing.assert_allclose((pose[:-1, :2] + step[:-1])[going], pose[1:, :2][going], atol=2e-6)
    turn = (pose[1:, 2] - pose[:-1, 2] - 0.2 * action[:-1, 2])[going]
    np.testing.assert_allclose(np.angle(np.exp(1j * turn)), 0.0, atol=1e-5)


def test_reward_is_progress_plus_what_happened():
    columns, _ = roll(sequence=5, settings=RolloutSettings(length=600))
    goal = np.hypot(*columns["robot_state"][:, :2].T.astype(float))
    going = ~columns["is_last"][:-1]
    rest = (columns["reward"][:-1] - (goal[:-1] - goal[1:]))[going]
    after = columns["event"][1:][going]
    collided = np.isin(after, [Event.COLLISION_HUMAN, Event.COLLISION_OBSTACLE])
    np.testing.assert_allclose(rest[collided], -26.0, atol=1e-4)
    np.testing.assert_allclose(
        rest[after == Event.GOAL] // 1,
        [100.0 if r > 99.5 else 99.0 for r in rest[after == Event.GOAL]],
        atol=1.0,
    )
    quiet = ~collided & (after != Event.GOAL)
    assert np.isclose(rest[quiet, None], [0.0, -1.0], atol=1e-4).any(axis=1).all()
    assert (rest[quiet] < -0.5).any()


def test_sequences_do_not_know_of_each_other():
    rollout = ScriptedRollout(CONFIG, SETTINGS, ScriptedPolicy(), 7)
    order = [2, 0, 1, 2]
    rows = [{k: v.copy() for k, v in rollout.run([i])[0][0].items()} for i in order]
    for name in rows[0]:
        np.testing.assert_array_equal(rows[0][name], rows[3][name])
    assert (rows[1]["scan"] != rows[2]["scan"]).any()


def test_longer_sequences_start_like_shorter_ones():
    short, _ = roll(settings=RolloutSettings(length=60))
    long, _ = roll(settings=RolloutSettings(length=150))
    for name in ("scan", "robot_state", "action", "humans"):
        np.testing.assert_array_equal(short[name][:59], long[name][:59])


def test_python_policies_see_what_is_stored_and_groups_do_not_matter():
    seen = []

    def policy(scan, robot_state):
        seen.append((scan.copy(), robot_state.copy()))
        return to_goal(scan, robot_state)

    settings = RolloutSettings(length=80)
    four = driven(settings, policy, 1, batch=4).run([0, 1, 2, 3])
    four = [({k: v.copy() for k, v in c.items()}, w) for c, w in four]
    assert len(seen) == 79
    assert seen[0][0].shape == (4, 1080)
    for row in (0, 17):
        for w in range(4):
            np.testing.assert_array_equal(np.rint(seen[row][0][w].astype(float) * 1000), four[w][0]["scan"][row])
            np.testing.assert_array_equal(seen[row][1][w], four[w][0]["robot_state"][row])
    pair = driven(settings, to_goal, 1, batch=4).run([2, 3])
    for a, b in zip(four[2:], pair, strict=True):
        for name, column in a[0].items():
            np.testing.assert_array_equal(column, b[0][name])
        for name, column in a[1].items():
            np.testing.assert_array_equal(column, b[1][name])


def test_scripted_and_python_rows_come_from_the_same_worlds():
    """A Python policy that repeats the stored actions of a scripted one gets the same rows."""
    settings = RolloutSettings(length=100)
    scripted, worlds = roll("constant-velocity", sequence=0, settings=settings)
    first_end = int(np.argmax(scripted["is_last"]))
    actions = iter(scripted["action"])
    replay, replay_worlds = driven(settings, lambda s, r: next(actions)[None], 0, batch=1).run([0])[0]
    for name in ("scan", "humans", "robot_pose", "reward", "event"):
        np.testing.assert_array_equal(replay[name][: first_end + 1], scripted[name][: first_end + 1])
    np.testing.assert_array_equal(replay_worlds["vertices"][:4], worlds["vertices"][:4])


def test_policies_with_memory_are_told_of_new_episodes():
    class Counting:
        def __init__(self):
            self.calls = []
            self.steps = None

        def reset(self, batch_size=None, mask=None):
            self.calls.append((batch_size, None if mask is None else mask.copy()))
            if batch_size is not None:
                self.steps = np.zeros(batch_size, int)
            else:
                self.steps[mask] = 0

        def __call__(self, scan, robot_state):
            self.steps += 1
            return to_goal(scan, robot_state)

    policy = Counting()
    rows = driven(RolloutSettings(length=120), policy, 3, batch=2).run([0, 1])
    assert policy.calls[0] == (2, None)
    starts = sum(int(c["is_first"][1:].sum()) for c, _ in rows)
    assert sum(int(m.sum()) for _, m in policy.calls[1:]) == starts > 0


@pytest.mark.parametrize(
    ("policy", "words"),
    [
        (lambda s, r: np.zeros((5, 3)), r"shape \(5, 3\), expected \(2, 3\) or \(2, 2\)"),
        (lambda s, r: np.full((2, 2), np.nan), "NaN or infinity"),
    ],
)
def test_bad_policy_output_is_named(policy, words):
    with pytest.raises(PolicyError, match=words):
        driven(RolloutSettings(length=5), policy, 0, batch=2).run([0, 1])


def test_unknown_scripted_policy():
    with pytest.raises(UnknownNameError, match="Did you mean 'orca'"):
        ScriptedPolicy("orka")


def test_stored_columns_suffice_to_recompute_the_scan():
    """From robot_pose, humans and the worlds tables alone: the same static scan, up to the float32 pose."""
    columns, worlds = roll(sequence=1, config=make_config("soadrl", humans=0, obstacles=6))
    starts = np.append(worlds["row"], len(columns["scan"]))
    for e in range(len(worlds["row"])):
        first, stop = worlds["episode_polygon_offset"][e : e + 2]
        at = worlds["polygon_offset"]
        polygons = [worlds["vertices"][at[p] : at[p + 1]] for p in range(first, stop)]
        for row in range(starts[e], starts[e + 1], 7):
            again = scan_polygons(polygons, np.zeros((0, 3)), columns["robot_pose"][row], CONFIG.sensor)
            close = abs(again - columns["scan"][row] / 1000.0) < 0.002
            assert close.mean() > 0.99


def test_float_scans_are_the_millimetres_before_rounding():
    mm, _ = roll()
    metres, _ = roll(settings=RolloutSettings(length=150, scan_dtype="float32"))
    assert metres["scan"].dtype == np.float32
    np.testing.assert_array_equal(np.rint(metres["scan"].astype(float) * 1000), mm["scan"])


def test_columns_can_be_left_out():
    columns, _ = roll(settings=RolloutSettings(length=20, rings=False, humans=False))
    assert "rings" not in columns
    assert "humans" not in columns


@pytest.mark.slow
def test_orca_data_looks_like_the_originals():
    """Shares of outcomes of the consistent physics stay near those of the original generator (its 24 sequences)."""
    rollout = ScriptedRollout(make_config("soadrl"), RolloutSettings(rings=False, humans=False), ScriptedPolicy(), 0)
    events = np.concatenate([rollout.run([i])[0][0]["event"] for i in range(30)])
    ended = events[(events > 0) & (events != Event.CUT)]
    share = np.bincount(ended, minlength=7) / len(ended)
    assert 0.08 < share[Event.GOAL] < 0.20  # original 0.107
    assert 0.35 < share[Event.COLLISION_HUMAN] < 0.55  # original, all collisions, 0.436
    assert 0.30 < share[Event.STUCK] < 0.52  # original 0.443
