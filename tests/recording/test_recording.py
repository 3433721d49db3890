"""Questions to a recorded file: what it is, a buffer of it, and many instants without holding it all."""

from __future__ import annotations

import math
import random
from pathlib import Path

import numpy as np
import pytest
from helpers.processes import Child
from helpers.recording_builder import (
    MS,
    START,
    Bag,
    RecordingBuilder,
    S,
    pose,
    swing_positions,
    swing_velocities,
)
from helpers.recording_files import STORE
from rosbags.rosbag2 import StoragePlugin

from zstate import Recording, UnknownFrame
from zstate.errors import Disconnected, InPast, InvalidInput
from zstate.odometry.messages import Fix, Imu, Pose
from zstate.recording.errors import RecordingError
from zstate.scans.messages import LaserScan, OccupancyGrid
from zstate.transform import Transform
from zstate.wire.joint_order import SampleLayout
from zstate.wire.measurements import to_float32_block
from zstate.wire.messages import to_block
from zstate.wire.ros2.encoder import RosStreamEncoder
from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.topics import FrameNames
from zstate.wire.ros2.types import IMU, LASER_SCAN, NAV_SAT_FIX, OCCUPANCY_GRID, POSE_WITH_COVARIANCE


def test_repr_has_duration_and_robots(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap") as builder:
        builder.describe("r1")
        builder.joints("r1", START + S, swing_positions(0), log_time=START + 2 * S)
        builder.describe("r2", at=START + 3 * S)
    with Recording(tmp_path / "r.mcap") as recording:
        assert recording.robots == ("r1", "r2")
        assert recording.info.duration_s == 3.0
        assert recording.info.complete


def test_unknown_robot_is_refused(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap") as builder:
        builder.describe("r1")
    with pytest.raises(InvalidInput, match="'r1'"):
        Recording(tmp_path / "r.mcap", "r2")


def test_closed_recording_raises(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
    recording = Recording(tmp_path / "r.mcap")
    recording.close()
    recording.close()
    with pytest.raises(RecordingError, match="closed"):
        recording.buffer()


def wild(path: Path, seed: int) -> None:
    """Two writers after each other, late samples, repeated stamps, clocks set back, edges that move over."""
    dice = random.Random(seed)
    with RecordingBuilder(path, "arm") as builder:
        builder.describe("arm")
        offset = 0
        for n in range(600):
            log_time = START + n * 10 * MS
            if n == 150:
                offset = -3600 * S
            session = 1 + (n > 300)
            stamp = log_time + offset - dice.choice([0, 0, 0, 35 * MS, 70 * MS])
            builder.joints(
                "arm",
                stamp,
                swing_positions(dice.random()),
                swing_velocities(n),
                session=session,
                log_time=log_time,
            )
            if n % 3 == 0:
                world = pose(dice.random(), dice.random(), yaw=dice.random())
                builder.edges(
                    "arm", stamp, {("odom", "world"): world, ("map", "odom"): pose(n)}, log_time=log_time
                )
            if n % 50 == 7:
                builder.edges("arm", stamp, {("map", "odom"): pose(-n)}, log_time=log_time, session=5)
            if n in {20, 400}:
                builder.statics("arm", log_time, {("tool", "tip"): pose(z=n)})


@pytest.mark.parametrize("seed", range(4))
def test_lookup_many_equals_that_of_a_full_buffer(tmp_path: Path, seed: int, monkeypatch):
    monkeypatch.setattr("zstate.recording.recording._BATCH", 37)
    wild(tmp_path / "r.mcap", seed)
    dice = np.random.default_rng(seed)
    begin = START - 3600 * S
    with Recording(tmp_path / "r.mcap") as recording:
        buffer = recording.buffer()
        known = [buffer.latest("map", "tip"), buffer.latest("world", "tool")]
        stamps = np.concatenate((dice.integers(begin - S, begin + 7 * S, 30), known, [START, begin]))
        for target, source in [("map", "tip"), ("world", "tool"), ("odom", "map"), ("tool", "tip")]:
            poses, valid = buffer.lookup_many(target, source, stamps)
            assert valid.sum() > 5
            streamed_poses, streamed_valid = recording.lookup_many(target, source, stamps)
            assert np.array_equal(streamed_valid, valid)
            assert np.array_equal(streamed_poses, poses, equal_nan=True)


def test_points_are_placed_as_by_a_full_buffer(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("zstate.recording.recording._BATCH", 37)
    wild(tmp_path / "r.mcap", 2)
    dice = np.random.default_rng(2)
    with Recording(tmp_path / "r.mcap") as recording:
        buffer = recording.buffer()
        newest = buffer.latest("world", "tool")
        stamps = dice.integers(newest - S, newest + S // 10, 50)
        points = dice.uniform(-5.0, 5.0, (50, 3)).astype(np.float32)
        expected, known = buffer.place(points, stamps, source="tool", target="world")
        placed, valid = recording.place(points, stamps, source="tool", target="world")
        assert 5 < valid.sum() < 50
        assert np.array_equal(valid, known)
        assert np.array_equal(placed, expected, equal_nan=True)
        placed, valid = recording.place(points, newest, source="tool", target="world")
        assert valid.all()
        assert np.array_equal(placed, buffer.place(points, newest, source="tool", target="world")[0])


def test_lookup_many_of_no_stamps_is_empty(tmp_path: Path):
    wild(tmp_path / "r.mcap", 1)
    with Recording(tmp_path / "r.mcap") as recording:
        poses, valid = recording.lookup_many("map", "tip", [])
    assert (poses.shape, valid.shape) == ((0, 7), (0,))


def test_unknown_and_disconnected_frames_raise(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        builder.joints("arm", START, swing_positions(0))
        builder.statics("arm", START, {("table", "cup"): pose()})
    with Recording(tmp_path / "r.mcap") as recording:
        with pytest.raises(UnknownFrame, match="tol"):
            recording.lookup_many("world", "tol", [START])
        with pytest.raises(Disconnected):
            recording.lookup_many("world", "cup", [START])
        with pytest.raises(InvalidInput, match="integer"):
            recording.lookup_many("world", "tool", [0.5])
        with pytest.raises(UnknownFrame, match="tol"):
            recording.place([[0, 0, 0]], START, source="tol", target="world")
        with pytest.raises(InvalidInput, match="1 points have 2 stamps"):
            recording.place([[0, 0, 0]], [START, START], source="tool", target="world")


def test_edges_refused_live_are_refused_from_a_recording(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap") as builder:
        builder.statics("thief", START, {("thief/map", "arm/camera"): pose(x=9.0)})
        builder.statics("thief", START, {("arm/base", "arm/laser"): pose(x=9.0)}, writer="laser")
        builder.statics("arm", START + MS, {("lower", "world"): pose(x=9.0)}, writer="mix-up")
        builder.statics("arm", START + 2 * MS, {("tool", "camera"): pose(x=1.0)})
        builder.describe("arm", at=START + 3 * MS)
        builder.joints("arm", START + 4 * MS, swing_positions(0))
    with Recording(tmp_path / "r.mcap") as recording:
        buffer = recording.buffer()
    placed = {frame.name: frame.parent for frame in buffer.frames() if frame.parent is not None}
    assert placed["arm/camera"] == "arm/tool"
    assert not {"arm/world", "arm/laser"} & placed.keys()
    assert buffer.can_lookup("world", "camera")


def test_bag_is_a_recording(tmp_path: Path):
    with Bag(tmp_path / "bag") as bag:
        for n in range(20):
            bag.tf(START + n, [Transform("odom", "base", [n, 0, 0], [0, 0, 0, 1], START + n * S)])
    with Recording(tmp_path / "bag") as recording:
        poses, valid = recording.lookup_many("odom", "base", [START + 5 * S // 2, START - 1, START])
    assert poses[:, 0].tolist()[::2] == [2.5, 0.0]
    assert valid.tolist() == [True, False, True]


MEMORY = """
    import resource, sys
    import numpy as np
    from zstate import Recording
    def peak(): return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    small, large = sys.argv[1:]
    stamps = np.arange(1_700_000_000_000_000_000, 1_700_000_001_000_000_000, 1_000_000)
    for path in (small, large):
        with Recording(path) as recording:
            poses, valid = recording.lookup_many("odom", "base0", stamps)
            assert valid.all()
        print(peak())
"""


@pytest.mark.processes
@pytest.mark.long
def test_lookup_many_memory_does_not_grow_with_the_recording(tmp_path: Path, spawn):
    # 40 edges of 64 bytes: 6,000 samples would fill a buffer with 15 MB.
    sizes = {"small": 1_000, "large": 6_000}
    for name, count in sizes.items():
        with RecordingBuilder(tmp_path / name, "cart") as builder:
            for n in range(count):
                edges = {("odom", f"base{k}"): pose(n, k) for k in range(40)}
                builder.edges("cart", START + n * 10 * MS, edges)
    child: Child = spawn(MEMORY, str(tmp_path / "small"), str(tmp_path / "large"), is_forked=False)
    small, large = int(child.line(60)), int(child.line(60))
    assert large - small < 6, (small, large)


def test_lookup_before_the_recording_does_not_suggest_a_listener(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        for n in range(3):
            builder.joints("arm", START + n * S, swing_positions(n))
    with Recording(tmp_path / "r.mcap") as recording:
        buffer = recording.buffer()
    frames = [frame for frame in buffer.frames() if frame.kind == "joint"]
    plan = buffer.plan(frames[0].parent, frames[0].name)
    for call in (lambda: plan.at(START - S), lambda: plan.poses([START - S])):
        with pytest.raises(InPast, match="the recording has nothing older of it") as caught:
            call()
        assert "listener" not in str(caught.value)


SCAN_FROM = (-2.0, 0.5, 1000, 0, 0.125, 8.0)


def scan(stamp: int, ranges: list[float]) -> LaserScan:
    return LaserScan(stamp, 0, 1, "laser", *SCAN_FROM, to_float32_block(ranges))


def grid(cells: bytes, session: int = 1) -> OccupancyGrid:
    return OccupancyGrid(session, START, "map", 0.5, len(cells), 1, to_block([1, 2, 0, 0, 0, 0, 1]), cells)


def test_recorded_scans_are_read_by_robot_and_sensor_and_placed_ray_by_ray(tmp_path: Path):
    path = tmp_path / "r.mcap"
    with RecordingBuilder(path) as builder:
        for n in range(3):  # along x with 1 m a millisecond
            builder.edges("arm", START + n * MS, {("odom", "laser"): pose(n)})
        for name, ranges in (("front", [1.0, math.nan, 2.0]), ("rear", [3.0])):
            builder.encoder.write_message("arm", scan(START, ranges), START + MS, name)
        builder.encoder.write_message("cart", scan(START, [5.0]), START + MS, "front")
    with Recording(path) as recording:
        sizes = [len(one.ranges) for one in recording.scans()]
        (rear,) = recording.scans("arm", "rear")
        (front,) = recording.scans("arm", "front")
        points, valid = recording.place(front.points(), front.stamps(), front.frame, "arm/odom")
        with pytest.raises(InvalidInput, match="no robot 'lift'"):
            list(recording.scans("lift"))
    assert (sizes, rear.ranges.tolist(), front.frame) == ([3, 1, 1], [3.0], "arm/laser")
    assert valid.tolist() == [True, False, True]
    assert np.isnan(points[1]).all()
    # Rays at 0 and 2 us, -2 and -1 rad, from a laser at 0 and 0.002 m.
    expected = [[math.cos(-2.0), math.sin(-2.0), 0.0], [0.002 + 2 * math.cos(-1.0), 2 * math.sin(-1.0), 0.0]]
    np.testing.assert_allclose(points[valid], expected, atol=1e-6)


def test_recorded_maps_are_those_that_changed(tmp_path: Path):
    path = tmp_path / "r.mcap"
    with RecordingBuilder(path) as builder:
        for second, message in enumerate([grid(b"\0"), grid(b"\0", session=2), grid(b"\x64\xff")]):
            builder.encoder.write_message("hall", message, START + second * S, "floor")
        builder.encoder.write_message("yard", grid(b"\x07"), START + 3 * S, "floor")
        builder.encoder.withdraw("hall", "map", "floor", START + 4 * S)
    with Recording(path) as recording:
        cells = [one.cells.tolist() for one in recording.maps("hall")]
        assert len(list(recording.maps())) == 3
        (yard,) = recording.maps("yard")
        assert recording.robots == ()
    assert cells == [[[0]], [[100, -1]]]
    assert (yard.frame, yard.resolution, yard.origin.translation.tolist()) == ("yard/map", 0.5, [1, 2, 0])


def test_scans_that_are_none_are_left_out(tmp_path: Path):
    path = tmp_path / "r.mcap"
    with RecordingBuilder(path, "arm") as builder:
        for ranges in ([1.0], [], [2.0]):
            builder.encoder.write_message("arm", scan(START, ranges), START, "front")
    with Recording(path) as recording:
        assert [one.ranges.tolist() for one in recording.scans()] == [[1.0], [2.0]]


def test_sensors_of_a_bag_are_those_of_its_robots_whatever_their_namespace(tmp_path: Path):
    encoder = RosStreamEncoder(FrameNames(Ros2Options(), "ros"), SampleLayout())
    reading = Imu(START, 0, 1, "imu_link", to_block([1, 2, 3]), to_block([0, 0, 9.81]))
    with Bag(tmp_path / "bag") as bag:
        bag.tf(START, [Transform("odom", "base", [1.0, 0, 0], [0, 0, 0, 1], START)])
        bag.joints(START, {"wheel": 1.0}, "/r1/joint_states")
        for topic in ("/imu/data", "/r1/imu/data"):
            bag.write(topic, START, STORE.deserialize_cdr(encoder.encode(reading), IMU.name), IMU.name)
        for place in ((47.5, 8.0, None, 0), (None, None, None, -1)):
            data = encoder.encode(Fix(START, 0, 1, "antenna", *place))
            message = STORE.deserialize_cdr(data, NAV_SAT_FIX.name)
            bag.write("/r1/gps/fix", START, message, NAV_SAT_FIX.name)
    with Recording(tmp_path / "bag") as recording:
        assert recording.robots == ("r1", "ros")
        (of_r1,) = recording.imu("r1", "imu_data")
        (of_all,) = recording.imu("ros", "imu_data")
        fixes = list(recording.fixes("r1", "gps_fix"))
    assert (of_r1.frame, of_all.frame) == ("r1/imu_link", "ros/imu_link")
    assert of_r1.gyro == reading.gyro
    assert [(one.frame, one.latitude, one.altitude, one.status) for one in fixes] == [
        ("r1/antenna", 47.5, None, 0),
        ("r1/antenna", None, None, -1),
    ]


def test_covariances_of_edges_in_a_converted_recording_are_no_poses(tmp_path: Path):
    encoder = RosStreamEncoder(FrameNames(Ros2Options(), "ros"), SampleLayout())
    pose = Pose(START, 0, 1, "odom", "", to_block([1, 2, 3, 0, 0, 0, 1]))
    message = STORE.deserialize_cdr(encoder.encode(pose), POSE_WITH_COVARIANCE.name)
    with Bag(tmp_path / "bag") as bag:
        for topic in ("/pose_with_covariance/base", "/r1/pose_with_covariance/base", "/mocap/pose"):
            bag.write(topic, START, message, POSE_WITH_COVARIANCE.name)
    with Recording(tmp_path / "bag") as recording:
        (found,) = recording.poses()
        assert [found] == list(recording.poses("ros", "mocap_pose"))
    assert (found.parent, found.child, found.pose) == ("ros/odom", "", pose.pose)


@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_scans_and_maps_of_a_ros_bag_are_placed_by_its_transforms(tmp_path: Path, storage: StoragePlugin):
    encoder = RosStreamEncoder(FrameNames(Ros2Options(), "ros"), SampleLayout())
    with Bag(tmp_path / "bag", storage) as bag:
        for n in range(3):
            stamp = START + n * MS
            bag.tf(stamp, [Transform("odom", "laser", [float(n), 0, 0], [0, 0, 0, 1], stamp)])
        for message, topic, kind in (
            (scan(START, [1.0, 2.0]), "/scan", LASER_SCAN),
            (grid(b"\x64\0"), "/map", OCCUPANCY_GRID),
        ):
            bag.write(topic, START, STORE.deserialize_cdr(encoder.encode(message), kind.name), kind.name)
    with Recording(tmp_path / "bag") as recording:
        (one,) = recording.scans(sensor="scan")
        points, valid = recording.place(one.points(), one.stamps(), one.frame, "odom")
        (floor,) = recording.maps()
    assert valid.all()
    assert points[1] == pytest.approx([0.001 + 2 * math.cos(-1.5), 2 * math.sin(-1.5), 0.0], abs=1e-6)
    assert (floor.cells.tolist(), floor.frame) == ([[100, 0]], "ros/map")
