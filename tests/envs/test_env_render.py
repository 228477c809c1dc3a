"""Pictures, films, windows."""

import sys
import types

import matplotlib
import numpy as np
import pytest
from PIL import Image, ImageColor, ImageDraw

matplotlib.use("Agg")
from env_cases import make, same
from matplotlib.figure import Figure

from navrep_data.envs import NavRepEnv, record, window
from navrep_data.errors import ConfigError, DisplayError, MissingExtraError, PolicyError
from navrep_data.sim import Simulator, drawing, make_config, raster


def colour(name):
    return np.array(ImageColor.getrgb(name), np.uint8)


def at(frame, camera, x, y):
    """Return the pixel that shows the point (x, y) [m]."""
    size = frame.shape[0]
    column = (x - camera.x + camera.half) * size / (2 * camera.half)
    row = (camera.half - y + camera.y) * size / (2 * camera.half)
    return frame[int(row), int(column)]


def test_everything_is_drawn_where_it_is():
    env = NavRepEnv("navrep-test", episode=0)
    env.reset()
    for _ in range(8):
        assert env.step([-0.7, -0.7, 0.0])[4]["event"] == "none"
    frame, state = env.frame(800), env._worlds.sim.state()
    assert frame.shape == (800, 800, 3)
    assert frame.dtype == np.uint8
    camera = env._camera
    x, y, theta, goal_x, goal_y, radius = state.robot[:6]
    assert same(at(frame, camera, x, y), colour(drawing.ROBOT))
    assert same(
        at(frame, camera, x + 1.7 * radius * np.cos(theta), y + 1.7 * radius * np.sin(theta)), colour("#d1495b")
    )
    assert same(at(frame, camera, goal_x, goal_y), colour(drawing.GOAL))
    for polygon in state.polygons[:-1]:
        assert same(at(frame, camera, *polygon.mean(axis=0)), colour(drawing.OBSTACLE))
    assert len(state.humans) > 0
    for human in state.humans:
        near = [at(frame, camera, human[0] + dx, human[1] + dy) for dx in (-0.2, 0, 0.2) for dy in (-0.2, 0, 0.2)]
        assert any(same(pixel, colour(raster.BODY)) for pixel in near)
    for leg in state.circles:
        assert at(frame, camera, *leg[:2]).sum() < colour(raster.BODY).sum()
    # the trail
    middle = 0.5 * (env._trail[0][0] + state.robot[:2])
    assert np.abs(at(frame, camera, *middle).astype(int) - colour(drawing.ROBOT)).max() < 90
    # what the lidar sees is pale, what it does not is white
    shades = {tuple(pixel) for row in frame[::7] for pixel in row[::7]}
    assert tuple(colour(raster.SEEN)) in shades
    assert tuple(colour(raster.BACKGROUND)) in shades
    # rays end in orange
    points = drawing.scan_points(env.seen["scan"], state.robot[:3])[::90]
    hits = [np.abs(at(frame, camera, *p).astype(int) - colour(drawing.RAY)).max() < 60 for p in points]
    assert np.mean(hits) > 0.5


def test_the_camera_shows_all_and_stays_for_an_episode():
    env = NavRepEnv("soadrl", render_mode="rgb_array")
    env.reset(seed=1)
    env.render()
    camera = env._camera
    env.step([1.0, 0.0, 0.0])
    env.render()
    assert env._camera is camera
    corners = np.concatenate(env._worlds.sim.state().polygons)
    assert (np.abs(corners - [camera.x, camera.y]) <= camera.half).all()
    env.reset()
    assert env._camera is None


@pytest.mark.parametrize(("side", "whole"), [(12.0, True), (40.0, False)])
def test_small_maps_are_shown_whole_and_large_ones_in_part(tmp_path, side, whole):
    Image.new("L", (60, 60), 254).save(tmp_path / "m.png")
    (tmp_path / "m.yaml").write_text(
        f"image: m.png\nresolution: {side / 60}\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\n"
        "free_thresh: 0.196\n"
    )
    env = NavRepEnv("map", maps=(str(tmp_path),), humans=2)
    places = [env.reset(seed=k)[1]["robot"][:2] for k in range(20)]
    assert np.ptp(places, axis=0).min() > 0.4 * side
    env.frame(32)
    camera, state = env._camera, env._worlds.sim.state()
    assert ((camera.x, camera.y) == (side / 2, side / 2)) == whole
    assert (camera.half >= side / 2) == whole
    everybody = np.concatenate([state.robot[None, :2], state.robot[None, 3:5], state.humans[:, :2]])
    assert (np.abs(everybody - [camera.x, camera.y]) <= camera.half).all()


