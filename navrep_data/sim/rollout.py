"""Sequences: a fixed number of consecutive rows, holding several episodes, as columns ready to be stored."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from navrep_data.errors import ConfigError, SimulationError
from navrep_data.observations import scan_to_rings
from navrep_data.schema import ACTION_SIZE, HUMAN_FIELDS, RINGS_SHAPE, Event
from navrep_data.sim import _layout as lay
from navrep_data.sim._batch import reset_worlds, seed_worlds
from navrep_data.sim._rollout import begin_row, begin_rows, choose_actions, finish_row, finish_rows, rollout_sequence
from navrep_data.sim._step import reset_world
from navrep_data.sim.config import SimConfig
from navrep_data.sim.policies import SCRIPTED, ScriptedPolicy
from navrep_data.sim.simulator import Simulator, WorldArrays, check_seed, no_world


class RobotDriver(Protocol):
    """What drives the robots of sequences: :class:`navrep_data.policies.Driver`, said here without importing it."""

    def start(self, simulator: Simulator) -> None:
        """Begin a group of sequences."""

    def reset(self, mask: NDArray[np.bool_], seeds: NDArray[np.int64]) -> None:
        """Begin episodes in the worlds of `mask`, with these seeds."""

    def commands(
        self,
        simulator: Simulator,
        mask: NDArray[np.bool_] | None = None,
        seen: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None,
    ) -> NDArray[np.float64]:
        """Return what robots are sent, (W, 3) [m/s, m/s, rad/s]."""


def episode_seeds(
    seed: int, sequences: Sequence[int], episodes: NDArray[np.int32], mask: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Return seeds (W,) for what drives, one for each episode that begins; they depend on nothing else.

    Parameters
    ----------
    seed : int
        The dataset's.
    sequences : sequence of int
        Numbers of W sequences.
    episodes : ndarray of shape (W,)
        Numbers of their present episodes.
    mask : ndarray of shape (W,), bool
        Where they begin; the seeds of others are 0.
    """
    seeds = np.zeros(len(mask), np.int64)
    for w in np.flatnonzero(mask).tolist():
        words = hashlib.blake2b(f"{seed} {sequences[w]} {episodes[w]}".encode(), digest_size=8)
        seeds[w] = int.from_bytes(words.digest(), "little") >> 1
    return seeds


# columns of the packed float output of the kernels
_STATE, _ACTION, _REWARD, _POSE, _RADIUS = slice(0, 5), slice(5, 8), 8, slice(9, 12), 12
_FLOATS, _INTS = 13, 4
_TERMINAL = np.array([event.terminal for event in Event])


@dataclass(frozen=True)
class RolloutSettings:
    """How sequences are rolled out and stored.

    Attributes
    ----------
    length : int
        Rows per sequence.
    scan_dtype : str
        ``"uint16"`` millimetres or ``"float32"`` metres.
    rings, humans, labels, contact : bool
        Whether to fill these columns (labels: scan_label).
    """

    length: int = 1000
    scan_dtype: str = "uint16"
    rings: bool = True
    humans: bool = True
    labels: bool = False
    contact: bool = False


class _Outputs:
    """Room for the rows of a batch of sequences; reused from batch to batch."""

    def __init__(self, config: SimConfig, settings: RolloutSettings, n: int) -> None:
        length, crowd = settings.length, config.max_others
        # every row may start an episode (a policy can give up at once), so tables grow only up to this
        starts = length
        self.scan = np.zeros((n, length, config.sensor.n_rays), settings.scan_dtype)
        # reused where one sequence at a time is made: fresh pages cost more than the rings themselves
        self.rings = np.zeros((length, *RINGS_SHAPE), np.uint8) if settings.rings and n == 1 else None
        self.floats = np.zeros((n, length, _FLOATS), np.float32)
        self.ints = np.zeros((n, length, _INTS), np.int32)
        self.humans = np.zeros((n, length if settings.humans else 1, crowd, len(HUMAN_FIELDS)), np.float32)
        self.labels = np.zeros((n, length if settings.labels else 1, config.sensor.n_rays), np.uint8)
        self.episodes = np.zeros((n, starts, 10))
        self.corners = np.zeros((n, starts * 4 * config.max_polygons, 2), np.float32)
        self.sizes = np.zeros((n, starts * config.max_polygons), np.int32)
        self.table = np.zeros((n, starts * max(1, crowd), 10), np.float32)
        self.counts = np.zeros((n, 4), np.int64)


