"""What the single and the vectorised environment share: a Simulator, which episode comes next, and what `info` says."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from navrep_data.errors import ConfigError, check_whole
from navrep_data.schema import ACTION_SIZE, ROBOT_STATE_SIZE, Event
from navrep_data.sim import SimConfig, Simulator, make_config, numpy_seed, scale_actions
from navrep_data.sim.simulator import MAX_NUMPY_SEED, MAX_SEED

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]
Observation = dict[str, F32]

EVENT_LABELS = np.array([event.label for event in Event], object)
TERMINAL = np.array([event.terminal for event in Event])
# Goals and starts lie within this of each other [m]; a robot that drives away may get further.
_WORLD_SIZE = 1000.0


def make_env_config(env: str | SimConfig, **changes: Any) -> SimConfig:
    """Return the config of an environment's name, or a config itself, with some fields changed (None = unchanged)."""
    if isinstance(env, SimConfig):
        return env.replace(**{name: value for name, value in changes.items() if value is not None})
    return make_config(env, **changes)


def observation_space(config: SimConfig) -> Any:
    """Return Dict(scan, robot_state): ranges in [0, range_max], the state within bounds that no robot leaves."""
    low, high = state_bounds(config)
    shape = lead(config)
    return gymnasium.spaces.Dict(
        scan=gymnasium.spaces.Box(0.0, config.sensor.range_max, (*shape, config.sensor.n_rays), np.float32),
        robot_state=gymnasium.spaces.Box(np.broadcast_to(low, (*shape, 5)), np.broadcast_to(high, (*shape, 5))),
    )


def action_space(config: SimConfig) -> Any:
    """Return Box(-1, 1, (3,)): shares of the robot's largest velocities."""
    return gymnasium.spaces.Box(-1.0, 1.0, (*lead(config), ACTION_SIZE), np.float32)


def lead(config: SimConfig) -> tuple[int, ...]:
    """Return the axes that come before an observation's own: none for one robot, (robots,) for several."""
    return () if config.robots == 1 else (config.robots,)


def state_bounds(config: SimConfig) -> tuple[F32, F32]:
    """Return low and high of the robot state, ndarrays of shape (5,), float32."""
    vx, vy, omega = config.max_velocity
    # twice the command: limited acceleration overshoots
    speed = 2.0 * float(np.hypot(vx, vy))
    reach = _WORLD_SIZE + speed * config.time_limit
    high = np.array([reach, reach, speed, speed, 2.0 * omega], np.float32)
    assert len(high) == ROBOT_STATE_SIZE
    return -high, high


def own_spec(spec: Any, config: SimConfig, most_steps: int | None) -> Any:
    """Return a copy of an environment's spec that makes it again anywhere, and says how many steps an episode has.

    The registered spec does not say it, since settings change it; and gymnasium would cut episodes beside the
    simulator. Maps are where they were found, whatever the working folder is later.
    """
    if spec is None:
        return None
    spec = copy.deepcopy(spec)
    if spec.max_episode_steps is None:
        spec.max_episode_steps = most_steps
    if spec.kwargs.get("maps"):
        spec.kwargs["maps"] = config.map_files
    return spec


