"""Pictures and packets in recordings: with the bytes that were published, read by rosbags and replayed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.pictures import jpeg, pixels, png, video
from helpers.processes import until
from helpers.recording_builder import RecordingBuilder
from helpers.robots import wait_for_reader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from zstate import Recording
from zstate.cameras import Camera, CameraListener, CameraPublisher
from zstate.cameras.camera import camera_to_message
from zstate.cameras.messages import CameraInfo, CompressedImage
from zstate.cameras.ros2 import decode_video, encode_video
from zstate.errors import MessageError
from zstate.net.session import Session
from zstate.recording.info import read_info, recorded_robots
from zstate.recording.player import Player
from zstate.recording.reader import RecordingReader
from zstate.recording.recorder import Recorder
from zstate.wire.measurements import with_field
from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.topics import FrameNames
from zstate.wire.ros2.types import COMPRESSED_VIDEO

NAMES = FrameNames(Ros2Options(), "r1")
START = 1_700_000_000_000_000_000
PERIOD = 33_333_333
FISHEYE = (0.01, -0.002, 0.0003, -0.00004)
PICTURES: dict[Any, list[bytes]] = {
    "jpeg": [jpeg(brightness=20 * number) for number in range(5)],
    "png": [png()],
    "h264": video(8, "h264", key_every=4),
    "h265": video(8, "h265", key_every=4),
}
TYPES = {
    **dict.fromkeys(("jpeg", "png"), ("/wrist/image_raw/compressed", "sensor_msgs/msg/CompressedImage")),
    **dict.fromkeys(("h264", "h265"), ("/wrist/image_raw/foxglove", "foxglove_msgs/msg/CompressedVideo")),
}


def write(path: Path, form: Any, *, lost: int = -1) -> list[CompressedImage]:
    """The pictures of r1's camera "wrist", of a robot alone in the file, without number ``lost``."""
    messages = [
        CompressedImage(START + number * PERIOD, number, 7, "lens", form, data)
        for number, data in enumerate(PICTURES[form])
        if number != lost
    ]
    with RecordingBuilder(path, "r1") as builder:
        for message in messages:
            builder.encoder.write_message("r1", message, message.stamp, "wrist")
    return messages


@pytest.mark.parametrize("form", PICTURES)
def test_recorded_pictures_and_packets_are_those_that_were_written(tmp_path: Path, form: str):
    messages = write(tmp_path / "run.mcap", form)
    with Recording(tmp_path / "run.mcap") as recording:
        assert [decoded.message for decoded in recording.measurements("image")] == messages
    with RecordingReader(tmp_path / "run.mcap") as reader:
        assert [(one.topic, one.type_name) for one in reader.channels()] == [TYPES[form]]


@pytest.mark.parametrize("form", PICTURES)
def test_rosbags_reads_the_same_bytes_by_the_definition_in_the_file(tmp_path: Path, form: str):
    messages = write(tmp_path / "run.mcap", form)
    with AnyReader([tmp_path / "run.mcap"]) as reader:
        read = [reader.deserialize(data, connection.msgtype) for connection, _, data in reader.messages()]
    assert [one.data.tobytes() for one in read] == [message.data for message in messages]
    assert {one.format for one in read} == {form}


def test_a_video_is_recorded_live_and_replayed_packet_for_packet(
    sessions: tuple[Session, Session], tmp_path: Path
):
    writer, reader = sessions
    path, packets = tmp_path / "run.mcap", PICTURES["h264"]
    with Recorder(reader, path, ["r1"]) as recorder, CameraPublisher(writer, "r1", "wrist") as publisher:
        wait_for_reader(writer, "zstate/r1/image/wrist")
        for number, packet in enumerate(packets):
            publisher.publish(packet, START + number * PERIOD, format="h264")
            until(lambda count=number + 1: recorder.stats.messages.get(("r1", "image")) == count)
    assert (recorder.stats.dropped, recorder.stats.missed) == (0, 0)
    (robot,) = recorded_robots(read_info(path))
    ((_, type_name), counts) = TYPES["h264"], [one.count for one in robot.streams]
    assert ([one.type for one in robot.streams], counts) == ([type_name], [len(packets)])
    received: list[Any] = []
    with CameraListener(reader, "r1") as listener:
        wait_for_reader(writer, "zstate/r1/image/wrist")
        with Player(writer, path) as player:
            report = player.run()
        until(lambda: listener.latest is not None and listener.latest.data == packets[-1])
        received.append(listener.latest)
    assert (report.refused, listener.refused) == ({}, {})
    wanted = pixels(brightness=20 * (len(packets) - 1)).astype(int)
    assert np.abs(received[0].decode() - wanted).mean() < 4.0


