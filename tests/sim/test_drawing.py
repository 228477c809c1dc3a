"""Drawings put things where they are."""

import matplotlib
import numpy as np
import pytest

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.patches import Circle, Polygon

from navrep_data.observations import scan_to_rings
from navrep_data.sim import Simulator, make_config
from navrep_data.sim.drawing import draw_rings, draw_scan, draw_world, scan_points


@pytest.fixture
def axes():
    figure, axes = plt.subplots()
    yield axes
    plt.close(figure)


def test_scan_points_lie_where_rays_end():
    points = scan_points(np.full(1080, 2.0), (1.0, -1.0, np.pi / 2))
    np.testing.assert_allclose(points[0], [1.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(np.hypot(*(points - [1.0, -1.0]).T), 2.0)


def test_world_shows_robot_people_and_obstacles(axes):
    sim = Simulator(make_config("soadrl", humans=4, obstacles=3), seed=2)
    scan = sim.observe()[0][0]
    state = sim.state()
    people = np.column_stack([state.humans[:, :4], state.humans[:, 7], np.ones(len(state.humans))])
    people = np.vstack([people, np.full((1, 6), np.nan)])
    draw_world(
        axes, state.polygons, state.robot[:3], radius=state.robot[5], goal=state.robot[3:5], humans=people, scan=scan,
        trail=[[0.0, -9.0], [0.0, -8.0]],
    )  # fmt: skip
    circles = [p for p in axes.patches if isinstance(p, Circle)]
    assert len(circles) == len(state.humans) + 1
    np.testing.assert_allclose(circles[-1].center, state.robot[:2])
    assert circles[-1].radius == state.robot[5]
    polygons = [p for p in axes.patches if isinstance(p, Polygon)]
    assert len(polygons) == len(state.polygons) + 1  # and the seen area
    filled = [p.get_facecolor()[3] > 0 for p in polygons[1:]]
    assert filled == [True] * (len(state.polygons) - 1) + [False]


def test_scan_and_rings_have_their_axes(axes):
    scan = np.linspace(1.0, 5.0, 1080, dtype=np.float32)
    draw_scan(axes, scan)
    x, y = axes.lines[0].get_data()
    assert (x[0], y[0], y[-1]) == (0.0, 1.0, 5.0)
    assert x[-1] == pytest.approx(359.556, abs=1e-3)
    axes.clear()
    draw_rings(axes, scan_to_rings(scan))
    image = axes.images[0].get_array()
    np.testing.assert_array_equal(np.asarray(image), scan_to_rings(scan).T)
