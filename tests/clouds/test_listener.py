"""CloudListener: clouds over the network, placed point by point."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest
from helpers.processes import repeated, until

from zstate.buffer.buffer import TransformBuffer
from zstate.clouds import CloudListener, CloudPublisher, PlacedCloud
from zstate.errors import InvalidInput
from zstate.nodes.transform_publisher import TransformPublisher
from zstate.transform import Transform

MS = 1_000_000
POINTS = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
TIMES = [2 * MS, 3 * MS, 4 * MS]


def pose_at(stamp: int, prefix: str = "") -> Transform:
    """A lidar that drives along x with 1 m a millisecond, without turning."""
    return Transform(f"{prefix}odom", f"{prefix}lidar", (stamp / MS, 0.0, 0.0), (0, 0, 0, 1), stamp=stamp)


def buffer_until(end: int, begin: int = 0) -> TransformBuffer:
    """A buffer with the poses of r1's lidar from ``begin`` to ``end``."""
    buffer = TransformBuffer(history_s=3600.0)
    for stamp in (begin, end):
        buffer.insert(pose_at(stamp, "r1/"))
    return buffer


def publish_one(sessions, clouds: CloudListener, *args: object, **options: object) -> PlacedCloud:
    with CloudPublisher(sessions[0], "r1", "lidar") as publisher:
        until(lambda: publisher.publish(*args, **options) or len(clouds))
    return next(iter(clouds))


def test_each_point_is_placed_by_the_pose_at_its_own_stamp(sessions):
    with CloudListener(sessions[1], "r1", "odom", buffer=buffer_until(10 * MS)) as clouds:
        placed = publish_one(sessions, clouds, POINTS, times=TIMES)
    assert np.allclose(placed.xyz, [[3.0, 0.0, 0.0], [3.0, 1.0, 0.0], [4.0, 0.0, 1.0]], atol=1e-6)
    assert placed.valid.all()
    assert (placed.stamp, placed.target, placed.is_rigid) == (2 * MS, "r1/odom", False)


def test_points_without_times_are_placed_rigidly_and_marked(sessions):
    with CloudListener(sessions[1], "r1", "odom", buffer=buffer_until(10 * MS)) as clouds:
        placed = publish_one(sessions, clouds, POINTS, 2 * MS)
    assert np.allclose(placed.xyz, [[3.0, 0.0, 0.0], [2.0, 1.0, 0.0], [2.0, 0.0, 1.0]], atol=1e-6)
    assert placed.is_rigid


def test_points_before_the_history_and_those_that_are_none_are_not_valid(sessions):
    points = np.array(POINTS)
    points[2] = np.nan
    with CloudListener(sessions[1], "r1", "odom", buffer=buffer_until(10 * MS, begin=3 * MS)) as clouds:
        placed = publish_one(sessions, clouds, points, times=TIMES)
    assert placed.valid.tolist() == [False, True, False]
    assert np.isnan(placed.xyz[~placed.valid]).all()


def test_a_cloud_waits_for_the_pose_of_its_last_point(sessions):
    buffer = buffer_until(3 * MS)
    with (
        CloudListener(sessions[1], "r1", "odom", buffer=buffer, timeout_s=60.0) as clouds,
        CloudPublisher(sessions[0], "r1", "lidar") as publisher,
    ):
        until(lambda: publisher.publish(POINTS, times=TIMES) or len(buffer._waiters))
        assert len(clouds) == 0
        buffer.insert(pose_at(4 * MS, "r1/"))
        assert np.allclose(next(iter(clouds)).xyz[2], [4.0, 0.0, 1.0], atol=1e-6)


def test_a_cloud_whose_pose_does_not_come_is_dropped_with_the_limiting_edge(sessions):
    with CloudListener(sessions[1], "r1", "odom", buffer=buffer_until(3 * MS), timeout_s=0.0) as clouds:
        with CloudPublisher(sessions[0], "r1", "lidar") as publisher:
            until(lambda: publisher.publish(POINTS, times=TIMES) or clouds.dropped)
        assert set(clouds.dropped) == {"InFuture"}
        assert "r1/odom" in str(clouds.last_reason)


