"""Static collisions on maps: exact distances of moving discs to cells."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from navrep_data.sim import _ian_contact, _ian_step
from navrep_data.sim import _ian_layout as il
from navrep_data.sim import _layout as lay
from navrep_data.sim._judge import COLLISION_HUMAN


def tables(solid: np.ndarray, resolution: float, x0: float, y0: float) -> tuple[il.MapTables, np.ndarray]:
    """Return the tables of one map, as far as contacts need them."""
    row = np.zeros(il.MAP_FIELDS)
    row[il.T_WIDTH], row[il.T_HEIGHT] = solid.shape
    row[il.T_X0], row[il.T_Y0], row[il.T_RESOLUTION] = x0, y0, resolution
    distance = ndimage.distance_transform_edt(~solid) if solid.any() else np.full(solid.shape, np.inf)
    empty = np.zeros(1)
    maps = il.MapTables(
        table=row[None], solid=solid.astype(np.uint8).ravel(),
        distance=(distance * resolution).astype(np.float32).ravel(),
        squares=np.zeros(1, np.uint8), pace=np.zeros(1, np.float32), fields=np.zeros(1, np.float32),
        field_start=np.zeros(1, np.int64), field_goal=np.zeros((1, 2)), scenarios=np.zeros((0, 3), np.int64),
        cast=np.zeros((0, il.CAST_FIELDS)), spots=np.zeros((0, 2)), pool=empty.astype(np.int64),
    )  # fmt: skip
    return maps, row


def oracle(solid: np.ndarray, resolution: float, x0: float, y0: float, a: np.ndarray, b: np.ndarray) -> float:
    """Sample the way densely and measure to every solid cell and the edge."""
    points = a + np.linspace(0.0, 1.0, 400)[:, None] * (b - a)
    high = np.array([x0, y0]) + np.array(solid.shape) * resolution
    best = max(min((points - [x0, y0]).min(), (high - points).min()), 0.0)
    for i, j in np.argwhere(solid):
        low = np.array([x0 + i * resolution, y0 + j * resolution])
        gap = np.maximum(np.maximum(low - points, points - low - resolution), 0.0)
        best = min(best, float(np.hypot(gap[:, 0], gap[:, 1]).min()))
    return best


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.02, 0.15])
def test_swept_distance_equals_dense_sampling(share: float) -> None:
    rng = np.random.default_rng(3)
    for trial in range(12):
        solid = rng.random((24, 17)) < share
        resolution, x0, y0 = float(rng.uniform(0.05, 0.3)), -1.0, 2.0
        maps, row = tables(solid, resolution, x0, y0)
        size = np.array(solid.shape) * resolution
        for _ in range(25):
            low = np.array([x0, y0])
            a = low + rng.random(2) * size
            b = np.clip(a + rng.normal(0.0, 0.15, 2) * (trial % 3), low, low + size - 1e-9)
            wanted = oracle(solid, resolution, x0, y0, a, b)
            for reach in (0.2, 0.5, 50.0):
                seen = _ian_contact.swept_cells(maps, row, *a, *b, reach)
                if wanted < reach:
                    # sampling can only miss the nearest point, by less than its spacing
                    assert wanted - np.hypot(*(b - a)) / 399 - 1e-12 <= seen <= wanted + 1e-9
                else:
                    assert reach - 1e-9 <= seen <= wanted + 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("original", [0.0, 1.0])
def test_a_wall_touched_together_with_somebody_is_noted_where_the_robot_got_to(original):
    """The other puts the robot back, so that the wall does no damage; it was touched all the same."""
    solid = np.zeros((30, 20), bool)
    solid[20:] = True
    maps, row = tables(solid, 0.1, 0.0, 0.0)
    agents, walkers = np.zeros((2, lay.AGENT_FIELDS)), np.zeros((2, il.WALKER_FIELDS))
    agents[0, [lay.A_X, lay.A_Y, lay.A_VX, lay.A_RADIUS]] = 1.85, 1.0, 0.5, 0.3
    agents[1, [lay.A_X, lay.A_Y, lay.A_RADIUS]] = 1.2, 1.5, 0.3
    walkers[0, [il.W_LAST_X, il.W_LAST_Y]] = 1.5, 1.0
    walkers[1, [il.W_LAST_X, il.W_LAST_Y]] = 1.2, 1.5
    circles = np.zeros((4, 4))
    circles[:2, :3], circles[2:, :3] = (1.85, 1.0, 0.3), (1.85, 1.35, 0.1)
    rules = np.zeros(il.RULE_FIELDS)
    rules[[il.R_ROBOTS, il.R_BOUNCE, il.R_ORIGINAL]] = 1.0, 1.0, original
    _ian_step._collide(agents, walkers, np.zeros((2, 2), np.int8), circles, 2, maps, row, rules)
    assert agents[:, lay.A_TOUCHED].tolist() == [1.0, 1.0]
    assert agents[:, lay.A_TOUCH_SPEED].tolist() == [0.5, 0.5]
    assert walkers[0, [il.W_HIT, il.W_DAMAGE, il.W_DAMAGE_STATIC]].tolist() == [COLLISION_HUMAN, 0.5, 0.0]
    assert agents[0, [lay.A_X, lay.A_Y]].tolist() == [1.5, 1.0]
