"""One world as a gymnasium environment."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from navrep_data.envs.window import Window, available_render_modes, check_render_mode
from navrep_data.envs.worlds import (
    EVENT_LABELS,
    F64,
    TERMINAL,
    EnvWorlds,
    Observation,
    action_space,
    make_env_config,
    observation_space,
    own_spec,
)
from navrep_data.sim import SimConfig, Simulator
from navrep_data.sim.raster import Camera, draw_frame

_ONE = np.ones(1, np.bool_)


class NavRepEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """A robot among people, as a gymnasium environment.

    Parameters
    ----------
    env : str or SimConfig
        Name in the registry (:func:`navrep_data.sim.environment_names`), or a config of your own.
    physics : str, optional
        ``"consistent"`` (default) or ``"original"``.
    episode : int, optional
        Number of the episode that the first bare reset plays, in environments with numbered episodes
        (``navrep-test``: 500, ``navrep-val``: 50, ``ian``: any); later ones play the next, after the last the first.
    render_mode : str, optional
        ``"rgb_array"``: :meth:`render` returns a picture; ``"human"``: a window that follows each step.
    pad_humans : bool
        Fill ``info["humans"]`` with NaN rows up to the most humans that an episode can have. gymnasium's own
        SyncVectorEnv and AsyncVectorEnv need that: they stack infos and cannot stack different numbers of people.
    **changes
        Other fields of :class:`navrep_data.sim.SimConfig`: ``humans``, ``obstacles``, ``rendering``, ``sensor``, ...

    Attributes
    ----------
    config : SimConfig
        What is simulated.
    seen : dict or None
        The last observation, whatever wrappers make of it.

    Raises
    ------
    UnknownNameError
        If there is no such environment.
    ConfigError
        If a setting has a wrong value, or `episode` is given where there are no numbered episodes.
    DisplayError
        If ``render_mode="human"`` finds no window to draw in.

    Notes
    -----
    Observation: Dict(scan (n_rays,) [m], robot_state (5,): goal x, goal y [m], vx, vy [m/s], omega [rad/s], robot
    frame), float32. Action: Box(-1, 1, (3,)), clipped, times the robot's `max_velocity` (1 m/s, 1 m/s, 1 rad/s unless
    the environment says otherwise). Goal and collisions terminate; timeout truncates.

    ``info`` holds, after reset and after each step: ``robot`` (3,) x, y, theta; ``humans`` (n, 4) x, y, vx, vy, world
    frame; ``event``, the reason why the episode ended, or ``"none"``; in environments with numbered episodes ``seed``,
    the numpy seed of the episode; with scenarios ``scenario``, the name. With several robots observations, actions and
    ``info["robot"]`` have a leading axis of robots, the reward is their mean and ``info["rewards"]`` each one's.

    ``reset(seed=s)`` plays numpy seed s in environments with numbered episodes, later bare resets s + 1, s + 2, ...;
    ``reset(options={"episode": k})`` plays number k: numpy seed 1000 + k of ``navrep-test`` (500 of them), k of
    ``navrep-val`` (50), and in ``ian`` scenario k modulo 27 with numpy seed k, as in the suite `navrep27`. Without
    a seed ``ian`` starts anywhere, the others with number 0. In environments without numbers s names a random stream,
    which later bare resets go on with.
    """

    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 5}  # noqa: RUF012

    def __init__(
        self,
        env: str | SimConfig = "navrep-train",
        *,
        physics: str | None = None,
        episode: int | None = None,
        render_mode: str | None = None,
        pad_humans: bool = False,
        **changes: Any,
    ) -> None:
        self.config = make_env_config(env, physics=physics, **changes)
        self.render_mode = check_render_mode(render_mode)
        # gymnasium's checker tries what an instance offers, gymnasium.make what the class does
        fps = max(1, round(1.0 / self.config.sensor.dt))
        self.metadata = {"render_modes": available_render_modes(), "render_fps": fps}
        self._spec: Any = None
        self._worlds = EnvWorlds(self.config, 1, episode)
        self._pad_humans = pad_humans
        self._running = False
        self.seen: Observation | None = None
        self._trail: list[F64] = []
        self._camera: Camera | None = None
        self._window: Window | None = None
        self.observation_space = observation_space(self.config)
        self.action_space = action_space(self.config)

    @property
    def simulator(self) -> Simulator:
        """What simulates this one world."""
        return self._worlds.sim

    @property
    def spec(self) -> Any:
        """What gymnasium knows of the environment, with the most steps of an episode; set by ``gymnasium.make``."""
        return self._spec

    @spec.setter
    def spec(self, spec: Any) -> None:
        self._spec = own_spec(spec, self.config, self.config.max_steps)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.

        Parameters
        ----------
        seed : int, optional
            Which one; see the class's notes.
        options : dict, optional
            ``{"episode": k}``: number k of the environment's numbered episodes. ``{"start": (x, y) or (x, y, theta),
            "goal": (x, y)}``, either or both: where the robot starts and wants to go [m, rad], on maps in the
            frame of the file, in the world that is drawn otherwise; refused where it is not free. One robot; no goals
            in scenarios.

        Returns
        -------
        observation, info
            See the class's notes.

        Raises
        ------
        ConfigError
            If a seed or an option is wrong.
        SimulationError
            If a world could not be drawn.
        """
        seed = None if seed is None else self._worlds.check_seed(seed)  # gymnasium takes Python's integers only
        super().reset(seed=seed)
        self._running = False
        self._worlds.choose([seed], options, self.np_random)
        self._worlds.restart(_ONE)
        self._running = True
        self._trail, self._camera = [], None
        return self._observe(), self._info()

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Drive for one time step (0.2 s unless the sensor says otherwise).

        Parameters
        ----------
        action : array_like of shape (3,), or (robots, 3)
            Shares of the largest velocities along x, y and of the rotation, robot frame, clipped to [-1, 1].

        Returns
        -------
        observation, reward, terminated, truncated, info
            See the class's notes.

        Raises
        ------
        gymnasium.error.ResetNeeded
            If the episode has ended, or none has begun.
        """
        if not self._running:
            raise gymnasium.error.ResetNeeded("The episode has ended or has not begun: call reset() before step().")
        rewards = self._worlds.step(np.asarray(action, np.float64)[None])
        event = int(self._worlds.events[0])
        terminated = bool(TERMINAL[event])
        self._running = event == 0
        observation, info = self._observe(), self._info()
        if rewards.ndim > 1:
            info["rewards"] = rewards[0]
        return observation, float(rewards[0].mean()), terminated, event != 0 and not terminated, info

    def _observe(self) -> Observation:
        batch = self._worlds.observe()
        self.seen = {name: values[0] for name, values in batch.items()}
        self._trail.append(self._worlds.drawn_robots()[0, :, :2])
        if self.render_mode == "human":
            self._show()
        return {name: values[0].copy() for name, values in batch.items()}

    def _info(self) -> dict[str, Any]:
        humans = self._worlds.humans()[0]
        if not self._pad_humans:
            humans = humans[: int(self._worlds.sim.human_counts()[0])]
        info: dict[str, Any] = {
            "robot": self._worlds.robots()[0],
            "humans": humans,
            "event": EVENT_LABELS[self._worlds.events[0]],
        }
        if self._worlds.numbered:
            info["seed"] = int(self._worlds.seeds[0])
        for index in self._worlds.scenarios():
            info["scenario"] = self.config.scenarios[index]
        return info

    def frame(self, size: int = 480) -> NDArray[np.uint8]:
        """Return a picture of the world as it is now, whatever the render mode.

        Parameters
        ----------
        size : int
            Width and height [pixels].

        Returns
        -------
        ndarray of shape (size, size, 3), uint8
            World, people and their legs, the seen area and where the rays end, goal, trail and robot.

        Raises
        ------
        gymnasium.error.ResetNeeded
            If no episode has begun.
        """
        if self.seen is None:
            raise gymnasium.error.ResetNeeded("There is nothing to draw before the first reset().")
        state, grid = self._worlds.sim.state(), self._worlds.sim.grid()
        self._camera = Camera.around(state, grid) if self._camera is None else self._camera.following(state, grid)
        return draw_frame(state, self._camera, self.seen["scan"], self.config.sensor, self._trail, grid, size)

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture (480, 480, 3), uint8, in mode ``"rgb_array"``; draw the window in mode ``"human"``."""
        if self.render_mode == "rgb_array":
            return self.frame()
        if self.render_mode == "human":
            self._show()
        return None

    def _show(self) -> None:
        if self._window is None:
            self._window = Window(f"navrep-data: {self.config.env}")
        self._window.show(self.frame())

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def __str__(self) -> str:
        """Name the environment and the physics."""
        return f"<NavRepEnv {self.config.env}, {self.config.physics}>"
