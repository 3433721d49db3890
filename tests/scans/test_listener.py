"""ScanListener: scans over the network, placed ray by ray."""

from __future__ import annotations

import asyncio
import math
import threading

import numpy as np
import pytest
from helpers.processes import until

from zstate.buffer.buffer import TransformBuffer
from zstate.errors import InvalidInput
from zstate.net.session import Session
from zstate.net.subscription import Received, subscribe
from zstate.nodes.transform_publisher import TransformPublisher
from zstate.scans import PlacedScan, Scan, ScanListener, ScanPublisher
from zstate.scans.messages import SCAN_RAYS
from zstate.transform import Transform
from zstate.wire.registry import get_wire

MS = 1_000_000
GEOMETRY = {"angle_min": 0.0, "angle_increment": math.pi / 2, "range_min": 0.1, "range_max": 10.0}


def pose_at(stamp: int, prefix: str = "") -> Transform:
    """A laser that drives along x with 1 m a millisecond, without turning."""
    return Transform(f"{prefix}odom", f"{prefix}laser", (stamp / MS, 0.0, 0.0), (0, 0, 0, 1), stamp=stamp)


def buffer_until(end: int, begin: int = 0) -> TransformBuffer:
    """A buffer with the poses of r1's laser from ``begin`` to ``end``."""
    buffer = TransformBuffer(history_s=3600.0)
    for stamp in (begin, end):
        buffer.insert(pose_at(stamp, "r1/"))
    return buffer


def publish_one(writer: Session, scans: ScanListener, *args: object, **options: object) -> PlacedScan:
    """Publishes until the listener returns a scan: none is kept for late readers."""
    with ScanPublisher(writer, "r1", "laser", **{**GEOMETRY, **options}) as publisher:
        until(lambda: publisher.publish(*args) or len(scans) > 0)
    return next(iter(scans))


def test_each_ray_is_placed_by_the_pose_at_its_own_stamp(sessions):
    writer, reader = sessions
    with ScanListener(reader, "r1", "odom", buffer=buffer_until(10 * MS)) as scans:
        placed = publish_one(writer, scans, [1.0, 1.0, 1.0], 2 * MS, ray_ns=MS)
    # Along x, y and -x, from laser positions of 2, 3 and 4 m.
    assert np.allclose(placed.points, [[3.0, 0.0, 0.0], [3.0, 1.0, 0.0], [3.0, 0.0, 0.0]], atol=1e-6)
    assert placed.valid.all()
    assert not placed.is_rigid
    assert (placed.stamp, placed.sensor, placed.scan.frame) == (2 * MS, "laser", "r1/laser")


def test_bare_target_is_a_frame_of_the_robot_among_others(sessions):
    writer, reader = sessions
    buffer = buffer_until(10 * MS)
    buffer.insert(pose_at(10 * MS, "r2/"))
    with ScanListener(reader, "r1", "odom", buffer=buffer, timeout_s=0.0) as scans:
        with ScanPublisher(writer, "r1", "laser", **GEOMETRY) as publisher:
            until(lambda: publisher.publish([1.0], 2 * MS) or len(scans) or scans.dropped)
        assert not scans.dropped
        assert next(iter(scans)).target == "r1/odom"


def test_rays_without_times_are_placed_rigidly_and_marked(sessions):
    writer, reader = sessions
    with ScanListener(reader, "r1", "odom", buffer=buffer_until(10 * MS)) as scans:
        placed = publish_one(writer, scans, [1.0, 1.0], 2 * MS)
    assert np.allclose(placed.points, [[3.0, 0.0, 0.0], [2.0, 1.0, 0.0]], atol=1e-6)
    assert placed.is_rigid


def test_rays_without_a_measurement_are_nan_and_the_others_keep_their_places(sessions):
    writer, reader = sessions
    with ScanListener(reader, "r1", "odom", buffer=buffer_until(10 * MS)) as scans:
        placed = publish_one(writer, scans, [math.inf, 1.0, math.nan, 0.01], 2 * MS)
    assert placed.valid.tolist() == [False, True, False, False]
    assert np.isnan(placed.points[~placed.valid]).all()
    assert np.allclose(placed.points[1], [2.0, 1.0, 0.0], atol=1e-6)


def test_rays_before_the_history_are_not_valid(sessions):
    writer, reader = sessions
    with ScanListener(reader, "r1", "odom", buffer=buffer_until(10 * MS, begin=3 * MS)) as scans:
        placed = publish_one(writer, scans, [1.0, 1.0, 1.0], 2 * MS, ray_ns=MS)
    assert placed.valid.tolist() == [False, True, True]


