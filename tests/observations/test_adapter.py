"""Scans of other lidars beside what the simulator's ray caster sees from the robot's centre."""

import math

import numpy as np
import pytest

from navrep_data.errors import ArrayError, BlindSectorWarning, ConfigError
from navrep_data.observations import BLIND_RANGE, Lidar, ScanAdapter, fill_blind, scan_to_rings
from navrep_data.schema import SensorContract
from navrep_data.sim.lidar import scan_polygons

CONTRACT = SensorContract()
ROOM = [np.array([[-6.0, -4.0], [7.0, -4.0], [7.0, 5.0], [-6.0, 5.0]])]


def box(x, y, half):
    return np.array([[x - half, y - half], [x + half, y - half], [x + half, y + half], [x - half, y + half]])


FURNITURE = [*ROOM, box(3.0, 2.0, 0.5), box(-3.0, -1.5, 0.7), box(2.0, -2.0, 0.3)]
LEGS = np.array([[2.5, 0.3, 0.06], [2.5, -0.1, 0.06], [-2.0, 2.0, 0.06]])


def seen_by(lidar, polygons=ROOM, circles=(), pose=(0.0, 0.0, 0.0)):
    """What a mounted scanner measures, by ray casting; +inf where it hits nothing."""
    x, y, theta = pose
    at = (
        x + math.cos(theta) * lidar.x - math.sin(theta) * lidar.y,
        y + math.sin(theta) * lidar.x + math.cos(theta) * lidar.y,
        theta + lidar.yaw,
    )
    step = abs(lidar.angle_increment)
    first = lidar.angle_min if lidar.angle_increment > 0 else lidar.angle_min - (lidar.n_rays - 1) * step
    reach = min(lidar.range_max, 1000.0)
    contract = SensorContract(lidar.n_rays, first, step, reach)
    ranges = scan_polygons(polygons, circles, at, contract)
    ranges = np.where(ranges >= reach, np.inf, ranges)
    return ranges if lidar.angle_increment > 0 else ranges[::-1].copy()


def truth(polygons=ROOM, circles=(), pose=(0.0, 0.0, 0.0), contract=CONTRACT):
    return scan_polygons(polygons, circles, pose, contract)


def around(n, **mounting):
    return Lidar(n, 0.0, 2 * math.pi / n, **mounting)


def corner(x, y, yaw, n=1081):
    """A scanner of 270 degrees on a corner of the robot, as the paper's robot carries two of."""
    return Lidar(n, -0.75 * math.pi, 1.5 * math.pi / (n - 1), 0.05, 30.0, x, y, yaw)


def test_the_models_own_scan_passes_through_unchanged():
    scan = truth(FURNITURE, LEGS)
    out = ScanAdapter(Lidar.of(CONTRACT))(scan)
    assert out.dtype == np.float32
    assert np.array_equal(out, scan)


@pytest.mark.slow
def test_the_kernel_alone_keeps_the_models_own_scan_to_rounding():
    adapter = ScanAdapter(Lidar.of(CONTRACT))
    adapter._same = False
    scan = truth(FURNITURE, LEGS)
    assert np.abs(adapter(scan) - scan).max() < 1e-5