def test_a_packet_that_the_recording_has_lost_is_missing_in_its_replay(
    sessions: tuple[Session, Session], tmp_path: Path
):
    writer, reader = sessions
    write(tmp_path / "run.mcap", "h264", lost=5)  # 6 and 7 need it, and 4 is a key frame
    with CameraListener(reader, "r1") as listener, Player(writer, tmp_path / "run.mcap") as player:
        wait_for_reader(writer, "zstate/r1/image/wrist")
        player.run()
        until(lambda: listener.refused.get("no key frame", 0) >= 2)
    assert listener.refused == {"no key frame": 2}
    assert listener.latest is not None
    assert listener.latest.stamp == START + 4 * PERIOD


def test_a_calibration_keeps_the_time_of_a_line_which_ros_does_not_carry(tmp_path: Path):
    def info(line_time_ns: int) -> CameraInfo:
        camera = Camera(64, 48, (60.0, 61.0, 31.5, 23.5), FISHEYE, "equidistant", "lens", line_time_ns)
        return with_field(camera_to_message(camera, START), "session", 7)

    messages = [info(20_000), info(0), info(30_000)]
    with RecordingBuilder(tmp_path / "run.mcap", "r1") as builder:
        for number, message in enumerate(messages):
            builder.encoder.write_message("r1", message, START + number, "wrist")
    with Recording(tmp_path / "run.mcap") as recording:
        assert [one.message for one in recording.measurements("camera_info")] == messages
    with AnyReader([tmp_path / "run.mcap"]) as reader:
        read = [reader.deserialize(data, connection.msgtype) for connection, _, data in reader.messages()]
    assert [(one.distortion_model, tuple(one.d)) for one in read] == [("equidistant", FISHEYE)] * 3


@pytest.fixture(scope="module")
def store() -> Any:
    """The types of rosbags, with foxglove's."""
    found = get_typestore(Stores.ROS2_JAZZY)
    found.register(get_types_from_msg(COMPRESSED_VIDEO.definition, COMPRESSED_VIDEO.name))
    return found


def payload(store: Any, data: bytes, form: str) -> bytes:
    time = store.types["builtin_interfaces/msg/Time"](START // 10**9, START % 10**9)
    message = store.types[COMPRESSED_VIDEO.name](time, "lens", np.frombuffer(data, np.uint8), form)
    return bytes(store.serialize_cdr(message, COMPRESSED_VIDEO.name))


def test_a_packet_has_the_bytes_of_rosbags(store: Any):
    packet = CompressedImage(START, 5, 77, "lens", "h264", PICTURES["h264"][0])
    theirs = payload(store, packet.data, "h264")
    assert encode_video(packet, NAMES) == theirs
    assert decode_video(theirs, 77, 5, NAMES) == packet


@pytest.mark.parametrize(
    ("data", "form", "reason"),
    [(b"\x82\x49", "vp9", "foreign"), (b"\xff\xd8\xff", "h264", "foreign"), (b"", "h265", "foreign")],
)
def test_packets_that_are_not_annex_b_are_refused(store: Any, data: bytes, form: str, reason: str):
    with pytest.raises(MessageError) as caught:
        decode_video(payload(store, data, form), 1, 0, NAMES)
    assert caught.value.reason == reason
    with pytest.raises(MessageError) as caught:
        decode_video(payload(store, PICTURES["h264"][0], "h264")[:-9], 1, 0, NAMES)
    assert caught.value.reason == "truncated"
