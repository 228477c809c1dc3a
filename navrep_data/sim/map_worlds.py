"""Worlds on maps for the batched simulator: arrays, rules, and the calls into the kernels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from navrep_data.errors import ConfigError, SimulationError, UnknownNameError, did_you_mean
from navrep_data.schema import ROBOT_STATE_SIZE
from navrep_data.sim import _ian_batch, _ian_scan
from navrep_data.sim import _ian_layout as il
from navrep_data.sim import _layout as lay
from navrep_data.sim._ellipse import ELLIPSE_COLUMNS
from navrep_data.sim._ian_contact import swept_cells
from navrep_data.sim._ian_place import place_on_map
from navrep_data.sim._orca import make_orca_work
from navrep_data.sim.config import SimConfig, keeps_speed_limit, kernel_flags, kernel_params
from navrep_data.sim.lidar import ray_directions
from navrep_data.sim.map_tables import RADIUS, MapWorldData, map_world_data

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]

# pepper_2d_iarlenv.py: limits of humans' acceleration and jerk along x, y and in rotation
HUMAN_ACCELERATION = (0.5, 0.5, 0.75)
HUMAN_JERK = (1.0, 1.0, 2.0)
# ours: neighbour distance [m], neighbours, horizons for agents and walls [s]; with the 5 s that training uses, agents
# stand still in front of doors
ORCA_ON_MAPS = (5.0, 10.0, 2.0, 1.0)
# preferred speeds of humans that are not planned [m/s]
HUMAN_SPEEDS = (0.6, 1.0)
# markenv.py, jointenv.py: environments with several maps are built, and so drawn, twice per reset
DRAWS_PER_RESET = 2
_WALKS = {
    "planned": il.WALK_PLANNED,
    "orca": il.WALK_ORCA,
    "static": il.WALK_STATIC,
    "constant-velocity": il.WALK_CONSTANT,
}


def map_rules(config: SimConfig) -> F64:
    """Return the config's numbers in the order of ``_ian_layout``'s ``R_*``."""
    original = config.physics == "original"
    joint = config.robots > 1
    damage = config.on_collision == "damage"
    r = np.zeros(il.RULE_FIELDS)
    r[il.R_DT] = config.sensor.dt
    r[il.R_STEPS] = np.inf if original and joint else round(config.time_limit / config.sensor.dt)
    r[il.R_ROBOTS] = config.robots
    r[il.R_ORIGINAL] = original
    r[il.R_LEGS] = config.rendering == "legs"
    r[il.R_ELLIPSE] = config.rendering == "ellipse"
    r[il.R_DAMAGE] = damage
    r[il.R_MAX_DAMAGE] = config.max_damage
    r[il.R_GOAL_RADIUS] = RADIUS if config.goal_radius is None else config.goal_radius
    r[il.R_IAN_REWARD] = original or damage
    # ianenv.py: PUNISH_SPIN; markenv.py has none, jointenv.py has it off
    r[il.R_SPIN] = 1e-3 if damage else 0.0
    r[il.R_BOUNCE] = damage or (original and not joint)
    r[il.R_INERTIA] = config.inertia == "limited"
    r[il.R_INERTIA_REST] = original and joint  # jointenv.py switches it off for the first robot only
    r[il.R_HUMAN_POLICY] = _WALKS[config.human_policy]
    r[il.R_DIFFERENTIAL] = config.drive == "differential"
    r[il.R_MAX_VX : il.R_MAX_VX + 3] = config.max_velocity
    r[il.R_ACCELERATION : il.R_ACCELERATION + 3] = config.robot_acceleration
    r[il.R_JERK : il.R_JERK + 3] = config.robot_jerk
    r[il.R_HUMAN_ACCELERATION : il.R_HUMAN_ACCELERATION + 3] = HUMAN_ACCELERATION
    r[il.R_HUMAN_JERK : il.R_HUMAN_JERK + 3] = HUMAN_JERK
    r[il.R_REWARD_GOAL] = 100.0
    r[il.R_REWARD_COLLISION] = -25.0
    r[il.R_REWARD_DANGER] = -1.0
    r[il.R_REWARD_PROGRESS] = 0.005 if r[il.R_IAN_REWARD] else 1.0
    r[il.R_DANGER_DIST] = 0.2
    r[il.R_RADIUS] = RADIUS
    r[il.R_HUMANS] = config.humans
    r[il.R_WANT_FIELD] = 1.0
    r[il.R_REDRAWS] = DRAWS_PER_RESET if original and (joint or len(config.maps) > 1) else 1
    r[il.R_SPEED_LOW], r[il.R_SPEED_HIGH] = HUMAN_SPEEDS
    return r


class MapArrays:
    """The state of a batch of worlds on maps, and scratch space; names as in ``WorldArrays`` where they agree."""

    def __init__(self, config: SimConfig, n_worlds: int, data: MapWorldData) -> None:
        agents = config.robots + config.max_humans
        n, rays, table = n_worlds, config.sensor.n_rays, data.tables.table
        cells = int(table[:, il.T_PLAN_CELLS].max())
        self.config = config
        self.params = kernel_params(config)
        self.flags = kernel_flags(config)
        self.rules = map_rules(config)
        self.dirs = ray_directions(config.sensor)
        self.worlds = il.MapWorldState(
            agents=np.zeros((n, agents, lay.AGENT_FIELDS)),
            walkers=np.zeros((n, agents, il.WALKER_FIELDS)),
            contacts=np.zeros((n, agents, agents), np.int8),
            scalars=np.zeros((n, lay.SCALAR_FIELDS)),
            place=np.zeros((n, il.PLACE_FIELDS)),
            own_field=np.zeros((n, 1 if data.scenarios else cells), np.float32),
            rng=np.zeros((n, lay.RNG_WORDS), np.uint64),
            seeded=np.zeros((n, lay.RNG_WORDS), np.uint64),
        )
        self.agents, self.scalars, self.rng = self.worlds.agents, self.worlds.scalars, self.worlds.rng
        w = self.worlds
        # what a step changes of a world
        self.stepped = (w.agents, w.walkers, w.contacts, w.scalars, w.place, w.own_field, w.rng, w.seeded)
        self.hits = np.zeros((n * config.robots, max(1, config.max_others)), np.int32)
        self.scans = np.zeros((n * config.robots, rays), np.float32)
        # scratch, shared by all worlds
        self.circles = np.zeros((2 * agents, ELLIPSE_COLUMNS))
        self.inv_work = np.zeros(rays)
        self.owner_work = np.zeros(rays, np.int32)
        self.moves = np.zeros((agents, 2))
        # a way down a field meets every cell at most once
        self.path = np.zeros((cells, 2), np.int64)
        edges_f, edges_i = data.edges
        work_f, work_i = make_orca_work(edges_f.shape[2], agents)
        self.orca = il.OrcaTables(
            edges_f=edges_f,
            edges_i=edges_i,
            params=np.array([*ORCA_ON_MAPS, config.sensor.dt, keeps_speed_limit(config)], np.float32),
            agents=np.zeros((agents, 6), np.float32),
            work_f=work_f,
            work_i=work_i,
        )


class MapWorlds:
    """A batch of worlds on maps: what :class:`Simulator` does with ``world="map"``."""

    def __init__(self, config: SimConfig, n_worlds: int) -> None:
        self.config = config
        self.n_worlds = n_worlds
        self.data = map_world_data(config)
        self.arrays = MapArrays(config, n_worlds, self.data)

    def reset(
        self,
        chosen: NDArray[np.bool_],
        streams: NDArray[np.uint64],
        *,
        seeded: bool = False,
        scenarios: NDArray[np.int64] | None = None,
        headings: F64 | None = None,
    ) -> None:
        """Start episodes; see ``reset_map_worlds`` for the arguments."""
        a, n = self.arrays, self.n_worlds
        scenarios = np.full(n, -1, np.int64) if scenarios is None else scenarios
        headings = np.full(n, np.nan) if headings is None else headings
        failed = _ian_batch.reset_map_worlds(
            chosen, a.worlds, self.data.tables, a.rules, a.flags, streams, seeded, scenarios, headings
        )
        if failed >= 0:
            raise self.no_place(failed)

    def no_place(self, world: int) -> SimulationError:
        """Return the error for a world whose map has no room for a start and a goal."""
        grid = self.data.maps[self.map_indices()[world]]
        return SimulationError(
            f"No start and goal for {self.config.robots} robots on map '{grid.name}': expected free places more "
            "than 3 m apart; take fewer robots or a larger map."
        )

    def step(self, commands: F64, rewards: F64, events: NDArray[np.uint8]) -> None:
        """Advance all worlds under commands (W, R, 3)."""
        a = self.arrays
        _ian_batch.step_map_worlds(
            commands, a.worlds, self.data.tables, a.rules, a.circles, a.path, a.orca, a.moves, rewards, events
        )

    def observe(self, mask: NDArray[np.bool_]) -> F32:
        """Fill the arrays' scans in the worlds of `mask` (W,) and return robot states (W R, 5), 0 in the others."""
        a = self.arrays
        states = np.zeros((len(a.scans), ROBOT_STATE_SIZE), np.float32)
        _ian_batch.observe_map_worlds(
            mask, a.worlds, self.data.tables, a.rules, a.circles, a.dirs, a.inv_work, a.owner_work, a.hits, a.params,
            a.flags, a.scans, states,
        )  # fmt: skip
        return states

    def robot_states(self, mask: NDArray[np.bool_], states: F32) -> None:
        """Fill robot states (W R, 5) in the worlds of `mask` (W,)."""
        _ian_batch.observe_map_states(mask, self.arrays.worlds, self.arrays.rules, states)

    def place(self, world: int, where: F64) -> None:
        """Put the robot of a world at x, y [m], heading [rad] with the goal x, y [m], right after a reset."""
        w = self.arrays.worlds
        place_on_map(w.agents[world], w.walkers[world], w.place[world], w.own_field[world], self.data.tables, *where)

    def ways_ahead(self) -> F64:
        """Return a point about a metre ahead of each first robot on its way to the goal, (W, 2) [m]."""
        out = np.zeros((self.n_worlds, 2))
        _ian_batch.ways_ahead(self.arrays.worlds, self.data.tables, self.arrays.path, out)
        return out

    def gaps(self, to_agent: F64, to_static: F64) -> None:
        """Fill (W,) each with the gaps around the first robots [m]; see :meth:`Simulator.gaps`."""
        a = self.arrays
        _ian_batch.measure_map_gaps(a.worlds, self.data.tables, a.rules, to_agent, to_static)

    def orca_velocities(self, out: F64) -> None:
        """Fill out (W, 2) with the velocities that ORCA chooses for the first robots along their planned way [m/s]."""
        a = self.arrays
        _ian_batch.choose_guided_robots(a.worlds, self.data.tables, a.rules, a.orca, a.path, out)

    def clearance(self, points: F64, world: int) -> F64:
        """Return the distances of points (N, 2) to solid cells or the map's edge [m]."""
        row = self.data.tables.table[int(self.arrays.worlds.place[world, il.M_MAP])]
        far = 1e3
        return np.array([swept_cells(self.data.tables, row, x, y, x, y, far) for x, y in points])

    def polygons(self, world: int) -> list[F64]:
        """Return the outlines of the world's map, simplified within 5 cm, for drawing."""
        grid = self.data.maps[int(self.map_indices()[world])]
        return grid.contours(0.05)

    def origins(self) -> F64:
        """Return where the worlds' (0, 0) is in the frames of their map files, (W, 2) [m]."""
        return self.data.origins[self.map_indices()]

    def map_indices(self) -> NDArray[np.int64]:
        """Return which of the config's maps each world is on, (W,)."""
        indices: NDArray[np.int64] = self.arrays.worlds.place[:, il.M_MAP].astype(np.int64)
        return indices

    def scenarios_played(self) -> NDArray[np.int64]:
        """Return the index of the scenario that each world plays, (W,); -1 where start and goal are random."""
        played: NDArray[np.int64] = self.arrays.worlds.place[:, il.M_SCENARIO].astype(np.int64)
        return played

    def scenario_name(self, world: int) -> str:
        """Return the scenario that a world plays, '' where start and goal are random."""
        index = int(self.arrays.worlds.place[world, il.M_SCENARIO])
        return self.data.scenarios[index].name if index >= 0 else ""

    def bodies(self, world: int) -> F64:
        """Return what the first robot's lidar sees of the others, (m, 7); columns as in ``_lidar`` and ``_ellipse``."""
        a = self.arrays
        w = a.worlds
        count = _ian_scan.other_bodies(
            0, w.agents[world], w.walkers[world], self.config.robots, int(w.scalars[world, lay.S_HUMANS]), a.rules,
            a.circles,
        )  # fmt: skip
        return a.circles[:count].copy()

    def scenario_indices(self, wanted: object) -> NDArray[np.int64]:
        """Return indices into the config's scenarios from names or indices (W,).

        Raises
        ------
        ConfigError, UnknownNameError
            If the config has no scenarios, or not these.
        """
        names = [scenario.name for scenario in self.data.scenarios]
        if not names:
            raise ConfigError(f"Environment {self.config.env!r} has no scenarios; take env='ian', or plain reset().")
        values = np.asarray(wanted)
        if values.shape != (self.n_worlds,):
            raise ConfigError(f"scenarios have shape {values.shape}, expected ({self.n_worlds},) names or indices.")
        result = np.zeros(self.n_worlds, np.int64)
        for w, value in enumerate(values.tolist()):
            if isinstance(value, str):
                if value not in names:
                    raise UnknownNameError(
                        f"Unknown scenario {value!r}.{did_you_mean(value, names)} Known: {', '.join(names)}."
                    )
                result[w] = names.index(value)
            elif isinstance(value, int) and 0 <= value < len(names):
                result[w] = value
            else:
                raise ConfigError(
                    f"Scenario {value!r} is none, expected a name or an index from 0 to {len(names) - 1}."
                )
        return result
