"""Pictures and calibrations as ROS 2 messages; rosbags is the independent encoder and decoder."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.manual_cdr import STORE, rosbags_cdr, rosbags_time
from helpers.pictures import jpeg, pixels, png, video
from helpers.processes import until
from hypothesis import given
from hypothesis import strategies as st

from zstate.cameras import Camera, CameraListener, CameraPublisher, RosImageListener
from zstate.cameras.camera import camera_from_message
from zstate.cameras.messages import CameraInfo, CompressedImage
from zstate.cameras.ros2 import decode_raw_image
from zstate.errors import InvalidInput, MessageError
from zstate.net.streams import KeyPublisher
from zstate.wire.joint_order import SampleLayout
from zstate.wire.messages import Message, from_block, to_block
from zstate.wire.ros2.decoder import RosDecoder
from zstate.wire.ros2.encoder import RosStreamEncoder
from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.topics import DdsKeys, FrameNames, RmwKeys
from zstate.wire.ros2.types import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE

STAMP = 1_700_000_000_123_456_789
NAMES = FrameNames(Ros2Options(), "r1")
K = (612.5, 598.25, 321.5, 238.75)
MATRIX = np.array([[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1]])
RATIONAL = (0.6, -0.9, 3e-4, -2e-4, 0.35, 0.95, -0.6, 0.12)
ROTATION = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
PROJECTION = np.array([[600.0, 0, 320, -60], [0, 600, 240, 0], [0, 0, 1, 0]])


def image(data: bytes = b"", form: Any = "jpeg", frame: str = "lens") -> CompressedImage:
    return CompressedImage(STAMP, 5, 77, frame, form, data or jpeg(8, 8))


def info(**changed: Any) -> CameraInfo:
    fields: dict[str, Any] = {
        **{"stamp": STAMP, "seq": 5, "session": 77, "frame": "lens", "width": 640, "height": 480},
        **{"model": "plumb_bob", "k": to_block(K), "d": to_block([-0.25, 0.1, 1e-3, -2e-3, 0.0])},
    }
    return CameraInfo(**{**fields, **changed})


def header(frame: str) -> Any:
    return STORE.types["std_msgs/msg/Header"](rosbags_time(STAMP), frame)


def rosbags_image(one: CompressedImage, form: str, *, little_endian: bool = True) -> bytes:
    data = np.frombuffer(one.data, np.uint8)
    return rosbags_cdr(COMPRESSED_IMAGE.name, header(one.frame), form, data, little_endian=little_endian)


def rosbags_info(  # noqa: PLR0917 - the order is that of CameraInfo
    size: tuple[int, int],
    model: str,
    d: Any,
    k: Any,
    r: Any = None,
    p: Any = None,
    binning: tuple[int, int] = (0, 0),
    region: tuple[int, int, int, int] = (0, 0, 0, 0),
    *,
    little_endian: bool = True,
) -> bytes:
    k = np.asarray(k, float)
    region_of = STORE.types["sensor_msgs/msg/RegionOfInterest"]
    return rosbags_cdr(
        CAMERA_INFO.name,
        header("lens"),
        size[1],
        size[0],
        model,
        np.asarray(d, float),
        k.ravel(),
        (np.eye(3) if r is None else np.asarray(r, float)).ravel(),
        (np.column_stack((k, np.zeros(3))) if p is None else np.asarray(p, float)).ravel(),
        *binning,
        region_of(*region, do_rectify=False),
        little_endian=little_endian,
    )


def encoded(message: Message) -> bytes:
    return RosStreamEncoder(NAMES, SampleLayout()).encode(message)


def decoded(stream: Any, payload: bytes) -> Any:
    (message,) = RosDecoder().messages(stream, payload, 77, 5, NAMES)
    return message


def refused(stream: Any, payload: bytes) -> str:
    with pytest.raises(MessageError) as caught:
        decoded(stream, payload)
    return caught.value.reason


@pytest.mark.parametrize(
    "one",
    [
        image(),
        image(png(5, 4), "png"),
        image(video(1)[0], "h264"),
        image(video(1, "h265")[0], "h265"),
        *(image(frame="f" * length) for length in range(1, 9)),
    ],
)
def test_a_picture_has_the_bytes_of_rosbags(one: CompressedImage):
    theirs = rosbags_image(one, one.format)
    assert encoded(one) == theirs
    turned = rosbags_image(one, one.format, little_endian=False)
    assert [decoded("image", payload) for payload in (theirs, turned, theirs + b"\x07\0\0")] == [one] * 3


@pytest.mark.parametrize(
    "form", ["jpeg", "", "bgr8; jpeg compressed bgr8", "rgb8; png compressed", "mono8; jpeg compressed "]
)
def test_the_first_bytes_say_what_a_picture_is_whatever_its_format_says(form: str):
    assert decoded("image", rosbags_image(image(), form)) == image()


@pytest.mark.parametrize(
    ("one", "form", "reason"),
    [
        (image(video(1)[0], "h264"), "jpeg", "foreign"),
        (image(), "", "foreign"),
        (image(), "16UC1; compressedDepth png", "foreign"),
    ],
)
def test_other_formats_are_refused(one: CompressedImage, form: str, reason: str):
    payload = rosbags_image(one, form)
    if one.format == "jpeg":
        payload = payload.replace(b"\xff\xd8\xff", b"\0\0\0")
    assert refused("image", payload) == reason


def test_a_truncated_picture_is_refused_as_such():
    payload = rosbags_image(image(), "jpeg")
    assert refused("image", payload[:-5]) == "truncated"
    whole = jpeg(8, 8)
    theirs = rosbags_cdr(COMPRESSED_IMAGE.name, header("lens"), "jpeg", np.frombuffer(whole[:-40], np.uint8))
    assert refused("image", theirs) == "truncated"


@pytest.mark.parametrize(
    ("one", "theirs"),
    [
        (info(), ((640, 480), "plumb_bob", [-0.25, 0.1, 1e-3, -2e-3, 0.0], MATRIX)),
        (
            info(model="rational_polynomial", d=to_block(RATIONAL)),
            ((640, 480), "rational_polynomial", RATIONAL, MATRIX),
        ),
        (info(model="equidistant", d=b""), ((640, 480), "equidistant", [], MATRIX)),
        (
            info(r=to_block(ROTATION), p=to_block(PROJECTION)),
            ((640, 480), "plumb_bob", [-0.25, 0.1, 1e-3, -2e-3, 0.0], MATRIX, ROTATION, PROJECTION),
        ),
        (info(k=bytes(32), d=b""), ((640, 480), "plumb_bob", [], np.zeros((3, 3)))),
    ],
)
def test_a_calibration_has_the_bytes_of_rosbags(one: CameraInfo, theirs: tuple[Any, ...]):
    payload = rosbags_info(*theirs)
    assert encoded(one) == payload
    turned = rosbags_info(*theirs, little_endian=False)
    assert [decoded("camera_info", one) for one in (payload, turned, payload + b"\x07\0")] == [one] * 3


def test_a_region_and_a_binning_give_the_calibration_of_the_pictures_as_they_are_sent():
    payload = rosbags_info((640, 480), "plumb_bob", [], MATRIX, None, PROJECTION, (2, 4), (100, 40, 200, 400))
    one = decoded("camera_info", payload)
    assert (one.width, one.height) == (200, 50)  # 400 / 2, 200 / 4
    assert np.allclose(from_block(one.k), (K[0] / 2, K[1] / 4, (K[2] - 100) / 2, (K[3] - 40) / 4))
    # A point of the whole sensor at (u, v) is at ((u - 100) / 2, (v - 40) / 4) in what is sent.
    whole, sent = Camera(640, 480, K), camera_from_message(one, "r1")
    point = [[0.1, 0.2, 1.0]]
    assert np.allclose(sent.project(point)[0], (whole.project(point)[0] - (100, 40)) / (2, 4))
    rectified = from_block(one.p).reshape(3, 4) @ [0.1, 0.2, 1.0, 1.0]
    of_sensor = PROJECTION @ [0.1, 0.2, 1.0, 1.0]
    assert np.allclose(rectified[:2], (of_sensor[:2] - (100, 40)) / (2, 4))


def test_numbers_beside_a_calibration_that_there_is_not_are_left_out():
    payload = rosbags_info((0, 0), "none", [1.0, 2.0], np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 4)))
    one = decoded("camera_info", payload)
    assert (one.is_calibrated, one.model, one.d, one.r, one.p) == (False, "plumb_bob", b"", None, None)
    with pytest.raises(InvalidInput, match="calibrate"):
        camera_from_message(one, "r1")


@pytest.mark.parametrize(
    ("model", "d", "k"),
    [
        ("fisheye62", [], MATRIX),
        ("plumb_bob", [1.0], MATRIX),
        ("plumb_bob", [np.nan] * 5, MATRIX),
        ("plumb_bob", [], -MATRIX),
        ("plumb_bob", [], MATRIX * np.nan),
        ("plumb_bob", [], MATRIX + np.eye(3, k=1)),
    ],
)
def test_what_is_no_calibration_is_malformed(model: str, d: list[float], k: np.ndarray):
    assert refused("camera_info", rosbags_info((640, 480), model, d, k)) == "malformed"


def raw(encoding: str, array: np.ndarray, step: int, height: int | None = None) -> bytes:
    rows, width = array.shape[:2]
    lines = np.zeros((rows, step), np.uint8)
    flat = array.reshape(rows, -1)[:, :step]
    lines[:, : flat.shape[1]] = flat
    data = lines.ravel()
    return rosbags_cdr(IMAGE.name, header("lens"), height or rows, width, encoding, 0, step, data)


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "rgba8", "bgra8", "mono8"])
def test_a_raw_picture_is_read_with_its_strides(encoding: str, padding: int):
    rgb = pixels(7, 5, 90)
    alpha = np.full((5, 7, 1), 255, np.uint8)
    sent = {
        "rgb8": rgb,
        "bgr8": rgb[..., ::-1],
        "rgba8": np.concatenate((rgb, alpha), axis=2),
        "bgra8": np.concatenate((rgb[..., ::-1], alpha), axis=2),
        "mono8": rgb[..., :1],
    }[encoding]
    payload = raw(encoding, sent, 7 * sent.shape[2] + padding)
    stamp, frame, array = decode_raw_image(payload, NAMES)
    assert (stamp, frame) == (STAMP, "lens")
    assert np.array_equal(array, rgb[..., 0] if encoding == "mono8" else rgb)


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (raw("32FC1", pixels(), 192), "foreign"),
        (raw("rgb8", pixels(), 191), "malformed"),
        (raw("rgb8", pixels(), 192, height=49), "malformed"),
        (raw("rgb8", pixels(), 192, height=2**32 - 1), "too large"),
        (raw("rgb8", pixels(), 192)[:-1], "truncated"),
        (raw("rgb8", pixels(), 192)[:4] + bytes(8) + raw("rgb8", pixels(), 192)[12:], "no stamp"),
    ],
)
def test_a_raw_picture_of_other_strides_sizes_or_encodings_is_refused(payload: bytes, reason: str):
    with pytest.raises(MessageError) as caught:
        decode_raw_image(payload, NAMES)
    assert caught.value.reason == reason


def test_raw_pictures_of_a_topic_are_published_as_pictures_of_the_robot(sessions):
    writer, reader = sessions
    key = f"0/wrist/image_raw/{IMAGE.dds}/{IMAGE.hash}"
    with (
        KeyPublisher(writer, key, "", is_bulk=True) as camera,
        RosImageListener(reader, "r1", "/wrist/image_raw") as raws,
        CameraPublisher(reader, "r1", "wrist") as publisher,
        CameraListener(writer, "r1") as listener,
    ):
        camera.put(raw("32FC1", pixels(), 192))
        until(lambda: camera.put(raw("bgr8", pixels()[..., ::-1], 192)) or len(raws._unread))
        image = next(iter(raws))
        assert (image.stamp, image.frame) == (STAMP, "lens")
        assert np.array_equal(image.pixels, pixels())
        until(lambda: publisher.publish(image.pixels, image.stamp) or listener.latest)
        assert listener.latest.stamp == STAMP
        until(lambda: camera.put(raw("32FC1", pixels(), 192)) or raws.refused)
        assert set(raws.refused) == {"foreign"}


@pytest.mark.parametrize(
    ("topic", "wire"), [("wrist", "ros2"), ("/wrist-1/image_raw", "ros2"), ("/wrist", "native")]
)
def test_what_is_no_topic_or_no_wire_of_raw_pictures_is_refused(sessions, topic: str, wire: str):
    with pytest.raises(InvalidInput):
        RosImageListener(sessions[0], "r1", topic, wire=wire)


@given(
    st.sampled_from([("image", encoded(image())), ("camera_info", encoded(info()))]),
    st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 255)), max_size=4),
)
def test_any_changed_bytes_are_a_message_or_refused(sent: tuple[str, bytes], changes: list[tuple[int, int]]):
    stream, payload = sent
    changed = bytearray(payload)
    for place, value in changes:
        changed[place % len(changed)] = value
    try:
        decoded(stream, bytes(changed))
    except MessageError as error:
        assert error.reason in {"malformed", "truncated", "too large", "foreign", "no stamp"}


def test_topics_are_those_of_image_transport():
    root, robots = RmwKeys(Ros2Options()), RmwKeys(Ros2Options(namespace="*"))
    assert root.topic("r1", "image", "wrist") == "/wrist/image_raw/compressed"
    assert robots.topic("r1", "camera_info", "wrist") == "/r1/wrist/camera_info"
    key = robots.key("r1", "image", "wrist")
    assert (robots.robot_from_key(key), robots.writer_name(key)) == ("r1", "wrist")
    kind = COMPRESSED_IMAGE.dds
    assert robots.expression("r1", "image") == f"0/r1/*/image_raw/compressed/{kind}/*"
    assert robots.expression("*", "image", "wrist") == f"0/*/wrist/image_raw/compressed/{kind}/*"
    bridged = DdsKeys(Ros2Options(namespace="*"))
    assert bridged.expression("r1", "camera_info") == "r1/*/camera_info"
    key = bridged.key("r1", "camera_info", "wrist")
    assert (bridged.robot_from_key(key), bridged.writer_name(key)) == ("r1", "wrist")


@pytest.mark.parametrize("wire", ["ros2:namespace=*", "ros2dds:namespace=*"])
def test_pictures_and_calibrations_cross_the_ros_wires(sessions, wire: str):
    writer, reader = sessions
    camera = Camera(64, 48, K, frame="lens")
    with (
        CameraPublisher(writer, "r1", "wrist", camera, wire) as publisher,
        CameraListener(reader, "r1", wire=wire) as listener,
    ):
        until(lambda: "wrist" in listener.cameras)
        until(lambda: publisher.publish(jpeg()) or len(listener))
        picture = next(iter(listener))
    assert (picture.name, picture.frame, picture.data) == ("wrist", "r1/lens", jpeg())
    assert picture.camera is not None
    assert picture.camera.k.tolist() == list(K)
