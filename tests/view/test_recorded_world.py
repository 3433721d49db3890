"""RecordedWorld: the scans, clouds and maps of a recording at any instant, read from the file when needed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.pictures import jpeg
from helpers.recording_builder import MS, START, RecordingBuilder, S, pose

from zstate.cameras import Camera
from zstate.cameras.camera import camera_to_message
from zstate.cameras.messages import CompressedImage
from zstate.clouds.cloud import Cloud, cloud_to_message
from zstate.clouds.messages import PointCloud
from zstate.scans import Scan
from zstate.scans.messages import LaserScan, OccupancyGrid
from zstate.view.data_source import ViewSource
from zstate.view.recorded_world import LogTimes, RecordedSensor, RecordedValue
from zstate.view.world_source import WriterName
from zstate.wire.measurements import to_float32_block
from zstate.wire.messages import to_block

FRONT, FLOOR = WriterName("cart", "front"), WriterName("hall", "floor")
TOP, WRIST = WriterName("cart", "top"), WriterName("cart", "wrist")
RAY_NS = 1000
COUNT = 100
"""Scans of each sensor, 100 ms apart: more than are read together."""


def scan(stamp: int, first: float) -> LaserScan:
    """Three rays, of which the first tells the scans apart."""
    ranges = to_float32_block([first, 1.0, 1.0])
    return LaserScan(stamp, 0, 1, "laser", 0.0, 0.5, RAY_NS, 0, 0.1, 1000.0, ranges)


def end_of(stamp: int) -> int:
    return stamp + 2 * RAY_NS


def grid(cells: bytes) -> OccupancyGrid:
    return OccupancyGrid(4, START, "map", 0.5, len(cells), 1, to_block([1, 2, 0, 0, 0, 0, 1]), cells)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Ten seconds of a cart with a laser, and a map that changes after 3 s and is withdrawn after 6 s.

    The stamps are of a clock that reads 50 s less than that of the recorder.
    """
    path, ahead = tmp_path / "run.mcap", 50 * S
    with RecordingBuilder(path, max_bytes=1 << 16) as builder:
        builder.encoder.write_message("hall", grid(b"\x64"), START, "floor")
        for n in range(COUNT + 1):
            stamp = START - ahead + n * 100 * MS
            builder.edges("cart", stamp, {("odom", "laser"): pose(n)}, log_time=stamp + ahead)
            if n < COUNT:
                builder.encoder.write_message("cart", scan(stamp, n + 1), stamp + ahead + MS, "front")
            if n == 30:
                builder.encoder.write_message("hall", grid(b"\x00\x00"), stamp + ahead + 2 * MS, "floor")
            if n == 60:
                builder.encoder.withdraw("hall", "map", "floor", stamp + ahead + 2 * MS)
    return path


@pytest.fixture
def source(path: Path):
    with ViewSource.from_recording(path) as source:
        yield source


def firsts(source: ViewSource, count: int, at: int | None) -> list[float]:
    return [float(scan.ranges[0]) for scan in source.world.sensors[FRONT].latest(count, at)]


def test_last_scans_until_an_instant_are_read_in_any_order(source: ViewSource):
    begin = START - 50 * S
    # Forwards, across the scans that are read together, and backwards.
    for n in (0, 1, 4, 40, 41, 99, 70, 3, 98, 0):
        at = end_of(begin + n * 100 * MS)
        expected = [float(k + 1) for k in range(max(0, n - 2), n + 1)]
        assert firsts(source, 3, at) == expected
        assert firsts(source, 3, at - 1) == [float(k + 1) for k in range(max(0, n - 3), n)]
    assert firsts(source, 2, None) == [COUNT - 1.0, COUNT]
    assert firsts(source, 0, None) == []


def test_scan_is_the_same_object_while_it_is_on_display(source: ViewSource):
    sensor, begin = source.world.sensors[FRONT], START - 50 * S
    shown = {}
    for n in range(4, 90):  # further than is read at once
        for one in sensor.latest(5, end_of(begin + n * 100 * MS)):
            assert shown.setdefault(one.stamp, one) is one


