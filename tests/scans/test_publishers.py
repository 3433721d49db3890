"""Publishers of scans and maps, read back from the network by plain subscriptions."""

from __future__ import annotations

import threading
from functools import cache
from typing import Any

import numpy as np
import pytest
from helpers.processes import Child, until
from helpers.tokens import current_tokens
from numpy.typing import NDArray

from zstate import connect
from zstate.clock import ManualClock
from zstate.errors import Closed, InvalidInput, SecondWriter
from zstate.net.subscription import Received, subscribe
from zstate.scans import Grid, MapPublisher, Scan, ScanPublisher
from zstate.scans.grid import grid_from_message
from zstate.scans.messages import SCAN_RAYS, LaserScan, OccupancyGrid
from zstate.scans.scan import scan_from_message
from zstate.wire.keys import WRITER_TOKEN
from zstate.wire.registry import get_wire

GEOMETRY = {"angle_min": -1.0, "angle_increment": 0.5, "range_min": 0.1, "range_max": 10.0}
ROOM = Grid([[0, 100], [-1, 50]], 0.5, (1.0, 2.0, 0.3))

LARGE_MAP_WITHIN_S = 60.0
"""A busy machine deflates, encodes and routes it in seconds."""

PUBLISH_LARGE_MAP = """
    import sys
    import numpy as np
    from zstate import connect
    from zstate.scans import Grid, MapPublisher
    cells = np.random.default_rng(1).integers(-1, 101, (4000, 4000), dtype=np.int8)
    with connect(**eval(sys.argv[2])) as session:
        with MapPublisher(session, "hall", Grid(cells, 0.05, (0, 0, 0)), sys.argv[1]):
            sys.stdin.readline()
"""
ROUTE = """
    import sys
    from zstate import connect
    with connect(mode="router", listen=sys.argv[1]):
        print("ready")
        sys.stdin.readline()
"""


@cache
def large_cells() -> NDArray[np.int8]:
    """Deflated they take 13.5 MB, in CDR 16 MB: sockets and Zenoh's queues hold about 4."""
    return np.random.default_rng(1).integers(-1, 101, (4000, 4000), dtype=np.int8)


class Scans(list[Scan]):
    """The scans of r1, as they arrive."""

    def __init__(self, session, wire: str = "native") -> None:
        self._subscriber = subscribe(session, get_wire(wire), "r1", "scan", self._on_messages)

    def _on_messages(self, received: list[Received]) -> None:
        for robot, _, message in received:
            assert isinstance(message, LaserScan)
            self.append(scan_from_message(message, robot))


class Maps(dict[str, Grid]):
    """The maps by key."""

    def __init__(self, session, wire: str = "native") -> None:
        self._subscriber = subscribe(
            session, get_wire(wire), "hall", "map", self._on_messages, on_withdrawn=self.pop
        )

    def _on_messages(self, received: list[Received]) -> None:
        for robot, key, message in received:
            assert isinstance(message, OccupancyGrid)
            self[key] = grid_from_message(message, robot)

    def receive_large_one(self) -> None:
        until(lambda: self, LARGE_MAP_WITHIN_S)
        (grid,) = self.values()
        assert np.array_equal(grid.cells, large_cells())


def publish_until_received(publisher: ScanPublisher, scans: Scans, ranges, **options) -> Scan:
    """Scans are not kept for late readers: publishes until the first has arrived."""
    until(lambda: publisher.publish(ranges, **options) or scans)
    return scans[0]


@pytest.mark.parametrize("wire", ["native", "ros2"])
def test_scan_arrives_as_it_was_published(sessions, wire: str):
    writer, reader = sessions
    scans = Scans(reader, wire)
    with ScanPublisher(writer, "r1", "front", wire, ray_ns=1000, frame="laser", **GEOMETRY) as publisher:
        scan = publish_until_received(publisher, scans, [1.0, np.inf, np.nan], stamp=5, intensities=[1, 2, 3])
    assert (scan.stamp, scan.ray_ns, scan.frame) == (5, 1000, "r1/laser")
    assert np.allclose((scan.angle_min, scan.angle_increment), (-1.0, 0.5))
    assert np.array_equal(scan.ranges, np.float32([1.0, np.inf, np.nan]), equal_nan=True)
    assert scan.intensities is not None
    assert scan.intensities.tolist() == [1.0, 2.0, 3.0]


def test_frame_of_a_sensor_has_its_name_by_default(sessions):
    writer, reader = sessions
    scans = Scans(reader)
    with ScanPublisher(writer, "r1", "front", **GEOMETRY) as publisher:
        assert publish_until_received(publisher, scans, [1.0], stamp=5).frame == "r1/front"