@pytest.mark.slow
@pytest.mark.parametrize(("width", "height"), [(12.0, 12.0), (30.0, 20.0), (60.0, 10.0), (45.0, 45.0)])
def test_walls_at_the_border_of_own_maps_are_whole_or_out_of_sight_and_the_robot_is_in_sight(tmp_path, width, height):
    """The pictures of whole episodes, wherever the robot drives: where a picture ends there is no wall."""
    cells, rng = 10, np.random.default_rng(1)
    image = Image.new("L", (round(width * cells), round(height * cells)), 254)
    ImageDraw.Draw(image).rectangle((0, 0, image.width - 1, image.height - 1), outline=0, width=4)
    image.save(tmp_path / "m.png")
    (tmp_path / "m.yaml").write_text(
        f"image: m.png\nresolution: {1 / cells}\norigin: [-3, 2, 0]\nnegate: 0\noccupied_thresh: 0.65\n"
        "free_thresh: 0.196\n"
    )
    env = NavRepEnv("map", maps=(str(tmp_path),), humans=2)
    in_part = False
    for seed in range(6):
        env.reset(seed=seed)
        left, right, bottom, top = env._worlds.sim.grid().extent
        for _ in range(4):
            frame, camera = env.frame(400), env._camera
            x, y = env._worlds.sim.state().robot[:2]
            assert same(at(frame, camera, x, y), colour(drawing.ROBOT))
            low, high = np.array([camera.x, camera.y]) - camera.half, np.array([camera.x, camera.y]) + camera.half
            # each wall of 0.4 m with a margin beyond it, or some metres without a wall
            gaps = np.array([left - low[0], bottom - low[1], high[0] - right, high[1] - top])
            assert ((gaps >= 0.5 - 1e-6) | (gaps <= -2.0 + 1e-6)).all(), (seed, camera)
            in_part |= bool((gaps < 0).any())
            if low[0] < left:
                column = round((left + 0.2 - low[0]) * 400 / (2 * camera.half) - 0.5)
                row = round((high[1] - min(top - 1.0, max(bottom + 1.0, camera.y))) * 400 / (2 * camera.half) - 0.5)
                wall = frame[row, max(column - 2, 0) : column + 3].astype(int).sum(axis=1)
                assert wall.min() < 500, "the wall, or ends of rays on it, is drawn"
                assert frame[row, 0].astype(int).sum() > 700, "and ends before the picture does"
            place = [rng.uniform(left + 1, right - 1), rng.uniform(bottom + 1, top - 1)]
            env._worlds.sim.arrays.agents[0, 0, :2] = place  # as if it had driven there
            env._trail = []
    assert in_part == (width > 26.0)


def test_map_cells_are_painted_where_they_are():
    canvas = raster.Canvas(raster.Camera(0.0, 0.0, 4.0), 160)
    occupied = np.zeros((4, 3), bool)
    occupied[0, 0] = occupied[3, 2] = True
    canvas.cells(occupied, (-2.0, -1.0), 1.0, "#000000")
    frame = canvas.array()
    camera = raster.Camera(0.0, 0.0, 4.0)
    assert at(frame, camera, -1.5, -0.5).sum() == 0
    assert at(frame, camera, 1.5, 1.5).sum() == 0
    assert (frame.sum(axis=2) == 0).mean() == pytest.approx(2 / 64, abs=0.002)


def test_thin_walls_survive_shrinking():
    canvas = raster.Canvas(raster.Camera(0.0, 0.0, 5.0), 50)
    occupied = np.zeros((1000, 1000), bool)
    occupied[500] = True  # 1 cm wide
    canvas.cells(occupied, (-5.0, -5.0), 0.01, "#000000")
    assert canvas.array()[:, 25].max() < 252


@pytest.mark.parametrize("size", [3, 5000, 100.5, True])
def test_wrong_sizes_are_refused(size):
    env = NavRepEnv("navrep-test")
    env.reset()
    with pytest.raises(ConfigError, match="expected a whole number from 16 to 4096"):
        env.frame(size)


def test_a_partial_scan_is_a_fan():
    config = make_config("navrep-test", humans=0, obstacles=0)
    sim = Simulator(config)
    state = sim.state()
    sensor = type(config.sensor)(n_rays=90, angle_increment=0.01)
    frame = raster.draw_frame(state, raster.Camera.around(state), np.full(90, 3.0), sensor, size=400)
    camera = raster.Camera.around(state)
    x, y, theta = state.robot[:3]
    inside = at(frame, camera, x + 1.5 * np.cos(theta + 0.452), y + 1.5 * np.sin(theta + 0.452))
    outside = at(frame, camera, x + 1.5 * np.cos(theta - 0.3), y + 1.5 * np.sin(theta - 0.3))
    assert not same(inside, outside)
    assert same(outside, colour(raster.BACKGROUND))


