"""Pictures, videos, calibrations and clouds in Foxglove; foxglove-sdk has the fields that it displays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import foxglove.messages
import numpy as np
import pytest
from helpers.foxglove_client import FoxgloveClient
from helpers.pictures import jpeg, video
from helpers.robots import STAMP, wait_for_reader

from zstate.cameras import Camera, CameraPublisher
from zstate.clouds import CloudPublisher
from zstate.net.session import Session

STILLS, VIDEO, INFO = "/wrist/image_raw/compressed", "/wrist/image_raw/foxglove", "/wrist/camera_info"
PERIOD = 33_000_000
FISHEYE = (0.01, -0.002, 0.0003, -0.00004)


def of_sdk(message: Any, *fields: str) -> Any:
    """The message of foxglove-sdk with the fields of a decoded one, which raises for others than its own."""
    kind = getattr(foxglove.messages, type(message).__name__)
    time = foxglove.messages.Timestamp(message.timestamp.sec, message.timestamp.nanosec)
    return kind(timestamp=time, **{name: getattr(message, name) for name in fields})


def publish(publisher: CameraPublisher, packets: Sequence[bytes], form: Any = None) -> None:
    for number, packet in enumerate(packets):
        publisher.publish(packet, STAMP + number * PERIOD, format=form)


@pytest.mark.parametrize("form", ["h264", "h265"])
def test_packets_of_a_video_are_foxglove_s_compressed_video_with_unchanged_bytes(
    sessions: tuple[Session, Session], serve: Any, form: str
):
    packets = video(8, form, key_every=4)
    with (
        CameraPublisher(sessions[0], "r1", "wrist") as publisher,
        FoxgloveClient(serve("r1").url) as client,
    ):
        client.subscribe(STILLS, VIDEO)
        wait_for_reader(sessions[0], "zstate/r1/image/wrist")
        publish(publisher, packets, form)
        client.until(lambda: len(client.frames.get(VIDEO, ())) == len(packets))
    assert STILLS not in client.frames
    assert client.channels[VIDEO]["schemaName"] == "foxglove_msgs/msg/CompressedVideo"
    for number, (packet, message) in enumerate(zip(packets, client.messages(VIDEO), strict=True)):
        assert (bytes(message.data), message.format, message.frame_id) == (packet, form, "wrist")
        assert message.timestamp.sec * 10**9 + message.timestamp.nanosec == STAMP + number * PERIOD
        theirs = of_sdk(message, "frame_id", "data", "format").encode()
        assert packet in theirs
        assert form.encode() in theirs


def test_pictures_are_on_the_topic_of_stills_as_they_came(sessions: tuple[Session, Session], serve: Any):
    pictures = [jpeg(brightness=20 * number) for number in range(3)]
    with (
        CameraPublisher(sessions[0], "r1", "wrist") as publisher,
        FoxgloveClient(serve("r1").url) as client,
    ):
        client.subscribe(STILLS, VIDEO)
        wait_for_reader(sessions[0], "zstate/r1/image/wrist")
        publish(publisher, pictures)
        client.until(lambda: len(client.frames.get(STILLS, ())) == len(pictures))
    assert VIDEO not in client.frames
    assert [bytes(message.data) for message in client.messages(STILLS)] == pictures


@pytest.mark.parametrize(("model", "shown"), [("equidistant", "kannala_brandt"), ("plumb_bob", "plumb_bob")])
def test_a_calibration_has_the_model_s_name_in_foxglove(
    sessions: tuple[Session, Session], serve: Any, model: Any, shown: str
):
    camera = Camera(64, 48, (60.0, 61.0, 31.5, 23.5), FISHEYE, model, "lens")
    with (
        CameraPublisher(sessions[0], "r1", "wrist", camera),
        FoxgloveClient(serve("r1").url) as client,
    ):
        client.subscribe(INFO)
        client.until(lambda: client.frames.get(INFO))
        (message,) = client.messages(INFO)
    assert message.distortion_model == shown
    assert f"`{shown}`" in (foxglove.messages.CameraCalibration.__doc__ or "")
    assert (tuple(message.d), message.header.frame_id) == (FISHEYE, "lens")
    assert np.array_equal(np.reshape(message.k, (3, 3)), camera.matrix)


@pytest.mark.parametrize("compression", [None, "lz4", "zstd"])
def test_a_cloud_is_a_point_cloud2_with_all_of_its_points(
    sessions: tuple[Session, Session], serve: Any, compression: Any
):
    points = np.zeros(500, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("ring", "<u2")])
    points["x"], points["ring"] = np.arange(500) / 7, np.arange(500)
    with (
        CloudPublisher(sessions[0], "r1", "front", frame="lidar", compression=compression) as publisher,
        FoxgloveClient(serve("r1").url) as client,
    ):
        client.subscribe("/front")
        wait_for_reader(sessions[0], "zstate/r1/cloud/front")
        publisher.publish(points, STAMP)
        client.until(lambda: client.frames.get("/front"))
        (message,) = client.messages("/front")
    assert client.channels["/front"]["schemaName"] == "sensor_msgs/msg/PointCloud2"
    assert [field.name for field in message.fields] == ["x", "y", "z", "ring"]
    assert np.frombuffer(bytes(message.data), points.dtype).tobytes() == points.tobytes()
