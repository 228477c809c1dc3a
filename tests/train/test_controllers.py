"""Controllers: the batch of worlds, PPO for a few steps, what it leaves, bad input."""

import json

import numpy as np
import pytest
import torch

from navrep_data import zoo
from navrep_data.errors import CheckpointError, ConfigError, DatasetMismatchError, TrainingError
from navrep_data.models import Controller, ControllerConfig, checkpoint, quantized
from navrep_data.models.controllers import limit_speed
from navrep_data.schema import Event, SensorContract
from navrep_data.sim import Simulator, make_config
from navrep_data.sim import _layout as lay
from navrep_data.train import controllers, learner
from navrep_data.train import worlds as train_worlds
from navrep_data.train.controller_recipe import (
    AUTHORS_SEEDS,
    VALIDATION_SEEDS,
    default_controller_recipe,
    environment,
    original_controller_recipe,
)
from navrep_data.train.logs import read_log
from navrep_data.train.state import last_folder
from navrep_data.train.worlds import Ending, TrainingWorlds, WorldGroups, play, shorten
from navrep_data.zoo.local import load_any_model
from navrep_data.zoo.policy import Policy
from navrep_data.zoo.sb3 import put_weights

SMALL = {"worlds": 8, "rollout": 8, "batch": 32, "steps": 128, "validate_every": 64}


def small(features, **changes):
    """Return a recipe of few steps; end to end in float32, as bfloat16 is slow on processors that do not have it."""
    precision = {"precision": "float32"} if features == "e2e" else {}
    return default_controller_recipe(features, "1d").replace(**{**SMALL, **precision, **changes})


def world_model(lidar="1d", alignment="taken"):
    torch.manual_seed(0)
    settings = {"lidar": lidar, "z_size": 16, "n_blocks": 1, "n_heads": 2, "action_alignment": alignment}
    return checkpoint.make("transformer", settings).eval()


@pytest.fixture
def few_episodes(monkeypatch):
    monkeypatch.setattr(controllers, "VALIDATION_SEEDS", range(5000, 5003))
    monkeypatch.setattr(controllers, "AUTHORS_SEEDS", range(1000, 1002))
    monkeypatch.setattr(controllers, "AUTHORS_HELD_OUT", range(1100, 1102))


def test_selection_never_looks_at_the_test_suite():
    assert not set(VALIDATION_SEEDS) & set(range(1000, 1200))
    assert (len(VALIDATION_SEEDS), VALIDATION_SEEDS[0]) == (100, 5000)
    assert (AUTHORS_SEEDS.start, AUTHORS_SEEDS.stop) == (1000, 1100)  # their own selection, by --original only


@pytest.mark.slow
def test_worlds_are_the_simulators_with_their_codes():
    model = world_model()
    policy = Policy(Controller(ControllerConfig(21)), "z", "1d", None, model)
    config = make_config("navrep-train", curriculum="adaptive")
    worlds = TrainingWorlds(config, policy, 4, seed=3, max_speed=1.0, reward_scale=0.5)
    twin = Simulator(config, 4, seed=3)
    obs = worlds.reset()
    twin.reset()
    rng = np.random.default_rng(0)
    ends = 0
    for _ in range(200):
        scan, state = twin.observe()
        with torch.no_grad():
            z = model.encode(model.observation(scan)).numpy()
        np.testing.assert_allclose(obs, np.concatenate([z, state], axis=1), rtol=1e-4, atol=1e-4)
        actions = rng.uniform(-2, 2, (4, 2)).astype(np.float32)
        worlds.step_async(actions)
        obs, rewards, done, infos = worlds.step_wait()
        command = np.zeros((4, 3))
        command[:, :2] = shorten(actions, 1.0)
        expected, events = twin.step(command)
        np.testing.assert_allclose(rewards, expected * 0.5, rtol=1e-5)
        assert (done == (events != 0)).all()
        for w in np.flatnonzero(done):
            ends += 1
            assert infos[w]["event"] == Event(int(events[w])).label
            assert infos[w].get("TimeLimit.truncated", False) == (events[w] == Event.TIMEOUT)
            if events[w] == Event.TIMEOUT:
                last_scan, last_state = twin.observe()
                last = np.concatenate([model.encode(model.observation(last_scan)).detach().numpy(), last_state], axis=1)
                np.testing.assert_allclose(infos[w]["terminal_observation"], last[w], rtol=1e-4, atol=1e-4)
        twin.reset(done)
    assert ends > 3
    assert len(worlds.take_outcomes()) == ends
    assert (worlds.simulator.difficulty() <= [5, 10]).all()


