"""NavRepSim for many independent worlds at once."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from navrep_data.errors import ConfigError, SimulationError, check_whole
from navrep_data.schema import ACTION_SIZE, HUMAN_FIELDS, ROBOT_STATE_SIZE, Event
from navrep_data.sim import _batch, _step
from navrep_data.sim import _layout as lay
from navrep_data.sim._ellipse import ELLIPSE_COLUMNS
from navrep_data.sim._geometry import swept_clearance
from navrep_data.sim._lidar import CIRCLE_COLUMNS
from navrep_data.sim._obstacles import OF_FIELDS, OI_FIELDS
from navrep_data.sim._orca import make_orca_work
from navrep_data.sim.config import SimConfig, kernel_flags, kernel_params, orca_params
from navrep_data.sim.gridmap import GridMap
from navrep_data.sim.lidar import ray_directions
from navrep_data.sim.map_worlds import MapWorlds
from navrep_data.sim.orca import check_near_zero

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]

# What was drawn may touch an obstacle to within rounding, or by a cell's corner [m].
_TOUCHING = 1e-6
MAX_SEED = 2**63 - 1
MAX_NUMPY_SEED = 2**32 - 1


def check_seed(seed: int) -> int:
    """Return `seed` if it can start a stream: a whole number from 0 to 2^63 - 1."""
    return check_whole("seed", seed, 0, MAX_SEED)


def no_world(config: SimConfig, which: str = "") -> SimulationError:
    """Return the error for a world that could not be drawn."""
    return SimulationError(
        f"No world {which}with humans={config.humans}, obstacles={config.obstacles} could be drawn: no free place, "
        f"or more than {lay.MAX_OBSTACLE_EDGES} obstacle edges; ask for fewer of both."
    )


def _rows(name: str, values: ArrayLike, n: int, size: int) -> F64:
    rows = np.array(values, np.float64)
    if rows.shape != (n, size) or np.isinf(rows).any():
        raise ConfigError(f"{name} have shape {rows.shape}, expected ({n}, {size}) finite numbers, or NaN.")
    return rows


def check_place(simulator: Simulator, world: int, where: F64) -> None:
    """Raise ConfigError unless the robot of a world can start and arrive there: x, y, heading, goal x, goal y."""
    state, config, origin = simulator.state(world), simulator.config, simulator.origins[world]
    radius = float(state.robot[5])
    if state.step > 0:
        raise ConfigError(f"World {world} has had {state.step} steps, expected none: robots are placed after a reset.")
    if config.scenarios and (where[3:] != state.robot[3:5]).any():
        raise ConfigError(
            "A goal was given, but scenarios have their own: give a start only, or an environment on maps without "
            "scenarios, such as map."
        )
    for name, place in (("start", where[:2]), ("goal", where[3:])):
        if simulator.maps is None:  # maps lie within these bounds
            check_near_zero(f"The {name}", place)
        gap = float(simulator.clearance([place], world)[0])
        x, y = place + origin
        if not gap >= radius - _TOUCHING:
            raise ConfigError(
                f"The {name} ({x:g}, {y:g}) has {gap:.2f} m to the next obstacle, expected at least the robot's radius "
                f"of {radius:.2f} m (negative: inside one, or outside of the world): choose a free place."
            )
    x, y = where[:2] + origin
    near = np.hypot(*(state.humans[:, :2] - where[:2]).T) - state.humans[:, 7] - radius
    if len(near) and near.min() < 0.0:
        raise ConfigError(
            f"The start ({x:g}, {y:g}) overlaps a human by {-near.min():.2f} m: choose a free place, or another seed."
        )
    way, reach = float(np.hypot(*(where[3:] - where[:2]))), config.goal_radius or radius
    if way <= reach:
        raise ConfigError(f"The goal is {way:.2f} m from the start, expected more than {reach:.2f} m, its reach.")


class WorldArrays:
    """The packed state of a batch of worlds and the scratch space of the kernels; see ``_layout`` for the columns."""

    def __init__(self, config: SimConfig, n_worlds: int) -> None:
        robots = config.robots
        agents = config.max_humans + robots
        polygons = config.max_polygons
        corners = 4 * polygons
        rays = config.sensor.n_rays
        n = n_worlds
        self.config = config
        self.params = kernel_params(config)
        self.flags = kernel_flags(config)
        self.orca_params = orca_params(config)
        self.dirs = ray_directions(config.sensor)
        # per world
        self.agents = np.zeros((n, agents, lay.AGENT_FIELDS))
        self.scalars = np.zeros((n, lay.SCALAR_FIELDS))
        self.vertices = np.zeros((n, corners, 2))
        self.polygon_start = np.zeros((n, polygons + 1), np.int64)
        self.edges = np.zeros((n, corners, 4))
        self.boxes = np.zeros((n, polygons, lay.BOX_FIELDS))
        # the obstacles that the humans know (first) and those that the robot knows (last)
        trees = 2 if config.physics == "original" else 1
        self.obst_f = np.zeros((n, trees, OF_FIELDS, lay.MAX_OBSTACLE_EDGES), np.float32)
        self.obst_i = np.zeros((n, trees, OI_FIELDS, lay.MAX_OBSTACLE_EDGES), np.int32)
        self.rng = np.zeros((n, lay.RNG_WORDS), np.uint64)
        self.stepped = (self.agents, self.scalars)  # what a step changes of a world
        # per world and robot
        self.hits = np.zeros((n * robots, max(1, config.max_others)), np.int32)
        self.scans = np.zeros((n * robots, rays), np.float32)
        # scratch, shared by all worlds
        self.agents32 = np.zeros((agents, 6), np.float32)
        self.circles = np.zeros((2 * agents, ELLIPSE_COLUMNS if config.rendering == "ellipse" else CIRCLE_COLUMNS))
        self.inv_work = np.zeros(rays)
        self.owner_work = np.zeros(rays, np.int32)
        self.moves = np.zeros((agents, 3))
        self.work_f, self.work_i = make_orca_work(lay.MAX_OBSTACLE_EDGES, agents)


@dataclass(frozen=True)
class WorldState:
    """A copy of one world, for drawing and analysis; everything in the world frame.

    Attributes
    ----------
    robot : ndarray of shape (7,)
        x, y [m], theta [rad], goal x, goal y [m], radius [m], preferred speed [m/s]; of the first robot.
    humans : ndarray of shape (n, 10)
        x, y [m], vx, vy [m/s], theta [rad], goal x, goal y [m], radius [m], preferred speed [m/s], sees the robot.
    polygons : list of ndarray of shape (k, 2)
        Corners [m]; anticlockwise = solid inside, clockwise = border (solid outside).
    circles : ndarray of shape (m, 3)
        What the lidar sees of the humans: x, y, radius [m]. With ``rendering="ellipse"`` the larger semi-axis.
    step : int
        Steps since reset.
    robots : ndarray of shape (R, 7)
        All robots, as `robot`.
    ellipses : ndarray of shape (m, 5)
        With ``rendering="ellipse"`` what the lidar sees of the humans: x, y [m], semi-axes along and across the
        heading [m], heading [rad]; otherwise no rows.
    """

    robot: F64
    humans: F64
    polygons: list[F64]
    circles: F64
    step: int
    robots: F64
    ellipses: F64


@dataclass(frozen=True)
class Touches:
    """What the first robots touched during the last step; everything 0 and False right after a reset.

    A touch is what the rule of the world's collisions takes for one, whether it ends the episode, does damage, or is
    outranked by the goal. Matter means walls, obstacles, the border of the world and the edge of a map.

    Attributes
    ----------
    agents : ndarray of shape (W, N - 1), bool
        Whether it touched each other agent: the other robots, then the humans; False in empty slots.
    agent_speeds : ndarray of shape (W, N - 1)
        Norm of the difference of both velocities then [m/s]; 0 without a touch.
    matter : ndarray of shape (W,), bool
        Whether it touched static matter.
    matter_speeds : ndarray of shape (W,)
        The robot's own speed then [m/s]; 0 without a touch.
    """

    agents: NDArray[np.bool_]
    agent_speeds: F64
    matter: NDArray[np.bool_]
    matter_speeds: F64


class Simulator:
    """A batch of independent worlds that step together.

    Parameters
    ----------
    config : SimConfig
        Environment, physics and sensor, for example from :func:`make_config`.
    n_worlds : int
        Number of worlds.
    seed : int
        World w draws from the stream of (seed, first_sequence + w) and nothing else.
    first_sequence : int
        Index of the first world's stream.

    Raises
    ------
    ConfigError
        If a value is out of range.

    Notes
    -----
    Worlds do not end by themselves: :meth:`step` reports events, the caller resets. An action is the body velocity
    command (vx, vy [m/s], omega [rad/s]) and is executed as given, but for what `drive` and `inertia` say.

    Worlds of maps in `consistent` physics are simulated with (0, 0) at the map's lower left corner, wherever the map's
    file puts that: the world frame of :meth:`state`. :attr:`origins` leads back to the file's frame.

    With several robots, arrays per robot have an axis of R robots after that of the W worlds. The episode is joint:
    one event per world, the highest ranking of its robots' (collision with an agent, with an obstacle, goal, timeout);
    a collision between robots counts as ``collision_human``, the code for collisions with agents.
    """

    def __init__(self, config: SimConfig, n_worlds: int = 1, seed: int = 0, first_sequence: int = 0) -> None:
        self._allocate(config, n_worlds)
        self.seed_worlds(seed, check_seed(first_sequence) + np.arange(n_worlds))
        self.reset()

    @classmethod
    def without_worlds(cls, config: SimConfig, n_worlds: int) -> Simulator:
        """Return a batch of worlds that have not begun: call :meth:`seed_worlds` and :meth:`reset` first."""
        self = cls.__new__(cls)
        self._allocate(config, n_worlds)
        return self

    def _allocate(self, config: SimConfig, n_worlds: int) -> None:
        self.config = config
        self.n_worlds = n_worlds = check_whole("n_worlds", n_worlds, 1)
        self.maps = MapWorlds(config, n_worlds) if config.world == "map" else None
        self.arrays: Any = WorldArrays(config, n_worlds) if self.maps is None else self.maps.arrays

    def seed_worlds(self, seed: int, sequences: NDArray[np.int64]) -> None:
        """Have world w draw from the stream of (seed, sequences[w]) from its next reset on."""
        _batch.seed_worlds(self.arrays.rng, self.arrays.scalars, check_seed(seed), sequences)

    def reset(self, mask: ArrayLike | None = None) -> None:
        """Start the next episode, in all worlds or in those where `mask` (W,) is True."""
        self._reset(self._mask(mask), self.arrays.rng)

    def reset_seeded(self, numpy_seeds: ArrayLike, mask: ArrayLike | None = None) -> None:
        """Start episodes drawn from numpy's legacy generator, in all worlds or in those of `mask` (W,).

        In `original` physics the world of ``numpy_seeds[w]`` is the one that the original software makes after
        ``numpy.random.seed(numpy_seeds[w])``; see :func:`navrep_data.sim.numpy_seed` for its numbered episodes. The
        worlds' own streams stay where they are, so a later :meth:`reset` draws what it would have drawn anyway.

        Parameters
        ----------
        numpy_seeds : array_like of shape (W,)
            Whole numbers from 0 to 2^32 - 1; those outside `mask` are not used.
        mask : array_like of shape (W,), optional
            Which worlds.

        Raises
        ------
        ConfigError
            If a shape or a seed is wrong, or the curriculum is adaptive.
        SimulationError
            If a world could not be drawn.
        """
        if self.config.curriculum == "adaptive":
            raise ConfigError(
                "curriculum='adaptive' cannot play numbered episodes: a world would depend on those before it; set "
                "curriculum='constant'."
            )
        chosen = self._mask(mask)
        self._reset(chosen, self._legacy_streams(numpy_seeds, chosen), seeded=True)

    def reset_scenarios(
        self,
        scenarios: ArrayLike,
        numpy_seeds: ArrayLike | None = None,
        mask: ArrayLike | None = None,
        headings: ArrayLike | None = None,
    ) -> None:
        """Start episodes of given scenarios, in all worlds or in those of `mask` (W,).

        Parameters
        ----------
        scenarios : array_like of shape (W,)
            Names, or indices into the config's scenarios; those outside `mask` are checked, too.
        numpy_seeds : array_like of shape (W,), optional
            As for :meth:`reset_seeded`: first the robot's start heading is drawn, then what the episode needs. Without
            them the worlds' own streams are drawn from. Suite ``navrep27``: round r of scenario i has seed 27 r + i.
        mask : array_like of shape (W,), optional
            Which worlds.
        headings : array_like of shape (W,), optional
            The robots' start headings [rad], instead of drawing them.

        Raises
        ------
        ConfigError
            If the environment has no scenarios, or a shape, index or seed is wrong.
        UnknownNameError
            If there is no scenario of that name.
        """
        if self.maps is None:
            raise ConfigError(f"Environment {self.config.env!r} has no scenarios; take env='ian', or plain reset().")
        chosen = self._mask(mask)
        indices = self.maps.scenario_indices(scenarios)
        fixed = None
        if headings is not None:
            fixed = np.asarray(headings, np.float64)
            if fixed.shape != (self.n_worlds,) or not np.isfinite(fixed[chosen]).all():
                raise ConfigError(
                    f"headings have shape {fixed.shape}, expected ({self.n_worlds},) finite angles [rad]."
                )
        if numpy_seeds is None:
            self.maps.reset(chosen, self.arrays.rng, scenarios=indices, headings=fixed)
        else:
            streams = self._legacy_streams(numpy_seeds, chosen)
            self.maps.reset(chosen, streams, seeded=True, scenarios=indices, headings=fixed)

    def _legacy_streams(self, numpy_seeds: ArrayLike, chosen: NDArray[np.bool_]) -> NDArray[np.uint64]:
        """Return the streams of numpy's legacy generators with these seeds."""
        seeds = np.asarray(numpy_seeds)
        if seeds.shape != (self.n_worlds,) or seeds.dtype.kind not in "iu":
            raise ConfigError(
                f"numpy_seeds have shape {seeds.shape}, dtype {seeds.dtype}, expected ({self.n_worlds},) whole numbers."
            )
        if (seeds[chosen] < 0).any() or (seeds[chosen] > MAX_NUMPY_SEED).any():
            raise ConfigError(f"numpy_seeds are {seeds.tolist()}, expected whole numbers from 0 to {MAX_NUMPY_SEED}.")
        streams = np.zeros((self.n_worlds, lay.RNG_WORDS), np.uint64)
        _batch.seed_legacy(streams, np.where(chosen, seeds, 0).astype(np.uint64), chosen)
        return streams

    @property
    def origins(self) -> F64:
        """Where the worlds' (0, 0) is in the frames of their map files, (W, 2) [m]; 0 where there is no such frame."""
        return np.zeros((self.n_worlds, 2)) if self.maps is None else self.maps.origins()

    def place(self, starts: ArrayLike, goals: ArrayLike, mask: ArrayLike | None = None) -> None:
        """Put robots and their goals elsewhere, right after a reset; everything else stays as it was drawn.

        Parameters
        ----------
        starts : array_like of shape (W, 3)
            x, y [m], heading [rad], in the frame of :meth:`state`; NaN = as drawn (x and y together).
        goals : array_like of shape (W, 2)
            x, y [m], in the frame of :meth:`state`; NaN = as drawn.
        mask : array_like of shape (W,), optional
            Which worlds.

        Raises
        ------
        ConfigError
            If there are several robots, a shape is wrong, an episode has had a step, a robot would not be free of
            obstacles and humans at its start or of obstacles at its goal, or would have arrived already; or if a
            scenario, which has its goals worked out beforehand, is given another one. No robot is moved then. Messages
            name places in the frame of the map's file.
        """
        chosen = self._mask(mask)
        where = np.concatenate([_rows("starts", starts, self.n_worlds, 3), _rows("goals", goals, self.n_worlds, 2)], 1)
        if self.config.robots > 1:
            raise ConfigError(f"robots is {self.config.robots}, expected 1: starts and goals are given for one robot.")
        columns = [lay.A_X, lay.A_Y, lay.A_HEADING, lay.A_GX, lay.A_GY]
        where = np.where(np.isnan(where), self.arrays.agents[:, 0, columns], where)
        for w in np.flatnonzero(chosen):
            check_place(self, int(w), where[w])
        for w in np.flatnonzero(chosen):
            if self.maps is not None:
                self.maps.place(int(w), where[w])
            else:
                self.arrays.agents[w, 0, columns] = where[w]

    def restart(self, seeds: ArrayLike, mask: ArrayLike | None = None) -> None:
        """Give worlds new streams, forget their episodes, and start the first one.

        A world restarted with a seed goes on like the only world of ``Simulator(config, seed=seed)``.

        Parameters
        ----------
        seeds : array_like of shape (W,)
            Whole numbers from 0 to 2^63 - 1; those outside `mask` are not used.
        mask : array_like of shape (W,), optional
            Which worlds; all by default.

        Raises
        ------
        ConfigError
            If a shape or a seed is wrong.
        """
        chosen = self._mask(mask)
        values = np.asarray(seeds)
        if values.shape != (self.n_worlds,) or values.dtype.kind not in "iu":
            raise ConfigError(
                f"seeds have shape {values.shape}, dtype {values.dtype}, expected ({self.n_worlds},) whole numbers."
            )
        for seed in values[chosen].tolist():
            check_seed(seed)
        streams = np.where(chosen, values, 0).astype(np.uint64)
        _batch.reseed_worlds(self.arrays.rng, self.arrays.scalars, streams, chosen)
        self._reset(chosen, self.arrays.rng)

    def _mask(self, mask: ArrayLike | None) -> NDArray[np.bool_]:
        chosen = np.ones(self.n_worlds, np.bool_) if mask is None else np.asarray(mask, np.bool_)
        if chosen.shape != (self.n_worlds,):
            raise ConfigError(f"mask has shape {chosen.shape}, expected ({self.n_worlds},).")
        return chosen

    def _reset(self, chosen: NDArray[np.bool_], streams: NDArray[np.uint64], *, seeded: bool = False) -> None:
        a = self.arrays
        if self.maps is not None:
            self.maps.reset(chosen, streams, seeded=seeded)
            return
        if not _batch.reset_worlds(
            chosen, a.agents, a.agents32, a.scalars, a.vertices, a.polygon_start, a.edges, a.obst_f, a.obst_i, a.boxes,
            streams, a.params, a.flags, a.orca_params, a.work_f, a.work_i, a.moves,
        ):  # fmt: skip
            raise no_world(self.config)

    def step(self, actions: ArrayLike, mask: ArrayLike | None = None) -> tuple[F64, NDArray[np.uint8]]:
        """Advance all worlds, or those where `mask` (W,) is True, by one time step.

        Parameters
        ----------
        actions : array_like of shape (W, 3)
            Body velocity commands: vx, vy [m/s], omega [rad/s]. With R > 1 robots: (W, R, 3).
        mask : array_like of shape (W,), optional
            Which worlds; the others stay as they are, with reward 0 and event 0.

        Returns
        -------
        rewards : ndarray of shape (W,)
            Reward of this step. With R > 1 robots: (W, R).
        events : ndarray of shape (W,), uint8
            :class:`navrep_data.schema.Event` codes; 0 = the episode goes on.
        """
        a = self.arrays
        commands = np.require(actions, np.float64, ["C", "W"])  # read-only arrays are a type of their own to a compiler
        expected = (self.n_worlds, *self._per_robot, ACTION_SIZE)
        if commands.shape != expected:
            raise ConfigError(f"actions have shape {commands.shape}, expected {expected}.")
        if not np.isfinite(commands).all():
            raise ConfigError("actions hold NaN or infinity, expected finite velocities.")
        rewards = np.zeros((self.n_worlds, self.config.robots))
        events = np.zeros(self.n_worlds, np.uint8)
        held = ~self._mask(mask)
        # kernels step all worlds: what a step changes is put back in those that wait, which are few
        kept = [(array, array[held]) for array in a.stepped] if held.any() else []
        if self.maps is not None:
            self.maps.step(commands.reshape(*rewards.shape, ACTION_SIZE), rewards, events)
        else:
            _batch.step_worlds(
                commands.reshape(self.n_worlds, -1), a.agents, a.agents32, a.scalars, a.edges, a.polygon_start,
                a.boxes, a.obst_f, a.obst_i, a.params, a.flags, a.orca_params, a.work_f, a.work_i, a.moves, rewards,
                events,
            )  # fmt: skip
        for array, rows in kept:
            array[held] = rows
        rewards[held], events[held] = 0.0, 0
        return rewards.reshape(self.n_worlds, *self._per_robot), events

    @property
    def _per_robot(self) -> tuple[int, ...]:
        """The axis of robots, where there is one."""
        return (self.config.robots,) if self.config.robots > 1 else ()

    def observe(self, mask: ArrayLike | None = None) -> tuple[F32, F32]:
        """Return scans (W, n_rays) [m] and robot states (W, 5), both float32, of the present state.

        Robot state: goal x, goal y [m], vx, vy [m/s], omega [rad/s] in the robot frame. With R > 1 robots:
        (W, R, n_rays) and (W, R, 5). With a `mask` (W,) only its worlds are observed: in the others the scan is the one
        before and the robot state 0.
        """
        a = self.arrays
        per_robot = (self.n_worlds, *self._per_robot)
        if self.maps is not None:
            states = self.maps.observe(self._mask(mask))
        else:
            states = np.zeros((self.n_worlds * self.config.robots, ROBOT_STATE_SIZE), np.float32)
            _batch.observe_worlds(
                self._mask(mask), a.agents, a.scalars, a.edges, a.polygon_start, a.circles, a.dirs, a.inv_work,
                a.owner_work, a.hits, a.params, a.flags, a.scans, states,
            )  # fmt: skip
        return a.scans.copy().reshape(*per_robot, -1), states.reshape(*per_robot, ROBOT_STATE_SIZE)

    def robot_states(self, mask: ArrayLike | None = None) -> F32:
        """Return the robot states (W, 5) of :meth:`observe`, without its scans; with R > 1 robots (W, R, 5).

        With a `mask` (W,) the states of other worlds are 0.
        """
        states = np.zeros((self.n_worlds * self.config.robots, ROBOT_STATE_SIZE), np.float32)
        if self.maps is not None:
            self.maps.robot_states(self._mask(mask), states)
        else:
            _batch.observe_states(self._mask(mask), self.arrays.agents, self.arrays.flags, states)
        return states.reshape(self.n_worlds, *self._per_robot, ROBOT_STATE_SIZE)

    def humans(self) -> F32:
        """Return what the `humans` column would hold now: (W, max_others, 6) float32, NaN-padded.

        `visible` is that of the last :meth:`observe`. With R > 1 robots: (W, R, max_others, 6), the other robots after
        the humans.
        """
        a = self.arrays
        out = np.zeros((self.n_worlds * self.config.robots, self.config.max_others, len(HUMAN_FIELDS)), np.float32)
        _batch.observe_others(a.agents, a.scalars, a.hits, a.flags, out)
        return out.reshape(self.n_worlds, *self._per_robot, *out.shape[1:])

    def _robots(self, columns: int | list[int]) -> F64:
        """Return columns of the robots, (W, ...), with R > 1 robots (W, R, ...)."""
        found: F64 = self.arrays.agents[:, : self.config.robots][:, :, columns]
        return found if self._per_robot else found[:, 0]

    def poses(self) -> F64:
        """Return x, y [m], theta [rad] of the robots, (W, 3), in the frame of :meth:`state`; with R > 1 (W, R, 3)."""
        return self._robots([lay.A_X, lay.A_Y, lay.A_HEADING])

    def goals(self) -> F64:
        """Return x, y [m] of the robots' goals, (W, 2), in the frame of :meth:`state`; with R > 1 robots (W, R, 2)."""
        return self._robots([lay.A_GX, lay.A_GY])

    def radii(self) -> F64:
        """Return the robots' radii [m], (W,); with R > 1 robots (W, R)."""
        return self._robots(lay.A_RADIUS).copy()

    def human_counts(self) -> NDArray[np.int64]:
        """Return the number of humans in each world, (W,)."""
        counts: NDArray[np.int64] = self.arrays.scalars[:, lay.S_HUMANS].astype(np.int64)
        return counts

    def human_motions(self) -> F64:
        """Return x, y [m], vx, vy [m/s] of the humans, in the frame of :meth:`state`; NaN in empty slots.

        Returns
        -------
        ndarray of shape (W, most humans, 4)
        """
        # x, y, vx, vy lie side by side: slices are copied several times faster than columns by number
        out: F64 = self.arrays.agents[:, self.config.robots :, lay.A_X : lay.A_VY + 1].copy()
        out[np.arange(out.shape[1]) >= self.human_counts()[:, None]] = np.nan
        return out

    def gaps(self) -> tuple[F64, F64]:
        """Return the gaps between the first robots' edges and the nearest other agent and static matter [m], both (W,).

        Negative where they overlap, infinite where there is nobody.

        Notes
        -----
        In worlds of polygons they are the present ones. On maps they are the smallest during the last step, and those
        to static matter are exact up to a metre; beyond that they are lower bounds.
        """
        a = self.arrays
        to_agent, to_static = np.zeros((2, self.n_worlds))
        if self.maps is not None:
            self.maps.gaps(to_agent, to_static)
        else:
            _batch.measure_gaps(a.agents, a.scalars, a.edges, a.polygon_start, a.flags, to_agent, to_static)
        return to_agent, to_static

    def orca_velocities(self) -> F64:
        """Return the velocities that ORCA chooses for the first robots, which see everybody, (W, 2) [m/s].

        In the frame of :meth:`state`. On maps ORCA follows the planned path; elsewhere it heads for the goal.
        """
        a = self.arrays
        out = np.zeros((self.n_worlds, 2))
        if self.maps is not None:
            self.maps.orca_velocities(out)
        else:
            _batch.choose_orca_robots(
                a.agents, a.agents32, a.scalars, a.obst_f, a.obst_i, a.flags, a.orca_params, a.work_f, a.work_i, out
            )
        return out

    def waypoints(self) -> F64:
        """Return points for the first robots to head for, (W, 2) [m], in the frame of :meth:`state`.

        On maps about a metre ahead on the planned path; the goals where there is no map.
        """
        if self.maps is not None:
            return self.maps.ways_ahead()
        goals: F64 = self.arrays.agents[:, 0, [lay.A_GX, lay.A_GY]]
        return goals

    def scenarios_played(self) -> NDArray[np.int64]:
        """Return which of the config's scenarios each world plays, (W,) indices; -1 where none."""
        return np.full(self.n_worlds, -1, np.int64) if self.maps is None else self.maps.scenarios_played()

    def grids(self) -> tuple[GridMap, ...]:
        """Return the maps that worlds may be on; none where there are no maps."""
        return () if self.maps is None else tuple(self.maps.data.maps)

    def map_indices(self) -> NDArray[np.int64]:
        """Return which of :meth:`grids` each world is on, (W,); -1 where there are no maps."""
        return np.full(self.n_worlds, -1, np.int64) if self.maps is None else self.maps.map_indices()

    def grid(self, world: int = 0) -> GridMap | None:
        """Return the map that a world is on, None where there is none."""
        grids = self.grids()
        return grids[self.map_indices()[world]] if grids else None

    def robot_events(self) -> NDArray[np.uint8]:
        """Return what the last step led to for each robot, (W, R) uint8 event codes."""
        events: NDArray[np.uint8] = self.arrays.agents[:, : self.config.robots, lay.A_EVENT].astype(np.uint8)
        return events

    def damage(self) -> F64:
        """Return the damage that each robot has taken since reset, (W, R) [m/s]; 0 unless ``on_collision="damage"``."""
        taken: F64 = self.arrays.agents[:, : self.config.robots, lay.A_DAMAGE].copy()
        return taken

    def touches(self) -> Touches:
        """Return whom and what the first robots touched during the last step."""
        agents = self.arrays.agents
        there = self.config.robots + self.arrays.scalars[:, lay.S_HUMANS]
        # what stands in the rows beyond is left from worlds with more humans
        touched = (agents[:, :, lay.A_TOUCHED] > 0.0) & (np.arange(agents.shape[1]) < there[:, None])
        speeds = np.where(touched, agents[:, :, lay.A_TOUCH_SPEED], 0.0)
        return Touches(touched[:, 1:], speeds[:, 1:], touched[:, 0], speeds[:, 0])

    def difficulty(self) -> NDArray[np.int64]:
        """Return the present setting of `humans` and `obstacles` in each world, (W, 2): what the curriculum adapts."""
        most = np.array([self.config.humans, self.config.obstacles])
        fewer: NDArray[np.int64] = self.arrays.scalars[:, [lay.S_FEWER_HUMANS, lay.S_FEWER_OBSTACLES]].astype(np.int64)
        return most - fewer

    def set_difficulty(self, difficulty: ArrayLike) -> None:
        """Set what :meth:`difficulty` returns, for the episodes that start from now on.

        Raises
        ------
        SimulationError
            If it is not (W, 2) whole numbers from 0 up to the config's `humans` and `obstacles`.
        """
        most = np.array([self.config.humans, self.config.obstacles])
        given = np.asarray(difficulty)
        if given.shape != (self.n_worlds, 2) or (given != np.clip(np.rint(given), 0, most)).any():
            raise SimulationError(
                f"difficulty has shape {given.shape}, expected ({self.n_worlds}, 2) whole numbers from 0 to "
                f"{most.tolist()}: what difficulty() returns."
            )
        self.arrays.scalars[:, [lay.S_FEWER_HUMANS, lay.S_FEWER_OBSTACLES]] = most - given

    def clearance(self, points: ArrayLike, world: int = 0) -> F64:
        """Return how far points (N, 2) are from solid static matter [m], world frame; negative inside it.

        In `consistent` physics a robot of radius r at a point is free of obstacles where this is at least r. In
        `original` physics this is what the lidar sees; collisions are decided by a grid.
        """
        a = self.arrays
        where = np.atleast_2d(np.asarray(points, np.float64))
        if self.maps is not None:
            return self.maps.clearance(where, world)
        n = int(a.scalars[world, lay.S_POLYGONS])
        edges, start = a.edges[world], a.polygon_start[world]
        return np.array([swept_clearance(x, y, x, y, edges, start, n) for x, y in where])

    def state(self, world: int = 0) -> WorldState:
        """Return a copy of one world's state."""
        a = self.arrays
        robots, n = self.config.robots, int(a.scalars[world, lay.S_HUMANS])
        agents = a.agents[world]
        columns = [lay.A_X, lay.A_Y, lay.A_HEADING, lay.A_GX, lay.A_GY, lay.A_RADIUS, lay.A_VPREF]
        human_columns = [
            lay.A_X, lay.A_Y, lay.A_VX, lay.A_VY, lay.A_HEADING, lay.A_GX, lay.A_GY, lay.A_RADIUS, lay.A_VPREF,
            lay.A_SEES,
        ]  # fmt: skip
        if self.maps is not None:
            polygons, seen = self.maps.polygons(world), self.maps.bodies(world)
        else:
            starts = a.polygon_start[world, : int(a.scalars[world, lay.S_POLYGONS]) + 1]
            polygons = [a.vertices[world, i:j].copy() for i, j in pairwise(starts)]
            seen = a.circles[: _step.fill_circles(-1, agents, robots, n, a.flags, a.circles)].copy()
        bodies = seen if self.config.rendering == "ellipse" else seen[:0]
        heading = np.arctan2(bodies[:, -1], bodies[:, -2])
        return WorldState(
            robot=agents[0, columns].copy(),
            humans=agents[robots : robots + n, human_columns].copy(),
            polygons=polygons,
            circles=seen[:, :3].copy(),
            step=int(a.scalars[world, lay.S_STEP]),
            robots=agents[:robots][:, columns].copy(),
            ellipses=np.column_stack([bodies[:, :2], bodies[:, -3], bodies[:, 2], heading]),
        )

    def describe_event(self, code: int) -> str:
        """Return the name of an event code."""
        return Event(int(code)).label

    def __repr__(self) -> str:
        """Name the environment, the physics and the size of the batch."""
        return f"Simulator({self.config.env}, {self.config.physics}, n_worlds={self.n_worlds})"


def warm_up() -> Any:
    """Compile, or load from numba's cache, what a simulator needs."""
    simulator = Simulator(SimConfig(humans=2, obstacles=1))
    simulator.step(np.zeros((1, ACTION_SIZE)))
    return simulator.observe()