def test_map_in_effect_is_that_of_the_instant(source: ViewSource):
    begin = START - 50 * S
    cells = {}
    for seconds in (6.5, 0.0, 2.9, 3.1, 5.9, 6.2, 10.0, 1.0):
        maps = source.world.maps_at(begin + round(seconds * 1e9))
        cells[seconds] = [grid.cells.tolist() for grid in maps.values()]
        assert set(maps) <= {FLOOR}
    black, free = [[[100]]], [[[0, 0]]]
    expected = {0.0: black, 1.0: black, 2.9: black, 3.1: free, 5.9: free, 6.2: [], 6.5: [], 10.0: []}
    assert cells == expected
    at = begin + S
    assert source.world.maps_at(at)[FLOOR] is source.world.maps_at(at + 1)[FLOOR]  # encoded once


def test_scan_whose_last_ray_has_no_pose_is_reported(source: ViewSource):
    sensor, begin = source.world.sensors[FRONT], START - 50 * S
    sensor.settle(source.buffer, "cart/odom", begin + S)
    assert sensor.problem is None
    sensor.settle(source.buffer, "elsewhere", begin + S)
    assert sensor.problem is not None
    assert sensor.problem.startswith("points without a pose: ")
    assert "elsewhere" in sensor.problem


def test_closed_source_reads_nothing(path: Path):
    with ViewSource.from_recording(path) as source:
        pass
    assert firsts(source, 3, None) == []


def test_recorded_scans_without_motion_have_a_span(tmp_path: Path):
    path = tmp_path / "still.mcap"
    with RecordingBuilder(path) as builder:
        builder.statics("cart", START, {("cart/base", "cart/laser"): pose(1.0)})
        for n in range(3):
            builder.encoder.write_message("cart", scan(START + n * S, n + 1), START + n * S, "front")
    with ViewSource.from_recording(path) as source:
        assert source.span == (end_of(START), end_of(START + 2 * S))
        assert firsts(source, 1, end_of(START + S)) == [2.0]


def cloud_message(stamp: int, count: int, first: float) -> PointCloud:
    """Points on the x axis, from ``first`` on."""
    points = np.zeros(count, [(name, "<f4") for name in "xyz"])
    points["x"] = first + np.arange(count)
    return cloud_to_message(Cloud(stamp, "lidar", points), is_dense=True)


@pytest.fixture
def with_clouds(tmp_path: Path):
    """Three seconds of a cart with a lidar of 10 Hz and 50 points."""
    path = tmp_path / "clouds.mcap"
    with RecordingBuilder(path) as builder:
        for n in range(31):
            stamp = START + n * 100 * MS
            builder.edges("cart", stamp, {("odom", "lidar"): pose(n)})
            builder.encoder.write_message("cart", cloud_message(stamp, 50, n), stamp + MS, "top")
    with ViewSource.from_recording(path) as source:
        yield source


def test_recorded_clouds_of_the_last_seconds_are_read_in_any_order(with_clouds: ViewSource):
    sensor = with_clouds.world.clouds[TOP]
    for n in (0, 7, 8, 30, 3):
        found = sensor.within(500 * MS, START + n * 100 * MS)
        assert [cloud.xyz[0, 0] for cloud in found] == list(range(max(0, n - 5), n + 1))
    assert sensor.frame == "cart/lidar"
    assert with_clouds.world.span == (START, START + 3 * S)


def test_recorded_clouds_are_read_again_for_more_points(with_clouds: ViewSource):
    def counts() -> list[int]:
        return [len(cloud) for cloud in with_clouds.world.clouds[TOP].within(200 * MS, START + S)]

    world = with_clouds.world
    world.limit_clouds(TOP, 10)
    assert counts() == [10, 10, 10]
    world.limit_clouds(TOP, 40)
    assert counts() == [40, 40, 40]