@pytest.mark.slow
def test_progress_is_paid_on_steps_that_end_nothing():
    policy = Policy(Controller(ControllerConfig(21)), "z", "1d", None, world_model())
    config = make_config("navrep-train", physics="consistent")
    plain, paid = (TrainingWorlds(config, policy, 4, seed=5, reward_scale=0.5, progress=p) for p in (0.0, 3.0))
    rng = np.random.default_rng(0)
    far = np.hypot(*plain.reset()[:, 16:18].T)
    paid.reset()
    ends = 0
    for _ in range(120):
        actions = rng.uniform(-1, 1, (4, 2)).astype(np.float32)
        plain.step_async(actions)
        paid.step_async(actions)
        (obs, before, done, _), (_, after, _, _) = plain.step_wait(), paid.step_wait()
        now = np.hypot(*obs[:, 16:18].T)
        np.testing.assert_allclose(after - before, np.where(done, 0.0, 1.5 * (far - now)), atol=1e-5)
        far, ends = now, ends + done.sum()
    assert ends > 0


@pytest.mark.slow
def test_groups_of_worlds_are_the_worlds_of_one_batch():
    """Same streams, same codes, same rewards, however many threads step them."""
    model = world_model()
    recipe = default_controller_recipe("zh", "1d").replace(worlds=12, batch=48, precision="float32")
    network = learner.make_network(recipe, model)

    def make(n_worlds, first_sequence):
        policy = learner.make_policy(recipe, network, model)
        return TrainingWorlds(
            environment(recipe), policy, n_worlds, seed=4, first_sequence=first_sequence, progress=2.0
        )

    whole, parts = (WorldGroups(make, 12, n) for n in (1, 3))
    assert [group.num_envs for group in parts.groups] == [4, 4, 4]
    np.testing.assert_allclose(whole.reset(), parts.reset(), atol=1e-5)
    draw = np.random.default_rng(0)
    ended = 0
    for _ in range(60):
        actions = draw.uniform(-1.0, 1.0, (12, 2)).astype(np.float32)
        results = []
        for worlds in (whole, parts):
            worlds.step_async(actions)
            results.append(worlds.step_wait())
        (seen, rewards, done, infos), (seen_2, rewards_2, done_2, infos_2) = results
        np.testing.assert_allclose(seen, seen_2, atol=1e-4)
        np.testing.assert_array_equal(rewards, rewards_2)
        np.testing.assert_array_equal(done, done_2)
        assert [info.get("event") for info in infos] == [info.get("event") for info in infos_2]
        ended += int(done.sum())
    assert ended > 0
    np.testing.assert_array_equal(whole.difficulty(), parts.difficulty())
    assert whole.take_outcomes() == parts.take_outcomes()
    hard = np.arange(24).reshape(12, 2) % 5
    for worlds in (whole, parts):
        worlds.restart(9, hard)
        np.testing.assert_array_equal(worlds.difficulty(), hard)
    np.testing.assert_allclose(whole.reset(), parts.reset(), atol=1e-5)
    whole.close()
    parts.close()


@pytest.mark.slow
@pytest.mark.parametrize(("easy", "expected"), [(True, [0, 0]), (False, [5, 10])])
def test_worlds_start_easy_or_hard(easy, expected, few_episodes, tmp_path):
    recipe = default_controller_recipe("z", "1d").replace(**SMALL, easy_start=easy)
    model = world_model()
    network = controllers.make_network(recipe, model)
    run = controllers._Run(recipe, tmp_path / "c", network, model, "W", False, None, "cpu")
    assert (run.worlds.difficulty() == expected).all()


