"""Which clock a recording goes by: the stamps in its messages' headers, or the time at which each was recorded.

Stamps say when something was measured. The time of recording says when it arrived: late and in bursts over a wireless
network, and at another speed than the robot's where a simulation or a bag was played.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]

SECOND = 1_000_000_000
MAX_ODD = 0.05
"""Share of stamps that may be missing, repeated or go back."""
SAME_CLOCK = SECOND // 2
"""Largest difference of two topics' least delays [ns]; more, and they were stamped by two clocks."""
PLAUSIBLE = 10 * SECOND
"""Stamps of single messages (goals) that are further off than this [ns] are of another clock."""


@dataclass(frozen=True)
class Clock:
    """The chosen clock.

    Attributes
    ----------
    why_not : str
        Why stamps cannot be used; empty where they are.
    recorded, stamped : ndarray of shape (N,), int64
        Both times of all odometry messages [ns], to turn one into the other.
    """

    why_not: str
    recorded: Ints
    stamped: Ints

    @property
    def stamps(self) -> bool:
        """Whether headers' stamps are used."""
        return not self.why_not

    def times(self, recorded: Ints, stamped: Ints) -> Ints:
        """Return the times of messages that all come from one stamping device [ns]."""
        return stamped if self.stamps else recorded

    def time(self, recorded: int, stamped: int) -> int:
        """Return the time of a message that may have been stamped by anything [ns]: by a person's computer, or not."""
        if not self.stamps:
            return recorded
        expected = int(np.interp(recorded - self.recorded[0], self.recorded - self.recorded[0], self._since()))
        expected += int(self.stamped[0])
        return stamped if stamped > 0 and abs(stamped - expected) <= PLAUSIBLE else expected

    def _since(self) -> Ints:
        since: Ints = self.stamped - self.stamped[0]
        return since


def choose_clock(scans: tuple[Ints, Ints], odometry: tuple[Ints, Ints]) -> Clock:
    """Choose stamps if those of scans and odometry can be used.

    Parameters
    ----------
    scans, odometry : tuple of two ndarrays of shape (N,), int64
        When messages were recorded, and their stamps [ns], in the order of recording.
    """
    why = _unusable("scans", scans[1]) or _unusable("odometry", odometry[1])
    if not why:
        delays = [float(np.percentile(recorded - stamped, 1)) for recorded, stamped in (scans, odometry)]
        apart = abs(delays[0] - delays[1])
        if apart > SAME_CLOCK:
            why = f"those of scans and odometry are of two clocks, {apart / SECOND:.3g} s apart"
    order = np.argsort(odometry[0], kind="stable")
    return Clock(why, odometry[0][order], np.maximum.accumulate(odometry[1][order]))


def _unusable(what: str, stamped: Ints) -> str:
    missing = float((stamped <= 0).mean())
    if missing > MAX_ODD:
        return f"those of {what} are 0" if missing == 1.0 else f"{missing:.0%} of those of {what} are 0"
    back = float((np.diff(stamped) <= 0).mean()) if len(stamped) > 1 else 0.0
    return f"{back:.0%} of those of {what} repeat or go back" if back > MAX_ODD else ""