def _columns(out: _Outputs, w: int, sequence: int, settings: RolloutSettings) -> dict[str, NDArray[Any]]:
    floats, ints = out.floats[w], out.ints[w]
    event = ints[:, 0].astype(np.uint8)
    step = ints[:, 2].copy()
    columns: dict[str, NDArray[Any]] = {"scan": out.scan[w]}
    if settings.rings:
        columns["rings"] = scan_to_rings(out.scan[w], out=out.rings)
    columns |= {
        "robot_state": np.ascontiguousarray(floats[:, _STATE]),
        "action": np.ascontiguousarray(floats[:, _ACTION]),
        "reward": floats[:, _REWARD].copy(),
        "is_first": step == 0,
        "is_last": event > 0,
        "is_terminal": _TERMINAL[event],
        "event": event,
        "sequence": np.full(settings.length, sequence, np.int32),
        "episode": ints[:, 1].copy(),
        "step": step,
        "robot_pose": np.ascontiguousarray(floats[:, _POSE]),
        "robot_radius": floats[:, _RADIUS].copy(),
    }
    if settings.humans:
        columns["humans"] = out.humans[w]
    if settings.labels:
        columns["scan_label"] = out.labels[w]
    if settings.contact:
        columns["contact"] = ints[:, 3].astype(np.uint8)
    return columns


def _worlds(out: _Outputs, w: int, sequence: int) -> dict[str, NDArray[Any]]:
    n_episodes, n_corners, n_polygons, n_humans = out.counts[w]
    e = out.episodes[w, :n_episodes]
    h = out.table[w, :n_humans]

    def offsets(sizes: NDArray[Any]) -> NDArray[np.int64]:
        return np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)

    return {
        "sequence": np.full(n_episodes, sequence, np.int32),
        "episode": np.arange(n_episodes, dtype=np.int32),
        "row": e[:, 0].astype(np.int32),
        "robot_start": e[:, 1:4].astype(np.float32),
        "robot_goal": e[:, 4:6].astype(np.float32),
        "robot_v_pref": e[:, 6].astype(np.float32),
        "has_border": e[:, 7] > 0.5,
        "vertices": out.corners[w, :n_corners].copy(),
        "polygon_offset": offsets(out.sizes[w, :n_polygons]),
        "episode_polygon_offset": offsets(e[:, 8]),
        "human_offset": offsets(e[:, 9]),
        "human_start": h[:, 0:3].copy(),
        "human_goal": h[:, 3:5].copy(),
        "human_v_pref": h[:, 5].copy(),
        "human_sees_robot": h[:, 6] > 0.5,
        "human_gait": h[:, 7:10].copy(),
    }


SequenceRows = tuple[dict[str, NDArray[Any]], dict[str, NDArray[Any]]]
"""Columns of one sequence and the static side of its episodes."""

Prepared = tuple[Any, tuple[Any, ...]]
"""A kernel, and arguments of the types that it is called with."""


