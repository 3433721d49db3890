"""The records of a recording as messages: ours with all that a listener knows, bags by their topics."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.recording_builder import (
    LATENCY,
    MS,
    RRBOT,
    START,
    STORE,
    Bag,
    RecordingBuilder,
    S,
    pose,
    recorded_buffer,
    swing_positions,
)
from rosbags.rosbag2 import StoragePlugin

from zstate.recording.decode import STREAMS, DecodedMessage, DecodedRecording
from zstate.recording.mcap.recover import recover
from zstate.recording.reader import RecordingReader
from zstate.scans.messages import LaserScan, OccupancyGrid
from zstate.transform import Transform
from zstate.wire.joint_order import SampleLayout
from zstate.wire.keys import MODEL_WRITER
from zstate.wire.measurements import to_float32_block
from zstate.wire.messages import (
    JointState,
    RobotDescription,
    StaticTransforms,
    TransformSample,
    from_block,
    poses_from_block,
    to_block,
)
from zstate.wire.ros2.encoder import RosStreamEncoder
from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.streams import ros_stream
from zstate.wire.ros2.topics import FrameNames
from zstate.wire.ros2.types import JOINT_STATE, LASER_SCAN, OCCUPANCY_GRID

SCAN_STREAMS = ("scan", "map")

STORAGES = (StoragePlugin.SQLITE3, StoragePlugin.MCAP)


class DecodedFile:
    """All messages and reports of a decoded recording."""

    def __init__(self, path: Path, **choice: object) -> None:
        self.refused: list[str] = []
        with RecordingReader(path) as reader:
            transcript = DecodedRecording(reader, lambda reason, _: self.refused.append(reason))
            self.robots = transcript.robots
            self.ignored = transcript.ignored
            self.decoded: list[DecodedMessage] = list(transcript.messages(**choice))

    def of(self, kind: type) -> list[DecodedMessage]:
        return [decoded for decoded in self.decoded if isinstance(decoded.message, kind)]


def test_joint_state_is_decoded_with_its_writer_and_every_number(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm", {7: "driver@host pid 1"}) as builder:
        builder.describe("arm", session=7)
        states = [
            builder.joints(
                "arm", START + n * MS + 1, swing_positions(n / 10), swing_positions(n / 7), session=7
            )
            for n in range(20)
        ]
    read = DecodedFile(tmp_path / "r.mcap")
    found = read.of(JointState)
    assert read.robots == ("arm",)
    assert [decoded.writer.robot for decoded in found] == ["arm"] * 20
    assert {(decoded.writer.session, decoded.writer.program) for decoded in found} == {
        (7, "driver@host pid 1")
    }
    for state, decoded in zip(states, found, strict=True):
        message = decoded.message
        assert isinstance(message, JointState)
        assert (message.stamp, message.seq, message.session) == (state.stamp, state.seq, state.session)
        assert (message.positions, message.velocities) == (state.positions, state.velocities)
        assert decoded.log_time == state.stamp + LATENCY
    assert not read.refused


def test_frames_of_several_robots_keep_their_names(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap") as builder:
        for robot in ("r1", "r2"):
            builder.edges(robot, START, {("odom", "base"): pose(1.0), ("fleet/map", "odom"): pose(2.0)})
    edges = {
        decoded.writer.robot: decoded.message.edges
        for decoded in DecodedFile(tmp_path / "r.mcap").of(TransformSample)
    }
    expected = (("odom", "base"), ("fleet/map", "odom"))
    assert edges == {"r1": expected, "r2": expected}


def test_static_writers_keep_their_names(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.statics("arm", START, {("tool", "camera"): pose(z=0.1)}, writer="camera")
        builder.statics("arm", START, {("world", "base"): pose()}, writer=MODEL_WRITER)
        builder.encoder.withdraw("arm", "tf_static", "camera", START + S)
    found = DecodedFile(tmp_path / "r.mcap").of(StaticTransforms)
    assert [(decoded.writer.edge_writer, decoded.message.edges) for decoded in found] == [
        ("camera", (("tool", "camera"),)),
        (MODEL_WRITER, (("world", "base"),)),
        ("camera", ()),
    ]


def scan(stamp: int = START, seq: int = 3, session: int = 9, frame: str = "laser") -> LaserScan:
    geometry = (-2.0, 0.5, 1000, 4000, 0.125, 8.0)
    return LaserScan(stamp, seq, session, frame, *geometry, to_float32_block([1.0, 2.0]))


def grid(session: int = 9, frame: str = "map") -> OccupancyGrid:
    return OccupancyGrid(session, START, frame, 0.5, 2, 1, to_block([1, 2, 0, 0, 0, 0, 1]), b"\xff\x64")


def test_scans_and_maps_are_decoded_as_written(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap") as builder:
        builder.encoder.write_message("arm", scan(), START + 1, "front-laser")
        builder.encoder.write_message("hall", grid(), START + 2, "map")
    read = DecodedFile(tmp_path / "r.mcap", streams=(*STREAMS, *SCAN_STREAMS))
    assert [(one.writer.robot, one.writer.stream, one.writer.edge_writer) for one in read.decoded] == [
        ("arm", "scan", "front-laser"),
        ("hall", "map", "map"),
    ]
    assert [one.message for one in read.decoded] == [scan(), grid()]
    assert read.robots == ("arm",)  # a hall with a map is none
    assert not DecodedFile(tmp_path / "r.mcap").decoded


def test_scans_and_maps_of_a_bag_are_named_by_their_topics(tmp_path: Path):
    with Bag(tmp_path / "bag") as bag:
        for message, topic, kind in (
            (scan(session=0), "/front", LASER_SCAN),
            (grid(session=0), "/hall/map", OCCUPANCY_GRID),
        ):
            payload = RosStreamEncoder(FrameNames(Ros2Options(), "r1"), SampleLayout()).encode(message)
            bag.write(topic, START, STORE.deserialize_cdr(payload, kind.name), kind.name)
    read = DecodedFile(tmp_path / "bag", streams=SCAN_STREAMS)
    found = {one.writer.stream: (one.writer.robot, one.writer.edge_writer) for one in read.decoded}
    assert found == {"scan": ("ros", "front"), "map": ("hall", "map")}
    (one,) = read.of(LaserScan)
    assert one.message == scan(seq=1, session=one.writer.session)


def test_messages_that_are_no_scan_or_map_are_counted_and_the_others_read(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap") as builder:
        for topic, message, kind in (
            ("/front", scan(session=0), LASER_SCAN),
            ("/floor", grid(session=0), OCCUPANCY_GRID),
        ):
            payload = RosStreamEncoder(FrameNames(Ros2Options(), "ros"), SampleLayout()).encode(message)
            channel = builder.writer.channel(topic, kind, ros_stream("scan").qos)
            # A grid ends with the number of its cells, 4 bytes, and its two cells.
            lies = payload[:-6] + (2**31).to_bytes(4, "little") + payload[-2:]
            for bad in (payload[: len(payload) // 2], payload[:-1], b"", lies, payload):
                builder.writer.write(channel, bad, START, START)
    read = DecodedFile(tmp_path / "r.mcap", streams=SCAN_STREAMS)
    assert len(read.of(LaserScan)) == len(read.of(OccupancyGrid)) == 1
    assert read.refused == ["truncated"] * 8


def test_a_recording_with_scans_and_maps_fills_a_buffer(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap") as builder:
        builder.encoder.write_message("hall", grid(), START, "map")
        builder.encoder.write_message("arm", scan(), START, "front")
        builder.edges("arm", START, {("odom", "base"): pose(1.0)})
    assert recorded_buffer(tmp_path / "r.mcap").lookup("arm/odom", "arm/base", START).translation[0] == 1.0


def test_restarted_writer_is_another_writer(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        builder.joints("arm", START, swing_positions(0), session=1)
        builder.joints("arm", START + S, swing_positions(1), session=2)
    assert [decoded.writer.session for decoded in DecodedFile(tmp_path / "r.mcap").of(JointState)] == [1, 2]


@pytest.mark.parametrize("storage", STORAGES)
def test_bag_is_read_by_its_topics(tmp_path: Path, storage: StoragePlugin):
    odom_from_base = Transform("odom", "base", [1.0, 2.0, 0.0], [0, 0, 0.6, 0.8], START + 5)
    base_from_lidar = Transform("base", "lidar", [0, 0, 0.3], [0, 0, 0, 1], 0)
    with Bag(tmp_path / "bag", storage) as bag:
        bag.describe()
        bag.tf(START, [base_from_lidar], "/tf_static")
        bag.tf(START + 5, [odom_from_base])
        bag.joints(START + 6, {"shoulder": 0.25, "elbow": -0.5})
        bag.joints(START + 7, {"knee": 1.0}, "/dog/joint_states")
    read = DecodedFile(tmp_path / "bag")
    assert read.robots == ("dog", "ros")
    (description,), (statics,) = read.of(RobotDescription), read.of(StaticTransforms)
    (sample,), (ros, dog) = read.of(TransformSample), read.of(JointState)
    assert description.message.urdf == RRBOT.urdf
    assert statics.writer.edge_writer is None
    assert statics.message.edges == (("base", "lidar"),)
    assert (sample.message.stamp, sample.message.edges) == (START + 5, (("odom", "base"),))
    assert np.array_equal(poses_from_block(sample.message.poses)[0], odom_from_base.pose7)
    assert (ros.writer.robot, ros.message.names) == ("ros", ("shoulder", "elbow"))
    assert from_block(ros.message.positions).tolist() == [0.25, -0.5]
    assert (dog.writer.robot, dog.writer.foreign) == ("dog", True)
    assert ros.writer.session != dog.writer.session


def test_messages_of_a_foreign_topic_are_counted(tmp_path: Path):
    with Bag(tmp_path / "bag") as bag:
        for n in range(5):
            bag.joints(START + n, {"shoulder": 0.0})
    assert [decoded.message.seq for decoded in DecodedFile(tmp_path / "bag").of(JointState)] == [
        1,
        2,
        3,
        4,
        5,
    ]


def test_other_topics_of_a_bag_are_listed_and_skipped(tmp_path: Path):
    with Bag(tmp_path / "bag") as bag:
        bag.joints(START, {"shoulder": 0.0}, "/joint_commands")
        bag.write("/chatter", START, STORE.types["std_msgs/msg/String"]("hello"), "std_msgs/msg/String")
    read = DecodedFile(tmp_path / "bag")
    assert {channel.topic for channel in read.ignored} == {"/joint_commands", "/chatter"}
    assert (read.robots, read.decoded) == ((), [])


def test_selected_robot_includes_the_root_namespace_of_a_bag(tmp_path: Path):
    with Bag(tmp_path / "bag") as bag:
        bag.joints(START, {"knee": 1.0}, "/dog/joint_states")
        bag.joints(START, {"knee": 1.0}, "/cat/joint_states")
        bag.tf(START, [Transform("dog/odom", "dog/base", [0, 0, 0], [0, 0, 0, 1], START)])
    decoded = DecodedFile(tmp_path / "bag", robots=("dog",)).decoded
    assert {(s.writer.robot, s.writer.stream) for s in decoded} == {("dog", "joint_states"), ("ros", "tf")}


def test_undecodable_messages_are_reported_and_skipped(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        builder.joints("arm", START, swing_positions(0))
        facts = {"zstate.robot": "arm", "zstate.session": "1"}
        joints = builder.writer.channel("/joint_states", JOINT_STATE, ros_stream("joint_states").qos, facts)
        builder.writer.write(joints, b"\0\1\0\0" + bytes(4), START + MS, START + MS)
        builder.joints("arm", START + 2 * MS, swing_positions(1))
    read = DecodedFile(tmp_path / "r.mcap")
    assert len(read.of(JointState)) == 2
    assert read.refused == ["truncated"]


def test_interval_of_log_times_can_be_read_alone(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        for n in range(10):
            builder.joints("arm", START + n * S, swing_positions(n), log_time=START + n * S)
    found = DecodedFile(
        tmp_path / "r.mcap", streams=("joint_states",), begin=START + 3 * S, end=START + 5 * S
    )
    assert [decoded.log_time for decoded in found.decoded] == [START + 3 * S, START + 4 * S]


def test_truncated_recording_is_decoded_as_far_as_possible(tmp_path: Path):
    with RecordingBuilder(tmp_path / "r.mcap", "arm") as builder:
        builder.describe("arm")
        for n in range(2000):
            builder.joints("arm", START + n * MS, swing_positions(n / 100))
            if n % 100 == 99:
                builder.writer.flush()
    whole = (tmp_path / "r.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: len(whole) // 2])
    found, all_told = DecodedFile(cut), DecodedFile(tmp_path / "r.mcap")
    assert 100 < len(found.decoded) < len(all_told.decoded)
    assert found.decoded == all_told.decoded[: len(found.decoded)]
    recover(cut, tmp_path / "saved.mcap")
    assert DecodedFile(tmp_path / "saved.mcap").decoded == found.decoded
