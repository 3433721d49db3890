"""Scans and grids as ROS 2 messages; rosbags is the independent encoder and decoder."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from helpers.manual_cdr import STORE, rosbags_cdr, rosbags_time
from hypothesis import given
from hypothesis import strategies as st
from mcap_ros2._dynamic import generate_dynamic

from zstate.errors import InvalidInput, MessageError
from zstate.scans.messages import LaserScan, OccupancyGrid
from zstate.stream_registry import stream_named
from zstate.wire.joint_order import SampleLayout
from zstate.wire.measurements import to_float32_block
from zstate.wire.messages import Message, to_block
from zstate.wire.ros2.decoder import RosDecoder
from zstate.wire.ros2.encoder import RosStreamEncoder
from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.topics import FrameNames
from zstate.wire.ros2.types import LASER_SCAN, OCCUPANCY_GRID

STAMP = 1_700_000_000_123_456_789
PLAIN, PREFIXED = FrameNames(Ros2Options(), "r1"), FrameNames(Ros2Options(frame_prefix="r1/"), "r1")
RANGES = np.array([0.5, np.inf, -np.inf, np.nan, 3.25], "f4")
HUGE = 2**32 - 1


def scan(**changed: Any) -> LaserScan:
    # all floats are exact in float32
    fields: dict[str, Any] = {
        **{
            "stamp": STAMP,
            "seq": 5,
            "session": 77,
            "frame": "laser",
            "angle_min": -2.25,
            "angle_increment": 0.25,
        },
        **{"ray_ns": 18_500, "scan_ns": 25_000_000, "range_min": 0.125, "range_max": 30.0},
        "ranges": to_float32_block(RANGES),
    }
    return LaserScan(**{**fields, **changed})


def grid(width: int = 3, height: int = 2, **changed: Any) -> OccupancyGrid:
    cells = (np.arange(width * height) % 102 - 1).astype(np.int8).tobytes()
    pose = to_block([1, 2, 3, 0, 0, 0, 1])
    fields: dict[str, Any] = {
        **{
            "session": 77,
            "stamp": STAMP,
            "frame": "map",
            "resolution": 0.25,
            "width": width,
            "height": height,
        },
        **{"origin": pose, "cells": cells},
    }
    return OccupancyGrid(**{**fields, **changed})


def rosbags_scan(one: LaserScan, *, little_endian: bool = True) -> bytes:
    header = STORE.types["std_msgs/msg/Header"](rosbags_time(one.stamp), one.frame)
    ranges = np.frombuffer(one.ranges, "<f4")
    angle_max = one.angle_min + max(0, len(ranges) - 1) * one.angle_increment
    numbers = (one.angle_min, angle_max, one.angle_increment, one.ray_ns / 1e9, one.scan_ns / 1e9)
    arrays = ranges, np.frombuffer(one.intensities or b"", "<f4")
    limits = one.range_min, one.range_max
    return rosbags_cdr(LASER_SCAN.name, header, *numbers, *limits, *arrays, little_endian=little_endian)


def rosbags_grid(one: OccupancyGrid, *, little_endian: bool = True) -> bytes:
    types, time = STORE.types, rosbags_time(one.stamp)
    numbers = np.frombuffer(one.origin, "<f8").tolist()
    origin = types["geometry_msgs/msg/Pose"](
        types["geometry_msgs/msg/Point"](*numbers[:3]), types["geometry_msgs/msg/Quaternion"](*numbers[3:])
    )
    return rosbags_cdr(
        OCCUPANCY_GRID.name,
        types["std_msgs/msg/Header"](time, one.frame),
        types["nav_msgs/msg/MapMetaData"](time, one.resolution, one.width, one.height, origin),
        np.frombuffer(one.cells, np.int8),
        little_endian=little_endian,
    )


def encoded(message: Message, names: FrameNames = PLAIN) -> bytes:
    return RosStreamEncoder(names, SampleLayout()).encode(message)


def decoded(stream: Any, payload: bytes, names: FrameNames = PLAIN) -> Message:
    (message,) = RosDecoder().messages(stream, payload, 77, 5, names)
    return message


def refused(stream: Any, payload: bytes) -> MessageError:
    with pytest.raises(MessageError) as caught:
        decoded(stream, payload)
    return caught.value


SCANS = [
    scan(),
    scan(intensities=to_float32_block(RANGES[::-1])),
    scan(ranges=b"", ray_ns=0, scan_ns=0),
    *(scan(frame="f" * length, range_max=np.inf) for length in range(1, 9)),
]
GRIDS = [grid(), grid(0, 0), grid(1, 1, stamp=0), *(grid(frame="f" * length) for length in range(1, 9))]


@pytest.mark.parametrize("one", SCANS)
def test_a_scan_has_the_bytes_of_rosbags(one: LaserScan):
    theirs = rosbags_scan(one)
    assert encoded(one) == theirs
    turned = rosbags_scan(one, little_endian=False)
    assert [decoded("scan", payload) for payload in (theirs, turned, theirs + b"\x07\0\0")] == [one] * 3


@pytest.mark.parametrize("one", GRIDS)
def test_a_grid_has_the_bytes_of_rosbags(one: OccupancyGrid):
    theirs = rosbags_grid(one)
    assert encoded(one) == theirs
    turned = rosbags_grid(one, little_endian=False)
    assert [decoded("map", payload) for payload in (theirs, turned, theirs + b"\x07\0\0")] == [one] * 3


@pytest.mark.long
def test_a_grid_of_4096_x_4096_cells_has_an_allowed_size():
    assert len(encoded(grid(4096, 4096, frame="f" * 1024))) <= stream_named("map").max_bytes


def test_mcap_ros2_support_decodes_scans_and_grids():
    decode = generate_dynamic(LASER_SCAN.name, LASER_SCAN.definition)[LASER_SCAN.name]
    theirs = decode(encoded(scan()))
    assert (theirs.header.frame_id, theirs.angle_min, theirs.angle_max) == ("laser", -2.25, -1.25)
    assert np.array(theirs.ranges, "f4").tobytes() == RANGES.tobytes()
    decode = generate_dynamic(OCCUPANCY_GRID.name, OCCUPANCY_GRID.definition)[OCCUPANCY_GRID.name]
    theirs = decode(encoded(grid()))
    assert (theirs.info.width, theirs.info.height, theirs.info.resolution) == (3, 2, 0.25)
    assert (theirs.info.origin.position.z, list(theirs.data)) == (3.0, [-1, 0, 1, 2, 3, 4])


@given(st.integers(0, 15_625_000), st.integers(0, 15_625_000))
def test_times_of_rays_up_to_15_ms_are_read_to_the_nanosecond(ray_ns: int, scan_ns: int):
    # below 2^-6 s the last of the 24 bits of float32 is at most 2^-30 s, and its half is below 0.5 ns
    one = scan(ray_ns=ray_ns, scan_ns=scan_ns)
    assert decoded("scan", encoded(one)) == one


def test_frames_have_the_prefix_of_the_robot_in_ros():
    for stream, one, name in (("scan", scan(), b"r1/laser\0"), ("map", grid(), b"r1/map\0")):
        payload = encoded(one, PREFIXED)
        assert name in payload
        assert decoded(stream, payload, PREFIXED) == one


@pytest.mark.parametrize(("stream", "payload"), [("scan", encoded(SCANS[1])), ("map", encoded(GRIDS[0]))])
def test_a_message_cut_off_anywhere_is_truncated(stream: str, payload: bytes):
    assert {refused(stream, payload[:length]).reason for length in range(len(payload))} == {"truncated"}


# The bytes of "laser" and "map", with a NUL, begin at byte 16 after the header, the stamp and their length.
_SCAN_NUMBERS, _GRID_NUMBERS = 24, 20 + 8


def with_number(payload: bytes, offset: int, form: str, value: float) -> bytes:
    data = bytearray(payload)
    struct.pack_into(form, data, offset, value)
    return bytes(data)


@pytest.mark.parametrize("offset", [12, _SCAN_NUMBERS + 28, _SCAN_NUMBERS + 32 + 4 * len(RANGES)])
@pytest.mark.parametrize("count", [HUGE, 2**31, 2**30, 1000])
def test_a_scan_that_promises_more_than_it_has_is_truncated(offset: int, count: int):
    assert refused("scan", with_number(encoded(scan()), offset, "<I", count)).reason == "truncated"


@pytest.mark.parametrize(("offset", "reason"), [(12, "truncated"), (100, "truncated"), (32, "malformed")])
def test_a_grid_that_promises_more_than_it_has_is_refused(offset: int, reason: str):
    payload = encoded(grid())
    assert struct.unpack_from("<I", payload, 32) == (3,)
    assert struct.unpack_from("<I", payload, 100) == (6,)
    assert refused("map", with_number(payload, offset, "<I", HUGE)).reason == reason


@pytest.mark.parametrize(
    ("index", "value", "text"),
    [
        (0, np.nan, "angles of finite numbers"),
        (2, np.inf, "angles of finite numbers"),
        (3, np.nan, "its time_increment is nan"),
        (3, -1e-6, "rays of -1000 ns each"),
        (3, 1e30, "last ray has 64 bits"),
        (4, np.inf, "its scan_time inf"),
        (4, -0.1, "a scan of -1000000"),
        (5, -1.0, "0 <= range_min <= range_max"),
        (6, np.nan, "0 <= range_min <= range_max"),
    ],
)
def test_a_scan_with_impossible_numbers_is_malformed(index: int, value: float, text: str):
    error = refused("scan", with_number(encoded(scan()), _SCAN_NUMBERS + 4 * index, "<f", value))
    assert error.reason == "malformed"
    assert text in str(error)


def test_intensities_of_other_rays_are_malformed():
    payload = encoded(scan()) + bytes(8)
    offset = _SCAN_NUMBERS + 32 + 4 * len(RANGES)
    assert "5 ranges take as many" in str(refused("scan", with_number(payload, offset, "<I", 2)))


@pytest.mark.parametrize(
    ("offset", "form", "value", "text"),
    [
        (_GRID_NUMBERS, "<f", 0.0, "resolution of a grid is positive"),
        (_GRID_NUMBERS, "<f", np.nan, "resolution of a grid is positive"),
        (44, "<d", np.nan, "origin of finite numbers"),
        (104, "<b", -2, "cells are from -1"),
        (104, "<b", 101, "cells are from -1"),
        (32, "<I", 4, "4 x 2 needs as many cells"),
    ],
)
def test_a_grid_with_impossible_numbers_is_malformed(offset: int, form: str, value: float, text: str):
    error = refused("map", with_number(encoded(grid()), offset, form, value))
    assert error.reason == "malformed"
    assert text in str(error)


def test_a_scan_without_a_stamp_or_a_frame_is_refused():
    assert refused("scan", rosbags_scan(scan()).replace(encoded(scan())[4:12], bytes(8))).reason == "no stamp"
    with pytest.raises(InvalidInput, match="means no stamp in ROS"):
        encoded(scan(stamp=0))
    nameless = encoded(scan(frame="abc")).replace(b"\x04\0\0\0abc\0", b"\x01\0\0\0\0abc")
    assert "1 to 1024 characters, not 0" in str(refused("scan", nameless))


@pytest.mark.parametrize(
    "make",
    [
        lambda: scan(angle_min=1e300),
        lambda: scan(range_max=1e300),
        lambda: grid(resolution=1e300),
        lambda: scan(stamp=2**62),
        lambda: grid(stamp=2**62),
        lambda: scan(frame="a\0b"),
    ],
)
def test_numbers_that_ros_cannot_represent_are_refused(make: Callable[[], Message]):
    with pytest.raises(InvalidInput):
        encoded(make())


@given(
    st.sampled_from([("scan", encoded(SCANS[1])), ("map", encoded(GRIDS[0]))]),
    st.integers(0, 200),
    st.binary(min_size=1, max_size=8),
)
def test_changed_bytes_raise_only_message_error(whole: tuple[Any, bytes], at: int, change: bytes):
    stream, payload = whole
    at %= len(payload)
    try:
        decoded(stream, payload[:at] + change + payload[at + len(change) :])
    except MessageError as error:
        assert error.reason in {"truncated", "malformed", "no stamp"}
