from __future__ import annotations

import numpy as np
import pytest
import recorded
from numba import config

from navrep_data import observations as obs
from navrep_data.errors import ArrayError, ConfigError
from navrep_data.observations.rings import first_rays

PURE_PYTHON = bool(config.DISABLE_JIT)


@pytest.fixture(scope="module")
def golden():
    return recorded.golden("rings")


def slow_rings(scan):
    """Rings from the definition: a cell is occupied if a ray ends in it, unknown if one ends before it or none sees."""
    edges, n = obs.RING_EDGES, len(scan)
    rings = np.zeros((64, 64), np.uint8)
    for section in range(64):
        rays = [scan[i] for i in range(n) if -(-section * n // 64) <= i < -(-(section + 1) * n // 64)]
        if rays and all(d == 0 or np.isnan(d) for d in rays):
            rings[section] = 1
            continue
        rays = [d for d in rays if d != 0]
        for cell in range(64):
            if any(edges[cell] <= d < edges[cell + 1] for d in rays):
                rings[section, cell] = 2
            elif any(d < edges[cell] for d in rays):
                rings[section, cell] = 1
    return rings


def test_edges_are_the_originals(golden):
    np.testing.assert_array_equal(obs.RING_EDGES[:-1], golden["range_level_mins"])
    np.testing.assert_array_equal(obs.RING_EDGES[1:], golden["range_level_maxs"])
    np.testing.assert_array_equal(first_rays(1080), golden["sector_first_ray_1080"])


@pytest.mark.parametrize("name", ["", "edge_", "rays1080_", "rays720_", "rays360_", "rays64_"])
def test_rings_are_the_originals(golden, name):
    rings = obs.scan_to_rings(golden[f"{name}scans"], blind="free")
    np.testing.assert_array_equal(rings, golden[f"{name}rings_raw"][..., 0])
    if name != "edge_":
        np.testing.assert_array_equal(obs.scan_to_rings(golden[f"{name}scans"]), rings)


@pytest.mark.parametrize("dtype", [np.float32, np.uint16])
def test_sections_that_nobody_saw_are_unknown(dtype):
    scan = np.full(1080, 5000 if dtype == np.uint16 else 5.0, dtype)
    scan[17:34], scan[40:50] = 0, 0  # all rays of section 1, some of section 2
    rings = obs.scan_to_rings(scan)
    assert (rings[1] == 1).all()
    np.testing.assert_array_equal(rings[2], rings[0])
    assert (obs.scan_to_rings(scan, blind="free")[1] == 0).all()
    if dtype == np.float32:
        scan[17:34] = np.nan
        np.testing.assert_array_equal(obs.scan_to_rings(scan), rings)
        scan[20] = np.inf  # one ray saw that there is nothing
        assert (obs.scan_to_rings(scan)[1] == 0).all()
    assert (obs.scan_to_rings(scan[:16])[20:24] != 1).any(), "sections without rays are none that nobody saw"
    with pytest.raises(ConfigError, match="blind is 'wall', expected 'unknown' or 'free'"):
        obs.scan_to_rings(scan, blind="wall")


@pytest.mark.parametrize(
    ("rings", "scan"),
    [
        ("rings_raw", "lidar_from_raw"),
        ("rings_obs", "lidar_from_obs_times2"),
        ("edge_rings_raw", "edge_lidar_from_raw"),
        ("edge_rings_obs", "edge_lidar_from_obs_times2"),
        ("soft_rings", "lidar_from_soft_times2"),
        ("rays720_rings_raw", "rays720_lidar"),
        ("rays360_rings_raw", "rays360_lidar"),
        ("rays64_rings_raw", "rays64_lidar"),
    ],
)
def test_scans_from_rings_are_the_originals(golden, rings, scan):
    expected = golden[scan]
    np.testing.assert_array_equal(obs.rings_to_scan(golden[rings][..., 0], expected.shape[-1]), expected)


@pytest.mark.parametrize(("zero", "name"), [(False, "rings_obs_e2e"), (True, "rings_obs")])
def test_floats_from_rings_are_the_originals(golden, zero, name):
    for prefix in ("", "edge_"):
        floats = obs.rings_to_float(golden[f"{prefix}rings_raw"][..., 0], zero_first_bin=zero)
        np.testing.assert_array_equal(floats, golden[prefix + name][..., 0])
        assert floats.dtype == np.float32


def test_every_float_near_an_edge_or_bucket_border_falls_in_the_right_cell():
    # 64 rays: one per section, so one scan checks 64 values against searchsorted.
    edges = obs.RING_EDGES[1:-1]
    borders = (np.arange(0, 0x7F81, 7 if not PURE_PYTHON else 997, dtype=np.uint32) << 16).view(np.float32)
    largest = np.finfo(np.float32).max
    values = np.concatenate([edges, borders, [1e-40, largest]]).astype(np.float32)
    below = np.nextafter(values, np.float32(0))
    above = np.nextafter(values[values < largest], np.float32(np.inf))
    values = np.concatenate([values, below, above])
    values = values[(values > 0) & np.isfinite(values)]
    values = values[: len(values) // 64 * 64].reshape(-1, 64)
    rings = obs.scan_to_rings(values)
    cell = np.searchsorted(obs.RING_EDGES, values, side="right") - 1
    expected = (np.arange(64) > cell[..., None]) + 2 * (np.arange(64) == cell[..., None])
    np.testing.assert_array_equal(rings, expected)


def test_random_scans_match_the_definition():
    rng = np.random.default_rng(0)
    special = np.array([0, -0.0, -1, np.nan, -np.nan, np.inf, -np.inf, 25, 0.3, 1e-45, -1e-45], np.float32)
    for n_rays in (1, 7, 63, 65, 128, 361, 1081):
        scan = rng.uniform(0, 30, n_rays).astype(np.float32)
        np.testing.assert_array_equal(obs.scan_to_rings(scan), slow_rings(scan))
        odd = rng.random(n_rays) < 0.3
        scan[odd] = rng.choice(special, odd.sum())
        np.testing.assert_array_equal(obs.scan_to_rings(scan), slow_rings(scan))


def test_millimetres_equal_their_metres_for_every_count():
    counts = np.arange(1 << 16).astype(np.uint16)[:: 1 if not PURE_PYTHON else 61]
    counts = counts[: len(counts) // 64 * 64].reshape(-1, 64)
    metres = obs.metres_from_millimetres(counts)
    np.testing.assert_array_equal(obs.scan_to_rings(counts), obs.scan_to_rings(metres))
    rng = np.random.default_rng(1)
    scans = rng.integers(0, 30000, (5, 1080)).astype(np.uint16)
    scans[rng.random(scans.shape) < 0.2] = 0
    for scan in scans[:1] if PURE_PYTHON else scans:
        np.testing.assert_array_equal(obs.scan_to_rings(scan), slow_rings(obs.metres_from_millimetres(scan)))


def test_leading_dimensions_strides_and_out():
    rng = np.random.default_rng(2)
    scans = rng.uniform(0, 25, (2, 3, 1080)).astype(np.float32)
    rings = obs.scan_to_rings(scans)
    assert rings.shape == (2, 3, 64, 64)
    np.testing.assert_array_equal(rings[1, 2], obs.scan_to_rings(scans[1, 2]))
    np.testing.assert_array_equal(obs.scan_to_rings(scans[:, ::2, ::-1]), obs.scan_to_rings(scans[:, ::2, ::-1].copy()))
    np.testing.assert_array_equal(obs.scan_to_rings(scans.astype(np.float64)), rings)
    out = np.full_like(rings, 9)
    assert obs.scan_to_rings(scans, out=out) is out
    np.testing.assert_array_equal(out, rings)
    assert obs.scan_to_rings(np.empty((0, 1080), np.float32)).shape == (0, 64, 64)
    assert obs.rings_to_scan(rings).shape == scans.shape


def test_unusable_input_is_refused():
    good = np.zeros((64, 64), np.uint8)
    with pytest.raises(ArrayError, match="dtype int64, expected"):
        obs.scan_to_rings(np.zeros(1080, np.int64))
    with pytest.raises(ArrayError, match=r"shape \(\)"):
        obs.scan_to_rings(np.float32(1))
    for out in (np.empty((1, 64, 64), np.uint8), np.empty((64, 64), np.int8), good.T[::-1]):
        with pytest.raises(ArrayError, match="out has shape"):
            obs.scan_to_rings(np.zeros(1080, np.float32), out=out)
    for call in (obs.rings_to_scan, obs.rings_to_float):
        with pytest.raises(ArrayError, match=r"rings has shape \(64, 64, 1\)"):
            call(good[..., None])
        with pytest.raises(ArrayError, match="dtype int64"):
            call(good.astype(np.int64))
    with pytest.raises(ArrayError, match="n_rays is 0"):
        obs.rings_to_scan(good, 0)
