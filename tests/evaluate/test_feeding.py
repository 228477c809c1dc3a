"""What networks are fed in a benchmark: their contract's ranges, the robot in proportion, and what was executed."""

import numpy as np
import pytest

from navrep_data.errors import ConfigError
from navrep_data.evaluate import get_suite
from navrep_data.evaluate.metrics import Contacts
from navrep_data.evaluate.reproduce.testing import scores
from navrep_data.evaluate.results import Results, file_name, header_of
from navrep_data.evaluate.runner import play
from navrep_data.evaluate.suite_worlds import SuiteWorlds
from navrep_data.policies import Driver, FunctionPolicy, NetworkPolicy, PolicySpec, resolve_policy
from navrep_data.schema import RobotContract, result_name
from navrep_data.sim import make_config
from navrep_data.testing import tiny_checkpoint

SUITE = get_suite("navreptest")


class Recording:
    """Acts out of bounds, and keeps what it is told."""

    name, inference = "recording", "deterministic"

    def __init__(self, ranges="contract", robot=None):
        self.ranges, self.robot = ranges, robot or RobotContract()
        self.told, self.others = [], []

    def for_robot(self, max_speed, radius):
        other = Recording(self.ranges, RobotContract(max_speed, radius))
        self.others.append(other)
        return other

    def reset(self, batch_size=None, mask=None, seed=None):
        pass

    def act(self, scan, state):
        return np.tile([2.0, -0.5, 0.0], (len(scan), 1))

    def observe(self, executed):
        assert executed.shape == (64, 3)
        self.told.append(executed[0])


def drive(policy, scaling="robot", steps=3, **changes):
    worlds = SuiteWorlds(make_config("navrep-test", physics="original", **changes), 2)
    driver = Driver(NetworkPolicy(policy, first_seed=1000, scaling=scaling))
    todo = iter([[0], [1]])
    played = play(SUITE, worlds, driver, lambda: next(todo, None))
    for _ in range(steps):
        next(played)
    return policy


def test_policies_are_told_what_the_robot_was_sent():
    policy = drive(Recording())
    np.testing.assert_allclose(policy.told, [[1.0, -0.5, 0.0]] * 3)
    assert not policy.others  # the suite's robot is that of training


def test_a_function_with_observe_is_told_too():
    class Function(Recording):
        __call__ = Recording.act

    told = Function()
    worlds = SuiteWorlds(make_config("navrep-test", physics="original"), 2)
    todo = iter([[0], [1]])
    next(play(SUITE, worlds, Driver(FunctionPolicy("f", told)), lambda: next(todo, None)))
    np.testing.assert_allclose(told.told, [[1.0, -0.5, 0.0]])


def test_another_robot_gets_the_policy_made_for_it():
    slow = {"max_velocity": (0.5, 0.5, 1.0)}
    policy = drive(Recording(), **slow)
    (other,) = policy.others
    assert other.robot == RobotContract(0.5, 0.3)
    np.testing.assert_allclose(other.told, [[0.5, -0.25, 0.0]] * 3)
    assert not policy.told
    as_trained = drive(Recording(), "none", **slow)
    assert not as_trained.others
    np.testing.assert_allclose(as_trained.told, [[0.5, -0.25, 0.0]] * 3)


def test_ranges_as_released_run_the_authors_software_as_it_is():
    policy = drive(Recording("as_released"), "none", max_velocity=(0.5, 0.5, 1.0))
    assert not policy.others
    assert not policy.told  # their memories were fed the network's own action


class Loaded(Recording):
    """As somebody's module holds a policy that knows robots, ready to be named."""

    def __call__(self, scan, state):
        return self.act(scan, state)


loaded = Loaded()


def test_a_loaded_policy_in_a_module_is_fed_as_by_its_name():
    for spec in (resolve_policy(loaded), resolve_policy(f"{__name__}:loaded")):
        assert (spec.kind, spec.settings()) == ("object", {"ranges": "contract", "scaling": "robot"})
        assert isinstance(spec.make(), NetworkPolicy)
    assert resolve_policy(loaded, scaling="none").settings()["scaling"] == "none"
    assert resolve_policy(loaded.act).kind == "function"
    with pytest.raises(ConfigError, match="loaded already"):
        resolve_policy(loaded, ranges="as_released")