def test_without_a_target_clouds_stay_in_their_frame_and_need_no_transforms(sessions):
    with CloudListener(sessions[1], "r1") as clouds:
        placed = publish_one(sessions, clouds, POINTS, times=TIMES)
        assert clouds.buffer is None
    assert placed.xyz.tolist() == POINTS
    assert placed.target == "r1/lidar"


def test_large_clouds_that_are_unread_are_lost_by_their_bytes(sessions):
    points = np.zeros((400_000, 3), np.float32)
    with CloudListener(sessions[1], "r1") as clouds, CloudPublisher(sessions[0], "r1", "lidar") as publisher:
        with repeated(lambda: publisher.publish(points, 1)):
            until(lambda: clouds.dropped)
        assert set(clouds.dropped) == {"Overflow"}
        # 12 bytes of a point, its place, which shares them, and a flag
        assert len(clouds) == 256 * 2**20 // (400_000 * (12 + 12 + 1))


def test_transforms_come_from_the_network_without_a_buffer(sessions):
    with (
        CloudListener(sessions[1], "r1", "odom", timeout_s=60.0) as clouds,
        TransformPublisher(sessions[0], "r1", "odometry") as odometry,
    ):
        for stamp in range(0, 12 * MS, MS):
            odometry.publish([pose_at(stamp)])
        placed = publish_one(sessions, clouds, POINTS, times=TIMES)
    assert np.allclose(placed.xyz[0], [3.0, 0.0, 0.0], atol=1e-6)


def test_one_sensor_can_be_selected(sessions):
    with CloudListener(sessions[1], "r1", sensor="rear") as clouds:
        with (
            CloudPublisher(sessions[0], "r1", "front") as front,
            CloudPublisher(sessions[0], "r1", "rear") as rear,
        ):
            until(lambda: (front.publish(POINTS, 1), rear.publish(POINTS, 1)) and len(clouds) > 1)
        clouds.close()
        assert {placed.sensor for placed in clouds} == {"rear"}


def test_a_message_that_is_no_cloud_is_counted_and_the_next_one_arrives(sessions):
    with CloudListener(sessions[1], "r1") as clouds:
        until(lambda: sessions[0].zenoh.put("zstate/r1/cloud/lidar", b"\xff") or clouds.refused)
        publish_one(sessions, clouds, POINTS, 2 * MS)
        assert len(clouds.refused) == 1


def test_times_that_no_point_can_have_are_counted_as_malformed(sessions):
    points = np.zeros(3, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("timestamp", "f8")])
    points["timestamp"] = 1e300
    with CloudListener(sessions[1], "r1") as clouds, CloudPublisher(sessions[0], "r1", "lidar") as publisher:
        until(lambda: publisher.publish(points, 1) or clouds.refused)
        assert list(clouds.refused) == ["malformed"]


def test_asynchronous_iteration_returns_the_clouds(sessions):
    async def first(clouds: CloudListener) -> PlacedCloud:
        async for placed in clouds:
            return placed
        raise AssertionError("the iteration ended without a cloud")

    with CloudListener(sessions[1], "r1") as clouds:
        with CloudPublisher(sessions[0], "r1", "lidar") as publisher:
            until(lambda: publisher.publish(POINTS, 1) or len(clouds))
        assert asyncio.run(first(clouds)).xyz.tolist() == POINTS


def test_wrong_arguments_are_refused_at_once(sessions):
    with pytest.raises(InvalidInput, match="timeout_s"):
        CloudListener(sessions[1], "r1", timeout_s=-1.0)
    with pytest.raises(InvalidInput, match="robot"):
        CloudListener(sessions[1], "a/b", "odom")


@pytest.mark.parametrize("wire", ["ros2dds", "ros2dds:namespace=*"])
def test_clouds_behind_a_ros2dds_bridge_need_the_name_of_their_topic(sessions, wire: str):
    with pytest.raises(InvalidInput, match="pass it: sensor='velodyne_points'"):
        CloudListener(sessions[1], "r1", wire=wire)
