"""Play episodes: a batch of worlds, whose finished ones go on with the next episode."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from navrep_data.errors import SimulationError
from navrep_data.evaluate.metrics import Contacts, measure
from navrep_data.evaluate.suite_worlds import SuiteWorlds
from navrep_data.evaluate.suites import Suite
from navrep_data.policies import BasePolicy, Driver
from navrep_data.policies.functions import BLOCK
from navrep_data.schema import Event
from navrep_data.sim import Touches

DEFAULT_BATCH = 64
TRAJECTORY_POINTS = 60
"""Most points of a stored trajectory."""

Take = Callable[[], list[int] | None]
"""Returns the next episodes to play: one, or a whole group for policies that want groups; None when all are taken."""


@dataclass(frozen=True)
class Episode:
    """A finished episode.

    Attributes
    ----------
    episode : int
        Its number in the suite.
    event : Event
        Why it ended.
    steps : int
        How many steps it took.
    metrics : dict
        By name, see :data:`METRICS`.
    trajectory : ndarray of shape (n, 2), int32
        Where the robot was, in centimetres, at most 60 points, first and last among them.
    contacts : Contacts
        What the robot touched.
    """

    episode: int
    event: Event
    steps: int
    metrics: dict[str, float]
    trajectory: NDArray[np.int32]
    contacts: Contacts = field(default_factory=Contacts)


class _ContactCounter:
    """Counts the contacts of the episodes that are being played, as :class:`Contacts` defines them."""

    def __init__(self, n: int) -> None:
        self.human, self.obstacle = np.zeros(n, np.int64), np.zeros(n, np.int64)
        self.speed = np.full(n, np.nan)
        self._agents: NDArray[np.bool_] = np.zeros((n, 0), np.bool_)
        self._matter = np.zeros(n, np.bool_)

    def begin(self, mask: NDArray[np.bool_]) -> None:
        self.human[mask], self.obstacle[mask], self.speed[mask] = 0, 0, np.nan
        self._agents[mask], self._matter[mask] = False, False

    def advance(self, touches: Touches) -> None:
        if self._agents.shape != touches.agents.shape:
            self._agents = np.zeros_like(touches.agents)
        self.human += (touches.agents & ~self._agents).sum(axis=1)
        self.obstacle += touches.matter & ~self._matter
        speeds = np.column_stack([
            np.where(touches.agents, touches.agent_speeds, np.nan),
            np.where(touches.matter, touches.matter_speeds, np.nan),
        ])  # fmt: skip
        self.speed = np.fmax(self.speed, np.fmax.reduce(speeds, axis=1))
        self._agents, self._matter = touches.agents, touches.matter

    def of(self, w: int) -> Contacts:
        return Contacts(int(self.human[w]), int(self.obstacle[w]), float(self.speed[w]))


class _Recorder:
    """The paths of the episodes that are being played."""

    def __init__(self, worlds: SuiteWorlds, max_steps: int) -> None:
        self.worlds = worlds
        self.paths = np.zeros((worlds.n, max_steps + 1, 4))  # x, y, gap to humans, gap to obstacles
        self.steps = np.zeros(worlds.n, np.int64)
        self.shortest = np.zeros(worlds.n)
        self.contacts = _ContactCounter(worlds.n)
        self._all = np.arange(worlds.n)

    def begin(self, mask: NDArray[np.bool_]) -> None:
        self.steps[mask] = 0
        self.shortest[mask] = self.worlds.shortest()[mask]
        self.contacts.begin(mask)
        self._write(mask)

    def advance(self, active: NDArray[np.bool_]) -> None:
        self.steps[active] += 1
        if (self.steps >= self.paths.shape[1]).any():
            raise SimulationError(f"An episode is longer than {self.paths.shape[1] - 1} steps: a bug of its suite.")
        self.contacts.advance(self.worlds.touches())
        self._write(active)

    def _write(self, mask: NDArray[np.bool_]) -> None:
        rows = self._all[mask]
        now = self.paths[rows, self.steps[rows]]
        now[:, :2] = self.worlds.poses()[mask, :2]
        to_human, to_static = self.worlds.gaps()
        now[:, 2], now[:, 3] = to_human[mask], to_static[mask]
        self.paths[rows, self.steps[rows]] = now

    def finish(self, w: int, episode: int, event: Event) -> Episode:
        steps = int(self.steps[w])
        path = self.paths[w, : steps + 1]
        metrics = measure(
            path[:, :2], path[:, 2], path[:, 3], self.worlds.sensor.dt, event == Event.GOAL, float(self.shortest[w])
        )
        return Episode(episode, event, steps, metrics, thin(path[:, :2]), self.contacts.of(w))


def thin(positions: NDArray[np.float64]) -> NDArray[np.int32]:
    """Return at most 60 positions [cm], evenly spaced in time, first and last among them."""
    count = min(len(positions), TRAJECTORY_POINTS)
    chosen = np.linspace(0, len(positions) - 1, count).round().astype(np.int64)
    return np.rint(100.0 * positions[chosen]).astype(np.int32)


def n_worlds(policy: BasePolicy, batch: int | None, episodes: int) -> int:
    """Return how many worlds to play in: groups need their rows, networks have a most."""
    if policy.grouped:
        return BLOCK
    wanted = min(DEFAULT_BATCH if batch is None else batch, max(1, episodes))
    return wanted if policy.max_rows is None else min(wanted, policy.max_rows)


def units(episodes: list[int], grouped: bool) -> list[list[int]]:
    """Return what :data:`Take` hands out: episodes one by one, or in groups of 64 numbers."""
    if not grouped:
        return [[k] for k in episodes]
    groups: dict[int, list[int]] = {}
    for k in episodes:
        groups.setdefault(k // BLOCK, []).append(k)
    return list(groups.values())


def play(suite: Suite, worlds: SuiteWorlds, driver: Driver, take: Take) -> Iterator[list[Episode]]:
    """Play episodes until there are none left, and yield those that a step has finished.

    Parameters
    ----------
    suite : Suite
        Whose numbers are played.
    worlds : Worlds
        To play in.
    driver : Driver
        Who drives.
    take : callable
        Where episodes come from.

    Yields
    ------
    list of Episode
        In the order in which they end; empty lists in between.
    """
    driver.start(worlds.simulator)
    recorder = _Recorder(worlds, suite.max_steps)
    playing = np.full(worlds.n, -1, np.int64)
    more = True
    while True:
        if more:
            more = _refill(suite, worlds, driver, recorder, playing, take)
        active = playing >= 0
        if not active.any():
            return
        events = worlds.step(driver.commands(worlds.simulator, active))
        recorder.advance(active)
        ended = np.flatnonzero(active & (events != 0))
        yield [recorder.finish(int(w), int(playing[w]), Event(int(events[w]))) for w in ended]
        playing[ended] = -1


def _refill(
    suite: Suite, worlds: SuiteWorlds, driver: Driver, recorder: _Recorder, playing: NDArray[Any], take: Take
) -> bool:
    """Start the next episodes in free worlds; returns False once there are none left."""
    free, grouped = np.flatnonzero(playing < 0), driver.policy.grouped
    if len(free) == 0 or (grouped and len(free) < worlds.n):
        return True
    mask = np.zeros(worlds.n, np.bool_)
    more = True
    for w in free:
        unit = take()
        if unit is None:
            more = False
            break
        # an episode of a group has a row of its own
        rows = [k % BLOCK for k in unit] if grouped else [int(w)]
        playing[rows] = unit
        mask[rows] = True
        if grouped:
            driver.start(worlds.simulator)
            break
    if mask.any():
        seeds = np.where(mask, suite.first_seed + playing, 0)
        scenarios = np.where(mask, playing % len(suite.scenarios), 0)
        worlds.reset(mask, seeds, scenarios)
        recorder.begin(mask)
        driver.reset(mask, playing)
    return more
