"""Orientations and frames of recordings: headings from quaternions, places from one frame to another by ``/tf``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

TF_TOPICS = {"/tf": False, "/tf_static": True}
"""Topics of transforms, and whether these hold for all times."""
TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
SAME_PLACE, SAME_YAW = 0.01, 0.01
"""Mountings that differ by no more [m, rad] are the same."""
LONGEST_CHAIN = 100
"""Frames between a frame and its root; more is a loop."""


def unit_quaternion(x: float, y: float, z: float, w: float) -> tuple[float, float, float, float] | None:
    """Return a quaternion of length 1; None where it is no orientation (all zeros, not finite)."""
    largest = max(abs(x), abs(y), abs(z), abs(w))
    if not 0.0 < largest < math.inf:  # also true of NaN in the first place of max
        return None
    x, y, z, w = x / largest, y / largest, z / largest, w / largest
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if not math.isfinite(norm):
        return None
    return x / norm, y / norm, z / norm, w / norm


def yaw_of(q: Any) -> float | None:
    """Return the heading [rad] of a ``geometry_msgs/Quaternion`` of any length; None where it is no orientation."""
    unit = unit_quaternion(q.x, q.y, q.z, q.w)
    if unit is None:
        return None
    x, y, z, w = unit
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


def mounting(matrix: Floats, mount: Sequence[float]) -> str:
    """Return what the matrix (4, 4) from scanner to robot says against x, y [m] and yaw [rad]; empty if nothing."""
    x, y, yaw = float(matrix[0, 3]), float(matrix[1, 3]), math.atan2(matrix[1, 0], matrix[0, 0])
    turned = abs(math.remainder(yaw - mount[2], 2.0 * math.pi))
    hangs = matrix[2, 2] < 0.0
    if math.dist((x, y), mount[:2]) <= SAME_PLACE and turned <= SAME_YAW and not hangs:
        return ""
    place = f"{x:.3g},{y:.3g},{yaw:.3g}"
    given = ",".join(f"{value:.3g}" for value in mount)
    upside = " and upside down, which --mount cannot say," if hangs else ","
    return f"{place}{upside} and it is taken to be at {given}: give --mount {place}"


class _Edge(NamedTuple):
    """A frame in its parent: at all times, or at some."""

    parent: str
    static: bool
    rows: list[tuple[int, tuple[float, ...]]]  # time [ns]; x, y, z [m], quaternion x, y, z, w


class Frames:
    """The frames of a recording: how each lies in its parent as time goes on."""

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}
        self._sorted: dict[str, tuple[Ints, Floats]] = {}

    def __len__(self) -> int:
        return len(self._edges)

    def add(self, transform: Any, time: int, static: bool) -> None:
        """Add a ``geometry_msgs/TransformStamped`` that holds at a time [ns]."""
        parent, child = str(transform.header.frame_id).strip("/"), str(transform.child_frame_id).strip("/")
        v, q = transform.transform.translation, transform.transform.rotation
        unit = unit_quaternion(q.x, q.y, q.z, q.w)
        place = (float(v.x), float(v.y), float(v.z))
        if unit is None or not all(map(math.isfinite, place)) or parent == child:
            return
        edge = self._edges.get(child)
        if edge is None or edge.parent != parent or edge.static != static:
            edge = self._edges[child] = _Edge(parent, static, [])
        if static:
            edge.rows.clear()
        edge.rows.append((time, (*place, *unit)))
        self._sorted.pop(child, None)

    def transform(self, source: str, target: str, time: int) -> Floats | None:
        """Return the matrix (4, 4) that takes places in `source` to `target` at a time [ns]; None if none joins them.

        Notes
        -----
        Between two transforms it is interpolated; before the first and after the last, the nearest holds.
        """
        up, down = self._to_root(source.strip("/"), time), self._to_root(target.strip("/"), time)
        for frame, from_source in up.items():
            if frame in down:
                found: Floats = np.linalg.inv(down[frame]) @ from_source
                return found
        return None

    def _to_root(self, frame: str, time: int) -> dict[str, Floats]:
        """Return the frames from this one up to its root, and the matrix from it to each."""
        matrix = np.eye(4)
        found = {frame: matrix}
        while frame in self._edges and len(found) < LONGEST_CHAIN:
            matrix = self._at(frame, time) @ matrix
            frame = self._edges[frame].parent
            if frame in found:
                break
            found[frame] = matrix
        return found

    def _at(self, child: str, time: int) -> Floats:
        if child not in self._sorted:
            rows = sorted(self._edges[child].rows, key=lambda row: row[0])
            self._sorted[child] = np.array([row[0] for row in rows], np.int64), np.array([row[1] for row in rows])
        times, values = self._sorted[child]
        after = int(np.searchsorted(times, time))
        if after == 0 or after == len(times):
            return _matrix(values[min(after, len(times) - 1)])
        share = (time - times[after - 1]) / max(int(times[after] - times[after - 1]), 1)
        a, b = values[after - 1], values[after].copy()
        if float(a[3:] @ b[3:]) < 0.0:  # the same orientation, told by the opposite quaternion
            b[3:] = -b[3:]
        return _matrix((1.0 - share) * a + share * b)


def _matrix(row: Floats) -> Floats:
    x, y, z, w = row[3:] / np.linalg.norm(row[3:])
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = row[:3]
    return matrix