@pytest.mark.slow
@pytest.mark.parametrize("least", [0.05, 0.3])
def test_the_width_of_actions_stays_within_its_bounds(least, few_episodes, tmp_path):
    recipe = default_controller_recipe("z", "1d").replace(**SMALL, least_std=least)
    model = world_model()
    network = learner.make_network(recipe, model)
    worlds = learner.make_worlds(recipe, network, model, None, 0)
    policy = learner.make_ppo(recipe, worlds, network, "cpu").policy
    for log_std, expected in ((-9.0, least), (np.log(0.4), 0.4), (9.0, 0.6)):
        with torch.no_grad():
            network.logstd.fill_(log_std)
        put_weights(policy, network)
        obs = torch.zeros(2, policy.observation_space.shape[0])
        width = policy.get_distribution(obs).distribution.stddev
        np.testing.assert_allclose(width.detach(), expected, rtol=1e-5)
        for wish in (-1.0, 1.0):  # from its bounds it finds the way back, and no step leads beyond them
            policy.optimizer.zero_grad()
            (-wish * policy.heads(obs)[1].sum()).backward()
            assert (policy.log_std.grad != 0).all()
            for group in policy.optimizer.param_groups:
                group["lr"] = 0.1
            policy.optimizer.step()
            assert (policy.log_std.exp() <= 0.6 + 1e-6).all()
            assert (policy.log_std.exp() >= least - 1e-6).all()
        assert (policy.log_std.exp() > least).all()
    with pytest.raises(ConfigError, match="least_std is 0"):
        recipe.replace(least_std=0.0)


@pytest.mark.slow
@pytest.mark.parametrize("end", [False, True])
def test_timeouts_are_truncations_unless_they_end(end):
    recipe = default_controller_recipe("z", "1d").replace(**SMALL, timeouts_end=end)
    model = world_model()
    worlds = learner.make_worlds(recipe, learner.make_network(recipe, model), model, None, 0)
    worlds.reset()
    seen = []
    for _ in range(180):  # standing still: who is not run into is out of time after 176 steps
        worlds.step_async(np.zeros((8, 2), np.float32))
        seen += [info for info in worlds.step_wait()[3] if info.get("event") == "timeout"]
    assert seen
    assert all(("TimeLimit.truncated" in info) != end for info in seen)
    assert original_controller_recipe("z", "1d").timeouts_end


def test_batch_follows_the_worlds_unless_given():
    recipe = default_controller_recipe("z", "1d")
    assert recipe.fit_batch(seed=3) == recipe.replace(seed=3)
    assert recipe.fit_batch(worlds=8).batch == 128
    assert recipe.fit_batch(worlds=70).batch == 280  # a quarter of 1120; a third is no whole number
    assert recipe.fit_batch(worlds=16, batch=64).batch == 64
    with pytest.raises(ConfigError, match="divisor of worlds x rollout = 256"):
        recipe.fit_batch(worlds=16, batch=4096)
    with pytest.raises(ConfigError, match="worlds is 0"):
        recipe.fit_batch(worlds=0)


def test_speed_limit_in_numpy_and_torch_agree():
    actions = np.array([[0.3, 0.1], [3.0, 0.0], [1.0, 1.0], [-1.0, 0.5], [0.0, 0.0]], np.float32)
    found = shorten(actions, 1.0)
    assert np.linalg.norm(found, axis=1).max() <= 1 + 1e-6
    np.testing.assert_allclose(found[2], [0.5**0.5] * 2, rtol=1e-6)
    clipped = torch.tensor(actions).clamp(-1, 1)
    np.testing.assert_allclose(limit_speed(clipped, 1.0).numpy(), found, rtol=1e-6)
    np.testing.assert_array_equal(shorten(actions, 0.0), clipped.numpy())


