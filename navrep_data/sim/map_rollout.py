"""Sequences in worlds on maps, under a scripted or a Python policy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from navrep_data.schema import ACTION_SIZE
from navrep_data.sim import _ian_rollout
from navrep_data.sim import _layout as lay
from navrep_data.sim._batch import seed_worlds
from navrep_data.sim.config import SimConfig
from navrep_data.sim.map_worlds import MapWorlds
from navrep_data.sim.policies import SCRIPTED, ScriptedPolicy
from navrep_data.sim.rollout import (
    DrivenRollout,
    RobotDriver,
    RolloutSettings,
    ScriptedRollout,
    SequenceRows,
    _columns,
    _Outputs,
    _worlds,
)
from navrep_data.sim.simulator import Simulator, check_seed

__all__ = ["DrivenMapRollout", "ScriptedMapRollout"]

NAME_BYTES = 64
"""Room for names of maps and scenarios in worlds files."""


class _MapSequences:
    """Worlds on maps and room for the rows of a group of sequences."""

    def __init__(self, config: SimConfig, settings: RolloutSettings, n: int, maps: MapWorlds | None = None) -> None:
        self.maps = MapWorlds(config, n) if maps is None else maps
        self.settings = settings
        self.out = _Outputs(config, settings, n)
        self.places = np.zeros((n, settings.length, 2), np.int64)
        self.pending = np.zeros(n, np.int64)
        self.gave_up = np.zeros(n, np.bool_)
        self.actions = np.zeros((n, config.robots, ACTION_SIZE))
        self._rewards, self._each = np.zeros(config.robots), np.zeros(config.robots)
        self._no_corners, self._no_start = np.zeros((1, 2)), np.zeros(2, np.int64)
        flags = self.maps.arrays.flags
        flags[lay.F_SCAN_MM] = settings.scan_dtype == "uint16"
        flags[lay.F_WANT_HUMANS] = settings.humans
        flags[lay.F_WANT_LABELS] = settings.labels
        self._names = np.array([_ascii(grid.name) for grid in self.maps.data.maps], f"S{NAME_BYTES}")
        self._hashes = np.array([_ascii(grid.hash) for grid in self.maps.data.maps], f"S{NAME_BYTES}")
        scenarios = [_ascii(scenario.name) for scenario in self.maps.data.scenarios]
        self._scenarios = np.array([*scenarios, b""], f"S{NAME_BYTES}")  # -1: none

    def begin(self, seed: int, sequences: Sequence[int]) -> None:
        """Seed the worlds and start their first episodes."""
        a = self.maps.arrays
        seed_worlds(a.rng, a.scalars, seed, np.array(sequences))
        self.out.counts[:] = 0
        self.pending[:] = 0
        self.gave_up[:] = False
        self.maps.reset(np.ones(len(sequences), np.bool_), a.rng)

    def observe(self, row: int) -> None:
        """Write the observations of a row."""
        a, out = self.maps.arrays, self.out
        _ian_rollout.begin_map_rows(
            row, a.worlds, self.maps.data.tables, a.rules, a.circles, a.dirs, a.inv_work, a.owner_work, a.hits, a.scans,
            a.params, a.flags, self._no_corners, self._no_start, out.scan, out.floats, out.ints, out.humans,
            out.labels, out.episodes, out.corners, out.sizes, out.table, out.counts, self.places,
        )  # fmt: skip

    def act(self, row: int) -> None:
        """Take the row's actions, or start new episodes where the last ones ended."""
        a, out = self.maps.arrays, self.out
        done = _ian_rollout.finish_map_rows(
            row, self.settings.length, self.pending, self.gave_up, self.actions, a.worlds, self.maps.data.tables,
            a.rules, a.flags, a.circles, a.path, a.orca, a.moves, self._rewards, self._each, out.floats, out.ints,
        )  # fmt: skip
        if not done:
            raise self.maps.no_place(int(np.flatnonzero(self.pending < 0)[0]))

    def rows(self, sequences: Sequence[int]) -> list[SequenceRows]:
        """Return what was written, one pair of dicts per sequence."""
        result = []
        for w, sequence in enumerate(sequences):
            worlds = _worlds(self.out, w, sequence)
            places = self.places[w, : self.out.counts[w, 0]]
            worlds["map"], worlds["map_hash"] = self._names[places[:, 0]], self._hashes[places[:, 0]]
            worlds["scenario"] = self._scenarios[places[:, 1]]
            result.append((_columns(self.out, w, sequence, self.settings), worlds))
        return result


def _ascii(name: str) -> bytes:
    return name.encode("ascii", "replace")[:NAME_BYTES]


class ScriptedMapRollout(ScriptedRollout):
    """Roll out sequences on maps under a scripted policy; see :class:`navrep_data.sim.ScriptedRollout`.

    ORCA follows the goal field round walls and avoids agents and the map's contours on the way.
    """

    batch = 1

    def __init__(self, config: SimConfig, settings: RolloutSettings, policy: ScriptedPolicy, seed: int) -> None:
        self.settings = settings
        self.seed = check_seed(seed)
        self._sequences = _MapSequences(config, settings, self.batch)
        self._memory = np.zeros((self.batch, config.robots, ACTION_SIZE))
        a = self._sequences.maps.arrays
        a.flags[lay.F_POLICY] = SCRIPTED[policy.name]
        a.params[lay.P_STUCK_SPEED] = policy.stuck_speed
        a.params[lay.P_OMEGA_NOISE] = policy.omega_noise
        a.params[lay.P_POLICY_SPEED] = policy.speed

    def run(self, sequences: Sequence[int]) -> list[SequenceRows]:
        """Return the rows of one sequence; the arrays are overwritten by the next call."""
        s = self._sequences
        s.begin(self.seed, sequences)
        a, tables, length = s.maps.arrays, s.maps.data.tables, s.settings.length
        self._memory[:] = 0.0
        for row in range(length):
            s.observe(row)
            _ian_rollout.choose_rows(
                row, length, s.pending, s.gave_up, a.worlds, tables, a.orca, a.path, a.params, a.flags, a.rules,
                self._memory, s.actions,
            )  # fmt: skip
            s.act(row)
        return s.rows(sequences)


class DrivenMapRollout(DrivenRollout):
    """Roll out sequences on maps under a policy; see :class:`navrep_data.sim.DrivenRollout`."""

    def __init__(
        self, config: SimConfig, settings: RolloutSettings, driver: RobotDriver, seed: int, batch: int = 64
    ) -> None:
        super().__init__(config, settings, driver, seed, batch)
        self._sequences: _MapSequences | None = None

    def run(self, sequences: Sequence[int]) -> list[SequenceRows]:
        """Return the rows of these sequences, in order; the arrays are overwritten by the next call."""
        n = len(sequences)
        if self.simulator is None or self.simulator.n_worlds != n or self._sequences is None:
            self.simulator = Simulator.without_worlds(self.config, n)
            self._sequences = _MapSequences(self.config, self.settings, n, self.simulator.maps)
        simulator, s = self.simulator, self._sequences
        s.begin(self.seed, sequences)
        for row in range(self.settings.length):
            s.observe(row)
            s.actions[:, 0] = self._drive(simulator, row, sequences, s.out, s.maps.arrays.scans)
            s.act(row)
        return s.rows(sequences)
