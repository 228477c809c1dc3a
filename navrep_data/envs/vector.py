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
    EVENT_LABELS,
    F64,
    TERMINAL,
    Mask,
    Observation,
    Worlds,
    action_space,
    make_env_config,
    observation_space,
)
from navrep_data.errors import ConfigError
from navrep_data.sim import SimConfig
from navrep_data.sim.raster import Camera, draw_frame

Infos = dict[str, Any]


class NavRepVectorEnv(gymnasium.vector.VectorEnv[Observation, NDArray[np.float32], NDArray[Any]]):
    """Many worlds that step together: what ``gymnasium.make_vec(..., vectorization_mode="vector_entry_point")`` makes.

    World i plays what :class:`NavRepEnv` plays with ``seed + i`` or ``episode + i``, bit for bit, whatever the number
    of worlds. A world whose episode ends starts its next one in the same step (SAME_STEP).

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
    **changes
        Other fields of :class:`navrep_data.sim.SimConfig`.

    Notes
    -----
    Observations are dictionaries of arrays with a leading axis of worlds; rewards (N,) float64; terminations and
    truncations (N,) bool. ``infos`` follow gymnasium's convention, ``_key`` (N,) bool saying for whom a value holds:
    ``robot`` (N, 3), ``humans`` (N, most humans, 4) with NaN in empty slots, ``event`` (N,) str, ``seed`` (N,) and
    ``scenario`` (N,) where there are such. Where episodes ended, ``final_obs`` (N,) holds their last observations (None
    elsewhere) and ``final_info`` the infos of their last steps, with the reason; observations are those of the next
    episodes.

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
        **changes: Any,
    ) -> None:
        self.config = make_env_config(env, physics=physics, **changes)
        self.num_envs = num_envs
        self.render_mode = check_render_mode(render_mode, self.metadata["render_modes"])
        self.metadata = {**self.metadata, "render_fps": max(1, round(1.0 / self.config.sensor.dt))}
        self._worlds = Worlds(self.config, num_envs, episode)
        self._running = False
        self._trails: list[list[F64]] = [[] for _ in range(num_envs)]
        self._cameras: list[Camera | None] = [None] * num_envs
        self._scans: NDArray[np.float32] | None = None
        self.single_observation_space = observation_space(self.config)
        self.single_action_space = action_space(self.config)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, Infos]:
        """Start episodes in all worlds, or in those of ``options["reset_mask"]``.

        Parameters
        ----------
        seed : int or sequence of int or None, optional
            World i gets ``seed + i``, or ``seed[i]``.
        options : dict, optional
            ``{"episode": k}``: world i plays number k + i; ``{"reset_mask": mask}``: ndarray of shape (N,), bool.

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
        seeds = self._seeds(seed)
        super().reset(seed=next((s for s in seeds if s is not None), None))
        self._worlds.choose(seeds, options, self.np_random)
        mask = self._reset_mask(options)
        if not self._running:
            mask[:] = True
        self._running = True
        self._restart(mask)
        return self._observe(), self._infos(np.ones(self.num_envs, np.bool_))

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, (int, np.integer)):
            return [int(seed) + i for i in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ConfigError(f"{len(seed)} seeds were given, expected one number or {self.num_envs} of them.")
        return list(seed)

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
        if self.render_mode is not None:
            for i in np.flatnonzero(mask):
                self._trails[i], self._cameras[i] = [], None

    def step(self, actions: ArrayLike) -> tuple[Observation, F64, Mask, Mask, Infos]:
        """Drive all worlds for one time step; worlds whose episode ended start the next.

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
            If no episode has begun.
        """
        if not self._running:
            raise gymnasium.error.ResetNeeded("No episode has begun: call reset() before step().")
        rewards = self._worlds.step(actions)
        events = self._worlds.events
        done = events != 0
        terminations = TERMINAL[events]
        truncations = done & ~terminations
        each = rewards if rewards.ndim > 1 else None
        infos: Infos = {}
        if done.any():
            infos = self._final(done, each)
            self._restart(done)
        infos.update(self._infos(np.ones(self.num_envs, np.bool_), None if each is None else each, ~done))
        return self._observe(), rewards if each is None else each.mean(axis=1), terminations, truncations, infos

    def _observe(self) -> Observation:
        observations = self._worlds.observe()
        if self.render_mode is not None:
            self._scans = observations["scan"].copy()
            for trail, robots in zip(self._trails, self._worlds.robots(), strict=True):
                trail.append(robots.reshape(-1, 3)[:, :2])
        return observations

    def _infos(self, mask: Mask, rewards: F64 | None = None, stepped: Mask | None = None) -> Infos:
        """Return the infos of the worlds of `mask`; rewards hold for `stepped`."""
        humans, robots = self._worlds.humans(), self._worlds.robots()
        labels = EVENT_LABELS[self._worlds.events]
        if not mask.all():
            humans[~mask], robots[~mask], labels[~mask] = 0.0, 0.0, None
        infos: Infos = {
            "robot": robots, "_robot": mask, "humans": humans, "_humans": mask.copy(),
            "event": labels, "_event": mask.copy(),
        }  # fmt: skip
        if self._worlds.numbered:
            infos |= {"seed": np.where(mask, self._worlds.seeds, 0), "_seed": mask.copy()}
        scenarios = self._worlds.scenarios()
        if len(scenarios):
            scenarios[~mask] = None
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
        return tuple(self._frame(i) for i in range(self.num_envs))

    def _frame(self, i: int) -> NDArray[np.uint8]:
        assert self._scans is not None
        state, grid = self._worlds.sim.state(i), self._worlds.grid(i)
        camera = self._cameras[i]
        if camera is None:
            camera = self._cameras[i] = Camera.around(state, grid)
        return draw_frame(state, camera, self._scans[i], self.config.sensor, self._trails[i], grid)
