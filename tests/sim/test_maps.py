from __future__ import annotations

import io
import os
import pickle
import sys
from pathlib import Path

import numpy as np
import pytest
from numba import config
from PIL import Image

from navrep_data.errors import ArrayError, ConfigError, MapError, MissingExtraError, NavrepDataError, UnknownNameError
from navrep_data.sim import _maps, gridmap
from navrep_data.sim.map_tables import map_for_physics
from navrep_data.sim.maps import GridMap, goal_field, load_map, map_names, planning_map

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from oracles_maps import distances, reached

PURE_PYTHON = bool(config.DISABLE_JIT)
GOOD = {
    "image": "map.pgm",
    "resolution": 0.5,
    "origin": "[-1.0, 2.0, 0.0]",
    "negate": 0,
    "occupied_thresh": 0.65,
    "free_thresh": 0.196,
}

# SIM_FACTS e.8: columns, rows, resolution [m], origin [m], free_thresh, % solid, % free
TABLE = {
    "asl": (128, 128, 0.16, (-12.8, -12.8), 0.15, 6.3, 93.7),
    "asl_office_j": (2736, 1280, 0.02, (-32.16, -11.52), 0.15, 0.9, 32.6),
    "cla_glass_hall": (2688, 2176, 0.02, (-43.92, -33.68), 0.196, 0.2, 99.8),
    "crowdmove1": (128, 128, 0.16, (-12.8, -12.8), 0.15, 0.0, 100.0),
    "crowdmove2": (512, 512, 0.04, (-12.8, -12.8), 0.15, 0.4, 98.8),
    "crowdmove3": (128, 128, 0.16, (-10.24, -10.24), 0.15, 2.9, 25.4),
    "crowdmove4": (128, 128, 0.16, (-10.24, -10.24), 0.15, 3.8, 96.2),
    "crowdmove5": (128, 128, 0.16, (-10.24, -10.24), 0.15, 4.1, 37.6),
    "crowdmove6": (128, 128, 0.2, (-12.8, -12.8), 0.15, 3.9, 69.3),
    "empty": (1024, 1024, 0.01, (-5.48, -5.48), 0.15, 0.4, 87.9),
    "hg_main_hall": (3008, 2752, 0.02, (-31.76, -10.0), 0.196, 0.2, 99.8),
    "markclutter": (368, 368, 0.046, (-8.5, -8.5), 0.15, 5.9, 93.0),
    "markcomplex": (1000, 1000, 0.017, (-12.0, -6.0), 0.15, 17.7, 79.0),
    "markmaze": (368, 368, 0.046, (-8.5, -8.5), 0.15, 14.2, 85.3),
    "marksimple": (1000, 1000, 0.017, (-8.5, -8.5), 0.15, 18.5, 81.3),
    "marktm1": (1000, 1000, 0.017, (-8.5, -8.5), 0.15, 1.2, 97.7),
    "marktm2": (1000, 1000, 0.017, (-8.5, -8.5), 0.15, 1.4, 97.6),
    "marktm3": (1000, 1000, 0.017, (-8.5, -6.5), 0.15, 1.5, 97.3),
    "marktrain": (1000, 1000, 0.017, (-3.5, -8.5), 0.15, 19.8, 80.2),
    "openlab_office_j": (1600, 3488, 0.02, (-22.16, -59.92), 0.196, 0.3, 99.7),
    "original_ckk": (2176, 1536, 0.02, (-10.0, -10.0), 0.196, 0.5, 99.5),
    "scrubbed_ckk": (2752, 1536, 0.02, (-10.0, -10.0), 0.196, 0.3, 99.7),
    "unity_scene_map": (1580, 995, 0.026, (-23.0, -12.0), 0.196, 2.0, 98.0),
}
# SIM_FACTS e.1: cells that a disc of 0.5 m reaches from (0, 0) on the map coarsened three times
REACHABLE = {
    "marktrain": 9729,
    "marksimple": 9201,
    "markcomplex": 5920,
    "marktm1": 12283,
    "marktm2": 11712,
    "marktm3": 10849,
    "markclutter": 1221,
    "markmaze": 1092,
}


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("NAVREP_DATA_HOME", str(tmp_path / "home"))
    return tmp_path / "home" / "maps"