class ScriptedRollout:
    """Roll out sequences under a scripted policy, entirely inside the kernels.

    Parameters
    ----------
    config : SimConfig
        The environment.
    settings : RolloutSettings
        Length and columns.
    policy : ScriptedPolicy
        The robot's policy. Where there are several robots it drives them all; rows are those of the first, and the
        others are listed after the humans.
    seed : int
        The dataset's seed; sequence i draws from the stream (seed, i) alone.
    """

    batch = 1

    def __init__(self, config: SimConfig, settings: RolloutSettings, policy: ScriptedPolicy, seed: int) -> None:
        self.arrays = WorldArrays(config, 1)
        self.settings = settings
        self.seed = check_seed(seed)
        self._out = _Outputs(config, settings, 1)
        _prepare(self.arrays, settings)
        self.arrays.flags[lay.F_POLICY] = SCRIPTED[policy.name]
        self.arrays.params[lay.P_STUCK_SPEED] = policy.stuck_speed
        self.arrays.params[lay.P_OMEGA_NOISE] = policy.omega_noise
        self.arrays.params[lay.P_POLICY_SPEED] = policy.speed

    def parts(self) -> tuple[tuple[Prepared, ...], tuple[Prepared, ...]]:
        """Return the kernels within :meth:`run`, with arguments, in two halves that compile for about as long."""
        a, out = self.arrays, self._out
        agents, scalars, orca = a.agents[0], a.scalars[0], (a.orca_params, a.work_f, a.work_i)
        static = (a.vertices[0], a.polygon_start[0], a.edges[0])
        three = np.zeros(3)
        begin = (reset_world, (
            agents, a.agents32, scalars, *static, a.obst_f[0], a.obst_i[0], a.boxes[0], a.rng[0], a.params, a.flags,
            *orca, a.moves,
        ))  # fmt: skip
        observe = (begin_row, (
            0, agents, scalars, *static, a.circles, a.dirs, a.inv_work, a.owner_work, a.hits[0], a.scans[0], a.params,
            a.flags, out.scan[0], out.floats[0], out.ints[0], out.humans[0], out.labels[0], out.episodes[0],
            out.corners[0], out.sizes[0], out.table[0], out.counts[0],
        ))  # fmt: skip
        choose = (choose_actions, (
            agents, a.agents32, scalars, a.obst_f[0], a.obst_i[0], a.rng[0], a.params, a.flags, *orca, three, three,
        ))  # fmt: skip
        finish = (finish_row, (
            0, 0, 0, False, three, agents, a.agents32, scalars, a.polygon_start[0], a.edges[0], a.obst_f[0],
            a.obst_i[0], a.boxes[0], a.params, a.flags, *orca, a.moves, three, out.floats[0], out.ints[0],
        ))  # fmt: skip
        return (observe, begin), (choose, finish)

    def blank(self) -> dict[str, NDArray[Any]]:
        """Return columns as :meth:`run` does, of one episode of zeros that is cut at its end; nothing is simulated."""
        out = self._out
        for array in (out.scan, out.floats, out.ints, out.humans):
            array[...] = 0
        out.ints[0, :, 2] = np.arange(self.settings.length)
        out.ints[0, -1, 0] = Event.CUT
        return _columns(out, 0, 0, self.settings)

    def run(self, sequences: Sequence[int]) -> list[SequenceRows]:
        """Return the rows of one sequence; the arrays are overwritten by the next call."""
        (sequence,) = sequences
        a, out = self.arrays, self._out
        seed_worlds(a.rng, a.scalars, self.seed, np.array([sequence]))
        ok = rollout_sequence(
            a.agents[0], a.agents32, a.scalars[0], a.vertices[0], a.polygon_start[0], a.edges[0], a.obst_f[0],
            a.obst_i[0], a.boxes[0], a.rng[0], a.circles, a.dirs, a.inv_work, a.owner_work, a.hits[0], a.scans[0],
            a.work_f, a.work_i, a.moves, a.params, a.flags, a.orca_params,
            out.scan[0], out.floats[0], out.ints[0], out.humans[0], out.labels[0], out.episodes[0], out.corners[0],
            out.sizes[0], out.table[0], out.counts[0],
        )  # fmt: skip
        if not ok:
            raise _no_world(a.config, sequence)
        return [(_columns(out, 0, sequence, self.settings), _worlds(out, 0, sequence))]