def test_scan_without_a_stamp_ends_now(sessions):
    writer, reader = sessions
    clock = ManualClock(1_000_000)
    scans = Scans(reader)
    with ScanPublisher(writer, "r1", "front", ray_ns=100, clock=clock, **GEOMETRY) as publisher:
        scan = publish_until_received(publisher, scans, [1.0, 1.0, 1.0])
    assert scan.end_stamp == 1_000_000
    assert scan.stamp == 999_800


def test_run_publishes_sweeps_that_end_at_their_ticks_and_leaves_out_none(sessions):
    writer, reader = sessions
    ticks: list[int] = []

    class Lidar:
        def read(self, stamp: int) -> list[float] | None:
            ticks.append(stamp)
            return None if len(ticks) % 2 else [1.0, 2.0]

    scans = Scans(reader)
    with ScanPublisher(writer, "r1", "front", ray_ns=100, **GEOMETRY) as publisher:
        publish_until_received(publisher, scans, [1.0, 2.0], stamp=0)
        scans.clear()
        thread = threading.Thread(target=publisher.run, args=(Lidar(), 100.0))
        thread.start()
        until(lambda: len(scans) >= 3)
    thread.join(10.0)
    ends = [scan.end_stamp for scan in scans if scan.stamp]
    assert ends == [tick for tick in ticks[1::2] if tick in set(ends)]


def test_run_keeps_the_stamp_of_a_scan(sessions):
    writer, reader = sessions
    scans = Scans(reader)

    class Lidar:
        scan = Scan(777, -1.0, 0.5, 100, [1.0, 2.0], 0.1, 10.0, "front")

        def read(self, _: int) -> Scan:
            return self.scan

    lidar = Lidar()
    with ScanPublisher(writer, "r1", "front", ray_ns=100, **GEOMETRY) as publisher:
        publish_until_received(publisher, scans, [1.0, 2.0], stamp=0)
        scans.clear()
        publisher.run(lidar, 100.0, seconds=0.05)
        until(lambda: scans)
        assert {scan.stamp for scan in scans} <= {0, 777}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"angle_increment": 0.25}, "has angle_increment=0.5; its source returned.* angle_increment=0.25"),
        ({"ray_ns": 50}, "has ray_ns=100; .* ray_ns=50"),
        ({"range_max": 5.0}, "has range_max=10.0; .* range_max=5.0"),
        ({"frame": "rear"}, "has frame='r1/front'; .* frame='r1/rear'"),
    ],
)
def test_run_refuses_a_scan_of_another_geometry_or_frame(sessions, changes: dict[str, Any], message: str):
    class Lidar:
        def read(self, stamp: int) -> Scan:
            own = {**GEOMETRY, "ray_ns": 100, "frame": "r1/front"}
            return Scan(stamp, ranges=[1.0, 2.0], **{**own, **changes})

    with ScanPublisher(sessions[0], "r1", "front", ray_ns=100, **GEOMETRY) as publisher:
        with pytest.raises(InvalidInput, match=message):
            publisher.run(Lidar(), 100.0, seconds=0.05)
        assert publisher.stats.sent == 0


def test_scan_that_is_none_is_refused_and_counted_and_nothing_is_sent(sessions):
    writer, _ = sessions
    with ScanPublisher(writer, "r1", "front", **GEOMETRY) as publisher:
        with pytest.raises(InvalidInput, match="flat array"):
            publisher.publish([[1.0]])
        with pytest.raises(InvalidInput, match="empty"):
            publisher.publish([])
        with pytest.raises(InvalidInput, match="one intensity for each ray"):
            publisher.publish([1.0, 2.0], intensities=[1.0])
        assert publisher.stats.sent == 0
        assert publisher.stats.refused == 3


@pytest.mark.parametrize("wire", ["native", "ros2"])
def test_scan_of_the_largest_size_arrives_and_a_larger_one_is_refused(sessions, wire: str):
    writer, reader = sessions
    scans = Scans(reader, wire)
    geometry = {**GEOMETRY, "angle_increment": 1e-5}
    rays = np.ones(SCAN_RAYS, dtype=np.float32)
    with ScanPublisher(writer, "r1", "front", wire, frame="f" * 500, **geometry) as publisher:
        scan = publish_until_received(publisher, scans, rays, intensities=rays)
        with pytest.raises(InvalidInput, match="100001 rays, where 100000 are allowed"):
            publisher.publish(np.ones(SCAN_RAYS + 1, dtype=np.float32))
    assert len(scan.ranges) == SCAN_RAYS


