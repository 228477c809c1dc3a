"""What our figures are measured against: the plainest code that gives the same numbers.

``brute_lidar`` and ``loop_rings`` give what the package gives, slowly; ``Rvo2`` is RVO2's own C++ (pyrvo). None
of them is a straw man on purpose: the lidar is vectorised numpy and the rings are compiled.
"""

from __future__ import annotations

import io
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from navrep_data.schema import SensorContract
from navrep_data.sim import WorldState


def brute_lidar(state: WorldState, contract: SensorContract) -> NDArray[np.float64]:
    """Return one scan (n_rays,) [m]: every ray against every edge and circle, in numpy."""
    angles = state.robot[2] + contract.angle_min + np.arange(contract.n_rays) * contract.angle_increment
    c, s = np.cos(angles)[:, None], np.sin(angles)[:, None]
    ranges = np.full(contract.n_rays, contract.range_max)
    if state.polygons:
        a = np.concatenate(state.polygons) - state.robot[:2]
        e = np.concatenate([np.roll(p, -1, axis=0) for p in state.polygons]) - state.robot[:2] - a
        with np.errstate(divide="ignore", invalid="ignore"):
            det = c * e[:, 1] - s * e[:, 0]
            distance = (a[:, 0] * e[:, 1] - a[:, 1] * e[:, 0]) / det
            along = (a[:, 0] * s - a[:, 1] * c) / det
        hit = (det != 0) & (distance >= 0) & (along >= 0) & (along <= 1)
        ranges = np.minimum(ranges, np.where(hit, distance, np.inf).min(axis=1))
    if len(state.circles):
        x, y = (state.circles[:, :2] - state.robot[:2]).T
        middle, off = c * x + s * y, c * y - s * x
        room = state.circles[:, 2] ** 2 - off**2
        distance = np.where((room >= 0) & (middle > 0), middle - np.sqrt(np.maximum(room, 0)), np.inf)
        ranges = np.minimum(ranges, distance.min(axis=1))
    return ranges


@njit(cache=True)
def loop_rings(scans: NDArray[np.uint16], edges: NDArray[np.float32], first: NDArray[np.int64], out: Any) -> None:
    """Fill out (N, 64, 64) as the original's loops do, compiled: mark the cells, then what lies behind."""
    out[:] = 0
    for n in range(scans.shape[0]):
        for section in range(64):
            nearest = 64
            for ray in range(first[section], first[section + 1]):
                if scans[n, ray] == 0:
                    continue
                metres = np.float32(scans[n, ray]) / np.float32(1000)
                cell = np.searchsorted(edges, metres, side="right") - 1
                out[n, section, cell] = 2
                nearest = min(nearest, cell)
            for cell in range(nearest, 64):
                if out[n, section, cell] == 0:
                    out[n, section, cell] = 1


class Rvo2:
    """A scene in RVO2's own simulator (pyrvo), as the original sets it up.

    Parameters
    ----------
    agents : ndarray of shape (N, 7)
        x, y, goal x, goal y, radius [m], largest speed [m/s], unused.
    polygons : sequence of ndarray of shape (V, 2)
        Obstacles [m], anticlockwise = solid inside.
    dt : float
        Time step [s].
    """

    def __init__(self, agents: NDArray[np.float64], polygons: Sequence[NDArray[np.float64]], dt: float = 0.2) -> None:
        import pyrvo

        self.agents = agents
        self.sim = pyrvo.RVOSimulator(dt, 10.0, 10, 5.0, 5.0, 0.3, 1.0)
        for x, y, _, _, radius, speed in agents[:, :6].tolist():
            self.sim.add_agent((x, y), 10.0, 10, 5.0, 5.0, radius, speed, (0.0, 0.0))
        for polygon in polygons:
            self.sim.add_obstacle([(float(x), float(y)) for x, y in polygon])
        self.sim.process_obstacles()

    def positions(self) -> NDArray[np.float64]:
        """Return positions (N, 2) [m]."""
        return np.array([self.sim.get_agent_position(i).to_tuple() for i in range(len(self.agents))])

    def aim(self) -> None:
        """Set preferred velocities to the goals: 1 m/s, less within a metre of the goal."""
        way = self.agents[:, 2:4] - self.positions()
        way /= np.maximum(np.hypot(way[:, 0], way[:, 1]), 1.0)[:, None]
        for i, (x, y) in enumerate(way.tolist()):
            self.sim.set_agent_pref_velocity(i, (x, y))

    def restart(self) -> None:
        """Put everybody back to the start, at rest."""
        for i, (x, y) in enumerate(self.agents[:, :2].tolist()):
            self.sim.set_agent_position(i, (x, y))
            self.sim.set_agent_velocity(i, (0.0, 0.0))


def original_npz(columns: dict[str, NDArray[Any]]) -> bytes:
    """Return rows as the original writes them: np.savez_compressed, float32 scans [m], float64 rest."""
    memory = io.BytesIO()
    np.savez_compressed(
        memory,
        scans=columns["scan"],
        robotstates=columns["robot_state"].astype(np.float64),
        actions=columns["action"].astype(np.float64),
        rewards=columns["reward"].astype(np.float64),
        dones=columns["is_last"],
    )
    return memory.getvalue()


def zlib_bytes(rows: NDArray[Any], chunk: int, level: int = 9) -> int:
    """Return the bytes of `rows` in shuffled chunks deflated by zlib, as h5py's own filters would store them."""
    total = 0
    for start in range(0, len(rows), chunk):
        block = np.ascontiguousarray(rows[start : start + chunk])
        shuffled = block.view(np.uint8).reshape(-1, block.dtype.itemsize).T.tobytes()
        total += len(zlib.compress(shuffled, level))
    return total