class DrivenRollout:
    """Roll out sequences under a policy that is asked at every row, a fixed group of them at a time.

    Parameters
    ----------
    config, settings, seed
        As for :class:`ScriptedRollout`.
    driver : RobotDriver
        Who drives. It is started anew for each group, so that rows do not depend on what was made before.
    batch : int
        Sequences per group.
    """

    def __init__(
        self, config: SimConfig, settings: RolloutSettings, driver: RobotDriver, seed: int, batch: int = 64
    ) -> None:
        if config.robots > 1:
            raise ConfigError(
                f"robots={config.robots} with a policy that drives one robot; set robots=1, or take a scripted policy, "
                f"which drives all ({', '.join(SCRIPTED)})."
            )
        self.config = config
        self.settings = settings
        self.driver = driver
        self.seed = check_seed(seed)
        self.batch = batch
        self.simulator: Simulator | None = None
        self._out: _Outputs | None = None

    def _begin(self, n: int) -> Simulator:
        """Return the worlds of a group, made anew where it has another size than the last one."""
        if self.simulator is None or self.simulator.n_worlds != n:
            self.simulator = Simulator.without_worlds(self.config, n)
            self._out = _Outputs(self.config, self.settings, n)
            _prepare(self.simulator.arrays, self.settings)
        return self.simulator

    def _drive(
        self, simulator: Simulator, row: int, sequences: Sequence[int], out: _Outputs, scans: NDArray[np.float32]
    ) -> NDArray[np.float64]:
        """Tell the driver of new episodes, and return what robots are sent, (W, 3); nothing after the last row."""
        first = out.ints[:, row, 2] == 0
        if row == 0:
            self.driver.start(simulator)
        if first.any():
            self.driver.reset(first, episode_seeds(self.seed, sequences, out.ints[:, row, 1], first))
        if row == self.settings.length - 1:
            return np.zeros((len(sequences), ACTION_SIZE))
        return self.driver.commands(simulator, seen=(scans, np.ascontiguousarray(out.floats[:, row, _STATE])))

    def run(self, sequences: Sequence[int]) -> list[SequenceRows]:
        """Return the rows of these sequences, in order; the arrays are overwritten by the next call."""
        n = len(sequences)
        simulator = self._begin(n)
        a, out = simulator.arrays, self._out
        assert out is not None
        simulator.seed_worlds(self.seed, np.array(sequences))
        out.counts[:] = 0
        everything = np.ones(n, np.bool_)
        if not reset_worlds(
            everything, a.agents, a.agents32, a.scalars, a.vertices, a.polygon_start, a.edges, a.obst_f, a.obst_i,
            a.boxes, a.rng, a.params, a.flags, a.orca_params, a.work_f, a.work_i, a.moves,
        ):  # fmt: skip
            raise _no_world(a.config, sequences[0])
        pending = np.zeros(n, np.int64)
        gave_up = np.zeros(n, np.bool_)
        result = np.zeros(2)  # reward and event of one robot
        length = self.settings.length
        for row in range(length):
            begin_rows(
                row, a.agents, a.scalars, a.vertices, a.polygon_start, a.edges, a.circles, a.dirs, a.inv_work,
                a.owner_work, a.hits, a.scans, a.params, a.flags, out.scan, out.floats, out.ints, out.humans,
                out.labels, out.episodes, out.corners, out.sizes, out.table, out.counts,
            )  # fmt: skip
            actions = self._drive(simulator, row, sequences, out, a.scans)
            if not finish_rows(
                row, length, pending, gave_up, actions, a.agents, a.agents32, a.scalars, a.vertices, a.polygon_start,
                a.edges, a.obst_f, a.obst_i, a.boxes, a.rng, a.params, a.flags, a.orca_params, a.work_f, a.work_i,
                a.moves, result, out.floats, out.ints,
            ):  # fmt: skip
                raise _no_world(a.config, sequences[0])
        return [(_columns(out, w, s, self.settings), _worlds(out, w, s)) for w, s in enumerate(sequences)]


def check_rings(config: SimConfig, rings: bool) -> None:
    """Refuse the rings column for a sensor that does not look once around, starting straight ahead.

    Raises
    ------
    ConfigError
        Naming the sensor's fields.
    """
    sensor = config.sensor
    if rings and not (sensor.covers_full_turn() and abs(sensor.angle_min) <= sensor.angle_increment):
        span = np.rad2deg(sensor.n_rays * sensor.angle_increment)
        raise ConfigError(
            f"rings=True with sensor.n_rays={sensor.n_rays} over {span:.0f} degrees from sensor.angle_min="
            f"{sensor.angle_min:g}: rings need rays once around from straight ahead; leave the column out (--no-rings)."
        )


def _prepare(arrays: WorldArrays, settings: RolloutSettings) -> None:
    check_rings(arrays.config, settings.rings)
    arrays.flags[lay.F_SCAN_MM] = settings.scan_dtype == "uint16"
    arrays.flags[lay.F_WANT_HUMANS] = settings.humans
    arrays.flags[lay.F_WANT_LABELS] = settings.labels


def _no_world(config: SimConfig, sequence: int) -> SimulationError:
    return no_world(config, f"for sequence {sequence} ")
