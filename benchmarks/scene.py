"""One scene for all simulators, and the adapter of each: 20 ORCA agents cross a circle among boxes, inside a border.

Agent 0 carries a lidar of 1080 rays over a full turn, 25 m. All agents: radius 0.4 m, 1 m/s, neighbours within 10 m
and at most 10 of them, horizons 5 s, time step 0.2 s. An adapter has `name`, `restart()` (not timed) and
`run(steps)` (timed), `positions()` to see that it simulates the same thing, `scan()` if it has a lidar, and `misses`:
what it does not do.
"""

from __future__ import annotations

import contextlib
import importlib
import sys
from typing import Any, Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray
from references import Rvo2

from navrep_data.sim import _layout as lay
from navrep_data.sim import make_config
from navrep_data.sim._orca import orca_step
from navrep_data.sim._step import (
    ORCA_MARGIN,
    build_trees,
    fill_edges,
    observe_scan,
    observe_state,
    orca_choice,
    pack_orca,
    step_world,
)
from navrep_data.sim.simulator import WorldArrays

N_AGENTS = 20
RADIUS, SPEED, DT = 0.4, 1.0, 0.2
CIRCLE, HALF = 7.0, 9.0
N_RAYS, RANGE = 1080, 25.0
EPISODE = 100
NEIGHBORS, NEIGHBOR_DIST, HORIZON = 10, 10.0, 5.0

Points = NDArray[np.float64]


def starts() -> Points:
    """Return positions (20, 2) [m]; goals are opposite. Not quite regular: ORCA deadlocks in perfect symmetry."""
    angle = 2 * np.pi * (np.arange(N_AGENTS) + np.random.default_rng(0).uniform(-0.2, 0.2, N_AGENTS)) / N_AGENTS
    return CIRCLE * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def boxes() -> list[Points]:
    """Return four squares (4, 2) [m], anticlockwise."""
    corner = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    return [corner + centre for centre in ((3.0, 1.5), (-2.5, 3.0), (-3.0, -2.0), (2.0, -3.5))]


def border() -> Points:
    """Return the border (4, 2) [m], clockwise: free inside."""
    return HALF * np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, 1.0], [1.0, -1.0]])


def polygons(with_boxes: bool) -> list[Points]:
    """Return what stands around: the border, and the boxes if asked for."""
    return [*(boxes() if with_boxes else []), border()]


class Adapter(Protocol):
    """What `peers.py` needs of a simulator."""

    name: str
    misses: str

    def restart(self) -> None: ...
    def run(self, steps: int) -> None: ...
    def positions(self) -> Points: ...


# --- ours ---------------------------------------------------------------------------------------------------------


@njit(error_model="numpy")
def _run_world(
    steps, agents, agents32, scalars, edges, polygon_start, boxes, obst_f, obst_i, circles, dirs, inv_work, owner_work,
    hits, scan, state, params, flags, orca_params, work_f, work_i, moves, result,
):  # fmt: skip
    """Run one world as the generator does, without its rows and resets."""
    humans = int(scalars[lay.S_HUMANS])
    command = np.zeros(3)
    for _ in range(steps):
        pack_orca(agents, humans + 1, agents32)
        vx, vy = orca_choice(
            0, agents, agents32, 1, humans, obst_f[0], obst_i[0], int(scalars[lay.S_OBST_ROBOT]), orca_params,
            work_f, work_i,
        )  # fmt: skip
        c, s = np.cos(agents[0, lay.A_HEADING]), np.sin(agents[0, lay.A_HEADING])
        command[0], command[1] = c * vx + s * vy, c * vy - s * vx
        step_world(
            agents, agents32, scalars, edges, polygon_start, boxes, obst_f, obst_i, params, flags, orca_params, work_f,
            work_i, moves, command, result,
        )  # fmt: skip
        observe_scan(
            0, agents, scalars, edges, polygon_start, circles, dirs, inv_work, owner_work, hits, params, flags, scan
        )
        observe_state(0, agents, flags, state)