class EnvWorlds:
    """A batch of worlds that play episodes one after the other.

    Parameters
    ----------
    config : SimConfig
        Environment, physics, sensor.
    n : int
        Number of worlds.
    episode : int or None
        Number of the episode that world 0 starts with, in environments with numbered episodes; world i starts with
        ``episode + i``, and each goes on in steps of `n`.

    Raises
    ------
    ConfigError
        If there are no numbered episodes and `episode` is given, or a value is out of range.
    """

    def __init__(self, config: SimConfig, n: int, episode: int | None = None) -> None:
        self.config = config
        self.n = n
        self._scenarios = len(config.scenarios)
        self.numbered = self._scenarios > 0 or _has_numbers(config.env)
        self._most = MAX_NUMPY_SEED if self.numbered else MAX_SEED  # the largest seed
        first = 0 if episode is None else self._number(episode)
        self.sim = Simulator(config, n)
        self._lead = lead(config)
        # what the next reset plays: a number of the environment's own list, or a numpy seed as it is
        self._next = first + np.arange(n)
        self._plain = np.zeros(n, np.bool_)
        # what nobody has seeded yet; lists of numbered episodes start with their first
        listed = self.numbered and (self._scenarios == 0 or episode is not None)
        self._fresh = np.full(n, not listed)
        self._restarts = np.zeros(n, np.bool_)  # streams that start anew at the next reset, with these seeds
        self._streams = np.zeros(n, np.int64)
        self._places: tuple[F64, F64] | None = None  # starts and goals of the next reset
        self.seeds = np.zeros(n, np.int64)  # numpy seeds of the present episodes
        self.events = np.zeros(n, np.uint8)

    def _number(self, episode: Any) -> int:
        if self._scenarios:
            return check_whole("episode", episode, 0, MAX_NUMPY_SEED)
        numpy_seed(self.config.env, episode)  # checks both
        return int(episode)

    def check_seed(self, seed: object) -> int:
        """Return a seed that names an episode or a stream of these worlds as an int, or refuse it."""
        return check_whole("seed", seed, 0, self._most)

    def choose(
        self, seeds: Sequence[int | None], options: Mapping[str, Any] | None, random: np.random.Generator
    ) -> None:
        """Decide what the next reset plays.

        Parameters
        ----------
        seeds : sequence of int or None, one per world
            From :meth:`check_seed`: numpy seeds in environments with numbered episodes, streams in the others; None =
            go on.
        options : mapping, optional
            ``{"episode": k}``: world i plays number k + i; ``{"start": ..., "goal": ...}``: see :meth:`restart`.
        random : numpy.random.Generator
            Seeds what nobody has seeded.
        """
        known = {"episode", "goal", "reset_mask", "start"}
        unknown = sorted(set(options or {}) - known)
        if unknown:
            raise ConfigError(f"Unknown reset option {unknown[0]!r}, expected one of: {', '.join(sorted(known))}.")
        given_places = (options or {}).get("start"), (options or {}).get("goal")
        self._places = None
        if any(place is not None for place in given_places):
            starts, goals = given_places
            self._places = _places("start", starts, self.n, (2, 3)), _places("goal", goals, self.n, (2,))
        if options and options.get("episode") is not None:
            self._next = self._number(options["episode"]) + np.arange(self.n)
            self._plain[:] = self._fresh[:] = False
            return
        given = np.array([seed is not None for seed in seeds])
        fresh = self._fresh & ~given
        keys = np.zeros(self.n, np.int64)
        for i, seed in enumerate(seeds):
            if seed is not None:
                keys[i] = seed
        if fresh.any():
            keys[fresh] = random.integers(0, self._most, int(fresh.sum()))
        chosen = given | fresh
        self._fresh[chosen] = False
        if self.numbered:
            self._next[chosen] = keys[chosen]
            self._plain |= chosen
        else:
            self._streams[chosen] = keys[chosen]
            self._restarts |= chosen

    def restart(self, mask: Mask) -> None:
        """Start the next episode in the worlds of `mask`, with start and goal that :meth:`choose` was told of."""
        places, self._places = self._places, None
        chosen = mask.copy()
        self._draw(mask)
        if places is not None:
            # users speak of places in the frame of the map's file
            starts, goals = places
            origins = self.sim.origins
            self.sim.place(starts - np.pad(origins, ((0, 0), (0, 1))), goals - origins, chosen)

    def _draw(self, mask: Mask) -> None:
        self.events[mask] = 0
        if self.numbered:
            self._restart_numbered(mask)
            return
        anew = mask & self._restarts
        if anew.any():
            self.sim.restart(self._streams, anew)
            self._restarts &= ~anew
            mask = mask & ~anew
        if mask.any():
            self.sim.reset(mask)

    def _restart_numbered(self, mask: Mask) -> None:
        for i in np.flatnonzero(mask):
            k = int(self._next[i])
            plain = self._plain[i] or self._scenarios
            self.seeds[i] = k % (MAX_NUMPY_SEED + 1) if plain else numpy_seed(self.config.env, k)
        # the suite navrep27: round r of scenario i has the numpy seed 27 r + i
        scenes = mask & ~self._plain if self._scenarios else np.zeros_like(mask)
        if scenes.any():
            self.sim.reset_scenarios(self._next % self._scenarios, self.seeds, scenes)
        others = mask & ~scenes
        if others.any():
            self.sim.reset_seeded(self.seeds, others)
        self._next[mask] += self.n

    def step(self, actions: ArrayLike, mask: Mask | None = None) -> F64:
        """Advance all, or those of `mask`, under actions in [-1, 1], (n, 3) or (n, robots, 3).

        Returns rewards and sets :attr:`events`; both are 0 outside `mask`.
        """
        commands = np.asarray(actions, np.float64)
        if commands.shape != (self.n, *self._lead, ACTION_SIZE):
            raise ConfigError(f"action has shape {commands.shape[1:]}, expected {(*self._lead, ACTION_SIZE)}.")
        rewards, self.events = self.sim.step(scale_actions(self.config, commands), mask)
        return rewards

    def observe(self, mask: Mask | None = None) -> Observation:
        """Return scan (n, ..., n_rays) [m] and robot_state (n, ..., 5), fresh arrays; see :meth:`Simulator.observe`."""
        scans, states = self.sim.observe(mask)
        return {"scan": scans, "robot_state": states}

    def robots(self) -> F64:
        """Return x, y [m], theta [rad] of the robots, (n, 3) or (n, robots, 3), on maps in the frame of the file."""
        poses = self.sim.poses()
        poses[..., :2] += self.sim.origins.reshape(self.n, *(1 for _ in self._lead), 2)
        return poses

    def drawn_robots(self) -> F64:
        """Return x, y [m], theta [rad] of the robots, (n, robots, 3), in the frame of the simulator's states."""
        return self.sim.poses().reshape(self.n, self.config.robots, 3)

    def humans(self) -> F64:
        """Return x, y [m], vx, vy [m/s] of the humans, (n, most humans, 4), as :meth:`robots`; NaN in empty slots."""
        out = self.sim.human_motions()
        out[..., :2] += self.sim.origins[:, None]
        return out

    def scenarios(self) -> NDArray[np.int64]:
        """Return which of the config's scenarios are played, (n,) indices; nothing where there are none."""
        return self.sim.scenarios_played() if self._scenarios else np.zeros(0, np.int64)


def _has_numbers(env: str) -> bool:
    try:
        numpy_seed(env, 0)
    except ConfigError:
        return False
    return True


def _places(name: str, value: Any, n: int, sizes: tuple[int, ...]) -> F64:
    """Return (n, largest size) of one place for all worlds, one each, or None; NaN = as drawn."""
    out = np.full((n, max(sizes)), np.nan)
    if value is None:
        return out
    try:
        rows = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        rows = np.zeros(0)
    if rows.shape[-1:] and rows.shape[-1] in sizes and rows.shape[:-1] in ((), (n,)) and np.isfinite(rows).all():
        out[:, : rows.shape[-1]] = rows
        return out
    wanted = "x, y [m], or with a heading [rad]" if len(sizes) > 1 else "x, y [m]"
    raise ConfigError(f"{name} is {value}, expected finite {wanted}, for all worlds or a row for each of {n}.")
