"""Policies that tests name as module:function."""

import os
import time
from pathlib import Path

import numpy as np


def sideways(scan, robot_state):
    """Goal direction turned by how much room there is, so that rows differ."""
    goal = robot_state[:, :2] / np.maximum(np.linalg.norm(robot_state[:, :2], axis=1, keepdims=True), 1e-6)
    turn = np.clip(1.0 / scan[:, ::36].min(axis=1), 0.0, 1.2)
    c, s = np.cos(turn), np.sin(turn)
    return np.stack([c * goal[:, 0] - s * goal[:, 1], s * goal[:, 0] + c * goal[:, 1]], axis=1)


def patient(scan, robot_state):
    """Straight to the goal; takes its time, or waits for its turn, where a test wants to interrupt it."""
    time.sleep(float(os.environ.get("PATIENCE", "0")))
    if "TURNSTILE" in os.environ:
        _wait_for_a_turn(Path(os.environ["TURNSTILE"]))
    return robot_state[:, :2] / np.maximum(np.abs(robot_state[:, :2]).max(axis=1, keepdims=True), 1e-6)


def _wait_for_a_turn(folder):
    """Let as many calls pass, of all processes together, as a test has written into a file; all of them without it."""
    calls = os.open(folder / "calls", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.write(calls, b".")
    number = os.lseek(calls, 0, os.SEEK_CUR)  # where this byte was put: the system writes one process's after another's
    os.close(calls)
    while _allowed(folder) < number:
        time.sleep(0.01)


def _allowed(folder):
    try:
        return int((folder / "allowed").read_text())
    except FileNotFoundError:
        return float("inf")


class Counting:
    """Has a memory: drives for as many steps as it has counted since its reset, then stands every other step."""

    def reset(self, batch_size=None, mask=None):
        if batch_size is not None:
            self.count = np.zeros(batch_size)
        else:
            self.count[mask] = 0

    def __call__(self, scan, robot_state):
        self.count += 1
        go = (self.count % 3 != 0)[:, None]
        return go * np.clip(robot_state[:, :2], -1, 1)


def wrong_shape(scan, robot_state):
    return np.zeros((3, 2))


def not_a_number(scan, robot_state):
    return np.full((len(scan), 2), np.nan)