@pytest.mark.slow
@pytest.mark.parametrize("lidar", ["rings", "1d"])
def test_scans_are_encoded_in_8_bits_while_training_and_exactly_afterwards(lidar, monkeypatch):
    model = world_model(lidar)
    recipe = default_controller_recipe("z", lidar)
    assert recipe.precision == "int8"
    assert learner.make_encoder(default_controller_recipe("e2e", lidar), None) is None
    network = learner.make_network(recipe, model)
    simulator = Simulator(environment(recipe), 8, seed=1)
    simulator.reset()
    scan, robot_state = simulator.observe()
    exact = learner.make_policy(recipe.replace(precision="float32"), network, model)
    codes = exact.look(scan, robot_state)[0]
    if quantized.can_quantize():
        encoders = [learner.make_encoder(recipe, model) for _ in range(2)]
        found = [learner.make_policy(recipe, network, model, "", e).look(scan, robot_state)[0] for e in encoders]
        np.testing.assert_array_equal(*found)  # calibrated on the same worlds: a resume sees the same
        assert not np.array_equal(found[0], codes)
        assert np.abs(found[0] - codes).max() < 0.2 * codes[:, :-5].std()
    monkeypatch.setattr(learner, "can_quantize", lambda: False)
    assert learner.make_encoder(recipe, model) is None
    rounded = learner.make_policy(recipe, network, model).look(scan, robot_state)[0]
    assert 0.0 < np.abs(rounded - codes).max() < 0.1 * codes[:, :-5].std()


@pytest.mark.slow
@pytest.mark.parametrize("features", ["z", "zh"])
def test_a_few_steps_leave_a_policy_that_loads_and_drives(features, few_episodes, tmp_path):
    model = world_model()
    recipe = default_controller_recipe(features, "1d").replace(**SMALL)
    done = controllers.train_controller(recipe, tmp_path / "c", model=model, model_name="W")
    assert (done.steps, done.held_out) == (128, None)
    policy = load_any_model(tmp_path / "c")
    assert (policy.features, policy.lidar, policy.network.config.squash) == (features, "1d", "tanh")
    simulator = Simulator(environment(recipe), 5, seed=1)
    policy.reset(batch_size=5)
    for _ in range(3):
        action = policy.act(*simulator.observe())
        assert action.shape == (5, 3)
        assert np.linalg.norm(action, axis=1).max() <= 1 + 1e-6
        simulator.step(action)
    log = read_log(tmp_path / "c")
    assert {"episodes", "policy_std", "humans", "approx_kl"} <= set(log[0])
    assert {float(r["episodes"]) > 0 for r in log if "success" in r} <= {True}, "no rate of no episodes"
    assert [r["step"] for r in log if "val_success" in r] == ["64", "128"]
    assert (tmp_path / "c" / "training.png").is_file()
    metadata = checkpoint.read_config(tmp_path / "c")["metadata"]
    assert metadata["selected_on"] == (
        "navrep-test, original physics, numpy seeds 5000 to 5002, by the share of goals without contact"
    )


@pytest.mark.slow
def test_a_goal_with_a_contact_is_no_success_of_ours(few_episodes, tmp_path, monkeypatch):
    """In original physics a goal outranks a collision of the same step; checkpoints are not chosen by such goals."""
    said = iter([[(Event.GOAL, True)] * 3, [(Event.GOAL, False), (Event.TIMEOUT, False), (Event.TIMEOUT, True)]])
    monkeypatch.setattr(controllers, "play", lambda *_: [Ending(*one) for one in next(said)])
    recipe = default_controller_recipe("e2e", "1d").replace(**SMALL)
    done = controllers.train_controller(recipe, tmp_path / "c")
    assert done.best == pytest.approx(1 / 3)
    assert [float(r["val_success"]) for r in read_log(tmp_path / "c") if "val_success" in r] == pytest.approx(
        [0.0, 1 / 3]
    )


