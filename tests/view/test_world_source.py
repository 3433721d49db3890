"""LiveSensor and WorldSource: what of the network's scans, clouds and maps is kept, and what is dropped."""

from __future__ import annotations

import numpy as np
import pytest

from zstate.buffer.buffer import TransformBuffer
from zstate.cameras import Camera
from zstate.cameras.camera import camera_to_message
from zstate.clouds.cloud import Cloud, cloud_to_message
from zstate.net.subscription import Received
from zstate.scans import Scan
from zstate.scans.messages import LaserScan, OccupancyGrid
from zstate.transform import Transform
from zstate.view.world_source import LiveSensor, WorldSource, WriterName
from zstate.wire.measurements import to_float32_block
from zstate.wire.messages import to_block

MS = 1_000_000


class ManualClock:
    """A monotonic clock that a test sets [s]."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock()


@pytest.fixture
def buffer() -> TransformBuffer:
    """Poses of the laser from 0 to 10 ms."""
    buffer = TransformBuffer(history_s=3600.0)
    for stamp in (0, 10 * MS):
        buffer.insert(Transform("odom", "r1/laser", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), stamp=stamp))
    return buffer


def scan_at(stamp: int, rays: int = 1) -> Scan:
    """A scan whose rays are all measured at ``stamp``."""
    return Scan(stamp, 0.0, 1e-6, 0, [1.0] * rays, 0.1, 10.0, "r1/laser")


def test_reason_of_a_dropped_scan_stays_while_a_newer_one_waits(clock: ManualClock, buffer: TransformBuffer):
    sensor = LiveSensor(clock=clock)
    sensor.add(scan_at(20 * MS))  # after the last pose
    clock.now_s += 2.0
    sensor.add(scan_at(21 * MS))
    sensor.settle(buffer, "odom")
    assert (sensor.dropped, sensor.latest(5)) == (1, [])
    assert sensor.reason is not None
    assert "r1/laser" in str(sensor.reason)
    sensor.add(scan_at(5 * MS))
    clock.now_s += 2.0
    sensor.settle(buffer, "odom")
    assert (sensor.dropped, sensor.reason) == (2, None)


def test_kept_scans_are_bounded_by_number_and_by_rays(buffer: TransformBuffer):
    few_rays, many_rays = LiveSensor(), LiveSensor()
    for _ in range(1100):
        few_rays.add(scan_at(5 * MS))
        few_rays.settle(buffer, "odom")
    assert len(few_rays.latest(2000)) == 1000
    for rays in (300_000, 300_000, 300_000, 300_000, 1):  # 4 bytes each, of 4 MB
        many_rays.add(scan_at(5 * MS, rays))
        many_rays.settle(buffer, "odom")
    assert [len(scan.ranges) for scan in many_rays.latest(9)] == [300_000, 300_000, 300_000, 1]


def test_waiting_scans_are_bounded_by_bytes(buffer: TransformBuffer):
    sensor = LiveSensor()
    for _ in range(5):
        sensor.add(scan_at(5 * MS, 300_000))
    sensor.settle(buffer, "odom")
    assert len(sensor.latest(9)) == 3


def test_scans_that_overflow_the_queue_are_counted_with_the_reason(
    clock: ManualClock, buffer: TransformBuffer
):
    sensor = LiveSensor(clock=clock)
    for _ in range(300):
        sensor.add(scan_at(20 * MS))  # waits for its pose
    sensor.settle(buffer, "odom")
    assert sensor.dropped == 300 - 256
    assert "r1/laser" in str(sensor.reason)


class ReceivingBuffer(TransformBuffer):
    """A buffer whose first lookup of a scan is overtaken by 256 further scans."""

    sensor: LiveSensor | None = None

    def explain(self, *args, **options):
        sensor, self.sensor = self.sensor, None
        if sensor is not None:
            for _ in range(256):
                sensor.add(scan_at(5 * MS))
        return super().explain(*args, **options)


def test_scans_that_arrive_during_a_lookup_are_all_kept_or_counted():
    buffer, sensor = ReceivingBuffer(history_s=3600.0), LiveSensor()
    for stamp in (0, 10 * MS):
        buffer.insert(Transform("odom", "r1/laser", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), stamp=stamp))
    sensor.add(scan_at(4 * MS))
    buffer.sensor = sensor
    sensor.settle(buffer, "odom")
    # The first one was lost to the queue's bound while its pose was looked up.
    assert [scan.stamp for scan in sensor.latest(999)] == [5 * MS] * 256
    assert sensor.dropped == 1


def sensor_name(number: int) -> WriterName:
    return WriterName(f"r{number}", "front")


def scans_of(source: WorldSource, *numbers: int) -> None:
    """One scan of each sensor."""
    message = LaserScan(0, 0, 1, "laser", 0.0, 0.1, 0, 0, 0.1, 10.0, to_float32_block([1.0]))
    source._on_scans([Received(f"r{n}", f"zstate/r{n}/scan/front", message) for n in numbers])


def test_stalest_sensor_makes_room_for_a_new_one(clock: ManualClock):
    with WorldSource(None, clock=clock) as source:
        for number in range(64):
            clock.now_s += 0.001
            scans_of(source, number)
        scans_of(source, 64, 65)
        assert set(source.sensors) == {sensor_name(n) for n in range(64)}
        assert source.refused == {"too many sensors": 2}
        ((what, why),) = source.problems
        assert what == "scans of further sensors"
        assert why.startswith(
            "2 refused; the first: zstate/r64/scan/front is not drawn, as 64 other sensors are; "
        )
        assert "`zstate view ROBOT`" in why
        clock.now_s += 9.99  # more than 10 s after the first scans, less after the last
        scans_of(source, 0, 65)
        assert set(source.sensors) == {sensor_name(n) for n in (0, *range(2, 64), 65)}
        assert source.refused == {"too many sensors": 2}


def test_map_beyond_the_limit_is_reported_with_what_to_do():
    message = OccupancyGrid(1, 0, "map", 1.0, 1, 1, to_block([0, 0, 0, 0, 0, 0, 1]), b"\x64")
    with WorldSource(None) as source:
        received = [Received(f"hall{n}", f"zstate/hall{n}/map/floor", message) for n in range(65)]
        source._on_maps(received)
        assert set(source.maps_at()) == {WriterName(f"hall{n}", "floor") for n in range(64)}
        ((what, why),) = source.problems
        assert what == "further maps"
        assert why.startswith(
            "1 refused; the first: zstate/hall64/map/floor is not drawn, as 64 other maps are; "
        )
        assert "`zstate ls`" in why
        source._on_maps(received[:64])  # maps that are drawn may change
        assert source.refused == {"too many maps": 1}


def test_cloud_is_thinned_out_to_the_limit_of_its_sensor():
    points = np.zeros(500, [(name, "<f4") for name in "xyz"])
    message = cloud_to_message(Cloud(5 * MS, "lidar", points), is_dense=True)
    with WorldSource(None) as source:
        source.limit_clouds(WriterName("r1", "top"), 20)
        source._on_clouds([Received("r1", f"zstate/r1/cloud/{name}", message) for name in ("top", "front")])
        buffer = TransformBuffer()
        buffer.insert_static(Transform("odom", "r1/lidar", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
        counts = {}
        for name, sensor in source.clouds.items():
            sensor.settle(buffer, "odom")
            counts[name.name] = [len(cloud) for cloud in sensor.within(0)]
        assert counts == {"top": [20], "front": [500]}


def test_cloud_with_impossible_times_is_refused():
    points = np.zeros(1, [*((name, "<f4") for name in "xyz"), ("timestamp", "<f8")])
    points["timestamp"] = 1e300
    message = cloud_to_message(Cloud(5 * MS, "lidar", points), is_dense=True)
    with WorldSource(None) as source:
        source._on_clouds([Received("r1", "zstate/r1/cloud/top", message)])
        assert (dict(source.clouds), source.refused) == ({}, {"malformed cloud": 1})


def test_calibration_of_a_camera_replaces_the_one_before_and_is_withdrawn():
    key = "zstate/r1/camera_info/wrist"

    def receive(source: WorldSource, width: int) -> None:
        camera = Camera(width, 48, (60.0, 60.0, 31.5, 23.5))
        source._on_cameras([Received("r1", key, camera_to_message(camera, 1))])

    with WorldSource(None) as source:
        receive(source, 64)
        receive(source, 80)
        assert source.cameras_at()[WriterName("r1", "wrist")].width == 80
        source._on_camera_withdrawn(key)
        assert source.cameras_at() == {}
