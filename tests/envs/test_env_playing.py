"""Driving by keyboard, with key events as matplotlib sends them."""

import gymnasium
import matplotlib
import numpy as np
import pytest

matplotlib.use("Agg")
from matplotlib.backend_bases import CloseEvent, KeyEvent

from navrep_data.envs import NavRepEnv, play, window
from navrep_data.envs.playing import Keyboard, drive
from navrep_data.envs.window import Window
from navrep_data.errors import ConfigError, DisplayError


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


def test_keys_add_up_while_they_are_held():
    clock = Clock()
    keyboard = Keyboard(clock)
    assert keyboard.action().tolist() == [0, 0, 0]
    keyboard.on_key("up", True)
    keyboard.on_key("A", True)
    keyboard.on_key("left", True)
    assert keyboard.action().tolist() == [1, 1, 1]
    keyboard.on_key("w", True)
    assert keyboard.action().tolist() == [1, 1, 1]
    keyboard.on_key("down", True)
    keyboard.on_key("w", False)
    clock.now = 1.0
    assert keyboard.action().tolist() == [0, 1, 1]
    assert keyboard.action().dtype == np.float32


def test_key_repeat_does_not_stutter():
    clock = Clock()
    keyboard = Keyboard(clock)
    keyboard.on_key("up", True)
    keyboard.on_key("up", False)
    clock.now = 0.03
    assert keyboard.action()[0] == 1
    keyboard.on_key("up", True)
    clock.now = 5.0
    assert keyboard.action()[0] == 1
    keyboard.on_key("up", False)
    clock.now = 5.1
    assert keyboard.action()[0] == 0


class Hands:
    """Presses keys of a real matplotlib window, in memory, as time goes by."""

    def __init__(self, script):
        self.keyboard = Keyboard()
        self.window = Window("t", self.keyboard.on_key, lambda: setattr(self.keyboard, "quit", True))
        self.window.wait = self.wait
        self.script = list(script)
        self.ticks = 0

    def key(self, name, key):
        canvas = self.window.figure.canvas
        canvas.callbacks.process(name, KeyEvent(name, canvas, key))

    def wait(self, seconds):
        self.ticks += 1
        for tick, name, key in self.script:
            if tick == self.ticks:
                if name == "close":
                    canvas = self.window.figure.canvas
                    canvas.callbacks.process("close_event", CloseEvent("close_event", canvas))
                else:
                    self.key(f"key_{name}_event", key)


@pytest.fixture
def hands():
    made = []

    def make(script):
        made.append(Hands(script))
        return made[-1]

    yield make
    for one in made:
        one.window.close()


@pytest.mark.slow
def test_the_robot_goes_where_the_keys_say(hands):
    env = NavRepEnv("navrep-train", humans=0, obstacles=0)
    # show() waits once and the loop waits once: two ticks per step
    person = hands([(1, "press", "up"), (13, "press", "escape")])
    uphill = next(s for s in range(50) if abs(env.reset(seed=s)[1]["robot"][2] - np.pi / 2) < 0.5)
    assert drive(env, person.keyboard, person.window, seed=uphill, speed=100.0) == []
    trail = np.array(env._trail)[:, 0]
    theta = env._worlds.robots()[0, 2]
    moved = trail[-1] - trail[0]
    np.testing.assert_allclose(moved, np.linalg.norm(moved) * np.array([np.cos(theta), np.sin(theta)]), atol=1e-9)
    assert np.linalg.norm(moved) > 0.9


@pytest.mark.slow
def test_restart_and_endings(hands):
    env = NavRepEnv("navrep-test", episode=7, time_limit=1.0, humans=0, obstacles=0)
    person = hands([(3, "press", "r")])
    lines = []
    assert drive(env, person.keyboard, person.window, episodes=2, speed=50.0, report=lines.append) == ["timeout"] * 2
    assert lines == ["episode 1: timeout", "episode 2: timeout"]
    # number 7 was given up, 8 and 9 were played, 10 began
    assert env._worlds.seeds[0] == 1010


def test_a_policy_drives_while_no_key_is_down(hands):
    env = NavRepEnv("navrep-test", episode=3, humans=0, obstacles=0)
    assert drive(env, (person := hands([])).keyboard, person.window, episodes=1, speed=100.0, policy="goal") == ["goal"]
    person = hands([(1, "press", "a"), (7, "press", "escape")])
    drive(env, person.keyboard, person.window, options={"episode": 3}, speed=100.0, policy="goal")
    trail = np.array(env._trail)[:, 0]
    sideways = np.array([-np.sin(env._worlds.robots()[0, 2]), np.cos(env._worlds.robots()[0, 2])])
    assert (trail[2] - trail[1]) @ sideways == pytest.approx(0.2), "the key counts"


def test_closing_the_window_ends(hands):
    env = NavRepEnv("navrep-test")
    person = hands([(4, "close", None)])
    assert drive(env, person.keyboard, person.window, speed=50.0) == []
    assert person.ticks <= 6


def test_matplotlibs_own_shortcuts_are_off(hands, monkeypatch):
    person = hands([])
    monkeypatch.setattr(type(person.window.figure), "savefig", lambda *a, **k: pytest.fail("s must not save"))
    for key in "sqrlk":
        person.key("key_press_event", key)
    assert matplotlib.pyplot.fignum_exists(person.window.figure.number)


def test_without_a_display_it_says_so():
    with pytest.raises(DisplayError, match="No window can be opened here"):
        play(NavRepEnv("navrep-test"))


@pytest.mark.slow
def test_play_opens_and_closes_its_window(monkeypatch):
    monkeypatch.setattr(window, "has_display", lambda: True)
    monkeypatch.setattr("matplotlib.figure.Figure.show", lambda self: None)
    before = matplotlib.pyplot.get_fignums()
    env = NavRepEnv("navrep-test", time_limit=0.4, humans=0, obstacles=0)
    assert play(env, episodes=1, speed=100.0, report=lambda line: None) == ["timeout"]
    assert matplotlib.pyplot.get_fignums() == before


def test_only_a_robot_of_ours_can_be_played(hands):
    person = hands([])
    with pytest.raises(ConfigError, match="cannot be played: expected an environment of navrep-data"):
        drive(gymnasium.make("CartPole-v1"), person.keyboard, person.window)
    with pytest.raises(ConfigError, match="speed is 0"):
        drive(NavRepEnv("navrep-test"), person.keyboard, person.window, speed=0)


def test_the_command_says_so_in_one_line(capsys):
    from navrep_data.cli.main import run

    with pytest.raises(SystemExit) as stop:
        run(["play", "--env", "navrep-test"])
    err = capsys.readouterr().err
    assert stop.value.code == 2
    assert err.startswith("Error: No window can be opened here")
    assert err.count("\n") == 1