def test_play_tells_who_was_touched():
    """A robot that starts on its goal, beside somebody who overlaps it, has arrived and has touched."""

    class Stand:
        sensor, world_model, name = SensorContract(), None, ""

        def reset(self, batch_size):
            self.n = batch_size

        def observe(self, executed):
            assert executed.shape == (self.n, 3)

        def act(self, scan, state):
            return np.zeros((self.n, 3), np.float32)

    config = make_config("navrep-test", physics="original", time_limit=0.4)
    (alone,) = play(Stand(), config, [5000])
    assert alone == (Event.TIMEOUT, False)

    class Crowded(Simulator):
        def reset_seeded(self, seeds, mask=None):
            super().reset_seeded(seeds, mask)
            agents = self.arrays.agents[0]
            agents[1:, lay.A_X] = 500.0 + 10.0 * np.arange(len(agents) - 1)
            agents[0, [lay.A_GX, lay.A_GY]] = agents[0, [lay.A_X, lay.A_Y]]
            gap = agents[0, lay.A_RADIUS] + agents[1, lay.A_RADIUS] - 0.05
            agents[1, [lay.A_X, lay.A_Y]] = agents[0, [lay.A_X, lay.A_Y]] + [0.0, gap]
            agents[1, [lay.A_GX, lay.A_GY]] = agents[1, [lay.A_X, lay.A_Y]] + [0.0, 50.0]
            agents[:, [lay.A_VX, lay.A_VY]] = 0.0

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train_worlds, "Simulator", Crowded)
        assert play(Stand(), config, [5000]) == [(Event.GOAL, True)]


@pytest.mark.slow
@pytest.mark.parametrize("features", ["z", "h", "zh", "e2e"])
def test_ppo_moves_actor_critic_and_width_and_nothing_of_the_encoder(features, few_episodes, tmp_path):
    """End to end it moves the convolutions, too."""
    model = None if features == "e2e" else world_model()
    before = {} if model is None else {name: p.clone() for name, p in model.named_parameters()}
    recipe = small(features, steps=64)
    controllers.train_controller(recipe, tmp_path / "a", model=model, stop_after=64)
    first = checkpoint.load(tmp_path / "a" / "checkpoints" / "step-00000064")
    controllers.train_controller(recipe.replace(lr=1e-9), tmp_path / "b", model=model, stop_after=64)
    still = checkpoint.load(tmp_path / "b" / "checkpoints" / "step-00000064")
    for name, p in first.named_parameters():
        moved = float((p - dict(still.named_parameters())[name]).detach().abs().max())
        assert (moved > 1e-5) == (not name.startswith("q.")), name
    if model is not None:
        assert all(torch.equal(p, before[name]) for name, p in model.named_parameters())


@pytest.mark.slow
def test_resume_goes_on_and_refuses_other_settings(few_episodes, tmp_path):
    model, out = world_model(), tmp_path / "c"
    recipe = default_controller_recipe("z", "1d").replace(**SMALL)
    controllers.train_controller(recipe, out, model=model, stop_after=64)
    with pytest.raises(ConfigError, match=r"started with max_speed = 1\.0, this resume has 2.0"):
        controllers.train_controller(recipe.replace(max_speed=2.0), out, model=model, resume=True)
    other = checkpoint.make("transformer", {**model.config.to_dict(), "n_blocks": 2})
    with pytest.raises(DatasetMismatchError, match="world_model_sha256"):
        controllers.train_controller(recipe, out, model=other, resume=True)
    done = controllers.train_controller(recipe, out, model=model, resume=True)
    assert done.steps == 128
    assert [r["step"] for r in read_log(out) if "val_success" in r] == ["64", "128"]


