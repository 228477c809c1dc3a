"""A policy at the wheel: the one way from the state of a simulator to what its robots are sent."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from navrep_data.errors import PolicyError
from navrep_data.policies.protocol import NEEDS, OF_EVERY_ROBOT, BasePolicy, Context, Observation
from navrep_data.schema import ACTION_SIZE
from navrep_data.sim import Simulator, robot_contract, scale_actions, velocity_commands

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]


class Driver:
    """Drives the robots of a simulator's worlds by a policy.

    A row is a robot: world by world, and where a world has several robots R, robot by robot.

    Parameters
    ----------
    policy : BasePolicy
        Who drives.

    Raises
    ------
    PolicyError
        If the policy needs what there is not.
    """

    def __init__(self, policy: BasePolicy) -> None:
        self.policy = policy
        self._name = policy.name or type(policy).__name__
        unknown = sorted(policy.needs - NEEDS)
        if unknown:
            raise PolicyError(f"Policy {self._name!r} needs {unknown[0]!r}, expected: {', '.join(sorted(NEEDS))}.")

    def start(self, simulator: Simulator) -> None:
        """Tell the policy where it drives; its memory begins anew.

        Raises
        ------
        PolicyError
            If it needs what only the first robot of a world is given, and there are several.
        """
        config = simulator.config
        beyond = sorted(self.policy.needs - OF_EVERY_ROBOT)
        if config.robots > 1 and beyond:
            raise PolicyError(
                f"Policy {self._name!r} needs {beyond[0]}, which worlds with one robot offer, but here are "
                f"{config.robots}; take another policy, or robots=1."
            )
        self.policy.start(Context(robot_contract(config), config.sensor, simulator.grids()))

    def reset(self, mask: NDArray[np.bool_], seeds: NDArray[np.int64]) -> None:
        """Tell the policy that episodes begin in the rows of `mask` (B,), with these seeds (B,)."""
        self.policy.reset(mask, seeds)

    def commands(
        self,
        simulator: Simulator,
        mask: NDArray[np.bool_] | None = None,
        seen: tuple[F32, F32] | None = None,
    ) -> F64:
        """Ask the policy, and tell it what its robots are sent.

        Parameters
        ----------
        simulator : Simulator
            The worlds.
        mask : ndarray of shape (B,), bool, optional
            All other robots are sent zeros.
        seen : tuple of ndarray, optional
            Scans (B, n_rays) and robot states (B, 5) of the present state, where they are known already.

        Returns
        -------
        ndarray of shape (W, 3), with R > 1 robots (W, R, 3)
            Body velocities [m/s, m/s, rad/s], within the robots' limits.

        Raises
        ------
        PolicyError
            If what the policy returned are no actions.
        """
        config = simulator.config
        rows = simulator.n_worlds * config.robots
        shares = np.asarray(self.policy.act(observe(simulator, self.policy.needs, seen)), np.float64)
        if shares.shape != (rows, ACTION_SIZE):
            raise PolicyError(
                f"Policy {self._name!r} returned shape {shares.shape}, expected ({rows}, 3): vx, vy, omega in [-1, 1]."
            )
        if not np.isfinite(shares).all():
            raise PolicyError(f"Policy {self._name!r} returned NaN or infinity, expected numbers in [-1, 1].")
        if mask is not None:
            shares = np.where(mask[:, None], shares, 0.0)
        steered = self.policy.steers and config.drive == "differential"
        executed = velocity_commands(config, shares[:, :2]) if steered else scale_actions(config, shares)
        self.policy.observe(executed)
        return executed if config.robots == 1 else executed.reshape(simulator.n_worlds, config.robots, ACTION_SIZE)


def observe(simulator: Simulator, needs: frozenset[str], seen: tuple[F32, F32] | None = None) -> Observation:
    """Return what a policy that `needs` this is given of the present state, a row per robot."""
    n = simulator.n_worlds * simulator.config.robots
    if seen is None:
        seen = simulator.observe() if "scan" in needs else (np.zeros((n, 0), np.float32), simulator.robot_states())
    scan, states = seen[0].reshape(n, -1), seen[1].reshape(n, -1)
    poses = simulator.poses().reshape(n, 3)

    def ahead(points: F64) -> F64:
        return to_robot_frame(points - poses[:, :2], poses[:, 2])

    found: dict[str, Any] = dict.fromkeys(NEEDS, np.zeros((n, 0)))
    found["map_index"] = np.zeros((n, 0), np.int64)
    found["humans"] = np.zeros((n, 0, 4))
    found["scan"] = scan[:, :0]
    made: dict[str, Callable[[], NDArray[Any]]] = {
        "scan": lambda: scan,
        "pose": lambda: poses,
        "radius": lambda: simulator.radii().reshape(n, 1),
        "waypoint": lambda: ahead(simulator.waypoints()),
        "map_index": lambda: simulator.map_indices()[:, None],
        "humans": lambda: _humans(simulator, poses),
        "orca_velocity": lambda: to_robot_frame(simulator.orca_velocities(), poses[:, 2]),
    }
    return Observation(states, **found | {name: made[name]() for name in needs})


def _humans(simulator: Simulator, poses: F64) -> F64:
    """Return where the humans are and how they move, seen from the robots: (B, H, 4)."""
    motions, headings = simulator.human_motions(), poses[:, 2:]
    places = to_robot_frame(motions[..., :2] - poses[:, None, :2], headings)
    return np.concatenate([places, to_robot_frame(motions[..., 2:], headings)], axis=-1)


def to_robot_frame(vectors: F64, theta: F64) -> F64:
    """Return vectors (..., 2) of the world frame in the frames of robots with headings `theta` (...) [rad]."""
    c, s = np.cos(theta), np.sin(theta)
    return np.stack([c * vectors[..., 0] + s * vectors[..., 1], c * vectors[..., 1] - s * vectors[..., 0]], axis=-1)