def test_scan_waits_for_the_pose_of_its_last_ray(sessions):
    writer, reader = sessions
    buffer = buffer_until(3 * MS)
    with (
        ScanListener(reader, "r1", "odom", buffer=buffer, timeout_s=60.0) as scans,
        ScanPublisher(writer, "r1", "laser", ray_ns=MS, **GEOMETRY) as publisher,
    ):
        until(lambda: publisher.publish([1.0, 1.0, 1.0], 2 * MS) or len(buffer._waiters))
        assert len(scans) == 0
        buffer.insert(pose_at(4 * MS, "r1/"))
        placed = next(iter(scans))
    assert np.allclose(placed.points[2], [3.0, 0.0, 0.0], atol=1e-6)


def test_scan_whose_pose_does_not_come_is_dropped_with_the_limiting_edge(sessions):
    writer, reader = sessions
    with ScanListener(reader, "r1", "odom", buffer=buffer_until(3 * MS), timeout_s=0.0) as scans:
        with ScanPublisher(writer, "r1", "laser", **GEOMETRY) as publisher:
            until(lambda: publisher.publish([1.0], 5 * MS) or scans.dropped)
        assert set(scans.dropped) == {"InFuture"}
        assert "r1/odom" in str(scans.last_reason)
        assert len(scans) == 0


@pytest.mark.parametrize("stamp", [2 * MS, 5 * MS], ids=["unread", "waiting"])
def test_scans_lost_for_newer_ones_are_counted(sessions, stamp: int):
    writer, reader = sessions
    kept = 256 if stamp < 3 * MS else 0
    with ScanListener(reader, "r1", "odom", buffer=buffer_until(3 * MS), timeout_s=60.0) as scans:
        with ScanPublisher(writer, "r1", "laser", **GEOMETRY) as publisher:
            # A burst may already be lost while it waits for a pose.
            until(
                lambda: (
                    [publisher.publish([1.0], stamp) for _ in range(50)]
                    and scans.dropped
                    and len(scans) == kept
                )
            )
        assert set(scans.dropped) == {"Overflow"}


@pytest.mark.parametrize(
    ("stamp", "limit"), [(2 * MS, 64 * 2**20), (5 * MS, 16 * 2**20)], ids=["unread", "waiting"]
)
def test_fewer_large_scans_are_kept_for_their_bytes(sessions, stamp: int, limit: int):
    writer, reader = sessions
    geometry = {**GEOMETRY, "angle_increment": math.tau / SCAN_RAYS}
    ranges = np.ones(SCAN_RAYS, dtype=np.float32)
    # As they wait, each ray has a range; unread ones have a point and a flag as well.
    kept = limit // (SCAN_RAYS * (4 if stamp > 3 * MS else 4 + 3 * 4 + 1))
    arrived: list[Received] = []
    with (
        subscribe(reader, get_wire("native"), "r1", "scan", arrived.extend),
        ScanListener(reader, "r1", "odom", buffer=buffer_until(3 * MS), timeout_s=60.0) as scans,
        ScanPublisher(writer, "r1", "laser", **geometry) as publisher,
    ):
        until(lambda: publisher.publish(ranges, stamp) or scans.dropped)
        assert set(scans.dropped) == {"Overflow"}
        # One more is in the hands of the thread that waits for its pose.
        until(lambda: scans.dropped["Overflow"] == len(arrived) - kept - (stamp > 3 * MS))
        assert len(scans) == (kept if stamp < 3 * MS else 0)


def test_scan_that_is_late_does_not_delay_another_sensor(sessions):
    writer, reader = sessions
    with ScanListener(reader, "r1", "odom", buffer=buffer_until(3 * MS), timeout_s=60.0) as scans:
        with (
            ScanPublisher(writer, "r1", "waiting", frame="laser", **GEOMETRY) as waiting,
            ScanPublisher(writer, "r1", "sound", frame="laser", **GEOMETRY) as sound,
        ):
            until(lambda: waiting.publish([1.0], 5 * MS) or len(scans.buffer._waiters))
            until(lambda: sound.publish([1.0], 2 * MS) or len(scans) > 0)
        assert next(iter(scans)).sensor == "sound"


