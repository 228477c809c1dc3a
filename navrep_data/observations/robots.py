"""What a policy sees of another robot than that of its training: everything in the proportions that it knows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from navrep_data.schema import RANGE_MAX, RobotContract


@dataclass(frozen=True)
class RobotScale:
    """Makes a robot of another speed and size look like the one that a policy was trained on.

    A robot of half the speed gets half as far in a step, so to a policy the world has to look twice as large. Its own
    body has to keep the size that the policy knows, or it would keep too little distance.

    Attributes
    ----------
    trained, robot : RobotContract
        What the policy was trained on, and what it drives.
    range_max : float
        Range that stands for "nothing hit" and that no range exceeds [m].

    Notes
    -----
    With s = trained.max_speed / robot.max_speed a range r becomes (r - robot.radius) s + trained.radius, cut at
    `range_max`; within the robot's own body r trained.radius / robot.radius, so that 0, a lost ray, stays 0. A ray that
    hit nothing stays one. Goal and velocity are multiplied by s. Turn rates stay: time is not scaled.
    """

    trained: RobotContract
    robot: RobotContract
    range_max: float = RANGE_MAX

    @property
    def factor(self) -> float:
        """The factor s of goal and velocity."""
        return self.trained.max_speed / self.robot.max_speed

    def ranges(self, scan: NDArray[Any]) -> NDArray[np.float32]:
        """Return ranges as the policy's own robot would have them.

        Parameters
        ----------
        scan : ndarray of shape (..., n_rays) [m]
            Ranges of the robot, `range_max` or more where a ray hits nothing.
        """
        scan = np.asarray(scan, np.float32)
        edge, mine = np.float32(self.robot.radius), np.float32(self.trained.radius)
        outside = (scan - edge) * np.float32(self.factor) + mine
        scaled = np.where(scan < edge, scan * (mine / edge), outside)
        far = np.float32(self.range_max)
        return np.where(scan >= far, far, np.minimum(scaled, far))