class Ours:
    """The kernels of this package on the common scene; rewards and collisions are worked out too."""

    def __init__(self, legs: bool = False, with_boxes: bool = True) -> None:
        self.name = "navrep-data, legs" if legs else "navrep-data"
        self.misses = "-" if legs else "- (trunks here, as the others)"
        self.world = WorldArrays(make_config("soadrl", humans=N_AGENTS), 1)
        self.world.flags[lay.F_LEGS] = legs
        self.state = np.zeros(5, np.float32)
        self.result = np.zeros(2)
        self._place(polygons(with_boxes))
        self.restart()
        self.run(1)

    def _place(self, shapes: list[Points]) -> None:
        w = self.world
        corners = np.concatenate(shapes)
        w.vertices[0, : len(corners)] = corners
        w.polygon_start[0, : len(shapes) + 1] = np.arange(len(shapes) + 1) * 4
        scalars = w.scalars[0]
        scalars[lay.S_HUMANS] = N_AGENTS - 1
        scalars[lay.S_POLYGONS] = len(shapes)
        scalars[lay.S_BORDER] = 1
        scalars[lay.S_XMIN : lay.S_YMAX + 1] = (-HALF, -HALF, HALF, HALF)
        if not build_trees(w.vertices[0], w.polygon_start[0], scalars, w.obst_f[0], w.obst_i[0]):
            raise RuntimeError("the scene's obstacles do not fit the simulator's arrays")
        fill_edges(w.vertices[0], w.polygon_start[0], len(shapes), w.edges[0])

    def restart(self) -> None:
        agents = self.world.agents[0]
        agents[:] = 0.0
        mine = agents[:N_AGENTS]
        mine[:, lay.A_X : lay.A_Y + 1] = starts()
        mine[:, lay.A_GX : lay.A_GY + 1] = -starts()
        mine[:, lay.A_RADIUS] = RADIUS
        mine[:, lay.A_VPREF] = SPEED
        mine[:, lay.A_SEES] = 1.0
        self.world.scalars[0, lay.S_TIME] = self.world.scalars[0, lay.S_STEP] = 0.0

    def run(self, steps: int) -> None:
        w = self.world
        _run_world(
            steps, w.agents[0], w.agents32, w.scalars[0], w.edges[0], w.polygon_start[0], w.boxes[0], w.obst_f[0],
            w.obst_i[0], w.circles, w.dirs, w.inv_work, w.owner_work, w.hits[0], w.scans[0], self.state, w.params,
            w.flags, w.orca_params, w.work_f, w.work_i, w.moves, self.result,
        )  # fmt: skip

    def positions(self) -> Points:
        return self.world.agents[0, :N_AGENTS, lay.A_X : lay.A_Y + 1].copy()

    def scan(self) -> Points:
        return self.world.scans[0].astype(np.float64)


@njit(error_model="numpy")
def _run_orca(steps, agents32, goals, wanted, obst_f, obst_i, n_obst, params, work_f, work_i, out):
    """Move all agents by ORCA, each towards its goal at 1 m/s, slower within a metre of it."""
    dt = params[4]
    for _ in range(steps):
        for i in range(agents32.shape[0]):
            x, y = goals[i, 0] - agents32[i, 0], goals[i, 1] - agents32[i, 1]
            far = max(np.hypot(x, y), 1.0)
            wanted[i, 0], wanted[i, 1] = x / far, y / far
        orca_step(agents32, wanted, obst_f, obst_i, n_obst, params, work_f, work_i, out)
        for i in range(agents32.shape[0]):
            agents32[i, 0] += out[i, 0] * dt
            agents32[i, 1] += out[i, 1] * dt
            agents32[i, 2], agents32[i, 3] = out[i, 0], out[i, 1]


class OursOrca:
    """Our ORCA alone."""

    name, misses = "navrep-data, ORCA alone", "-"

    def __init__(self) -> None:
        self.full = Ours()
        self.agents32 = np.zeros((N_AGENTS, 6), np.float32)
        self.wanted = np.zeros((N_AGENTS, 2))
        self.out = np.zeros((N_AGENTS, 2), np.float32)
        self.restart()
        self.run(1)

    def restart(self) -> None:
        self.agents32[:, 0:2] = starts()
        self.agents32[:, 2:4] = 0.0
        self.agents32[:, 4], self.agents32[:, 5] = RADIUS + ORCA_MARGIN, SPEED

    def run(self, steps: int) -> None:
        w = self.full.world
        _run_orca(
            steps, self.agents32, -starts(), self.wanted, w.obst_f[0, 0], w.obst_i[0, 0],
            int(w.scalars[0, lay.S_OBST_ROBOT]), w.orca_params, w.work_f, w.work_i, self.out,
        )  # fmt: skip

    def positions(self) -> Points:
        return self.agents32[:, 0:2].astype(np.float64)


class PyRvo:
    """RVO2 in C++ through pyrvo; preferred velocities are set from Python every ten steps only, in its favour."""

    name, misses = "pyrvo (RVO2 in C++), ORCA alone", "lidar, legs, scenarios, rewards, datasets"

    def __init__(self) -> None:
        at = starts()
        agents = np.column_stack([at, -at, np.full(N_AGENTS, RADIUS + ORCA_MARGIN), np.full(N_AGENTS, SPEED)])
        self.rvo = Rvo2(agents, polygons(True), DT)

    def restart(self) -> None:
        self.rvo.restart()

    def run(self, steps: int) -> None:
        for step in range(steps):
            if step % 10 == 0:
                self.rvo.aim()
            self.rvo.sim.do_step()

    def positions(self) -> Points:
        return self.rvo.positions()


# --- others -------------------------------------------------------------------------------------------------------


