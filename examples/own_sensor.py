"""Simulate a lidar of your own, and feed its scans to what expects 1080 rays all round.

python examples/own_sensor.py --rays 240 --degrees 270 --noise 0.02 --dropout 0.01 --out sensor.png

A scanner with few rays, a limited field of view, noise and lost rays drives through a world; ScanAdapter brings its
scans to the 1080 rays of the models and datasets of this package.
"""

import argparse
import math

import gymnasium
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from navrep_data.observations import Lidar, ScanAdapter, scan_to_rings
from navrep_data.policies import to_goal
from navrep_data.schema import SensorContract
from navrep_data.sim.drawing import draw_rings


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rays", type=int, default=240)
    parser.add_argument("--degrees", type=float, default=270.0, help="field of view, centred straight ahead")
    parser.add_argument("--range", type=float, default=10.0, help="largest range [m]")
    parser.add_argument("--noise", type=float, default=0.02, help="standard deviation of ranges [m]")
    parser.add_argument("--dropout", type=float, default=0.01, help="share of rays that read 0")
    parser.add_argument("--steps", type=int, default=15)
    parser.add_argument("--out", default="sensor.png")
    arguments = parser.parse_args()

    view = math.radians(arguments.degrees)
    sensor = SensorContract(
        n_rays=arguments.rays,
        angle_min=-view / 2,
        angle_increment=view / (arguments.rays - 1),
        range_max=arguments.range,
    )
    env = gymnasium.make(
        "navrep_data:NavRepTest-v0", sensor=sensor, scan_noise=arguments.noise, scan_dropout=arguments.dropout
    )
    adapter = ScanAdapter(Lidar.of(sensor))
    observation, _ = env.reset(seed=1003)
    for _ in range(arguments.steps):
        observation, _, terminated, truncated, _ = env.step(to_goal(observation["robot_state"]))
        if terminated or truncated:
            observation, _ = env.reset()
    full = adapter(observation["scan"])
    print(f"{env.observation_space['scan'].shape} -> {full.shape}")

    figure, axes = plt.subplot_mosaic("WR", figsize=(10, 5), layout="constrained")
    axes["W"].imshow(env.unwrapped.frame(600))
    axes["W"].set_axis_off()
    axes["W"].set_title(f"{arguments.rays} rays over {arguments.degrees:g} degrees")
    draw_rings(axes["R"], scan_to_rings(full))
    axes["R"].set_title("rings of the adapted scan")
    figure.savefig(arguments.out, dpi=90)
    print(arguments.out)


if __name__ == "__main__":
    main()
