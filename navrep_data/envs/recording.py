"""Films of episodes: GIF by pillow, MP4 by imageio-ffmpeg where that is installed."""

from __future__ import annotations

import importlib
import importlib.util
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from navrep_data.envs.single import NavRepEnv
from navrep_data.envs.wheel import Wheel
from navrep_data.errors import ConfigError, MissingExtraError
from navrep_data.policies import AnyPolicy

_FORMATS = (".gif", ".mp4")
# GIF counts hundredths of a second
_HUNDREDTH = 10
_COLOURS = 64


@dataclass(frozen=True)
class Recording:
    """What was filmed.

    Attributes
    ----------
    path : Path
        The film.
    event : str
        Why the episode ended, ``"none"`` where `max_steps` cut it.
    steps : int
        Its length.
    total_reward : float
        Sum of rewards.
    """

    path: Path
    event: str
    steps: int
    total_reward: float


def record(
    env: gymnasium.Env[Any, Any],
    policy: AnyPolicy,
    path: str | os.PathLike[str],
    *,
    seed: int | None = None,
    options: dict[str, Any] | None = None,
    max_steps: int | None = None,
    speed: float = 1.0,
    size: int = 480,
) -> Recording:
    """Play an episode and write it as a film.

    Parameters
    ----------
    env : gymnasium.Env
        A NavRep environment, wrapped or not, of any render mode.
    policy : str, callable or BasePolicy
        Who drives: what :func:`navrep_data.policies.resolve_policy` takes, such as ``"goal"``, a name of the zoo, what
        :func:`navrep_data.zoo.load` returned, or a function ``(scan, robot_state) -> action`` in [-1, 1] with one row
        per robot. It sees the environment's own scans, whatever wrappers make of them.
    path : path
        ``.gif``, or ``.mp4`` where imageio-ffmpeg is installed.
    seed, options
        For ``env.reset``.
    max_steps : int, optional
        End after so many steps.
    speed : float
        1 = as fast as the simulated time.
    size : int
        Width and height [pixels].

    Returns
    -------
    Recording
        What was filmed.

    Raises
    ------
    ConfigError
        If `path` has another ending, or `env` is no NavRep environment.
    UnknownNameError, PolicyError
        If the policy cannot be used.
    MissingExtraError
        If MP4 is asked for and imageio-ffmpeg is not installed.

    Examples
    --------
    >>> import gymnasium
    >>> from navrep_data.envs import record
    >>> env = gymnasium.make("navrep_data:NavRepTest-v0")
    >>> record(env, "goal", "episode.gif", options={"episode": 3}, size=200).event  # doctest: +SKIP
    'goal'
    """
    target = Path(path)
    world = _checked(env, target, speed)
    robot = Wheel(world, policy)
    _, info = env.reset(seed=seed, options=options)
    robot.begin(info)
    frames, total, steps, over = [world.frame(size)], 0.0, 0, False
    while not over and (max_steps is None or steps < max_steps):
        _, reward, terminated, truncated, info = env.step(robot.action())
        frames.append(world.frame(size))
        total, steps, over = total + float(reward), steps + 1, bool(terminated or truncated)
    seconds = world.config.sensor.dt / speed
    target.parent.mkdir(parents=True, exist_ok=True)
    (write_gif if target.suffix.lower() == ".gif" else write_mp4)(target, frames, seconds)
    return Recording(target, str(info["event"]), steps, total)


def _checked(env: gymnasium.Env[Any, Any], target: Path, speed: float) -> NavRepEnv:
    if target.suffix.lower() not in _FORMATS:
        raise ConfigError(f"The film is called {target.name!r}, expected a name that ends in {' or '.join(_FORMATS)}.")
    if target.suffix.lower() == ".mp4":
        _need_ffmpeg()
    if not 0.01 <= speed <= 100.0:
        raise ConfigError(f"speed is {speed!r}, expected a number from 0.01 to 100.")
    world = env.unwrapped
    if not isinstance(world, NavRepEnv):
        raise ConfigError(f"{world} cannot be filmed: expected an environment of navrep-data, a single one.")
    return world


def write_gif(path: Path, frames: list[NDArray[np.uint8]], seconds: float) -> None:
    """Write frames (h, w, 3), uint8, as a GIF that shows each for so many seconds."""
    # one palette for all: colours do not flicker, and files are small
    palette = Image.fromarray(np.concatenate([frames[0], frames[-1]])).quantize(_COLOURS)
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    duration = max(2 * _HUNDREDTH, round(seconds * 1000 / _HUNDREDTH) * _HUNDREDTH)
    part = path.with_name(path.name + ".part")
    images[0].save(part, "GIF", save_all=True, append_images=images[1:], duration=duration, loop=0, optimize=False)
    part.replace(path)


def _need_ffmpeg() -> Any:
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        raise MissingExtraError(
            "MP4 needs imageio-ffmpeg, which is not installed: pip install imageio-ffmpeg, or write a .gif."
        )
    return importlib.import_module("imageio_ffmpeg")


def write_mp4(path: Path, frames: list[NDArray[np.uint8]], seconds: float) -> None:
    """Write frames (h, w, 3), uint8, as an MP4 that shows each for so many seconds.

    Raises
    ------
    MissingExtraError
        If imageio-ffmpeg is not installed.
    """
    ffmpeg = _need_ffmpeg()
    height, width = frames[0].shape[:2]
    part = path.with_name(path.stem + ".part" + path.suffix)
    writer = ffmpeg.write_frames(str(part), (width, height), fps=1.0 / seconds, macro_block_size=1)
    writer.send(None)
    for frame in frames:
        writer.send(np.ascontiguousarray(frame))
    writer.close()
    part.replace(path)