@pytest.mark.slow
@pytest.mark.parametrize("features", ["z", "zh", "e2e"])
def test_a_resume_gives_the_same_weights(features, few_episodes, tmp_path):
    model = None if features == "e2e" else world_model()
    # 24 steps per world between checkpoints: episodes are cut there, and some end and adapt their difficulty
    recipe = small(features, rollout=24, steps=576, batch=64, validate_every=192)
    controllers.train_controller(recipe, tmp_path / "whole", model=model)
    controllers.train_controller(recipe, tmp_path / "parts", model=model, stop_after=192)
    controllers.train_controller(recipe, tmp_path / "parts", model=model, resume=True, stop_after=384)
    controllers.train_controller(recipe, tmp_path / "parts", model=model, resume=True)
    ours, theirs = (checkpoint.load(last_folder(tmp_path / name)) for name in ("whole", "parts"))
    for (name, a), b in zip(ours.named_parameters(), theirs.parameters(), strict=True):
        assert torch.equal(a, b), name
    a, b = (
        [{k: v for k, v in r.items() if k not in ("seconds", "steps_per_s")} for r in read_log(tmp_path / name)]
        for name in ("whole", "parts")
    )
    assert a == b


@pytest.mark.slow
def test_nan_stops_and_keeps_the_last_good_checkpoint(few_episodes, tmp_path, monkeypatch):
    advance, steps = TrainingWorlds.advance, []

    def poisoned(self, actions):
        found = advance(self, actions)
        steps.append(0)
        return found._replace(rewards=found.rewards * (np.float32("nan") if len(steps) > 12 else 1))

    monkeypatch.setattr(TrainingWorlds, "advance", poisoned)
    recipe = default_controller_recipe("z", "1d").replace(**SMALL)
    with pytest.raises(
        TrainingError, match=r"Weights are NaN after 128 steps.*step-00000064; start in another folder with a lower lr"
    ) as error:
        controllers.train_controller(recipe, tmp_path / "c", model=world_model())
    assert "\n" not in str(error.value)
    assert last_folder(tmp_path / "c").name == "step-00000064"
    assert load_any_model(tmp_path / "c").features == "z"


@pytest.mark.slow
def test_the_authors_settings_run_and_report_the_episodes_they_did_not_select_on(few_episodes, tmp_path, monkeypatch):
    recipe = original_controller_recipe("z", "1d")
    assert (recipe.worlds, recipe.rollout, recipe.batch, recipe.entropy, recipe.steps) == (
        6,
        128,
        192,
        0.01,
        60_000_000,
    )
    short = recipe.replace(rollout=32, validate_every=192, steps=192)
    heard, said = [], iter([0.9, 0.1, 0.4])  # two validations, of which the first is selected; then what is held out

    def play(policy, _, seeds):
        heard.append((seeds, {name: p.clone() for name, p in policy.network.named_parameters()}))
        goals = round(10 * next(said))
        # a goal with a contact counts here, as it did for the authors
        return [Ending(Event.GOAL, True)] * goals + [Ending(Event.TIMEOUT, False)] * (10 - goals)

    monkeypatch.setattr(controllers, "play", play)
    short = short.replace(steps=384)
    done = controllers.train_controller(short, tmp_path / "c", model=world_model(alignment="leading"))
    assert (done.best, done.held_out) == (pytest.approx(0.9), 0.4)
    assert [seeds.start for seeds, _ in heard] == [1000, 1000, 1100]
    selected = checkpoint.load(tmp_path / "c")
    assert selected.config.squash == "clip"
    for name, p in selected.named_parameters():
        assert torch.equal(p, heard[0][1][name])
        assert torch.equal(p, heard[2][1][name]), "held-out episodes are played by the selected controller"
    assert any(not torch.equal(p, selected.get_parameter(n)) for n, p in heard[1][1].items())
    kept = json.loads((tmp_path / "c" / "held_out.json").read_text())
    assert (kept["success_rate"], kept["step"]) == (0.4, 192)


@pytest.mark.slow
@pytest.mark.parametrize(("make", "scale"), [(default_controller_recipe, 1 / 32), (original_controller_recipe, 1.0)])
def test_only_our_own_end_to_end_training_scales_ranges(make, scale):
    recipe = make("e2e", "1d").replace(worlds=2, rollout=4, batch=8)
    network = learner.make_network(recipe, None)
    worlds = learner.make_worlds(recipe, network, None, None, 0)
    assert learner.make_ppo(recipe, worlds, network, "cpu").policy.features_extractor.scale == scale


