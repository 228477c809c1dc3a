"""Driving a robot by keyboard."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from navrep_data.envs.single import NavRepEnv
from navrep_data.envs.wheel import Wheel
from navrep_data.envs.window import Window, need_display
from navrep_data.errors import ConfigError
from navrep_data.policies import AnyPolicy

# Shares of the largest velocities along x (forward), y (left) and of the rotation (left)
KEYS: dict[str, tuple[float, float, float]] = {
    "up": (1.0, 0.0, 0.0), "w": (1.0, 0.0, 0.0),
    "down": (-1.0, 0.0, 0.0), "s": (-1.0, 0.0, 0.0),
    "a": (0.0, 1.0, 0.0), "d": (0.0, -1.0, 0.0),
    "left": (0.0, 0.0, 1.0), "q": (0.0, 0.0, 1.0),
    "right": (0.0, 0.0, -1.0), "e": (0.0, 0.0, -1.0),
}  # fmt: skip
"""Key (matplotlib's name) -> action while it is down."""
RESTART = ("r", "enter")
QUIT = ("escape", "x")
HELP = "arrows or w a s d q e drive (left, right, q, e turn; a, d sidestep), r starts the next episode, escape ends"
# Held keys repeat as up and down in quick succession on some systems: a key counts as held this long after it went up.
_RELEASE_SECONDS = 0.06


class Keyboard:
    """Which keys are down, and what that means.

    Parameters
    ----------
    clock : callable
        Returns the time [s].
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._released: dict[str, float | None] = {}
        self.restart = False
        self.quit = False

    def on_key(self, key: str, pressed: bool) -> None:
        """Take note that a key went down or up."""
        name = key.lower()
        if pressed and name in RESTART:
            self.restart = True
        elif pressed and name in QUIT:
            self.quit = True
        elif name in KEYS:
            self._released[name] = None if pressed else self._clock()

    def action(self) -> NDArray[np.float32]:
        """Return the action of the keys that are down, ndarray of shape (3,), float32, in [-1, 1]."""
        now = self._clock()
        held = [k for k, up in self._released.items() if up is None or now - up < _RELEASE_SECONDS]
        total = np.sum([KEYS[k] for k in held], axis=0) if held else np.zeros(3)
        return np.clip(total, -1.0, 1.0).astype(np.float32)


def play(
    env: gymnasium.Env[Any, Any],
    *,
    seed: int | None = None,
    options: dict[str, Any] | None = None,
    episodes: int | None = None,
    speed: float = 1.0,
    report: Callable[[str], None] = print,
    policy: AnyPolicy | None = None,
) -> list[str]:
    """Let somebody at the keyboard drive the robot.

    Parameters
    ----------
    env : gymnasium.Env
        A NavRep environment with one robot, wrapped or not.
    seed : int, optional
        For the first ``env.reset``.
    options : dict, optional
        For the first ``env.reset``; ``start`` and ``goal`` for all.
    episodes : int, optional
        End after so many; without it, at Escape.
    speed : float
        1 = real time.
    report : callable
        Gets one line per episode.
    policy : str, callable or BasePolicy, optional
        Who drives instead while no key is down, see :func:`navrep_data.policies.resolve_policy`.

    Returns
    -------
    list of str
        How each finished episode ended.

    Raises
    ------
    DisplayError
        If no window can be opened.
    ConfigError
        If `env` is no NavRep environment with one robot.
    """
    need_display()
    keyboard = Keyboard()
    window = Window("navrep-data play", keyboard.on_key, lambda: setattr(keyboard, "quit", True))
    try:
        return drive(
            env, keyboard, window, seed=seed, options=options, episodes=episodes, speed=speed, report=report,
            policy=policy,
        )  # fmt: skip
    finally:
        window.close()


def drive(
    env: gymnasium.Env[Any, Any],
    keyboard: Keyboard,
    window: Window,
    *,
    seed: int | None = None,
    options: dict[str, Any] | None = None,
    episodes: int | None = None,
    speed: float = 1.0,
    report: Callable[[str], None] = print,
    policy: AnyPolicy | None = None,
) -> list[str]:
    """Do what :func:`play` does, with a keyboard and a window that are there already."""
    world = env.unwrapped
    if not isinstance(world, NavRepEnv) or world.action_space.shape != (3,):
        raise ConfigError(f"{world} cannot be played: expected an environment of navrep-data with one robot.")
    if not 0.01 <= speed <= 100.0:
        raise ConfigError(f"speed is {speed!r}, expected a number from 0.01 to 100.")
    wheel = None if policy is None else Wheel(world, policy)
    endings: list[str] = []
    places = {name: place for name, place in (options or {}).items() if name in ("start", "goal")} or None
    _, info = env.reset(seed=seed, options=options)
    if wheel is not None:
        wheel.begin(info)
    due = time.monotonic()
    while not keyboard.quit and (episodes is None or len(endings) < episodes):
        # a policy is asked in any case: what it remembers goes on where a key takes over
        chosen = None if wheel is None else wheel.action()
        pressed = keyboard.action()
        _, _, terminated, truncated, info = env.step(pressed if chosen is None or pressed.any() else chosen)
        window.show(world.frame())
        if terminated or truncated:
            endings.append(str(info["event"]))
            report(f"episode {len(endings)}: {info['event']}")
        if terminated or truncated or keyboard.restart:
            keyboard.restart = False
            _, info = env.reset(options=places)
            if wheel is not None:
                wheel.begin(info)
        due = max(due + world.config.sensor.dt / speed, time.monotonic())
        window.wait(due - time.monotonic())
    return endings
