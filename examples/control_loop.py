"""Drive a robot with a released policy: two scanners in, velocity out, no ROS.

python examples/control_loop.py --policy e2e_1d.released --source ../shared/released

The robot carries two scanners of 270 degrees at opposite corners, as the one in the paper does. Here it is simulated,
in a room with pillars; on a real robot, write the four methods of `Robot` over its drivers and keep the loop. Released
policies fail now and then (about 6 of 10 test episodes end at the goal), so keep the robot's own safety stop as well.
"""

import argparse
import time

import numpy as np

from navrep_data import zoo
from navrep_data.observations import Lidar, ScanAdapter
from navrep_data.schema import SensorContract
from navrep_data.sim.lidar import scan_polygons

PERIOD = 0.2  # the policies were trained at 5 Hz
RADIUS = 0.3
SPEED = 0.8  # of this robot, at most [m/s]
RAYS, INCREMENT = 811, np.radians(270) / 810


class Robot:
    """A holonomic robot in a simulated room. Replace this by yours."""

    scanners = (
        Lidar(RAYS, -np.radians(135), INCREMENT, 0.05, 30.0, x=0.25, y=0.2, yaw=np.radians(45)),
        Lidar(RAYS, -np.radians(135), INCREMENT, 0.05, 30.0, x=-0.25, y=-0.2, yaw=np.radians(-135)),
    )

    def __init__(self) -> None:
        self.walls = np.array([(-7.5, -4.0), (7.5, -4.0), (7.5, 4.0), (-7.5, 4.0)])
        self.pillars = np.array([(0.0, 0.6, 0.5), (-2.5, -1.5, 0.4), (2.0, 2.5, 0.4)])  # x, y, radius
        self.pose = np.array([-5.0, -0.5, 0.3])
        self.velocity = np.zeros(3)
        self.goal = np.array([5.0, 1.0])

    def scans(self):
        """Return the ranges of both scanners [m], in the order of `scanners`."""
        return [self._scan(scanner) for scanner in self.scanners]

    def robot_state(self):
        """Return goal x, y [m], velocity x, y [m/s] and turn rate [rad/s] along the robot's axes."""
        dx, dy = self.goal - self.pose[:2]
        c, s = np.cos(self.pose[2]), np.sin(self.pose[2])
        return np.array([c * dx + s * dy, c * dy - s * dx, *self.velocity])

    def drive(self, velocity):
        """Command vx, vy [m/s] and turn rate [rad/s] along the robot's axes; return what it will really do."""
        length = np.hypot(*velocity[:2])
        self.velocity = np.array([*velocity[:2] * min(1.0, SPEED / max(length, 1e-9)), velocity[2]])
        return self.velocity

    def wait(self):
        """Let the time of one step pass."""
        c, s = np.cos(self.pose[2]), np.sin(self.pose[2])
        vx, vy, omega = self.velocity
        self.pose = self.pose + PERIOD * np.array([c * vx - s * vy, s * vx + c * vy, omega])

    def _scan(self, scanner):
        c, s = np.cos(self.pose[2]), np.sin(self.pose[2])
        place = [
            self.pose[0] + c * scanner.x - s * scanner.y,
            self.pose[1] + s * scanner.x + c * scanner.y,
            self.pose[2] + scanner.yaw,
        ]
        contract = SensorContract(scanner.n_rays, scanner.angle_min, scanner.angle_increment, scanner.range_max, PERIOD)
        return scan_polygons([self.walls], self.pillars, place, contract)

    def clearance(self):
        """Return the least distance to walls and pillars [m]."""
        x, y = self.pose[:2]
        pillars = np.hypot(self.pillars[:, 0] - x, self.pillars[:, 1] - y) - self.pillars[:, 2]
        return min(pillars.min(), 7.5 - abs(x), 4.0 - abs(y)) - RADIUS


def control(robot, policy, max_steps=300, sleep=False):
    """Run the loop until the goal, a collision or the last step; returns which, and the number of steps."""
    adapter = ScanAdapter(robot.scanners, policy.sensor)
    policy = policy.for_robot(max_speed=SPEED, radius=RADIUS)  # trained on a faster and wider one
    policy.reset(batch_size=1)
    for step in range(max_steps):
        start = time.perf_counter()
        scan = adapter(*robot.scans())
        action = policy.act(scan[None], robot.robot_state()[None])[0]
        executed = robot.drive(SPEED * action)
        policy.observe(executed[None])  # not what was asked for: this robot's diagonal is no faster
        robot.wait()
        if np.hypot(*(robot.goal - robot.pose[:2])) < RADIUS:
            return "goal", step + 1
        if robot.clearance() < 0:
            return "collision", step + 1
        if sleep:
            time.sleep(max(0.0, PERIOD - (time.perf_counter() - start)))
    return "timeout", max_steps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policy", default="e2e_1d.released", help="name in the zoo")
    parser.add_argument("--source", help="folder of the released files (default: cache, then network)")
    parser.add_argument("--real-time", action="store_true", help="5 steps per second")
    args = parser.parse_args()
    policy = zoo.load(args.policy, source=args.source)
    robot = Robot()
    start = time.perf_counter()
    outcome, steps = control(robot, policy, sleep=args.real_time)
    took = (time.perf_counter() - start) / steps
    print(f"{policy.name}: {outcome} after {steps} steps ({steps * PERIOD:.1f} s), at {robot.pose.round(2)}")
    print(f"{1e3 * took:.1f} ms per step, simulated scanners included")


if __name__ == "__main__":
    main()