class Still:
    """A policy as the zoo's are."""

    batch = None

    def reset(self, batch_size):
        self.batch = batch_size

    def act(self, scan, robot_state):
        assert scan.shape == (self.batch, 1080)
        assert robot_state.shape == (self.batch, 5)
        return np.zeros((self.batch, 3))


@pytest.mark.slow
def test_gif(tmp_path):
    env = make("navrep-test")
    film = record(env, "goal", tmp_path / "deep" / "episode.gif", options={"episode": 12}, size=120)
    assert (film.path, film.event) == (tmp_path / "deep" / "episode.gif", "goal")
    assert film.total_reward > 99
    with Image.open(film.path) as image:
        assert image.n_frames == film.steps + 1
        assert image.size == (120, 120)
        assert image.info["duration"] == 200
        first = np.array(image.convert("RGB"))
        image.seek(film.steps)
        last = np.array(image.convert("RGB"))
    assert (first != last).any(axis=2).mean() > 0.01
    env.reset(options={"episode": 12})
    drawn = env.unwrapped.frame(120).astype(int)
    assert np.abs(drawn - first).mean() < 8  # 64 colours
    assert [p.name for p in film.path.parent.iterdir()] == ["episode.gif"]


def test_objects_with_act_and_cut_films(tmp_path):
    film = record(make("navrep-test"), Still(), tmp_path / "e.gif", seed=1000, max_steps=3, size=64, speed=2.0)
    assert (film.event, film.steps) == ("none", 3)
    with Image.open(film.path) as image:
        assert (image.n_frames, image.info["duration"]) == (4, 100)


def test_mp4_without_the_program_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match="pip install imageio-ffmpeg"):
        record(make("navrep-test"), "goal", tmp_path / "e.mp4")
    assert not list(tmp_path.iterdir())


def test_mp4_hands_all_frames_to_the_program(tmp_path, monkeypatch):
    got = []

    def write_frames(path, size, fps, macro_block_size):
        got.append((size, fps))
        frame = yield
        with open(path, "wb") as file:
            while True:
                got.append(frame.shape)
                file.write(frame.tobytes())
                try:
                    frame = yield
                except GeneratorExit:
                    return

    fake = types.SimpleNamespace(write_frames=write_frames)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", fake)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: fake)
    film = record(make("navrep-test"), "goal", tmp_path / "e.mp4", seed=1, max_steps=2, size=64)
    assert got == [((64, 64), 5.0)] + [(64, 64, 3)] * 3
    assert film.path.stat().st_size == 3 * 64 * 64 * 3


def test_films_of_something_else_are_refused(tmp_path):
    import gymnasium

    with pytest.raises(ConfigError, match=r"The film is called 'e.avi', expected a name that ends in .gif or .mp4"):
        record(make("navrep-test"), "goal", tmp_path / "e.avi")
    with pytest.raises(ConfigError, match="cannot be filmed: expected an environment of navrep-data"):
        record(gymnasium.make("CartPole-v1"), "goal", tmp_path / "e.gif")
    with pytest.raises(PolicyError, match="policy is 3, expected a name, a function"):
        record(make("navrep-test"), 3, tmp_path / "e.gif")


def test_human_mode_without_a_display_says_what_to_do():
    with pytest.raises(DisplayError, match="No window can be opened here") as caught:
        make("navrep-test", render_mode="human")
    assert "rgb_array" in str(caught.value)
    assert NavRepEnv("navrep-test").metadata["render_modes"] == ["rgb_array"]
    assert NavRepEnv.metadata["render_modes"] == ["human", "rgb_array"]


@pytest.fixture
def display(monkeypatch):
    """Stand in for a window: matplotlib's canvas in memory."""
    shown = []
    monkeypatch.setattr(window, "has_display", lambda: True)
    monkeypatch.setattr(Figure, "show", lambda figure: shown.append(figure))
    return shown


@pytest.mark.slow
def test_human_mode_follows_each_step(display):
    env = make("navrep-test", render_mode="human")
    env.reset(seed=1000)
    env.step(np.zeros(3))
    world = env.unwrapped
    first = np.array(world._window._image.get_array())
    assert same(first, world.frame())
    env.step(np.ones(3))
    assert not same(np.array(world._window._image.get_array()), first)
    assert env.render() is None
    figure = world._window.figure
    assert display == [figure]
    env.close()
    env.close()
    assert not matplotlib.pyplot.fignum_exists(figure.number)


def test_may_have_display_asks_the_surroundings(monkeypatch):
    monkeypatch.delitem(sys.modules, "matplotlib.pyplot", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.delenv("DISPLAY", raising=False)
    assert not window.may_have_display()
    monkeypatch.setenv("DISPLAY", ":0")
    assert window.may_have_display()
