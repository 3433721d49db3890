"""Covariances are recorded as messages that other tools read, and come back with their samples."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.recording_builder import MS, START, RecordingBuilder, S, pose, recorded_buffer
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from zstate.errors import MessageError
from zstate.recording.covariances import (
    CHILD_FRAME,
    CovarianceJoin,
    EdgeCovariance,
    covariance_topic,
    decode_covariance,
    encode_covariance,
)
from zstate.recording.decode import DecodedRecording
from zstate.recording.info import other_channels, read_info, recorded_robots
from zstate.recording.mcap.records import MAGIC
from zstate.recording.mcap.recover import recover
from zstate.recording.mcap.writer import MIN_BYTES
from zstate.recording.reader import RecordingReader
from zstate.recording.storage import EDGE_WRITER, ROBOT
from zstate.wire.messages import TransformSample, covariances_of, order_digest, to_block
from zstate.wire.ros2.qos import Qos
from zstate.wire.ros2.types import POSE_WITH_COVARIANCE

BASE, BALL = ("odom", "base"), ("base", "ball")
COUNT = 20


def covariance(number: int) -> np.ndarray:
    """A covariance with 21 different numbers: A A^T is positive semidefinite."""
    root = np.random.default_rng(number).normal(size=(6, 6))
    upper = np.triu(root @ root.T)
    return upper + np.triu(upper, 1).T  # numpy's product need not be symmetric in the last bit


def write(path: Path, *, alone: str | None = "cart", count: int = COUNT, **options: int) -> None:
    """Poses of the base with covariances except in every fifth sample, and of a ball without."""
    with RecordingBuilder(path, alone, **options) as builder:
        for n in range(count):
            poses = {BASE: pose(n, yaw=0.1 * n), BALL: pose(z=n)}
            known = {BASE: covariance(n)} if n % 5 else None
            builder.edges("cart", START + n * 10 * MS, poses, writer="odometry", covariances=known)


def check(path: Path, count: int = COUNT) -> None:
    """Lookups of the edge have the covariance of the sample, bit for bit, and no others have one."""
    buffer = recorded_buffer(path)
    for n in range(count):
        stamp = START + n * 10 * MS
        found = buffer.lookup("cart/odom", "cart/base", stamp)
        assert found.translation[0] == n
        if n % 5:
            assert np.array_equal(found.covariance, covariance(n))
        else:
            assert found.covariance is None
        assert buffer.lookup("cart/base", "cart/ball", stamp).covariance is None


@pytest.mark.parametrize("alone", ["cart", None])
def test_lookups_of_an_edge_give_the_covariance_of_its_samples(tmp_path: Path, alone: str | None):
    write(tmp_path / "r.mcap", alone=alone)
    check(tmp_path / "r.mcap")


@pytest.mark.long
def test_covariances_belong_to_their_samples_across_split_files(tmp_path: Path):
    write(tmp_path / "r.mcap", count=1000, max_bytes=MIN_BYTES)
    assert len(list(tmp_path.iterdir())) > 5
    check(tmp_path / "r.mcap", count=1000)


def by_rosbags(path: Path) -> list[tuple[str, Any]]:
    with AnyReader([path]) as reader:
        return [
            (connection.topic, reader.deserialize(data, connection.msgtype))
            for connection, _, data in reader.messages()
        ]


def by_mcap_ros2(path: Path) -> list[tuple[str, Any]]:
    with path.open("rb") as stream:
        decoded = make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
        return [(channel.topic, message) for _, channel, _, message in decoded]


@pytest.mark.parametrize("read", [by_rosbags, by_mcap_ros2])
def test_other_readers_get_poses_with_covariances(tmp_path: Path, read: Callable[[Path], Any]):
    write(tmp_path / "r.mcap")
    numbers = [n for n in range(COUNT) if n % 5]
    messages = [message for topic, message in read(tmp_path / "r.mcap") if topic != "/tf"]
    for n, message in zip(numbers, messages, strict=True):
        stamp = message.header.stamp
        assert (stamp.sec * S + stamp.nanosec, message.header.frame_id) == (START + n * 10 * MS, "odom")
        position, turn = message.pose.pose.position, message.pose.pose.orientation
        numbers = [position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w]
        assert numbers == pose(n, yaw=0.1 * n)
        assert list(message.pose.covariance) == covariance(n).ravel().tolist()


def test_info_shows_the_topic_of_the_robot_and_its_writer(tmp_path: Path):
    write(tmp_path / "r.mcap", alone=None)
    info = read_info(tmp_path / "r.mcap")
    (robot,) = recorded_robots(info)
    assert other_channels(info) == []
    assert {(one.topic, one.type, one.count, one.writer) for one in robot.streams} == {
        ("/tf", "tf2_msgs/msg/TFMessage", COUNT, "odometry"),
        (
            "/cart/pose_with_covariance/base",
            "geometry_msgs/msg/PoseWithCovarianceStamped",
            COUNT * 4 // 5,
            "odometry",
        ),
    }


def test_recovered_recording_has_the_covariances(tmp_path: Path):
    write(tmp_path / "r.mcap")
    data = (tmp_path / "r.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: -len(MAGIC)])  # as a killed recorder leaves it
    recover(tmp_path / "cut.mcap", tmp_path / "whole.mcap")
    check(tmp_path / "whole.mcap")


def test_malformed_covariance_is_counted_and_its_sample_read(tmp_path: Path):
    path = tmp_path / "r.mcap"
    with RecordingBuilder(path, "cart") as builder:
        known = {BASE: covariance(1)}
        builder.edges("cart", START, {BASE: pose()}, writer="odometry", covariances=known)
        metadata = {"zstate.session": "2", ROBOT: "cart", EDGE_WRITER: "odometry", CHILD_FRAME: "base"}
        channel = builder.writer.channel("/covariances", POSE_WITH_COVARIANCE, Qos(), metadata)
        builder.writer.write(channel, b"\x00\x01\x00\x00", START + MS, START + MS)
        builder.edges("cart", START + MS, {BASE: pose(x=1)}, writer="odometry", log_time=START + MS)
    refused: list[str] = []
    with RecordingReader(path) as reader:
        recording = DecodedRecording(reader, lambda reason, text: refused.append(reason))
        messages = [decoded.message for decoded in recording.messages()]
    assert [covariances_of(message) is None for message in messages] == [False, True]
    assert refused == ["truncated"]


def test_covariance_of_another_stamp_or_edge_is_not_joined():
    edges = (BASE,)
    sample = TransformSample(START, 0, 2, order_digest(edges), to_block([pose()]), edges)
    join = CovarianceJoin()
    assert join.join(sample) is sample
    for stamp, edge in ((START - 1, BASE), (START, BALL)):
        join.add(EdgeCovariance(stamp, *edge, to_block(pose()), np.ones(21)))
        assert join.join(sample) is sample
    join.add(EdgeCovariance(START, *BASE, to_block(pose()), np.arange(21.0)))
    assert covariances_of(join.join(sample)).tolist() == [list(range(21))]


@pytest.mark.parametrize("length", [0, 3, 20, 300])
def test_truncated_payload_is_refused(length: int):
    payload = encode_covariance(EdgeCovariance(START, *BASE, to_block(pose()), np.ones(21)))
    assert decode_covariance(payload, "base").child == "base"
    with pytest.raises(MessageError, match="cut off"):
        decode_covariance(payload[:length], "base")


@pytest.mark.parametrize(
    ("namespace", "child", "topic"),
    [
        ("", "base_link", "/pose_with_covariance/base_link"),
        ("arm_1", "fleet/map", "/arm_1/pose_with_covariance/fleet_map"),
        ("", "7-up", "/pose_with_covariance/_7_up"),
    ],
)
def test_topic_is_a_name_of_ros(namespace: str, child: str, topic: str):
    assert covariance_topic(namespace, child) == topic