def test_recorded_pictures_and_calibrations_are_those_of_the_instant(tmp_path: Path):
    path = tmp_path / "pictures.mcap"
    camera, small = (Camera(w, 48, (60.0, 60.0, 31.5, 23.5), frame="lens") for w in (64, 80))
    with RecordingBuilder(path) as builder:
        builder.encoder.write_message("cart", camera_to_message(camera, START), START, "wrist")
        for n in range(20):
            stamp = START + n * 100 * MS
            builder.edges("cart", stamp, {("base", "lens"): pose(n)})
            image = CompressedImage(stamp, n, 1, "lens", "jpeg", jpeg(brightness=5 * n))
            builder.encoder.write_message("cart", image, stamp + MS, "wrist")
            if n == 10:
                builder.encoder.write_message(
                    "cart", camera_to_message(small, stamp), stamp + 2 * MS, "wrist"
                )
    with ViewSource.from_recording(path) as source:
        world = source.world
        for n in (3, 19, 0, 12):
            at = START + n * 100 * MS
            (packet,) = world.pictures[WRIST].latest(1, at)
            assert packet.data == jpeg(brightness=5 * n)
            assert packet.frame == "cart/lens"
            assert world.cameras_at(at + 50 * MS)[WRIST].width == (64 if n < 10 else 80)


def indexed(*stamps: int) -> RecordedSensor:
    scans = [Scan(stamp, 0.0, 0.5, 0, [1.0], 0.1, 10.0, "laser") for stamp in stamps]
    recorded = RecordedSensor(lambda begin, end: iter(scans[begin:end]))
    for number, one in enumerate(scans):
        recorded.add(one, number)
    return recorded


def stamps_of(recorded: RecordedSensor, at: int | None = None) -> list[int]:
    return [scan.stamp for scan in recorded.latest(9, at)]


def test_delayed_scan_is_left_out_and_a_clock_set_back_begins_again():
    assert stamps_of(indexed(10 * S, 11 * S, 11 * S - MS, 12 * S)) == [10 * S, 11 * S, 12 * S]
    assert stamps_of(indexed(10 * S, 11 * S, 2 * S, 3 * S)) == [2 * S, 3 * S]


def test_sensor_is_stale_after_ten_of_its_periods():
    # 10 Hz with one silence of 4 s, which is no period.
    tenths = [0, 1, 2, 3, 43, 44, 45, 46]
    recorded = indexed(*(n * 100 * MS for n in tenths))
    assert not recorded.is_stale(1300 * MS)
    assert recorded.is_stale(1301 * MS)
    assert not recorded.is_stale(4300 * MS)
    assert not recorded.is_stale(5600 * MS)
    assert recorded.is_stale(5601 * MS)
    assert not recorded.is_stale(None)
    assert not indexed(0).is_stale(100 * S)


def test_log_time_is_interpolated_and_begins_again_with_the_clock():
    times = LogTimes()
    assert times.log_time(0) is None
    for stamp, log_time in ((100, 1000), (200, 3000), (200, 4000), (300, 5000)):
        times.add(stamp, log_time)
    assert [times.log_time(stamp) for stamp in (0, 100, 150, 200, 250)] == [1000, 1000, 2000, 3000, 4000]
    assert times.log_time(300) is None
    times.add(10, 6000)
    times.add(20, 7000)
    assert [times.log_time(stamp) for stamp in (0, 15, 150)] == [6000, 6500, None]


def test_map_is_read_once_while_it_is_in_effect():
    reads: list[int] = []
    recorded = RecordedValue(reads.append)
    for log_time, is_withdrawn in ((10, False), (20, True), (30, False)):
        recorded.add(log_time, is_withdrawn=is_withdrawn)
    for log_time in (5, 10, 19, 20, 29, 30, 99, None, 15):
        recorded.at(log_time)
    assert reads == [10, 30, 10]
