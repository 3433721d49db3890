"""Pictures and calibrations in recordings: as they were sent, for rosbags as well, and replayed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.pictures import jpeg, png, video
from helpers.processes import until
from helpers.robots import wait_for_reader
from rosbags.highlevel import AnyReader

from zstate import Recorder, Recording
from zstate.cameras import Camera, CameraPublisher
from zstate.recording.decode import RecordedWriter
from zstate.recording.storage import Channel
from zstate.wire.registry import get_wire
from zstate.wire.ros2.types import CAMERA_INFO, COMPRESSED_IMAGE, COMPRESSED_VIDEO, RosType

STAMP = 1_700_000_000_000_000_000
K = (60.0, 61.0, 31.5, 23.5)
SENT = {"jpeg": jpeg(), "png": png(), "h264": video(1)[0]}


@pytest.fixture(params=["native", "ros2"])
def recorded(request, sessions, tmp_path: Path) -> Path:
    """A recording of three pictures of r1's wrist, and of its calibration."""
    writer, reader = sessions
    path, camera = tmp_path / "run.mcap", Camera(64, 48, K, frame="lens")
    with (
        CameraPublisher(writer, "r1", "wrist", camera, [request.param]) as publisher,
        Recorder(reader, path, ["r1"], wire=request.param) as recorder,
    ):

        def count(stream: str) -> int:
            return recorder.stats.messages.get(("r1", stream), 0)

        wait_for_reader(writer, get_wire(request.param).expression("r1", "image"))
        for number, (form, data) in enumerate(SENT.items()):
            publisher.publish(data, STAMP + number, format=form if form == "h264" else None)
        until(lambda: count("image") == 3 and count("camera_info"))
    assert not recorder.stats.refused
    return path


def test_rosbags_reads_the_bytes_on_the_topics_of_image_transport(recorded: Path):
    with AnyReader([recorded]) as reader:
        topics = {one.topic: one.msgtype for one in reader.connections}
        assert topics == {
            "/wrist/image_raw/compressed": COMPRESSED_IMAGE.name,
            "/wrist/image_raw/foxglove": COMPRESSED_VIDEO.name,
            "/wrist/camera_info": CAMERA_INFO.name,
        }
        messages = [(one.topic, reader.deserialize(data, one.msgtype)) for one, _, data in reader.messages()]
    pictures = [message for topic, message in messages if topic.startswith("/wrist/image_raw")][-3:]
    assert {one.format: one.data.tobytes() for one in pictures} == SENT
    (info, *_) = [message for topic, message in messages if topic.endswith("info")]
    assert (info.width, info.height, info.header.frame_id) == (64, 48, "lens")
    assert np.array_equal(info.k, [60, 0, 31.5, 0, 61, 23.5, 0, 0, 1])


def test_a_recording_has_the_messages_under_the_name_of_the_camera(recorded: Path):
    with Recording(recorded, "r1") as recording:
        *_, one, two, three = recording.measurements("image")
        (info, *_) = recording.measurements("camera_info")
    assert {one.writer.edge_writer for one in (one, two, three, info)} == {"wrist"}
    pictures = [one.message for one in (one, two, three)]
    assert {one.format: one.data for one in pictures} == SENT
    assert [one.stamp for one in pictures] == [STAMP, STAMP + 1, STAMP + 2]


@pytest.mark.parametrize(
    ("topic", "kind", "robot", "name"),
    [
        ("/r1/wrist/image_raw/compressed", COMPRESSED_IMAGE, "r1", "wrist"),
        ("/r1/camera/color/image_raw/compressed", COMPRESSED_IMAGE, "r1", "camera_color"),
        ("/camera/image_raw/compressed", COMPRESSED_IMAGE, "ros", "camera"),
        ("/r1/wrist/compressed", COMPRESSED_IMAGE, "r1", "wrist_compressed"),
        ("/r1/wrist/image_raw/foxglove", COMPRESSED_VIDEO, "r1", "wrist"),
        ("/r1/wrist/video", COMPRESSED_VIDEO, "r1", "wrist_video"),
    ],
)
def test_in_bags_of_ros_the_topic_without_its_last_names_gives_the_camera(
    topic: str, kind: RosType, robot: str, name: str
):
    channel = Channel(topic, kind.name, "cdr", {}, 1)
    writer = RecordedWriter.from_channel(channel, ["r1"])
    assert writer is not None
    assert (writer.robot, writer.stream, writer.edge_writer) == (robot, "image", name)