@pytest.mark.parametrize(("name", "value"), [("gamma", 3.0), ("gae_lambda", 50.0), ("clip_range", 9.0), ("lr", 2.0)])
def test_settings_have_limits(name, value):
    with pytest.raises(ConfigError, match=rf"{name} is .*expected a number from 0 to 1\."):
        default_controller_recipe("z", "1d").replace(**{name: value})


@pytest.mark.slow
def test_end_to_end(few_episodes, tmp_path):
    recipe = default_controller_recipe("e2e", "1d").replace(**{**SMALL, "steps": 64})
    controllers.train_controller(recipe, tmp_path / "c")
    policy = load_any_model(tmp_path / "c")
    assert policy.act(*Simulator(environment(recipe), 3, seed=1).observe()).shape == (3, 3)


@pytest.mark.parametrize("env", ["ian", "navrep-train"])
def test_training_on_scenarios_of_a_suite_is_said(env, tmp_path):
    said = []
    with pytest.raises(ConfigError):  # there is no model, which is found out after what is said
        controllers.train_controller(
            default_controller_recipe("z", "1d").replace(env=env), tmp_path / "c", report=said.append
        )
    assert [("navrep27" in line) for line in said] == [True] * (env == "ian")


@pytest.mark.slow
def test_a_network_is_continued(few_episodes, tmp_path):
    model = world_model()
    torch.manual_seed(5)
    network = Controller(ControllerConfig(21)).eval()
    init = Policy(network, "z", "1d", None, model, name="given")
    before = {name: p.clone() for name, p in network.named_parameters()}
    recipe = default_controller_recipe("z", "1d").replace(**{**SMALL, "steps": 64, "lr": 1e-9})
    controllers.train_controller(recipe, tmp_path / "c", model=model, init=init)
    trained = checkpoint.load(tmp_path / "c")
    assert trained.config.squash == "clip"  # it keeps its own bounds
    for name, p in trained.named_parameters():
        torch.testing.assert_close(p, before[name], rtol=1e-4, atol=1e-6)
    assert json.loads((tmp_path / "c" / "recipe.json").read_text())["data"]["init"] == "given"
    with pytest.raises(CheckpointError, match="do not fit"):
        controllers.train_controller(recipe.replace(features="zh"), tmp_path / "d", model=model, init=init)


@pytest.mark.slow
def test_a_resume_need_not_name_what_it_went_on_from(few_episodes, tmp_path):
    model = world_model()
    init = Policy(Controller(ControllerConfig(21, n_hidden=24)), "z", "1d", None, model, name="given")
    recipe = default_controller_recipe("z", "1d").replace(**SMALL)
    controllers.train_controller(recipe, tmp_path / "c", model=model, init=init, stop_after=64)
    done = controllers.train_controller(recipe, tmp_path / "c", model=model, resume=True)
    assert done.steps == 128
    assert checkpoint.load(tmp_path / "c").config.n_hidden == 24


@pytest.mark.slow
def test_a_refused_training_leaves_the_folder_free(few_episodes, tmp_path):
    model = world_model()
    recipe = default_controller_recipe("z", "1d").replace(**{**SMALL, "steps": 32, "rollout": 4})
    with pytest.raises(ConfigError, match="physics"):
        controllers.train_controller(recipe.replace(physics="foo"), tmp_path / "c", model=model)
    assert controllers.train_controller(recipe, tmp_path / "c", model=model).steps == 32


@pytest.mark.slow
def test_a_resume_repairs_what_a_stopped_run_left_half_done(few_episodes, tmp_path):
    model, out = world_model(), tmp_path / "c"
    recipe = default_controller_recipe("z", "1d").replace(**{**SMALL, "steps": 32, "rollout": 4})
    controllers.train_controller(recipe, out, model=model)
    whole = {path: path.read_bytes() for path in out.glob("**/*.safetensors") if "checkpoints" not in path.parts}
    assert len(whole) == 2
    (out / "model.safetensors").unlink()  # as killed before it was published
    (out / "world_model" / "config.json").unlink()
    (out / "world_model" / "model.safetensors").write_bytes(b"half")
    controllers.train_controller(recipe, out, model=model, resume=True)
    assert {path: path.read_bytes() for path in whole} == whole
    assert load_any_model(out).features == "z"