class Navground:
    """navground's C++ world; collision handling is switched off, in its favour.

    Its ORCA agents hold no sensor readings (`environment_state` is a GeometricState, which sensors ignore), so the
    lidar is updated by a call after each step: the same C++ code, and about a microsecond for the call.
    """

    def __init__(self, lidar: bool = True, with_boxes: bool = True) -> None:
        self.name = "navground" if lidar else "navground, no lidar"
        self.misses = "legs, rewards, sensors of its own ORCA agents (read by a call here), training windows"
        self._lidar, self._shapes = lidar, polygons(with_boxes)
        self._core = importlib.import_module("navground.core")
        self._sim = importlib.import_module("navground.sim")
        self.restart()

    def restart(self) -> None:
        core, sim = self._core, self._sim
        self.world = sim.World()
        self.world.ignore_collisions = True
        self._agents = [self._agent(k, at) for k, at in enumerate(starts().astype(np.float32))]
        for agent in self._agents:
            self.world.add_agent(agent)
        for polygon in self._shapes:
            for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
                self.world.add_wall(core.LineSegment(a.astype(np.float32), b.astype(np.float32)))

    def _agent(self, k: int, at: NDArray[np.float32]) -> Any:
        core, sim = self._core, self._sim
        orca = core.behaviors.ORCABehavior()
        orca.optimal_speed, orca.horizon, orca.safety_margin = SPEED, NEIGHBOR_DIST, ORCA_MARGIN
        orca.time_horizon = orca.static_time_horizon = HORIZON
        orca.max_number_of_neighbors = NEIGHBORS
        sensors = [sim.state_estimations.BoundedStateEstimation(NEIGHBOR_DIST)]
        if k == 0:
            self._sensor = sim.state_estimations.LidarStateEstimation(RANGE, 0.0, 2 * np.pi, N_RAYS)
            self._reading = core.SensingState()
            self._sensor.prepare_state(self._reading)
        kinematics = core.kinematics.OmnidirectionalKinematics(SPEED, 1.0)
        agent = sim.Agent(RADIUS, orca, kinematics, sim.tasks.WaypointsTask([-at], False, 0.1), sensors, DT)
        agent.position = at
        return agent

    def run(self, steps: int) -> None:
        if not self._lidar:
            self.world.run(steps, DT)
            return
        world, robot, update, reading = self.world, self._agents[0], self._sensor.update, self._reading
        for _ in range(steps):
            world.update(DT)
            update(robot, world, reading)

    def positions(self) -> Points:
        return np.array([agent.position for agent in self._agents], np.float64)

    def scan(self) -> Points:
        return np.array(self._sensor.read_ranges(self._reading))


class IrSim:
    """ir-sim, headless; its ORCA (pyrvo) does not see the obstacles, its lidar does."""

    def __init__(self, world_file: Any) -> None:
        self.name = "ir-sim"
        self.misses = "obstacles in ORCA, legs, rewards, datasets"
        world_file.write_text(_irsim_world())
        with contextlib.redirect_stdout(sys.stderr):  # it prints which window systems it misses
            irsim = importlib.import_module("irsim")
            self.env = irsim.make(str(world_file), headless=True, log_level="ERROR")

    def restart(self) -> None:
        self.env.reset()

    def run(self, steps: int) -> None:
        for _ in range(steps):
            self.env.step()

    def positions(self) -> Points:
        return np.array([robot.state[:2, 0] for robot in self.env.robot_list], np.float64)

    def scan(self) -> Points:
        return np.array(self.env.get_lidar_scan(0)["ranges"], np.float64)


def _irsim_world() -> str:
    import yaml

    orca = {
        "name": "orca", "neighborDist": NEIGHBOR_DIST, "maxNeighbors": NEIGHBORS, "timeHorizon": HORIZON,
        "timeHorizonObst": HORIZON, "safe_radius": ORCA_MARGIN, "maxSpeed": SPEED,
    }  # fmt: skip
    lidar = {"name": "lidar2d", "range_min": 0, "range_max": RANGE, "angle_range": 2 * np.pi, "number": N_RAYS}
    robots = []
    for k, (x, y) in enumerate(starts().tolist()):
        robot: dict[str, Any] = {
            "kinematics": {"name": "omni"}, "shape": {"name": "circle", "radius": RADIUS}, "state": [x, y, 0],
            "goal": [-x, -y, 0], "vel_min": [-SPEED, -SPEED], "vel_max": [SPEED, SPEED], "group": 0,
            "group_behavior": orca,
        }  # fmt: skip
        robots.append({**robot, "sensors": [lidar]} if k == 0 else robot)
    shapes = [{"name": "polygon", "vertices": box.tolist()} for box in boxes()]
    shapes.append({"name": "linestring", "vertices": [*border().tolist(), border()[0].tolist()]})
    size = 4 * HALF
    world = {
        "height": size, "width": size, "offset": [-size / 2, -size / 2], "step_time": DT, "sample_time": DT,
        "control_mode": "auto", "collision_mode": "unobstructed",
    }  # fmt: skip
    return yaml.safe_dump({"world": world, "robot": robots, "obstacle": [{"shape": shape} for shape in shapes]})
