"""Independent CDR encoders: one written from the specification, and rosbags.

XCDR1, section 7.4.1 of the DDS-XTypes specification: a value is aligned to its size, counted
from the end of the four-byte header; a string is a uint32 length including its NUL, then the bytes;
a sequence is a uint32 count, then the items.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from rosbags.typesys import Stores, get_typestore

Value = tuple[str, object]  # "i", "I" or "d" as in struct, or "s"
Edges = Sequence[tuple[str, str]]

SECOND = 10**9
STORE = get_typestore(Stores.ROS2_KILTED)


def zeros(size: int) -> bytes:
    return bytes(size)


def cdr(values: Iterator[Value], order: str = "<", fill: Callable[[int], bytes] = zeros) -> bytes:
    """The payload of these values; ``fill`` makes the padding."""
    data = b""
    for kind, value in values:
        if kind == "s":
            text = str(value).encode() + b"\x00"
            data += fill(-len(data) % 4) + struct.pack(f"{order}I", len(text)) + text
        else:
            data += fill(-len(data) % struct.calcsize(kind)) + struct.pack(order + kind, value)
    return (b"\x00\x01" if order == "<" else b"\x00\x00") + fill(2) + data


def time(stamp: int) -> Iterator[Value]:
    yield "i", stamp // SECOND
    yield "I", stamp % SECOND


def joint_state(
    stamp: int,
    frame_id: str,
    names: Sequence[str],
    *sequences: Sequence[float],
) -> Iterator[Value]:
    """The values of a JointState: names, then positions, velocities and efforts."""
    yield from time(stamp)
    yield "s", frame_id
    yield "I", len(names)
    yield from (("s", name) for name in names)
    for sequence in sequences:
        yield "I", len(sequence)
        yield from (("d", number) for number in sequence)


def tf_message(stamps: Sequence[int], edges: Edges, poses: Sequence[Sequence[float]]) -> Iterator[Value]:
    """The values of a TFMessage."""
    yield "I", len(edges)
    for stamp, (parent, child), pose in zip(stamps, edges, poses, strict=True):
        yield from time(stamp)
        yield "s", parent
        yield "s", child
        yield from (("d", number) for number in pose)


def rosbags_cdr(name: str, *fields: object, little_endian: bool = True) -> bytes:
    """The rosbags encoding of a message with these fields."""
    return bytes(STORE.serialize_cdr(STORE.types[name](*fields), name, little_endian=little_endian))


def rosbags_time(stamp: int) -> object:
    return STORE.types["builtin_interfaces/msg/Time"](stamp // SECOND, stamp % SECOND)


def rosbags_joint_state(
    stamp: int, frame_id: str, names: Sequence[str], *sequences: Sequence[float], little_endian: bool = True
) -> bytes:
    header = STORE.types["std_msgs/msg/Header"](rosbags_time(stamp), frame_id)
    arrays = [np.array(sequence, "f8") for sequence in sequences]
    return rosbags_cdr(
        "sensor_msgs/msg/JointState", header, list(names), *arrays, little_endian=little_endian
    )


def rosbags_tf_message(
    stamps: Sequence[int], edges: Edges, poses: Sequence[Sequence[float]], *, little_endian: bool = True
) -> bytes:
    types = STORE.types
    transforms = [
        types["geometry_msgs/msg/TransformStamped"](
            types["std_msgs/msg/Header"](rosbags_time(stamp), parent),
            child,
            types["geometry_msgs/msg/Transform"](
                types["geometry_msgs/msg/Vector3"](*pose[:3]),
                types["geometry_msgs/msg/Quaternion"](*pose[3:]),
            ),
        )
        for stamp, (parent, child), pose in zip(stamps, edges, poses, strict=True)
    ]
    return rosbags_cdr("tf2_msgs/msg/TFMessage", transforms, little_endian=little_endian)


def rosbags_numbers(
    numbers: Sequence[float], labels: Sequence[str] = (), *, little_endian: bool = True
) -> bytes:
    """A Float64MultiArray with a dimension for each of ``labels``."""
    types = STORE.types
    dimensions = [types["std_msgs/msg/MultiArrayDimension"](label, len(numbers), 1) for label in labels]
    layout = types["std_msgs/msg/MultiArrayLayout"](dimensions, 0)
    data = np.array(numbers, "f8")
    return rosbags_cdr("std_msgs/msg/Float64MultiArray", layout, data, little_endian=little_endian)


Point = tuple[float, Sequence[Sequence[float]]]
"""The time from the start [s]; positions, and what follows of velocities, accelerations and efforts."""


def rosbags_trajectory(stamp: int, names: Sequence[str], *points: Point, little_endian: bool = True) -> bytes:
    types = STORE.types
    header = types["std_msgs/msg/Header"](rosbags_time(stamp), "")
    rows = []
    for time_s, numbers in points:
        blocks = [np.array(block, "f8") for block in (*numbers, *[()] * (4 - len(numbers)))]
        duration = types["builtin_interfaces/msg/Duration"](*divmod(round(time_s * SECOND), SECOND))
        rows.append(types["trajectory_msgs/msg/JointTrajectoryPoint"](*blocks, duration))
    name = "trajectory_msgs/msg/JointTrajectory"
    return rosbags_cdr(name, header, list(names), rows, little_endian=little_endian)