def test_workers_in_other_folders_find_the_weights(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "weights").mkdir()
    assert resolve_policy("e2e_1d.v1", "weights").source == str(tmp_path / "weights")
    assert resolve_policy("e2e_1d.v1", "hf://user/name").source == "hf://user/name"


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"ranges": "cut"}, "ranges is 'cut', expected one of: contract, as_released"),
        ({"scaling": "half"}, "scaling is 'half', expected one of: robot, none"),
        ({"ranges": "as_released", "scaling": "robot"}, "unscaled: leave scaling out"),
    ],
)
def test_settings_that_mean_nothing_are_refused(how, words):
    with pytest.raises(ConfigError, match=words):
        resolve_policy("e2e_1d.20201026", **how)


def test_only_released_networks_have_ranges_as_released(tmp_path):
    for name in ("e2e_1d.v1", str(tiny_checkpoint(tmp_path / "own"))):
        with pytest.raises(ConfigError, match="is none of them: leave it out"):
            resolve_policy(name, ranges="as_released")
    assert resolve_policy("goal", ranges="as_released").settings() == {}
    spec = resolve_policy("e2e_1d.20201026", ranges="as_released")
    assert spec.settings() == {"ranges": "as_released", "scaling": "none"}


def test_results_say_how_a_network_was_fed_in_header_name_and_file():
    usual, authors, trained = (
        resolve_policy("e2e_1d.20201026", **how) for how in ({}, {"ranges": "as_released"}, {"scaling": "none"})
    )
    headers = [header_of(spec, SUITE, "original") for spec in (usual, authors, trained)]
    assert [Results(h).name for h in headers] == [
        "e2e_1d.20201026",
        "e2e_1d.20201026 (ranges as the authors fed them)",
        "e2e_1d.20201026 (as trained)",
    ]
    assert len({h["variant"] for h in headers}) == 3
    assert headers[0]["settings"]["ranges"] == "contract"
    assert headers[0]["settings"]["scaling"] == "robot"
    assert [file_name(s) for s in (usual, authors, trained)] == [
        "e2e_1d.20201026.json",
        "e2e_1d.20201026.ranges-as_released.json",
        "e2e_1d.20201026.scaling-none.json",
    ]
    noisy = {"inference": "as_released", "ranges": "as_released"}
    assert result_name("x", noisy) == "x (noise of the release, ranges as the authors fed them)"
    assert "ranges" not in header_of(PolicySpec("goal", "goal only", "goal", "baseline"), SUITE, "original")["settings"]


def test_runs_fed_as_the_authors_do_it_are_a_source_of_their_own():
    found = []
    for how, letters in (({}, "SS"), ({"ranges": "as_released"}, "SC"), ({"scaling": "none"}, "CC")):
        results = Results(header_of(resolve_policy("e2e_1d.20201026", **how), SUITE, "original"))
        results.outcome, results.contacts = list(letters), [Contacts()] * 2
        found.append(results)
    rates = {source: of["all"]["success_rate"] for source, of in scores(found)["e2e_1d"].items()}
    assert rates == {"released": 1.0, "released_as_fed": 0.5}
    assert set(scores(found[:1])["e2e_1d"]) == {"released"}
    assert scores(found[2:]) == {}


@pytest.mark.slow
def test_a_network_sees_the_office_as_long_as_its_contract(tmp_path, monkeypatch, maps):
    """The office map is 109 m wide; a network of 25 m must not see that."""
    from navrep_data.zoo.policy import Policy

    farthest = []
    fitted = Policy._fitted

    def spy(self, ranges, state):
        found = fitted(self, ranges, state)
        farthest.append((float(ranges.max()), float(found[0].max())))
        return found

    monkeypatch.setattr(Policy, "_fitted", spy)
    from navrep_data.evaluate.suite_worlds import SuiteWorlds

    own = tiny_checkpoint(tmp_path / "own")
    suite = get_suite("navrep27")
    driver = Driver(resolve_policy(str(own)).make())
    worlds = SuiteWorlds(suite.config("original"), 27)
    todo = iter([[k] for k in range(27)])
    next(play(suite, worlds, driver, lambda: next(todo, None)))
    assert max(seen for seen, _ in farthest) > 30.0
    assert max(fed for _, fed in farthest) <= 25.0
