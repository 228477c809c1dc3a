"""``navrep-data play``."""

from __future__ import annotations

from typing import Annotated

import typer

from navrep_data.cli._common import say, say_err


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
    speed: Annotated[float, typer.Option("--speed", help="1 = real time.")] = 1.0,
) -> None:
    """Drive the robot by keyboard, where there is a window.

    Arrows or w a s d q e drive, r starts the next episode, Escape ends.
    """
    from navrep_data.envs import NavRepEnv, play
    from navrep_data.envs.playing import HELP
    from navrep_data.envs.window import need_display

    need_display()
    world = NavRepEnv(env, physics=physics, episode=episode, humans=humans, obstacles=obstacles)
    say_err(HELP)
    endings = play(world, seed=seed, episodes=episodes, speed=speed, report=say)
    say(f"{len(endings)} episodes, {endings.count('goal')} at the goal")