def test_refit_refuses_what_is_no_policy(tmp_path):
    recipe = default_controller_recipe("z", "1d").replace(**SMALL, refit=True)
    model = world_model()
    with pytest.raises(CheckpointError, match=r"--init is a .*expected a policy") as error:
        controllers.train_controller(recipe, tmp_path / "c", model=model, init=model)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_a_released_policy_is_continued(released, few_episodes, tmp_path, monkeypatch):
    monkeypatch.setenv("NAVREP_RELEASED_DIR", str(released))
    init = zoo.load("transformer_1d_z.released")
    model = zoo.load("transformer_1d.released")
    recipe = default_controller_recipe("z", "1d").replace(**{**SMALL, "steps": 64, "lr": 1e-9})
    controllers.train_controller(recipe, tmp_path / "c", model=model, model_name="transformer_1d.released", init=init)
    policy = load_any_model(tmp_path / "c")
    scan, state = Simulator(environment(recipe), 6, seed=1).observe()
    for one in (policy, init):
        one.reset(batch_size=6)
    np.testing.assert_allclose(policy.act(scan, state), init.act(scan, state), atol=1e-3)


def test_bad_input(tmp_path):
    recipe = default_controller_recipe("h", "1d").replace(**SMALL)
    for model, words in (
        (checkpoint.make("vae", {"lidar": "1d"}), "need a memory"),
        (world_model("rings"), "reads rings, expected 1d"),
        (checkpoint.make("memory", {}), "without a V"),
    ):
        with pytest.raises(ConfigError, match=words) as error:
            controllers.train_controller(recipe, tmp_path / "c", model=model)
        assert "\n" not in str(error.value)
    with pytest.raises(ConfigError, match="divisor of worlds x rollout"):
        recipe.replace(batch=33)
    assert not (tmp_path / "c").exists()


def test_memory_that_is_fed_the_action_taken_lags_by_one_row():
    model = world_model()
    policy = Policy(Controller(ControllerConfig(21)), "h", "1d", None, model, context="newest-32")
    simulator = Simulator(make_config("navrep-train"), 2, seed=0)
    rows, actions, found = [], [], []
    policy.reset(batch_size=2)
    rng = np.random.default_rng(0)
    for t in range(5):
        scan, state = simulator.observe()
        if t == 3:
            policy.reset(mask=np.array([False, True]))
        found.append(policy.encode(scan, state)[:, 5:])
        action = np.zeros((2, 3), np.float32)
        action[:, :2] = rng.uniform(-1, 1, (2, 2))
        policy.observe(action)
        simulator.step(action)
        rows.append((scan, state))
        actions.append(action)
    with torch.no_grad():
        z = torch.stack([model.encode(model.observation(s)) for s, _ in rows], 1)
        goal = torch.stack([torch.tensor(state[:, :2]) for _, state in rows], 1)
        taken = torch.stack([torch.tensor(a) for a in actions], 1)
        whole, _ = model.hidden(z, goal, taken)
        second, _ = model.hidden(z[1:, 3:], goal[1:, 3:], taken[1:, 3:])
    assert not found[0].any()
    for t in range(1, 5):
        np.testing.assert_allclose(found[t][0], whole[0, t - 1].numpy(), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(found[2][1], whole[1, 1].numpy(), rtol=1e-4, atol=1e-5)
    assert not found[3][1].any()
    np.testing.assert_allclose(found[4][1], second[0, 0].numpy(), rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_play_counts_each_episode_once():
    model = world_model()
    torch.manual_seed(0)
    policy = Policy(Controller(ControllerConfig(21)), "z", "1d", None, model)
    config = make_config("navrep-test", physics="original")
    both = play(policy, config, [5000, 5001, 5002])
    assert all(e.event != Event.NONE for e in both)
    assert [play(policy, config, [seed])[0] for seed in (5000, 5001, 5002)] == both
