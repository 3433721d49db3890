"""Clouds as ROS 2 messages; rosbags is the independent encoder and decoder."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest
from helpers.manual_cdr import STORE, rosbags_cdr, rosbags_time
from hypothesis import given
from hypothesis import strategies as st
from mcap_ros2._dynamic import generate_dynamic

from zstate.clouds.cloud import Cloud, cloud_from_message, cloud_to_message
from zstate.clouds.messages import CLOUD_POINTS, PointCloud, PointField
from zstate.errors import InvalidInput, MessageError
from zstate.wire.joint_order import SampleLayout
from zstate.wire.measurements import with_field
from zstate.wire.messages import Message
from zstate.wire.ros2.decoder import RosDecoder
from zstate.wire.ros2.encoder import RosStreamEncoder
from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.topics import FrameNames
from zstate.wire.ros2.types import POINT_CLOUD2

STAMP = 1_700_000_000_123_456_789
PLAIN, PREFIXED = FrameNames(Ros2Options(), "r1"), FrameNames(Ros2Options(frame_prefix="r1/"), "r1")
POINT = [PointField("x", 0, 7, 1), PointField("y", 4, 7, 1), PointField("z", 8, 7, 1)]
VELODYNE = [
    *POINT,
    PointField("intensity", 12, 7, 1),
    PointField("ring", 16, 4, 1),
    PointField("time", 18, 7, 1),
]
OUSTER = [*POINT, PointField("t", 20, 6, 1), PointField("histogram", 24, 8, 3)]


def cloud(
    fields: list[PointField] = POINT, step: int = 12, rows: int = 1, pad: int = 0, **changed: Any
) -> PointCloud:
    width = 3
    row_step = width * step + pad
    data = np.random.default_rng(step).integers(0, 256, rows * row_step, dtype=np.uint8).tobytes()
    head: dict[str, Any] = {"stamp": STAMP, "seq": 5, "session": 77, "frame": "lidar"}
    layout: dict[str, Any] = {
        **{"height": rows, "width": width, "fields": tuple(fields), "is_bigendian": False},
        **{"point_step": step, "row_step": row_step, "data": data, "is_dense": False},
    }
    return PointCloud(**{**head, **layout, **changed})


def rosbags_cloud(one: PointCloud, *, little_endian: bool = True) -> bytes:
    types = STORE.types
    return rosbags_cdr(
        POINT_CLOUD2.name,
        types["std_msgs/msg/Header"](rosbags_time(one.stamp), one.frame),
        one.height,
        one.width,
        [types["sensor_msgs/msg/PointField"](*field) for field in one.fields],
        one.is_bigendian,
        one.point_step,
        one.row_step,
        np.frombuffer(one.data, np.uint8),
        one.is_dense,
        little_endian=little_endian,
    )


def encoded(message: Message, names: FrameNames = PLAIN) -> bytes:
    return RosStreamEncoder(names, SampleLayout()).encode(message)


def decoded(payload: bytes, names: FrameNames = PLAIN) -> Message:
    (message,) = RosDecoder().messages("cloud", payload, 77, 5, names)
    return message


def refused(payload: bytes) -> MessageError:
    with pytest.raises(MessageError) as caught:
        decoded(payload)
    return caught.value


CLOUDS = [
    cloud(),
    cloud(VELODYNE, 22),
    cloud(OUSTER, 48, rows=2, pad=7, is_bigendian=True, is_dense=True),
    cloud(width=0, row_step=0, data=b""),
    *(cloud(frame="f" * length) for length in range(1, 9)),
    *(cloud([PointField("x" * length, 0, 2, 1)], 1) for length in range(1, 9)),
]


@pytest.mark.parametrize("one", CLOUDS)
def test_a_cloud_has_the_bytes_of_rosbags(one: PointCloud):
    theirs = rosbags_cloud(one)
    assert encoded(one) == theirs
    turned = rosbags_cloud(one, little_endian=False)
    assert [decoded(payload) for payload in (theirs, turned, theirs + b"\x07\0\0")] == [one] * 3


def test_mcap_ros2_support_decodes_clouds():
    decode = generate_dynamic(POINT_CLOUD2.name, POINT_CLOUD2.definition)[POINT_CLOUD2.name]
    theirs, one = decode(encoded(CLOUDS[2])), CLOUDS[2]
    assert (theirs.header.frame_id, theirs.height, theirs.point_step) == ("lidar", 2, 48)
    assert [(field.name, field.count) for field in theirs.fields][-1] == ("histogram", 3)
    assert (bytes(theirs.data), theirs.is_dense) == (one.data, True)


@pytest.mark.parametrize("compression", ["lz4", "zstd"])
def test_a_compressed_cloud_is_decompressed_for_ros(compression: Any):
    points = (
        np.random.default_rng(1).random((100, 3), dtype=np.float32).view([(n, "<f4") for n in "xyz"])[:, 0]
    )
    one = Cloud(STAMP, "lidar", points)
    plain, packed = (cloud_to_message(one, True, chosen) for chosen in ("", compression))
    assert encoded(packed) == encoded(plain)
    rounded = decoded(encoded(cloud_to_message(one, True, compression, 0.01)))
    assert isinstance(rounded, PointCloud)
    # half of the resolution, and the rounding to float32
    assert abs(cloud_from_message(rounded, "r1").xyz - one.xyz).max() <= 0.005 + 1e-7


def test_frames_have_the_prefix_of_the_robot_in_ros():
    payload = encoded(cloud(), PREFIXED)
    assert b"r1/lidar\0" in payload
    assert decoded(payload, PREFIXED) == cloud()


def test_a_message_cut_off_anywhere_is_truncated():
    payload = encoded(CLOUDS[1])
    assert {refused(payload[:length]).reason for length in range(len(payload))} == {"truncated"}


# "lidar" with its NUL begins at byte 16 after the header, the stamp and its length, and ends at 22.
_HEIGHT, _WIDTH, _FIELDS = 24, 28, 32


@pytest.mark.parametrize(
    ("offset", "count", "reason", "text"),
    [
        (_FIELDS, 2**32 - 1, "malformed", "points of 4294967295 fields, where 64 are allowed"),
        (_FIELDS, 65, "malformed", "points of 65 fields"),
        (_FIELDS, 0, "malformed", ""),
        (_WIDTH, 10**8, "malformed", f"100000000 points of 12 bytes, where {CLOUD_POINTS} points"),
        (_WIDTH, 4, "malformed", "4 points of 12 bytes do not fit into a row of 36"),
        (_HEIGHT, 2, "malformed", "2 rows of 36 bytes need as many; the cloud has 36"),
        (_HEIGHT, 2**32 - 1, "malformed", f"where {CLOUD_POINTS} points"),
    ],
)
def test_counts_that_do_not_agree_are_refused(offset: int, count: int, reason: str, text: str):
    data = bytearray(encoded(cloud()))
    struct.pack_into("<I", data, offset, count)
    error = refused(bytes(data))
    assert error.reason == reason
    assert text in str(error)


def test_more_bytes_than_there_are_is_truncated():
    payload = encoded(cloud())
    at = payload.rindex(struct.pack("<I", 36))
    assert refused(payload[:at] + struct.pack("<I", 2**31) + payload[at + 4 :]).reason == "truncated"


@pytest.mark.parametrize(
    ("field", "text"),
    [
        (PointField("x", 9, 7, 1), "is not inside a point of 12 bytes"),
        (PointField("x", 0, 7, 4), "is not inside a point of 12 bytes"),
        (PointField("x", 0, 0, 1), "datatype 0"),
        (PointField("x", 0, 9, 1), "datatype 9"),
        (PointField("x", 0, 7, 0), "the count 0"),
        (PointField("z", 0, 7, 1), "different names"),
        (PointField("", 0, 7, 1), "a name has 1 to"),
    ],
)
def test_impossible_fields_are_refused(field: PointField, text: str):
    with pytest.raises(InvalidInput, match=text):
        with_field(cloud(), "fields", (field, *POINT[1:]))


@given(
    st.sampled_from([encoded(one) for one in CLOUDS[:3]]),
    st.integers(0, 300),
    st.binary(min_size=1, max_size=8),
)
def test_changed_bytes_raise_only_message_error(whole: bytes, at: int, change: bytes):
    at %= len(whole)
    try:
        decoded(whole[:at] + change + whole[at + len(change) :])
    except MessageError as error:
        assert error.reason in {"truncated", "malformed", "no stamp"}