def pgm(rows):
    rows = np.asarray(rows, np.uint8)
    return b"P5\n%d %d\n255\n" % (rows.shape[1], rows.shape[0]) + rows.tobytes()


def write_map(folder, pixels=None, name="map.yaml", raw=None, **changes):
    """Write a map folder; a change to None removes the key. Returns the YAML's path."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = np.full((4, 6), 254, np.uint8)
    rows[0, 1] = 0  # top row
    rows[3, 5] = 205
    (folder / "map.pgm").write_bytes(pgm(rows) if pixels is None else pixels)
    keys = {key: value for key, value in (GOOD | changes).items() if value is not None}
    text = "".join(f"{key}: {value}\n" for key, value in keys.items()) if raw is None else raw
    (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return folder / name


# --- the paper's maps ---------------------------------------------------------------------------------------------


def test_all_of_the_papers_maps_are_there(maps):
    assert maps == sorted(TABLE)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(TABLE))
def test_the_papers_maps_are_read_as_the_original_reads_them(name, maps):
    columns, rows, resolution, origin, free_threshold, solid, free = TABLE[name]
    grid = load_map(name)
    assert grid.shape == (columns, rows)
    assert grid.resolution == resolution
    assert grid.origin == origin
    assert (grid.free_threshold, grid.occupied_threshold) == (free_threshold, 0.65)
    assert 100 * grid.occupied.mean() == pytest.approx(solid, abs=0.0501)
    assert 100 * grid.free.mean() == pytest.approx(free, abs=0.0501)
    assert load_map(name) is grid
    left, right, low, high = grid.extent
    assert (right - left, high - low) == pytest.approx((columns * resolution, rows * resolution))


@pytest.mark.parametrize("name", sorted(REACHABLE))
def test_reachable_cells_are_those_of_the_original(name, maps):
    coarse = load_map(name).coarsened(3)
    assert coarse.resolution == pytest.approx(8 * TABLE[name][2])
    assert coarse.origin == TABLE[name][3]
    assert int(coarse.reachable((0.0, 0.0), 0.5).sum()) == REACHABLE[name]


def test_unknown_ground_collides_or_not_by_the_threshold(maps):
    asl, unity = load_map("asl_office_j"), load_map("unity_scene_map")
    grey = np.isclose(asl.occupancy, 1 - 205 / 254, atol=1e-6)
    assert grey.mean() > 0.5
    assert (asl.signed_distance()[grey] < 0).all()
    assert (asl.signed_distance(free_threshold=0.196)[grey & ~asl.occupied] > 0).all()
    grey = np.isclose(unity.occupancy, 1 - 205 / 254, atol=1e-6)
    assert grey.mean() > 0.1
    assert (unity.signed_distance()[grey] > 0).all()


def test_planning_maps_are_as_coarse_as_the_originals(maps):
    found = {name: planning_map(load_map(name)).resolution for name in ("asl", "asl_office_j", "unity_scene_map")}
    assert found == {"asl": 0.32, "asl_office_j": 0.16, "unity_scene_map": pytest.approx(0.104)}
    assert 0.1 <= planning_map(load_map("marksimple")).resolution < 0.2


def test_without_the_extra_the_message_has_the_command(monkeypatch, tmp_path):
    monkeypatch.setattr(_maps, "EXTRA_PACKAGE", "no_such_package_here")
    for call in (map_names, lambda: load_map("asl")):
        with pytest.raises(MissingExtraError, match=r'pip install "navrep-data\[maps\]"'):
            call()
    # maps of one's own need no extra, not even by a bare word
    write_map(tmp_path / "mine")
    monkeypatch.chdir(tmp_path)
    assert load_map("mine").shape == (6, 4)


def test_unknown_names_say_what_was_meant(maps):
    with pytest.raises(UnknownNameError, match="Did you mean 'asl_office_j'"):
        load_map("asl_ofice_j")
    with pytest.raises(NavrepDataError, match="Unknown map ''"):
        load_map("")


def test_the_optional_packages_modules_are_not_imported(maps):
    load_map("asl")
    assert not {"pepper_2d_simulator", "pepper_2d_iarlenv", "gymified_pepper_envs"}.intersection(sys.modules)


# --- maps of one's own --------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_cells_places_and_occupancies(tmp_path):
    grid = load_map(write_map(tmp_path))
    assert (grid.name, grid.source, grid.shape) == ("map", "map.yaml", (6, 4))
    # the image's top row is the highest row of cells
    assert np.argwhere(grid.occupied).tolist() == [[1, 3]]
    assert np.argwhere(~grid.free).tolist() == [[1, 3], [5, 0]]
    assert grid.extent == (-1.0, 2.0, 2.0, 4.0)
    assert grid.cell_of([[-0.9, 2.1], [1.99, 3.99], [-50, 50], [-0.5, 2.5]]).tolist() == [
        [0, 0],
        [5, 3],
        [0, 3],
        [1, 1],
    ]
    assert grid.contains([[-0.9, 2.1], [2.0, 3.0], [-1.0, 2.0], [-1.1, 3.0]]).tolist() == [True, False, True, False]
    cells = np.argwhere(np.ones(grid.shape))
    np.testing.assert_array_equal(grid.cell_of(grid.centre_of(cells)), cells)
    assert grid.occupancy.dtype == np.float32
    for array in (grid.occupancy, grid.occupied, grid.free, grid.distance, grid.signed_distance(), grid.free_squares):
        assert not array.flags.writeable


def test_both_occupancy_rules(tmp_path):
    path = write_map(tmp_path, pixels=pgm([[0, 100, 205, 254, 255]]))
    ros, original = load_map(path), load_map(path, occupancy="original")
    np.testing.assert_allclose(ros.occupancy[:, 0], [1, 155 / 255, 50 / 255, 1 / 255, 0], rtol=1e-6)
    np.testing.assert_allclose(original.occupancy[:, 0], [1, 154 / 254, 49 / 254, 0, -1 / 254], rtol=1e-5, atol=1e-7)
    # the two part at unknown ground
    assert not ros.free[2, 0]
    assert original.free[2, 0]
    turned = load_map(write_map(tmp_path / "negated", pixels=pgm([[0, 205, 255]]), negate=1))
    np.testing.assert_allclose(turned.occupancy[:, 0], [0, 205 / 255, 1], rtol=1e-6)
    with pytest.raises(ConfigError, match="negate: 1"):
        load_map(tmp_path / "negated", occupancy="original")
    with pytest.raises(ConfigError, match="'original' or 'ros'"):
        load_map(path, occupancy="grey")  # type: ignore[arg-type]


def test_png_folders_and_new_content(tmp_path):
    buffer = io.BytesIO()
    Image.fromarray(np.array([[0, 254], [254, 254]], np.uint8)).save(buffer, "PNG")
    path = write_map(tmp_path, pixels=buffer.getvalue())
    grid = load_map(tmp_path)
    assert np.argwhere(grid.occupied).tolist() == [[0, 1]]
    assert load_map(path) is grid
    colour = io.BytesIO()
    Image.fromarray(np.array([[[0, 0, 0], [254, 254, 254], [254, 254, 254]]], np.uint8)).save(colour, "PNG")
    (tmp_path / "map.pgm").write_bytes(colour.getvalue())
    assert load_map(path).shape == (3, 1)


HOSTILE_YAML = {
    "missing keys": ({"resolution": None, "origin": None}, "lacks resolution, origin"),
    "zero resolution": ({"resolution": 0.0}, "resolution is 0"),
    "negative resolution": ({"resolution": -0.1}, r"resolution is -0\.1"),
    "infinite resolution": ({"resolution": ".inf"}, "resolution is 'inf', expected a number"),
    "NaN origin": ({"origin": "[.nan, 0, 0]"}, "origin is 'nan'"),
    "short origin": ({"origin": "[1]"}, r"expected \[x, y, 0\]"),
    "rotated": ({"origin": "[0, 0, 0.5]"}, "turns the map by 0.5 rad"),
    "text": ({"occupied_thresh": "much"}, "occupied_thresh is 'much'"),
    "truth": ({"free_thresh": "true"}, "free_thresh is 'True'"),
    "thresholds crossed": ({"free_thresh": 0.7}, "expected 0 <= free_thresh < occupied_thresh"),
    "thresholds large": ({"occupied_thresh": 65}, "expected 0 <= free_thresh < occupied_thresh"),
    "negate": ({"negate": 3}, "negate is '3'"),
    "raw mode": ({"mode": "raw"}, "mode is 'raw'"),
    "absolute image": ({"image": "/etc/passwd"}, "is absolute or leaves the folder"),
    "image above": ({"image": "../map.pgm"}, "is absolute or leaves the folder"),
    "image in between": ({"image": "x/../../map.pgm"}, "is absolute or leaves the folder"),
    "windows path": ({"image": r"C:\map.pgm"}, "is absolute or leaves the folder"),
    "windows above": ({"image": r"..\map.pgm"}, "is absolute or leaves the folder"),
    "no such image": ({"image": "other.pgm"}, "'other.pgm' does not exist in"),
    "image list": ({"image": "[a, b]"}, "expected a file name"),
    "image folder": ({"image": "."}, "does not exist"),
    "zero byte": ({"image": '"a\\0b"'}, "expected a file name"),
    "code": ({"image": "!!python/object/apply:os.system [echo]"}, "not valid YAML"),
    "not a mapping": ({"raw": "- 1\n- 2\n"}, "holds list"),
    "empty": ({"raw": ""}, "holds NoneType"),
    "binary": ({"raw": b"\x00\xff\xfe\x80"}, "not valid YAML"),
    "unclosed": ({"raw": "image: [1, 2"}, "not valid YAML"),
    "deep": ({"raw": "[" * 1500}, "not valid YAML"),
    "huge": ({"raw": "a: 1\n" * 20000}, "expected at most 65,536"),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", sorted(HOSTILE_YAML))
def test_hostile_yaml_is_refused(case, tmp_path):
    changes, words = HOSTILE_YAML[case]
    path = write_map(tmp_path / "m", **changes)
    with pytest.raises(MapError, match=words) as caught:
        load_map(path)
    assert "\n" not in str(caught.value)


def png_claiming(width, height):
    """A small PNG whose header claims another size."""
    import struct
    import zlib

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0" * 64)) + chunk(b"IEND", b"")
    )


def saved(array, kind="PNG"):
    buffer = io.BytesIO()
    Image.fromarray(array).save(buffer, kind)
    return buffer.getvalue()


HOSTILE_IMAGES = {
    "empty": (b"", "cannot be read as an image"),
    "text": (b"hello", "cannot be read as an image"),
    "cut short": (pgm(np.full((50, 50), 254))[:200], "cannot be read as an image"),
    "huge header": (b"P5\n100000 100000\n255\n", "expected, at most 67,108,864"),
    "png bomb": (png_claiming(10000, 10000), "10000 x 10000 pixels, expected at most 67,108,864"),
    "png cut": (png_claiming(3000, 3000), "cannot be read as an image"),
    "16 bit": (saved(np.full((3, 3), 60000, np.uint16)), "mode I;16"),
    "another format": (saved(np.full((3, 3), 254, np.uint8), "BMP"), "cannot be read as an image"),
    "no free cell": (pgm(np.zeros((3, 3))), "no free cell"),
    "only unknown": (pgm(np.full((3, 3), 205)), "no free cell"),
}


@pytest.mark.parametrize("case", sorted(HOSTILE_IMAGES))
def test_hostile_images_are_refused(case, tmp_path):
    image, words = HOSTILE_IMAGES[case]
    with pytest.raises(MapError, match=words):
        load_map(write_map(tmp_path, pixels=image))


def test_files_may_be_links_into_a_store(tmp_path):
    """As those of tools that keep large files elsewhere, under other names."""
    (tmp_path / "store").mkdir()
    expected = load_map(write_map(tmp_path / "m"))
    for k, name in enumerate(("map.yaml", "map.pgm")):
        (tmp_path / "m" / name).rename(tmp_path / "store" / str(k))
        (tmp_path / "m" / name).symlink_to(tmp_path / "store" / str(k))
    for path in (tmp_path / "m", tmp_path / "m" / "map.yaml"):
        found = load_map(path)
        assert (found.hash, found.name) == (expected.hash, "map")
    # one description, two images
    write_map(tmp_path / "n", pixels=pgm([[0, 254]]))
    (tmp_path / "n" / "map.yaml").unlink()
    (tmp_path / "n" / "map.yaml").symlink_to(tmp_path / "store" / "0")
    assert load_map(tmp_path / "n").shape == (2, 1)
    (tmp_path / "store" / "1").unlink()
    with pytest.raises(MapError, match=r"'map\.pgm' does not exist in .*m: put it there"):
        load_map(tmp_path / "m")


@pytest.mark.parametrize("yaw", ["1e-12", "-0.0", "6.283185307179586", "-6.2831853", "12.566370614"])
def test_an_origin_turned_by_nothing_or_whole_turns_is_not_turned(yaw, tmp_path):
    assert load_map(write_map(tmp_path, origin=f"[-1.0, 2.0, {yaw}]")).origin == (-1.0, 2.0)


@pytest.mark.parametrize("mode", [None, "scale"])
@pytest.mark.parametrize(
    "colour",
    [
        (255, 255, 0),
        (0, 255, 0),
        (150, 150, 255),
        (205, 205, 205),
        (254, 254, 254, 0),
        (254, 254, 254, 255),
        (0, 0, 0, 255),
    ],
)
def test_colours_count_by_the_mean_of_their_channels(colour, mode, tmp_path):
    """As in map_server, whose trinary mode counts alpha as a channel, too."""
    pixels = np.full((2, 2, len(colour)), 255, np.uint8)
    pixels[0, 0] = colour
    grid = load_map(write_map(tmp_path, pixels=saved(pixels), mode=mode))
    counted = colour if mode is None else colour[:3]
    assert grid.occupancy[0, 1] == pytest.approx((255.0 - sum(counted) / len(counted)) / 255.0, abs=1e-6)


def test_palettes_and_grey_with_alpha_count_as_colours(tmp_path):
    grey = np.full((2, 2, 2), 255, np.uint8)
    grey[0, 0] = 205, 55
    image = Image.new("P", (2, 2), 1)
    image.putpalette([255, 255, 0, 255, 255, 255])
    image.putpixel((0, 0), 0)
    palette = io.BytesIO()
    image.save(palette, "PNG")
    for k, (pixels, mean) in enumerate(((saved(grey), (3 * 205 + 55) / 4), (palette.getvalue(), 170.0))):
        grid = load_map(write_map(tmp_path / str(k), pixels=pixels))
        assert grid.occupancy[0, 1] == pytest.approx((255.0 - mean) / 255.0, abs=1e-6)


@pytest.mark.parametrize("origin", ["[456000, 5428000, 0]", "[0, -16385, 0]", "[16383.0, 0, 0]"])
def test_maps_far_from_the_origin_are_refused_in_float32(origin, tmp_path):
    grid = load_map(write_map(tmp_path, origin=origin))
    assert map_for_physics(grid, "consistent").origin == (0.0, 0.0)
    with pytest.raises(MapError, match=r"expected within 16384 m of 0.*: set the map's origin near 0"):
        map_for_physics(grid, "original")


def test_missing_files_and_ambiguous_folders(tmp_path):
    with pytest.raises(MapError, match="does not exist: expected a map_server YAML file"):
        load_map(tmp_path / "nothing.yaml")
    (tmp_path / "empty").mkdir()
    with pytest.raises(MapError, match="found none"):
        load_map(tmp_path / "empty")
    write_map(tmp_path / "two", name="a.yaml")
    write_map(tmp_path / "two", name="b.yaml")
    with pytest.raises(MapError, match=r"found a\.yaml, b\.yaml"):
        load_map(tmp_path / "two")


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: GridMap("x", np.zeros(3), 1.0, (0, 0)), ArrayError, r"shape \(3,\)"),
        (lambda: GridMap("x", np.full((2, 2), np.nan), 1.0, (0, 0)), ArrayError, "finite"),
        (lambda: GridMap("x", np.zeros((2, 2)), 0.0, (0, 0)), ConfigError, "resolution is 0.0"),
        (lambda: GridMap("x", np.zeros((2, 2)), 1.0, (0, np.inf)), ConfigError, "origin"),
        (
            lambda: GridMap("x", np.zeros((2, 2)), 1.0, (0, 0)).coarsened(2),
            ConfigError,
            "2 x 2 cells of map 'x' 2 times",
        ),
        (lambda: GridMap("x", np.zeros((2, 2)), 1.0, (0, 0)).cell_of([1.0]), ArrayError, "expected"),
        (lambda: GridMap("x", np.zeros((2, 2)), 1.0, (0, 0)).contours(-1.0), ConfigError, "tolerance is -1"),
        (lambda: GridMap("x", np.zeros((2, 2)), 1.0, (0, 0)).ground(-1.0), ConfigError, "radius is -1"),
        (lambda: GridMap("x", np.zeros((2, 2)), 1.0, (0, 0)).reachable((5, 5), 0.1), MapError, r"not on map 'x'"),
        (lambda: GridMap("x", np.eye(2), 1.0, (0, 0)).reachable((0.5, 0.5), 0.1), MapError, "expected at least 0.1"),
        (lambda: goal_field(GridMap("x", np.zeros((2, 2)), 1.0, (0, 0)), (-1, 0)), MapError, "not on map 'x'"),
    ],
)
def test_unusable_input_is_refused(make, error, words):
    with pytest.raises(error, match=words):
        make()


# --- what follows from a map --------------------------------------------------------------------------------------


def random_map(seed, shape=(23, 17), share=0.08, resolution=0.3):
    rng = np.random.default_rng(seed)
    occupancy = rng.choice([0.0, 0.193, 1.0], shape, p=[0.9 - share, 0.1, share]).astype(np.float32)
    return GridMap("random", occupancy, resolution, (-2.0, 1.0), free_threshold=0.15)


@pytest.mark.parametrize("seed", range(3))
def test_signed_distance_matches_every_solid_cell_tried(seed):
    grid = random_map(seed)
    expected = distances(grid.occupied) * 0.3
    np.testing.assert_allclose(grid.distance, expected, rtol=1e-6)
    np.testing.assert_array_equal(grid.signed_distance() < 0, (grid.occupancy > 0.15) & ~grid.occupied)
    np.testing.assert_allclose(np.abs(grid.signed_distance()), expected, rtol=1e-6)
    assert (grid.signed_distance(free_threshold=0.65) >= 0).all()


def test_a_map_without_walls_is_infinitely_far_from_them():
    assert (GridMap("open", np.zeros((3, 4)), 1.0, (0.0, 0.0)).signed_distance() == np.inf).all()


@pytest.mark.parametrize("seed", range(4))
def test_reachable_matches_a_king_who_cuts_no_corners(seed):
    grid = random_map(seed, share=0.2)
    closed = grid.signed_distance() < 0.35
    start = tuple(np.argwhere(~closed)[0])
    found = grid.reachable(grid.centre_of(start), 0.35)
    np.testing.assert_array_equal(found, reached(closed, start))
    assert found.sum() > 1


def test_coarsening_takes_the_highest_of_four_and_drops_odd_ends():
    grid = random_map(1)
    coarse = grid.coarsened()
    assert (coarse.shape, coarse.resolution, coarse.origin) == ((11, 8), 0.6, (-2.0, 1.0))
    for i in range(11):
        for j in range(8):
            assert coarse.occupancy[i, j] == grid.occupancy[2 * i : 2 * i + 2, 2 * j : 2 * j + 2].max()
    assert grid.coarsened(2) is grid.coarsened(2)
    np.testing.assert_array_equal(grid.coarsened(2).occupancy, coarse.coarsened().occupancy)
    assert grid.coarsened(0) is grid


def test_ground_is_what_discs_cover():
    grid = random_map(3, (30, 25), 0.02)
    radius = 0.95
    barred = np.pad(grid.occupancy > grid.free_threshold, 1, constant_values=True)
    centres = distances(barred)[1:-1, 1:-1] * 0.3 >= radius
    expected = distances(centres) * 0.3 < radius
    np.testing.assert_array_equal(grid.ground(radius), expected)
    assert 0 < expected.sum() < grid.free.sum()
    np.testing.assert_array_equal(grid.ground(0.0), grid.occupancy <= grid.free_threshold)


def test_the_hash_is_of_the_content():
    a, b = random_map(1), random_map(1)
    assert a.hash == b.hash
    assert len({a.hash, random_map(2).hash, random_map(1, resolution=0.4).hash, a.coarsened().hash}) == 4


# --- the cache on disk --------------------------------------------------------------------------------------------


@pytest.fixture
def small_maps_on_disk(monkeypatch):
    monkeypatch.setattr(gridmap, "DISK_CACHE_CELLS", 0)


def test_distances_and_ground_are_kept_on_disk(own_cache, small_maps_on_disk, monkeypatch):
    first = random_map(1)
    distance, ground = first.distance, first.ground(0.5)
    assert len(list(own_cache.iterdir())) == 2

    def no_more(*_):
        raise AssertionError("worked out again")

    monkeypatch.setattr("scipy.ndimage.distance_transform_edt", no_more)
    np.testing.assert_array_equal(random_map(1).distance, distance)
    np.testing.assert_array_equal(random_map(1).ground(0.5), ground)
    with pytest.raises(AssertionError, match="worked out again"):
        random_map(1).ground(0.6)


DAMAGE = {
    "cut": lambda data: data[: len(data) // 2],
    "emptied": lambda data: b"",
    "one bit": lambda data: data[:700] + bytes([data[700] ^ 4]) + data[701:],
    "another shape": lambda data: npz(values=np.zeros((2, 2), np.float32)),
    "another type": lambda data: npz(values=np.zeros((23, 17))),
    "another name": lambda data: npz(other=np.zeros((23, 17), np.float32)),
    "a pickle": lambda data: pickle.dumps(np.zeros((23, 17), np.float32)),
    "pickled objects": lambda data: npz(values=np.array([Trap()], object)),
    "longer": lambda data: data + b"\0" * 10000,
}


class Trap:
    def __reduce__(self):
        return os.mkdir, ("trap-sprung",)


def npz(**arrays):
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


@pytest.mark.parametrize("kind", sorted(DAMAGE))
def test_a_damaged_cache_is_made_anew(kind, own_cache, small_maps_on_disk, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    expected = random_map(1).distance
    (path,) = own_cache.iterdir()
    good = path.read_bytes()
    path.write_bytes(DAMAGE[kind](good))
    np.testing.assert_array_equal(random_map(1).distance, expected)
    np.testing.assert_array_equal(np.load(path)["values"], expected)
    assert not Path("trap-sprung").exists()


def test_a_cache_that_cannot_be_written_is_no_error(own_cache, small_maps_on_disk):
    own_cache.parent.mkdir(parents=True)
    own_cache.write_bytes(b"a file where the folder should be")
    assert random_map(1).distance.shape == (23, 17)
