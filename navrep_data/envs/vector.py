"""Many worlds as one gymnasium vector environment, stepped together by the kernels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from navrep_data.envs.window import check_render_mode
from navrep_data.envs.worlds import (
    F64,
    TERMINAL,
    EnvWorlds,
    Mask,
    Observation,
    action_space,
    make_env_config,
    observation_space,
    own_spec,
)
from navrep_data.errors import ConfigError, check_whole, did_you_mean, whole_number
from navrep_data.schema import Event
from navrep_data.sim import SimConfig, WorldState
from navrep_data.sim.raster import Camera, draw_frame

Infos = dict[str, Any]


def _autoreset_mode(mode: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError:
        known = [known.value for known in AutoresetMode]
        raise ConfigError(
            f"autoreset_mode is {str(mode)!r}, expected one of: {', '.join(known)}.{did_you_mean(str(mode), known)}"
        ) from None


def _at_least_one(name: str, value: int | None) -> int | None:
    return None if value is None else check_whole(name, value, 1)


class NavRepVectorEnv(gymnasium.vector.VectorEnv[Observation, NDArray[np.float32], NDArray[Any]]):
    """Many worlds that step together: what ``gymnasium.make_vec(..., vectorization_mode="vector_entry_point")`` makes.

    World i starts with the episode that :class:`NavRepEnv` plays with ``seed + i`` or ``episode + i``, bit for bit,
    whatever the number of worlds. Later episodes are those of the single environment, too, where seeds name streams;
    numbered episodes go on in steps of `num_envs` (seed + i + num_envs, ...), so that the worlds share the list out.

    Parameters
    ----------
    num_envs : int
        Number of worlds.
    env : str or SimConfig
        As for :class:`NavRepEnv`.
    physics : str, optional
        As for :class:`NavRepEnv`.
    episode : int, optional
        World i starts with number ``episode + i`` at its first bare reset and goes on in steps of `num_envs`.
    render_mode : str, optional
        ``"rgb_array"``: :meth:`render` returns a picture of each world.
    autoreset_mode : gymnasium.vector.AutoresetMode or str
        When a world whose episode has ended starts its next one. ``"SameStep"``: in that step. ``"NextStep"``: in the
        next one, whose action it ignores (reward 0); gymnasium's wrappers of vector observations want this.
        ``"Disabled"``: by ``reset(options={"reset_mask": mask})`` of yours, before the next step. Same episodes in all.
    max_episode_steps : int, optional
        Cut episodes after so many steps (truncated, event ``cut``), as gymnasium's TimeLimit does.
    **changes
        Other fields of :class:`navrep_data.sim.SimConfig`.

    Notes
    -----
    Observations are dictionaries of arrays with a leading axis of worlds; rewards (N,) float64; terminations and
    truncations (N,) bool. ``infos`` follow gymnasium's convention, ``_key`` (N,) bool saying for whom a value holds:
    ``robot`` (N, 3), ``humans`` (N, most humans, 4) with NaN in empty slots, ``event`` (N,) uint8, codes of
    :class:`navrep_data.schema.Event` (``Event(code).label`` is what a single environment's info says), ``seed`` (N,)
    and ``scenario`` (N,), index in ``config.scenarios``, where there are such; all of them numbers, which wrappers can
    convert. Where episodes ended with SAME_STEP, ``final_obs`` (N,) holds their last observations (None elsewhere) and
    ``final_info`` the infos of their last steps, with the reason; observations are those of the next episodes.

    ``reset(options={"reset_mask": mask})`` resets some worlds only.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array"],
        "render_fps": 5,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        env: str | SimConfig = "navrep-train",
        *,
        physics: str | None = None,
        episode: int | None = None,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        max_episode_steps: int | None = None,
        **changes: Any,
    ) -> None:
        self.config = make_env_config(env, physics=physics, **changes)
        self.num_envs = num_envs = check_whole("num_envs", num_envs, 1)
        self.render_mode = check_render_mode(render_mode, self.metadata["render_modes"])
        self.autoreset_mode = _autoreset_mode(autoreset_mode)
        fps = max(1, round(1.0 / self.config.sensor.dt))
        self.metadata = {**self.metadata, "render_fps": fps, "autoreset_mode": self.autoreset_mode}
        self._spec: Any = None
        self._most_steps = _at_least_one("max_episode_steps", max_episode_steps)
        self._worlds = EnvWorlds(self.config, num_envs, episode)
        self._running = False
        self._steps = np.zeros(num_envs, np.int64)
        self._ended = np.zeros(num_envs, np.bool_)  # worlds that wait for their next episode
        self._trails: list[list[F64]] = [[] for _ in range(num_envs)]
        self._cameras: list[Camera | None] = [None] * num_envs
        self._scans: NDArray[np.float32] | None = None
        self.single_observation_space = observation_space(self.config)
        self.single_action_space = action_space(self.config)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    @property
    def spec(self) -> Any:
        """What gymnasium knows of the environment, with the most steps of an episode; set by ``gymnasium.make_vec``."""
        return self._spec

    @spec.setter
    def spec(self, spec: Any) -> None:
        self._spec = own_spec(spec, self.config, self._most_steps or self.config.max_steps)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, Infos]:
        """Start episodes in all worlds, or in those of ``options["reset_mask"]``.

        Parameters
        ----------
        seed : int or sequence of int or None, optional
            World i gets ``seed + i``, or ``seed[i]``.
        options : dict, optional
            ``{"episode": k}``: world i plays number k + i; ``{"reset_mask": mask}``: ndarray of shape (N,), bool;
            ``{"start": ..., "goal": ...}``: as for :class:`NavRepEnv`, one for all worlds or a row for each. They hold
            for this reset, not for episodes that follow by themselves.

        Returns
        -------
        observations, infos
            See the class's notes.

        Raises
        ------
        ConfigError
            If a seed or an option is wrong.
        SimulationError
            If a world could not be drawn.
        """
        # gymnasium takes Python's integers only
        seeds = [None if s is None else self._worlds.check_seed(s) for s in self._seeds(seed)]
        super().reset(seed=next((s for s in seeds if s is not None), None))
        self._worlds.choose(seeds, options, self.np_random)
        mask = self._reset_mask(options)
        if not self._running:
            mask[:] = True
        self._running = True
        self._restart(mask)
        return self._observe(), self._infos(np.ones(self.num_envs, np.bool_))

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[Any]:
        if seed is None:
            return [None] * self.num_envs
        first = whole_number(seed)
        if first is not None:
            return [first + i for i in range(self.num_envs)]
        try:
            seeds = list(seed)  # type: ignore[arg-type]
        except TypeError:  # no number and no list of them
            raise ConfigError(f"seed is {seed!r}, expected one whole number or {self.num_envs} of them.") from None
        if len(seeds) != self.num_envs:
            raise ConfigError(f"{len(seeds)} seeds were given, expected one number or {self.num_envs} of them.")
        return seeds

    def _reset_mask(self, options: dict[str, Any] | None) -> Mask:
        given = (options or {}).get("reset_mask")
        mask = np.ones(self.num_envs, np.bool_) if given is None else np.array(given)
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
            raise ConfigError(
                f"reset_mask has shape {mask.shape}, dtype {mask.dtype}, {int(mask.sum())} set; "
                f"expected ({self.num_envs},) bool with at least one world."
            )
        return mask

    def _restart(self, mask: Mask) -> None:
        self._worlds.restart(mask)
        self._steps[mask], self._ended[mask] = 0, False
        if self.render_mode is not None:
            for i in np.flatnonzero(mask):
                self._trails[i], self._cameras[i] = [], None

    def step(self, actions: ArrayLike) -> tuple[Observation, F64, Mask, Mask, Infos]:
        """Drive all worlds for one time step; worlds whose episode ended start the next, see `autoreset_mode`.

        Parameters
        ----------
        actions : array_like of shape (N, 3), or (N, robots, 3)
            Shares of the largest velocities, clipped to [-1, 1].

        Returns
        -------
        observations, rewards, terminations, truncations, infos
            See the class's notes.

        Raises
        ------
        gymnasium.error.ResetNeeded
            If no episode has begun, or one has ended that only you reset.
        """
        if not self._running:
            raise gymnasium.error.ResetNeeded("No episode has begun: call reset() before step().")
        stepped = ~self._ended
        if not stepped.all():
            self._start_waiting()
        rewards = self._worlds.step(actions, None if stepped.all() else stepped)
        self._cut(stepped)
        events = self._worlds.events
        done = events != 0
        terminations = TERMINAL[events]
        truncations = done & ~terminations
        each = rewards if rewards.ndim > 1 else None
        infos: Infos = {}
        if self.autoreset_mode is not AutoresetMode.SAME_STEP:
            self._ended = done
        elif done.any():
            infos = self._final(done, each)
            self._restart(done)
            stepped = ~done
        infos.update(self._infos(np.ones(self.num_envs, np.bool_), None if each is None else each, stepped))
        return self._observe(), rewards if each is None else each.mean(axis=1), terminations, truncations, infos

    def _start_waiting(self) -> None:
        """Start the next episodes of worlds whose last one ended in the step before."""
        if self.autoreset_mode is AutoresetMode.DISABLED:
            which = ", ".join(map(str, np.flatnonzero(self._ended)[:8]))
            raise gymnasium.error.ResetNeeded(
                f"The episodes of worlds {which} have ended: call reset(options={{'reset_mask': terminations | "
                "truncations}) before step()."
            )
        self._restart(self._ended.copy())

    def _cut(self, stepped: Mask) -> None:
        """Count the steps, and end episodes that have had as many as `max_episode_steps` says."""
        self._steps += stepped
        if self._most_steps is not None:
            over = stepped & (self._steps >= self._most_steps) & (self._worlds.events == 0)
            self._worlds.events[over] = Event.CUT

    def _observe(self) -> Observation:
        observations = self._worlds.observe()
        if self.render_mode is not None:
            self._scans = observations["scan"].copy()
            for trail, robots in zip(self._trails, self._worlds.drawn_robots(), strict=True):
                trail.append(robots[:, :2])
        return observations

    def _infos(self, mask: Mask, rewards: F64 | None = None, stepped: Mask | None = None) -> Infos:
        """Return the infos of the worlds of `mask`; rewards hold for `stepped`."""
        humans, robots = self._worlds.humans(), self._worlds.robots()
        events = self._worlds.events.copy()
        if not mask.all():
            humans[~mask], robots[~mask], events[~mask] = 0.0, 0.0, 0
        infos: Infos = {
            "robot": robots, "_robot": mask, "humans": humans, "_humans": mask.copy(),
            "event": events, "_event": mask.copy(),
        }  # fmt: skip
        if self._worlds.numbered:
            infos |= {"seed": np.where(mask, self._worlds.seeds, 0), "_seed": mask.copy()}
        scenarios = self._worlds.scenarios()
        if len(scenarios):
            scenarios[~mask] = 0
            infos |= {"scenario": scenarios, "_scenario": mask.copy()}
        if rewards is not None and stepped is not None and stepped.any():
            infos |= {"rewards": rewards * stepped[:, None], "_rewards": stepped}
        return infos

    def _final(self, done: Mask, rewards: F64 | None) -> Infos:
        """Return what episodes that have just ended leave: last observations and infos."""
        last = self._worlds.observe(done)
        final = np.full(self.num_envs, None, object)
        for i in np.flatnonzero(done):
            final[i] = {name: values[i].copy() for name, values in last.items()}
        info = self._infos(done.copy(), rewards, done.copy())
        return {"final_obs": final, "_final_obs": done, "final_info": info, "_final_info": done.copy()}

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a picture (480, 480, 3), uint8, of each world in mode ``"rgb_array"``."""
        if self.render_mode is None:
            return None
        if self._scans is None:
            raise gymnasium.error.ResetNeeded("There is nothing to draw before the first reset().")
        return tuple(self.frame(i) for i in range(self.num_envs))

    def frame(self, world: int, size: int = 480) -> NDArray[np.uint8]:
        """Return a picture of one world as it is now, whatever the render mode; the trail is kept in ``"rgb_array"``.

        Parameters
        ----------
        world : int
            Which.
        size : int
            Width and height [pixels].

        Returns
        -------
        ndarray of shape (size, size, 3), uint8
            As :meth:`NavRepEnv.frame`.
        """
        if not self._running:
            raise gymnasium.error.ResetNeeded("There is nothing to draw before the first reset().")
        world = self._number(world)
        state, grid = self._worlds.sim.state(world), self._worlds.sim.grid(world)
        if self._scans is not None:
            scan = self._scans[world]
        else:
            scan = self._worlds.observe(np.arange(self.num_envs) == world)["scan"][world]
        camera = self._cameras[world]
        if camera is None or self.render_mode is None:
            camera = Camera.around(state, grid)
        camera = self._cameras[world] = camera.following(state, grid)
        return draw_frame(state, camera, scan, self.config.sensor, self._trails[world], grid, size)

    def state(self, world: int) -> WorldState:
        """Return a copy of one world's state, see :class:`navrep_data.sim.WorldState`."""
        return self._worlds.sim.state(self._number(world))

    def _number(self, world: object) -> int:
        return check_whole("world", world, -self.num_envs, self.num_envs - 1) % self.num_envs
