"""Simulated lasers: rays against walls whose distance is known, and against a search of all cells."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from zstate import InvalidInput, Transform, TransformBuffer
from zstate.scans import Grid, SimulatedLaser, dummy_scan
from zstate.scans.simulated_laser import MountedLaser, free_distances

QUARTER = math.pi / 2


def room(width: int = 42, height: int = 22) -> NDArray[np.int8]:
    """A free room with walls of one cell."""
    cells = np.zeros((height, width), dtype=np.int8)
    cells[[0, -1]] = cells[:, [0, -1]] = 100
    return cells


def laser(grid: Grid | None = None, **changes: Any) -> SimulatedLaser:
    """A laser with rays to the right, ahead, to the left and behind; in a room of 4 x 2 m."""
    four_rays = {"angle_min": -QUARTER, "angle_increment": QUARTER, "ray_count": 4, **changes}
    return SimulatedLaser(grid or Grid(room(), 0.1, (-0.1, -0.1, 0.0)), **four_rays)


def test_ranges_are_the_distances_to_the_walls():
    ranges = laser().ranges(1.0, 0.5, 0.0)
    assert ranges.dtype == np.float32
    # The walls are at x = 0 and 4, y = 0 and 2.
    np.testing.assert_allclose(ranges, [0.5, 3.0, 1.5, 1.0], rtol=1e-6)
    np.testing.assert_allclose(laser().ranges(1.0, 0.5, QUARTER), [3.0, 1.5, 1.0, 0.5], rtol=1e-6)


def test_a_scan_places_its_points_on_the_walls():
    turned = 0.3
    scan = SimulatedLaser(Grid(room(), 0.1, (-0.1, -0.1, 0.0)), frame="lidar", ray_ns=7).scan(
        5, 1.3, 0.7, turned
    )
    assert (scan.stamp, scan.frame, scan.ray_ns, len(scan.ranges)) == (5, "lidar", 7, 1081)
    map_from_lidar = Transform.from_rpy("map", "lidar", (1.3, 0.7, 0.0), (0.0, 0.0, turned))
    x, y, _ = (map_from_lidar @ scan.points()).T
    distances = np.min(np.abs([x, x - 4.0, y, y - 2.0]), axis=0)
    assert distances.max() < 1e-5  # float32 of up to 4 m


def test_the_pose_is_in_the_frame_of_the_grid_whose_origin_is_turned():
    yaw = 0.6
    corner = Transform.from_rpy("map", "corner", (5.0, -3.0, 0.0), (0.0, 0.0, yaw))
    x, y, _ = corner @ [1.1, 0.6, 0.0]
    ranges = laser(Grid(room(), 0.1, corner)).ranges(x, y, yaw)
    np.testing.assert_allclose(ranges, [0.5, 3.0, 1.5, 1.0], rtol=1e-6)


def test_only_occupied_cells_stop_a_ray():
    cells = np.array([[0, 0, -1, 64, 65, 100]], dtype=np.int8)
    one = laser(Grid(cells, 1.0, (0.0, 0.0, 0.0)), angle_min=0.0, ray_count=1)
    assert one.ranges(0.5, 0.5, 0.0).tolist() == [3.5]


def test_outside_of_the_grid_all_is_free():
    pillar = Grid([[100]], 1.0, (0.0, 0.0, 0.0))
    ahead = laser(pillar, angle_min=0.0, ray_count=1)
    assert ahead.ranges(-3.0, 0.5, 0.0).tolist() == [3.0]
    assert ahead.ranges(4.0, 0.5, math.pi).tolist() == [3.0]
    assert ahead.ranges(-3.0, 0.5, math.pi).tolist() == [math.inf]
    assert ahead.ranges(-3.0, 1.5, 0.0).tolist() == [math.inf]
    assert ahead.ranges(1e9, 1e9, 0.0).tolist() == [math.inf]


def test_ranges_beyond_the_limits_are_infinite_as_rep_117_requires():
    ranges = laser(range_min=0.9, range_max=2.9).ranges(1.0, 0.5, 0.0)
    np.testing.assert_allclose(ranges, [-math.inf, math.inf, 1.5, 1.0], rtol=1e-6)
    assert laser(range_min=0.9, range_max=2.9).scan(0, 1.0, 0.5, 0.0).valid.tolist() == [
        False,
        False,
        True,
        True,
    ]


def test_a_wall_at_the_largest_range_is_measured():
    ahead = laser(Grid([[0, 0, 100]], 1.0, (0, 0, 0)), angle_min=0.0, ray_count=1, range_max=1.5)
    assert ahead.ranges(0.5, 0.5, 0.0).tolist() == [1.5]


def test_a_sensor_inside_of_a_wall_measures_zero():
    assert laser().ranges(-0.05, 1.0, 0.3).tolist() == [0.0] * 4


def test_each_ray_may_have_its_own_pose():
    moving = laser().ranges([1.0, 1.5, 2.0, 2.5], [0.5, 0.6, 0.7, 0.8], [0.0, 0.0, 0.0, -QUARTER])
    # Right 0.5; ahead 4 - 1.5; left 2 - 0.7; behind, turned by a right angle to the right, is left: 2 - 0.8.
    turned = [0.5, 2.5, 1.3, 1.2]
    np.testing.assert_allclose(moving, turned, rtol=1e-6)


def test_noise_has_its_deviation_and_is_repeated_by_its_seed():
    rays = {"angle_min": 0.0, "angle_increment": 1e-9, "ray_count": 2000, "noise_m": 0.02}
    first, second, other = (laser(**rays, seed=seed).ranges(1.0, 0.5, 0.0) for seed in (7, 7, 8))
    assert first.tolist() == second.tolist() != other.tolist()
    errors = first - 3.0
    # Standard errors: 0.02 / sqrt(2000) of the mean, and 0.02 / sqrt(4000) of the deviation.
    assert abs(errors.mean()) < 5 * 0.02 / math.sqrt(2000)
    assert abs(errors.std() - 0.02) < 5 * 0.02 / math.sqrt(4000)


def nearest_hit(cells: NDArray[np.int8], x: float, y: float, angle: float) -> float:
    """By intersecting the ray with the square of every occupied cell."""
    rows, columns = np.nonzero(cells >= 65)
    low = np.stack((columns, rows)) - np.array([[x], [y]])
    ends = np.stack((low, low + 1.0)) / np.array([[math.cos(angle)], [math.sin(angle)]])
    entry = np.maximum(ends.min(axis=0).max(axis=0), 0.0)
    leave = ends.max(axis=0).min(axis=0)
    return min(entry[entry <= leave], default=math.inf)


@given(st.integers(0, 2**32), st.integers(1, 30), st.integers(1, 30), st.sampled_from([0.002, 0.02, 0.2]))
def test_rays_find_what_a_search_of_all_cells_finds(seed: int, width: int, height: int, density: float):
    random = np.random.default_rng(seed)
    cells = np.where(random.random((height, width)) < density, 100, 0)
    x, y = random.uniform(-10, width + 10), random.uniform(-10, height + 10)
    angle_min = random.uniform(-3.0, 3.0)
    one = SimulatedLaser(
        Grid(cells, 1.0, (0, 0, 0)), angle_min=angle_min, angle_increment=0.1, ray_count=63, range_max=100.0
    )
    expected = [nearest_hit(cells, x, y, angle_min + 0.1 * i) for i in range(63)]
    np.testing.assert_allclose(one.ranges(x, y, 0.0), expected, rtol=1e-6, atol=1e-9)


@given(st.integers(0, 2**32), st.integers(1, 12), st.integers(1, 12))
def test_free_distances_are_chebyshev_distances(seed: int, width: int, height: int):
    occupied = np.random.default_rng(seed).random((height, width)) < 0.1
    distances = free_distances(occupied)
    found = np.argwhere(occupied)
    for cell in np.ndindex(height, width):
        expected = min((int(np.abs(other - cell).max()) for other in found), default=1000)
        assert distances[cell[0] + 1, cell[1] + 1] == expected
    assert not distances[[0, -1]].any()
    assert not distances[:, [0, -1]].any()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ray_count": 0}, "one ray or more; got ray_count=0"),
        ({"noise_m": -0.1}, "finite and 0 or more; got -0.1"),
        ({"noise_m": math.nan}, "got nan"),
        ({"range_max": -1.0}, "0 <= range_min <= range_max"),
        ({"angle_increment": 0.0}, "angle_increment is 0"),
        ({"ray_ns": -1}, "0 or more; got -1"),
    ],
)
def test_a_geometry_that_is_none_is_refused(changes: dict[str, Any], message: str):
    with pytest.raises(InvalidInput, match=message):
        laser(**changes)


def test_a_tilted_grid_is_refused():
    with pytest.raises(InvalidInput, match="is not in the x-y plane"):
        laser(Grid(room(), 0.1, Transform.from_rpy("map", "corner", (0, 0, 0), (0.1, 0, 0))))


@pytest.mark.parametrize(
    ("x", "message"),
    [
        (math.nan, "x of a laser is one finite number, or 4"),
        ([1.0, 2.0], "x of a laser is one finite number, or 4"),
        ("here", "x must be real numbers"),
    ],
)
def test_a_pose_that_is_none_is_refused(x: Any, message: str):
    with pytest.raises(InvalidInput, match=message):
        laser().ranges(x, 0.0, 0.0)


def test_the_dummy_scan_is_that_of_dummy_laser():
    scan = dummy_scan(10**18)
    assert (len(scan.ranges), scan.frame, scan.is_rigid) == (1081, "single_rrbot_hokuyo_link", True)
    last = scan.angle_min + scan.angle_increment * 1080
    assert np.degrees([scan.angle_min, last]) == pytest.approx([-135.0, 135.0])
    assert (scan.range_min, scan.range_max) == (0.0, 10.0)
    # dummy_laser: |sin(counter)|, and counter grows by 0.1 with each of 30 scans a second.
    for counter in range(40):
        ranges = dummy_scan(round(counter * 1e9 / 30)).ranges
        assert ranges == pytest.approx(abs(math.sin(0.1 * counter)), abs=1e-6)


def test_tilted_laser_measures_walls_and_the_floor_along_its_rays():
    # A wall at x = 3 m. Rays along x and -x, from (0.5, 0.5, 1.0), turned down by 30 degrees about y.
    cells = np.zeros((10, 40), int)
    cells[:, 30:] = 100
    laser = SimulatedLaser(
        Grid(cells, 0.1, (0.0, 0.0, 0.0)), angle_increment=math.pi, angle_min=0.0, ray_count=2, range_max=9.0
    )
    down = (0.0, math.sin(math.radians(15.0)), 0.0, math.cos(math.radians(15.0)))
    forward, backward = laser.scan_in_space(0, [(0.5, 0.5, 1.0, *down)] * 2).ranges
    # The floor is 1 m below: 1 / sin 30. The other ray goes up, and leaves the map.
    assert forward == pytest.approx(2.0)
    assert backward == math.inf
    forward, _ = laser.scan_in_space(0, [(2.0, 0.5, 1.0, *down)] * 2).ranges
    # Here the wall is nearer: 1 m ahead, 1 / cos 30.
    assert forward == pytest.approx(1.0 / math.cos(math.radians(30.0)))


def test_ray_above_the_top_of_a_wall_has_no_echo():
    # A wall 2.5 m away and 2.5 m high, seen from z = 1 m: its top is atan(1.5 / 2.5) = 31 degrees up.
    cells = np.zeros((10, 40), int)
    cells[:, 30:] = 100
    laser = SimulatedLaser(Grid(cells, 0.1, (0.0, 0.0, 0.0)), angle_min=0.0, ray_count=1)
    for degrees, distance in ((30.0, 2.5 / math.cos(math.radians(30.0))), (32.0, math.inf)):
        half = -math.radians(degrees) / 2.0
        (ahead,) = laser.scan_in_space(0, [(0.5, 0.5, 1.0, 0.0, math.sin(half), 0.0, math.cos(half))]).ranges
        assert ahead == pytest.approx(distance)


def test_level_laser_in_the_plane_of_the_map_measures_no_floor():
    cells = np.zeros((10, 40), int)
    cells[:, 30:] = 100
    laser = SimulatedLaser(Grid(cells, 0.1, (0.0, 0.0, 0.0)), angle_min=0.0, ray_count=1)
    (ahead,) = laser.scan_in_space(0, [(0.5, 0.5, 0.0, 0.0, 1e-12, 0.0, 1.0)]).ranges
    assert ahead == pytest.approx(2.5)


def test_limits_of_a_tilted_laser_hold_along_the_ray():
    # A wall at x = 3 m. A ray from x = 2.94, z = 1 m, 60 degrees down, hits it after 0.06 m / cos 60.
    cells = np.zeros((10, 40), int)
    cells[:, 30:] = 100
    pose = (2.94, 0.55, 1.0, 0.0, math.sin(math.radians(30.0)), 0.0, math.cos(math.radians(30.0)))
    for range_min, distance in ((0.1, 0.12), (0.13, -math.inf)):
        one = SimulatedLaser(
            Grid(cells, 0.1, (0.0, 0.0, 0.0)), angle_min=0.0, ray_count=1, range_min=range_min
        )
        (ahead,) = one.scan_in_space(0, [pose]).ranges
        assert ahead == pytest.approx(distance)


def test_noise_of_a_tilted_laser_is_along_the_ray_and_on_the_floor_as_well():
    # Rays from z = 1 m, 60 degrees down, without a wall: the floor after 1 m / sin 60.
    free = Grid(np.zeros((4, 4), int), 1.0, (0.0, 0.0, 0.0))
    rays = {"angle_min": 0.0, "angle_increment": 1e-9, "ray_count": 2000}
    noisy = SimulatedLaser(free, **rays, noise_m=0.02, seed=7)
    pose = (2.0, 2.0, 1.0, 0.0, math.sin(math.radians(30.0)), 0.0, math.cos(math.radians(30.0)))
    errors = noisy.scan_in_space(0, [pose] * 2000).ranges - 1.0 / math.sin(math.radians(60.0))
    assert abs(errors.std() - 0.02) < 5 * 0.02 / math.sqrt(4000)


@pytest.mark.parametrize("shape", [(7,), (3, 7), (4, 6)])
def test_poses_of_another_shape_are_refused(shape: tuple[int, ...]):
    with pytest.raises(InvalidInput, match=r"have the shape \(4, 7\), one pose for each ray"):
        laser().scan_in_space(0, np.ones(shape))


def mounted(buffer: TransformBuffer) -> MountedLaser:
    """Rays every second, so that a sweep takes 3 s."""
    return MountedLaser(laser(ray_ns=10**9), buffer, "r1/laser", "r1/map")


def test_mounted_laser_measures_each_ray_from_its_own_pose():
    """The robot drives from x = 1 m at 0 s to x = 2 m at 10 s, facing along x."""
    buffer = TransformBuffer()
    for second, x in ((0, 1.0), (10, 2.0)):
        buffer.insert(Transform.from_rpy("r1/odom", "r1/laser", [x, 0.5, 0.2], [0, 0, 0], second * 10**9))
    source = mounted(buffer)
    scan = source.read(9 * 10**9)
    assert scan is not None
    assert (scan.stamp, scan.end_stamp) == (6 * 10**9, 9 * 10**9)
    # Rays to the right at 6 s, ahead at 7 s (x = 1.7), to the left at 8 s, behind at 9 s (x = 1.9).
    np.testing.assert_allclose(scan.ranges, [0.5, 4.0 - 1.7, 1.5, 1.9], rtol=1e-6)
    # The sweep ends at the newest pose, and only once.
    newest = source.read(20 * 10**9)
    assert newest is not None
    assert newest.end_stamp == 10 * 10**9
    assert source.read(21 * 10**9) is None


def test_mounted_laser_on_static_edges_measures_at_each_stamp():
    buffer = TransformBuffer()
    buffer.insert_static(Transform.from_rpy("r1/base", "r1/laser", [1.0, 0.5, 0.0], [0, 0, 0]))
    source = mounted(buffer)
    assert source.target == "r1/base"
    for stamp in (5 * 10**9, 6 * 10**9):
        scan = source.read(stamp)
        assert scan is not None
        assert scan.end_stamp == stamp
    # In the map the laser is turned by a quarter.
    buffer.insert_static(Transform.from_rpy("r1/map", "r1/base", [0.0, 0.0, 0.0], [0, 0, QUARTER]))
    assert source.target == "r1/map"


def test_mounted_laser_measures_again_after_the_clock_is_set_back():
    buffer = TransformBuffer()
    buffer.insert_static(Transform.from_rpy("r1/base", "r1/laser", [1.0, 0.5, 0.0], [0, 0, 0]))
    source = mounted(buffer)
    assert source.read(60 * 10**9) is not None
    # A late tick is no older clock.
    assert source.read(60 * 10**9 - 1) is None
    again = source.read(5 * 10**9)
    assert again is not None
    assert again.end_stamp == 5 * 10**9


def test_mounted_laser_without_a_pose_has_a_problem_and_no_sweep():
    source = mounted(TransformBuffer())
    assert source.read(5 * 10**9) is None
    assert "r1/laser" in str(source.problem())