@pytest.mark.parametrize("n", [90, 360, 720, 1440, 2880])
@pytest.mark.parametrize("yaw", [0.0, 0.3, math.pi, -2.0])
def test_other_ray_counts_see_straight_walls_exactly(n, yaw):
    lidar = around(n, yaw=yaw)
    out = ScanAdapter(lidar)(seen_by(lidar))
    off = np.abs(out - truth())
    # a corner between two rays is cut off; everything else is straight
    assert (off > 1e-3).sum() <= 4 * (1080 // n + 2)
    assert off.max() < 8.0 * (2 * math.pi / n)


@pytest.mark.parametrize(("x", "y", "yaw"), [(0.3, 0.2, 0.7), (-0.4, 0.0, math.pi), (0.0, -0.5, -1.5)])
@pytest.mark.parametrize("n", [720, 1080, 2000])
def test_mounting_offset_is_taken_out(x, y, yaw, n):
    lidar = around(n, x=x, y=y, yaw=yaw)
    out = ScanAdapter(lidar)(seen_by(lidar))
    off = np.abs(out - truth())
    assert np.quantile(off, 0.97) < 1e-4
    assert off.max() < 0.1
    ignored = ScanAdapter(around(n))(seen_by(lidar))
    assert np.quantile(np.abs(ignored - truth()), 0.9) > 0.1, "leaving the mounting out is no small mistake"


@pytest.mark.parametrize("seed", range(5))
def test_clockwise_and_upside_down(seed):
    r = np.random.default_rng(seed)
    x, y, yaw = r.uniform(-0.3, 0.3, 3)
    up = Lidar(900, -2.0, 4.0 / 899, x=x, y=y, yaw=yaw)
    down = Lidar(900, 2.0, -4.0 / 899, x=x, y=y, yaw=yaw)
    ranges = seen_by(up, FURNITURE, LEGS)
    assert np.array_equal(seen_by(down, FURNITURE, LEGS), ranges[::-1])
    assert np.array_equal(ScanAdapter(down, unknown=0)(ranges[::-1]), ScanAdapter(up, unknown=0)(ranges))


@pytest.mark.parametrize("seed", range(6))
def test_two_scanners_on_corners_make_one_scan(seed):
    r = np.random.default_rng(seed)
    pose = (*r.uniform(-1.0, 1.0, 2), r.uniform(-3, 3))
    front, rear = corner(0.25, 0.2, math.pi / 4), corner(-0.25, -0.2, -3 * math.pi / 4)
    adapter = ScanAdapter([front, rear])
    out = adapter(*(seen_by(s, FURNITURE, LEGS, pose) for s in (front, rear)))
    true = truth(FURNITURE, LEGS, pose)
    off = np.abs(out - true)
    assert np.median(off) < 1e-4
    assert (off > 0.05).mean() < 0.06, "only around edges that scanner and centre see from different sides"
    assert not adapter.blind.any()
    # one scanner alone is blind to the back, which is not free by default
    with pytest.warns(BlindSectorWarning, match=r"No scanner looks along \d+ of 1080 rays \(\d+ to \d+ deg\)"):
        alone = ScanAdapter(front)(seen_by(front, FURNITURE, LEGS, pose))
    assert (alone == 0.0).sum() > 150
    # nothing is invented nearer than it is
    assert (out > true - 0.05).mean() > 0.97


def test_nearest_counts_where_two_scanners_disagree():
    a, b = around(1080), around(1080)
    near, far = np.full(1080, 2.0), np.full(1080, 5.0)
    assert np.allclose(ScanAdapter([a, b])(near, far), 2.0, atol=1e-3)
    assert np.allclose(ScanAdapter([a, b])(far, near), 2.0, atol=1e-3)


def test_field_of_view_and_the_unknown_directions():
    lidar = Lidar(541, -math.pi / 2, math.pi / 540)  # the half in front
    ranges = seen_by(lidar)
    angles = CONTRACT.angle_min + np.arange(1080) * CONTRACT.angle_increment
    behind = np.cos(angles) < -0.01
    front = np.cos(angles) > 0.01
    free = ScanAdapter(lidar, unknown=25.0)(ranges)
    assert (free[behind] == 25.0).all()
    assert np.abs(free - truth())[front].max() < 0.1
    invalid = ScanAdapter(lidar, unknown=0.0)(ranges)
    assert (invalid[behind] == 0.0).all()
    assert np.array_equal(invalid[front], free[front])


@pytest.mark.parametrize("bad", [np.nan, 0.0, -1.0, 0.049, -np.inf])
def test_invalid_returns_say_nothing(bad):
    lidar = Lidar(1080, 0.0, CONTRACT.angle_increment, range_min=0.05, range_max=30.0)
    ranges = np.full(1080, 3.0)
    ranges[100:110] = bad
    for adapter in (ScanAdapter(lidar, unknown=0.0), _never_same(ScanAdapter(lidar, unknown=0.0))):
        out = adapter(ranges)
        assert (out[100:110] == 0.0).all()
        assert np.allclose(np.delete(out, np.arange(100, 110)), 3.0, atol=1e-4)
    free = Lidar(1080, 0.0, CONTRACT.angle_increment, 0.05, 30.0, invalid_is_free=True)
    for adapter in (ScanAdapter(free, unknown=0.0), _never_same(ScanAdapter(free, unknown=0.0))):
        assert (adapter(ranges)[100:110] == 25.0).all()


def _never_same(adapter):
    adapter._same = False
    return adapter


@pytest.mark.parametrize("none", [np.inf, 30.0, 31.0, 26.0])
def test_no_return_is_free_not_unknown(none):
    lidar = Lidar(1080, 0.0, CONTRACT.angle_increment, range_max=30.0)
    for adapter in (ScanAdapter(lidar, unknown=0.0), _never_same(ScanAdapter(lidar, unknown=0.0))):
        assert (adapter(np.full(1080, none)) == 25.0).all()


def test_all_invalid_is_all_unknown():
    lidars = [corner(0.2, 0.2, 0.8), corner(-0.2, -0.2, -2.3)]
    scans = np.full((2, 1081), np.nan)
    assert (ScanAdapter(lidars, unknown=25.0)(*scans) == 25.0).all()
    with pytest.warns(BlindSectorWarning, match=r"1080 of 1080 rays say nothing .*invalid_is_free=True"):
        assert (ScanAdapter(lidars)(*scans) == 0.0).all()


def test_blind_sectors_are_warned_of_once():
    adapter = ScanAdapter(Lidar(541, -math.pi / 2, math.pi / 540))
    with pytest.warns(BlindSectorWarning):
        scan = adapter(np.full(541, 4.0))
    assert np.array_equal(adapter(np.full(541, 4.0)), scan), "a second warning would fail here"
    assert (scan[adapter.blind] == 0.0).all()
    assert adapter.blind.sum() == 539
    lost = ScanAdapter(Lidar.of(CONTRACT))
    ranges = np.full(1080, 4.0)
    ranges[:100] = np.nan
    lost(ranges)  # a few are every scanner's
    ranges[:200] = np.nan
    with pytest.warns(BlindSectorWarning, match="200 of 1080 rays say nothing"):
        lost(ranges)
    lost(ranges)


def test_what_models_are_shown_of_a_blind_sector():
    """Rings: unknown. Ranges: the nearer side of a narrow gap; of a wide one that, but no more than a metre."""
    scan = np.full(1080, 6.0, np.float32)
    scan[:100], scan[300:317], scan[500:518], scan[800:900] = 0.0, 0.0, 0.0, 0.0
    scan[299], scan[900:] = 3.0, 0.5
    shown = fill_blind(scan)
    assert shown.dtype == np.float32
    assert (shown[:100] == 0.5).all()
    assert (shown[300:317] == 3.0).all()
    assert (shown[500:518] == BLIND_RANGE).all()
    assert (shown[800:900] == 0.5).all()
    assert np.array_equal(shown[scan > 0], scan[scan > 0])
    assert (fill_blind(np.zeros((2, 1080))) == BLIND_RANGE).all()
    assert fill_blind(shown) is shown
    rings = scan_to_rings(scan)
    assert (rings[1:5] == 1).all()
    with pytest.raises(ArrayError, match="use metres_from_millimetres"):
        fill_blind(np.zeros(1080, np.uint16))


@pytest.mark.parametrize("seed", range(3))
def test_walls_that_scanners_see_have_no_holes(seed):
    """In a closed room nothing is free as far as the scan reaches, whatever lies between the returns of the corners."""
    r = np.random.default_rng(seed)
    front, rear = corner(0.35, 0.3, math.pi / 4, 271), corner(-0.35, -0.3, -3 * math.pi / 4, 271)
    adapter = ScanAdapter([front, rear])
    for _ in range(10):
        pose = (*r.uniform(-1.0, 1.0, 2), r.uniform(-3, 3))
        out = adapter(*(seen_by(s, FURNITURE, LEGS, pose) for s in (front, rear)))
        assert out.max() < 13.0
        assert out.min() > 0.0


def test_between_two_fields_of_view():
    """They all but meet, half an increment apart: the nearer side counts. A gap of more is blind."""
    step = math.pi / 180
    halves = [Lidar(180, 0.0, step, range_max=30.0), Lidar(180, math.pi, step, range_max=30.0, x=0.0)]
    out = ScanAdapter(halves)(np.full(180, 4.0), np.full(180, 6.0))
    assert set(np.round(np.unique(out))) <= {4.0, 5.0, 6.0}
    apart = [Lidar(178, 0.0, step), Lidar(178, math.pi, step)]
    adapter = ScanAdapter(apart, unknown=0)
    assert 0 < adapter.blind.sum() < 16
    assert (adapter(np.full(178, 4.0), np.full(178, 6.0))[adapter.blind] == 0.0).all()
    # one target ray between them that no beam is nearest to
    thin = [Lidar(180, 0.4 * step, step), Lidar(179, math.pi + 0.9 * step, step)]
    out = ScanAdapter(thin)(np.full(180, 4.0), np.full(179, np.inf))
    assert out.min() > 3.9


def test_min_pooling_loses_nothing_thin():
    dense = around(5400)
    ranges = np.full(5400, 8.0)
    ranges[2] = 2.0  # one thin pole between the model's rays 0 and 1
    assert ScanAdapter(dense)(ranges).min() > 7.9
    pooled = ScanAdapter(dense, pooling="min")(ranges)
    assert pooled.min() == pytest.approx(2.0, abs=1e-3)
    assert (pooled < 7.9).sum() <= 2


@pytest.mark.parametrize("seed", range(3))
def test_min_pooling_beside_a_dumb_minimum(seed):
    r = np.random.default_rng(seed)
    n = 10_800
    ranges = r.uniform(1.0, 20.0, n)
    out = ScanAdapter(around(n), pooling="min")(ranges)
    angles = np.arange(n) * 2 * math.pi / n
    for k in range(0, 1080, 7):
        off = np.abs((angles - k * CONTRACT.angle_increment + math.pi) % (2 * math.pi) - math.pi)
        inside = ranges[off < 0.5 * CONTRACT.angle_increment].min()
        around_it = ranges[off < 0.5 * CONTRACT.angle_increment + math.pi / n].min()
        assert around_it - 1e-3 <= out[k] <= inside + 1e-3


@pytest.mark.parametrize("pooling", ["nearest", "min"])
def test_anything_at_all_gives_ranges_within_the_contract(pooling):
    r = np.random.default_rng(1)
    odd = np.array([np.nan, np.inf, -np.inf, 0.0, -0.0, -3.0, 1e-30, 1e-6, 1e30, 25.0, 24.999999, 0.3], np.float64)
    lidars = [corner(0.3, -0.2, -0.8, 333), around(77, x=-2.0, y=1.0), Lidar(1, 0.0, 0.1), Lidar(2, 3.0, -0.2)]
    adapter = ScanAdapter(lidars, pooling=pooling, unknown=0.0)
    scans = [r.choice(odd, (200, lidar.n_rays)) for lidar in lidars]
    with np.errstate(all="raise"):
        out = adapter(*scans)
    assert out.shape == (200, 1080)
    assert ((out >= 0.0) & (out <= 25.0)).all(), "NaN would fail here too"


def test_batches_equal_one_by_one_and_keep_leading_axes():
    front, rear = corner(0.25, 0.2, 0.8), corner(-0.25, -0.2, -2.3)
    adapter = ScanAdapter([front, rear])
    r = np.random.default_rng(3)
    a, b = (r.uniform(0.1, 30.0, (2, 3, 1081)).astype(np.float32) for _ in range(2))
    out = adapter(a, b)
    assert out.shape == (2, 3, 1080)
    assert all(np.array_equal(out[i, j], adapter(a[i, j], b[i, j])) for i in range(2) for j in range(3))


def test_another_contract():
    contract = SensorContract(n_rays=400, angle_min=-1.0, angle_increment=2.0 / 399, range_max=4.0)
    lidar = around(1440)
    out = ScanAdapter(lidar, contract)(seen_by(lidar))
    true = truth(contract=contract)
    assert out.shape == (400,)
    assert np.quantile(np.abs(out - true), 0.98) < 1e-3
    assert out.max() == 4.0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"n_rays": 0}, "n_rays is 0"),
        ({"angle_increment": 0.0}, "is it in degrees"),
        ({"angle_increment": 0.75}, "is it in degrees"),
        ({"n_rays": 3000}, "more than a turn"),
        ({"range_min": 5.0, "range_max": 1.0}, "0 <= range_min < range_max"),
        ({"range_min": -1.0}, "0 <= range_min"),
        ({"x": math.nan}, "check the mounting"),
        ({"yaw": math.inf}, "check the mounting"),
    ],
)
def test_bad_lidars(options, words):
    with pytest.raises(ConfigError, match=words):
        Lidar(**{"n_rays": 720, "angle_min": 0.0, "angle_increment": 2 * math.pi / 720, **options})


def test_bad_calls():
    adapter = ScanAdapter([around(720), around(360)])
    with pytest.raises(ArrayError, match="1 scans for 2 lidars"):
        adapter(np.ones(720))
    with pytest.raises(ArrayError, match=r"Scan 0 has shape \(360,\), expected \(..., 720\)"):
        adapter(np.ones(360), np.ones(720))
    with pytest.raises(ArrayError, match="expected floating metres"):
        adapter(np.ones(720, np.uint16), np.ones(360))
    with pytest.raises(ArrayError, match="equal leading dimensions"):
        adapter(np.ones((2, 720)), np.ones((3, 360)))
    with pytest.raises(ConfigError, match="at least one Lidar"):
        ScanAdapter([])
    with pytest.raises(ConfigError, match="pooling is 'max'"):
        ScanAdapter(around(720), pooling="max")
    with pytest.raises(ConfigError, match="unknown is 26"):
        ScanAdapter(around(720), unknown=26.0)