def test_one_sensor_can_be_selected(sessions):
    writer, reader = sessions
    with ScanListener(reader, "r1", "odom", sensor="rear", buffer=buffer_until(3 * MS)) as scans:
        with (
            ScanPublisher(writer, "r1", "front", frame="laser", **GEOMETRY) as front,
            ScanPublisher(writer, "r1", "rear", frame="laser", **GEOMETRY) as rear,
        ):
            until(lambda: (front.publish([1.0], MS), rear.publish([1.0], MS)) and len(scans) > 1)
        scans.close()
        assert {placed.sensor for placed in scans} == {"rear"}


def test_transforms_come_from_the_network_without_a_buffer(sessions):
    writer, reader = sessions
    with (
        ScanListener(reader, "r1", "odom", timeout_s=60.0) as scans,
        TransformPublisher(writer, "r1", "odometry") as odometry,
    ):
        for stamp in range(0, 12 * MS, MS):
            odometry.publish([pose_at(stamp)])
        placed = publish_one(writer, scans, [1.0, 1.0], 2 * MS, ray_ns=MS)
    assert np.allclose(placed.points, [[3.0, 0.0, 0.0], [3.0, 1.0, 0.0]], atol=1e-6)


def test_scans_of_ros_are_placed_as_well(sessions):
    writer, reader = sessions
    with ScanListener(reader, "r1", "odom", wire="ros2", buffer=buffer_until(10 * MS)) as scans:
        with ScanPublisher(writer, "r1", "scan", "ros2", frame="laser", ray_ns=MS, **GEOMETRY) as publisher:
            until(lambda: publisher.publish([1.0, 1.0], 2 * MS) or len(scans) > 0)
        placed = next(iter(scans))
    assert np.allclose(placed.points, [[3.0, 0.0, 0.0], [3.0, 1.0, 0.0]], atol=1e-6)


def test_asynchronous_iteration_returns_the_scans(sessions):
    writer, reader = sessions

    async def first(scans: ScanListener) -> PlacedScan:
        async for placed in scans:
            return placed
        raise AssertionError("the iteration ended without a scan")

    with ScanListener(reader, "r1", "odom", buffer=buffer_until(10 * MS)) as scans:
        with ScanPublisher(writer, "r1", "laser", **GEOMETRY) as publisher:
            until(lambda: publisher.publish([1.0], MS) or len(scans) > 0)
        assert asyncio.run(first(scans)).scan.ranges.tolist() == [1.0]


def test_message_that_is_no_scan_is_counted_and_the_next_one_arrives(sessions):
    writer, reader = sessions
    with ScanListener(reader, "r1", "odom", buffer=buffer_until(10 * MS)) as scans:
        until(lambda: writer.zenoh.put("zstate/r1/scan/laser", b"\xff") or scans.refused)
        placed = publish_one(writer, scans, [1.0], 2 * MS)
        assert isinstance(placed.scan, Scan)
        assert len(scans.refused) == 1


def test_wrong_arguments_are_refused_at_once(sessions):
    with pytest.raises(InvalidInput, match="timeout_s"):
        ScanListener(sessions[1], "r1", "odom", timeout_s=-1.0)
    with pytest.raises(InvalidInput, match="robot"):
        ScanListener(sessions[1], "a/b", "odom")


def is_placing(sensor: str) -> bool:
    return any(thread.name == f"zstate scans of {sensor}" for thread in threading.enumerate())


def test_thread_of_a_sensor_outlives_the_session_and_ends_with_the_listener(sessions, monkeypatch):
    writer, reader = sessions
    failures: list[object] = []
    monkeypatch.setattr(threading, "excepthook", failures.append)
    buffer = buffer_until(3 * MS)
    with ScanListener(reader, "r1", "odom", buffer=buffer, timeout_s=60.0) as scans:
        with ScanPublisher(writer, "r1", "outliving", frame="laser", **GEOMETRY) as publisher:
            until(lambda: publisher.publish([1.0], 5 * MS) or len(buffer._waiters))
        reader.close()
        buffer.insert(pose_at(5 * MS, "r1/"))
        until(lambda: len(scans) > 0)
        assert is_placing("outliving")
    until(lambda: not is_placing("outliving"))
    assert not failures


def test_scan_that_waits_for_its_pose_ends_with_the_listener(sessions):
    writer, reader = sessions
    buffer = buffer_until(3 * MS)
    with (
        ScanListener(reader, "r1", "odom", buffer=buffer, timeout_s=3600.0) as scans,
        ScanPublisher(writer, "r1", "waiting_long", frame="laser", **GEOMETRY) as publisher,
    ):
        until(lambda: publisher.publish([1.0], 5 * MS) or len(buffer._waiters))
    until(lambda: not is_placing("waiting_long"))
    assert len(scans) == 0
    assert not scans.dropped
