"""``navrep-data play``."""

from __future__ import annotations

from typing import Annotated

import typer

from navrep_data.cli._common import say, say_err
from navrep_data.errors import ConfigError


def _place(name: str, text: str) -> tuple[float, ...]:
    """Return numbers with commas between them."""
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(f"--{name} is {text!r}, expected numbers with commas between them: 1.5,-2") from None


def play_command(
    env: Annotated[str, typer.Option("--env", help="Environment.")] = "navrep-train",
    physics: Annotated[
        str | None, typer.Option("--physics", help="consistent or original.", show_default="consistent")
    ] = None,
    episode: Annotated[
        int | None, typer.Option("--episode", help="Number of the first episode, where episodes are numbered.")
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Same seed, same worlds.", show_default="any")] = None,
    humans: Annotated[
        int | None, typer.Option("--humans", help="Mean number of humans.", show_default="the environment's")
    ] = None,
    obstacles: Annotated[
        int | None, typer.Option("--obstacles", help="Most squares and walls.", show_default="the environment's")
    ] = None,
    episodes: Annotated[int | None, typer.Option("--n", help="End after so many episodes.")] = None,
    start: Annotated[
        str | None, typer.Option("--start", metavar="X,Y[,THETA]", help="Where the robot starts \\[m, rad].")
    ] = None,
    goal: Annotated[str | None, typer.Option("--goal", metavar="X,Y", help="Where it wants to go \\[m].")] = None,
    speed: Annotated[float, typer.Option("--speed", help="1 = real time.")] = 1.0,
    policy: Annotated[
        str | None,
        typer.Option("--policy", help="Who drives while no key is down, as in benchmark.", show_default="nobody"),
    ] = None,
) -> None:
    """Drive the robot by keyboard, where there is a window.

    Arrows or w a s d q e drive, r starts the next episode, Escape ends.
    """
    from navrep_data.envs import NavRepEnv, play
    from navrep_data.envs.playing import HELP
    from navrep_data.envs.window import need_display

    options = {name: _place(name, text) for name, text in (("start", start), ("goal", goal)) if text is not None}
    need_display()
    world = NavRepEnv(env, physics=physics, episode=episode, humans=humans, obstacles=obstacles)
    say_err(HELP)
    endings = play(world, seed=seed, options=options or None, episodes=episodes, speed=speed, report=say, policy=policy)
    say(f"{len(endings)} episodes, {endings.count('goal')} at the goal")