def test_wrong_geometry_is_refused_when_the_publisher_opens(sessions):
    with pytest.raises(InvalidInput, match="angle_increment is 0"):
        ScanPublisher(sessions[0], "r1", "front", **{**GEOMETRY, "angle_increment": 0.0})
    with pytest.raises(InvalidInput, match="range_min <= range_max"):
        ScanPublisher(sessions[0], "r1", "front", **{**GEOMETRY, "range_min": 11.0})


def test_second_writer_of_a_sensor_is_refused_with_the_name_of_the_first(sessions):
    writer, other = sessions
    with ScanPublisher(writer, "r1", "front", program="first", **GEOMETRY):
        until(lambda: current_tokens(other, WRITER_TOKEN.expression("r1"), 1.0))
        with pytest.raises(SecondWriter, match="first"):
            ScanPublisher(other, "r1", "front", **GEOMETRY)
        with ScanPublisher(other, "r1", "rear", **GEOMETRY):
            pass


def test_publish_after_close_raises_closed(sessions):
    with ScanPublisher(sessions[0], "r1", "front", **GEOMETRY) as publisher:
        pass
    with pytest.raises(Closed, match="front"):
        publisher.publish([1.0])


@pytest.mark.parametrize("wire", ["native", "ros2"])
def test_late_reader_receives_the_map(sessions, wire: str):
    writer, reader = sessions
    with MapPublisher(writer, "hall", ROOM, wire):
        maps = Maps(reader, wire)
        until(lambda: maps)
        (grid,) = maps.values()
    assert grid.frame == "hall/map"
    assert np.array_equal(grid.cells, ROOM.cells)
    assert np.isclose(grid.resolution, ROOM.resolution)
    assert np.allclose(grid.origin.pose7, ROOM.origin.pose7)


def test_map_is_replaced_and_then_withdrawn(sessions):
    writer, reader = sessions
    maps = Maps(reader)
    with MapPublisher(writer, "hall", ROOM, frame="floor") as publisher:
        until(lambda: maps)
        assert maps["zstate/hall/map/map"].frame == "hall/floor"
        publisher.set(Grid([[100]], 1.0, (0.0, 0.0, 0.0)))
        until(lambda: maps["zstate/hall/map/map"].cells.shape == (1, 1))
    until(lambda: not maps)
    with pytest.raises(Closed):
        publisher.set(ROOM)


def test_map_of_4096_x_4096_cells_arrives(sessions):
    writer, reader = sessions
    cells = np.zeros((4096, 4096), dtype=np.int8)
    cells[::7, ::3] = 100
    with MapPublisher(writer, "hall", Grid(cells, 0.05, (0, 0, 0)), frame="f" * 500):
        maps = Maps(reader)
        until(lambda: maps)
        (grid,) = maps.values()
        assert np.array_equal(grid.cells, cells)


def receive_late(wire: str, **options: Any) -> None:
    """Several times: a link that is stalled goes on if another one receives anything."""
    for _ in range(4):
        with connect(**options) as session:
            Maps(session, wire).receive_large_one()


@pytest.mark.parametrize("wire", ["native", "ros2"])
@pytest.mark.long
def test_large_map_reaches_early_and_late_readers_in_its_process(sessions, wire: str):
    writer, reader = sessions
    early = Maps(reader, wire)
    with MapPublisher(writer, "hall", Grid(large_cells(), 0.05, (0, 0, 0)), wire):
        early.receive_large_one()
        receive_late(wire)


@pytest.mark.processes
@pytest.mark.parametrize("wire", ["native", "ros2"])
def test_large_map_reaches_early_and_late_readers_in_another_process(spawn, wire: str):
    with connect() as reader:
        early = Maps(reader, wire)
        spawn(PUBLISH_LARGE_MAP, wire, "{}")
        early.receive_large_one()
        receive_late(wire)


@pytest.mark.processes
@pytest.mark.long
@pytest.mark.parametrize("wire", ["native", "ros2"])
def test_large_map_reaches_early_and_late_readers_through_a_router(spawn, free_port: int, wire: str):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    options = {"mode": "client", "endpoints": endpoint}
    router: Child = spawn(ROUTE, endpoint)
    assert router.line() == "ready"
    with connect(**options) as reader:
        early = Maps(reader, wire)
        spawn(PUBLISH_LARGE_MAP, wire, repr(options))
        early.receive_large_one()
        receive_late(wire, **options)


def test_second_writer_of_a_map_is_refused(sessions):
    writer, other = sessions
    with MapPublisher(writer, "hall", ROOM, program="first"):
        until(lambda: current_tokens(other, WRITER_TOKEN.expression("hall"), 1.0))
        with pytest.raises(SecondWriter, match="first"):
            MapPublisher(other, "hall", ROOM)
        with MapPublisher(other, "hall", ROOM, writer="cellar"):
            pass
