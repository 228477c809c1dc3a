"""What shipped networks do about a sector that nobody saw: none drives into it, though its goal lies there."""

import math

import numpy as np
import pytest

from navrep_data import zoo


@pytest.mark.slow
@pytest.mark.parametrize("name", ["e2e_1d.v1", "joint_1d_z.v1", "transformer_rings_z.v1", "joint_rings_z.v1"])
def test_networks_do_not_drive_where_nobody_looked(name):
    rng = np.random.default_rng(0)
    scan = np.repeat(rng.uniform(3, 20, (32, 12)), 90, axis=1).astype(np.float32)
    behind = np.cos(np.arange(1080) * 2 * math.pi / 1080) < -math.cos(math.pi / 4)
    state = np.zeros((32, 5), np.float32)
    state[:, 0] = -5.0
    policy = zoo.load(name)
    speed = {}
    for what, value in (("free", 25.0), ("blind", 0.0)):
        scan[:, behind] = value
        policy.reset(batch_size=32)
        for _ in range(5):
            action = policy.act(scan, state)
        speed[what] = float(action[:, 0].mean())
    assert speed["free"] < -0.5, "called free, it drives there"
    assert speed["blind"] > 0.0
