"""CDR payloads of zstate and of genuine ROS 2 are equal, byte for byte."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np
import pytest
from helpers.processes import Child
from hypothesis import given, settings
from hypothesis import strategies as st
from peers import Program
from ros_messages import (
    CLOCK,
    JOINT_STATE,
    STRING,
    TF_MESSAGE,
    XYZ,
    XYZW,
    joint_state,
    laser_scan,
    occupancy_grid,
    tf_message,
    time,
    transform_stamped,
)

from zstate.scans.messages import LaserScan, OccupancyGrid
from zstate.streams import StreamName
from zstate.wire.joint_order import SampleLayout
from zstate.wire.measurements import to_float32_block
from zstate.wire.messages import Message, to_block
from zstate.wire.ros2 import types
from zstate.wire.ros2.cdr import decode_clock, decode_string, encode_clock, encode_string
from zstate.wire.ros2.decoder import JointStateDecoder, RosDecoder, TfMessageDecoder
from zstate.wire.ros2.encoder import JointStateEncoder, RosStreamEncoder, TfMessageEncoder
from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.topics import FrameNames

pytestmark = [pytest.mark.kilted, pytest.mark.processes]

Piece = tuple[Literal["u32", "text", "f64", "f32", "i8"], Any]

texts = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=12)
stamps = st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1)
numbers = st.floats(allow_nan=False)
many = settings(max_examples=100, deadline=None)


@pytest.fixture(scope="module")
def kilted() -> Iterator[Program]:
    children: list[Child] = []

    def spawn(*arguments: str) -> Child:
        children.append(Child(*arguments))
        return children[-1]

    try:
        yield Program(spawn, "kilted", "rclpy_bytes.py")
    finally:
        for child in children:
            child.kill()


def mask(pieces: Sequence[Piece]) -> bytes:
    """1 for each defined byte of a payload, 0 for padding, which ROS leaves uninitialised."""
    out = bytearray(b"\1\1\1\1")
    for kind, value in pieces:
        size = {"f64": 8, "i8": 1}.get(kind, 4)
        out += bytes(-(len(out) - 4) % size)
        out += bytes([1]) * (4 + len(value.encode()) + 1 if kind == "text" else size)
    return bytes(out)


def header(frame: str = "") -> list[Piece]:
    return [("u32", 0), ("u32", 0), ("text", frame)]


def sequence(kind: Literal["text", "f64"], values: Sequence[Any]) -> list[Piece]:
    return [("u32", len(values)), *((kind, value) for value in values)]


def assert_same(ours: bytes, genuine: bytes, meant: bytes) -> None:
    """Equal but for padding; rmw_serialize may leave up to a word after the end."""
    assert len(ours) == len(meant)
    assert len(ours) <= len(genuine) < len(ours) + 16
    wrong = [i for i, means in enumerate(meant) if means and ours[i] != genuine[i]]
    assert not wrong, (wrong, ours.hex(), genuine.hex())


def genuine_bytes(kilted: Program, type_name: str, message: dict[str, Any]) -> bytes:
    return bytes.fromhex(kilted.ask("serialize", type=type_name, message=message))


def genuine_message(kilted: Program, type_name: str, payload: bytes) -> dict[str, Any]:
    return kilted.ask("deserialize", type=type_name, data=payload.hex())


@st.composite
def joint_states(draw: st.DrawFn) -> tuple[list[str], list[float], list[float] | None, list[float] | None]:
    names = draw(st.lists(texts, max_size=5, unique=True))
    block = st.lists(numbers, min_size=len(names), max_size=len(names))
    return names, draw(block), draw(block | st.none()), draw(block | st.none())


def test_type_hashes_are_those_that_ros_generates(kilted: Program):
    known = (types.JOINT_STATE, types.TF_MESSAGE, types.STRING, types.CLOCK)
    for kind in (*known, types.LASER_SCAN, types.OCCUPANCY_GRID):
        assert kind.hash == kilted.ask("hash", type_name=kind.name)


@many
@given(stamps, joint_states())
def test_joint_states_are_the_same_bytes(kilted: Program, stamp: int, state: Any):
    names, *blocks = state
    message = joint_state(stamp, names, *(block or [] for block in blocks))
    genuine = genuine_bytes(kilted, JOINT_STATE, message)
    packed = [None if block is None else to_block(block) for block in blocks]
    ours = JointStateEncoder(names).encode(stamp, *packed)
    floats = [piece for block in blocks for piece in sequence("f64", block or [])]
    assert_same(ours, genuine, mask([*header(), *sequence("text", names), *floats]))
    assert genuine_message(kilted, JOINT_STATE, ours) == message
    decoded = JointStateDecoder().decode(genuine)
    assert (decoded.stamp, list(decoded.names), decoded.positions) == (stamp, names, packed[0])
    assert [decoded.velocities or b"", decoded.efforts or b""] == [block or b"" for block in packed[1:]]


@many
@given(stamps, st.lists(st.tuples(texts, texts, st.lists(numbers, min_size=7, max_size=7)), max_size=4))
def test_transforms_are_the_same_bytes(kilted: Program, stamp: int, transforms: Any):
    message = tf_message(*(transform_stamped(stamp, *one) for one in transforms))
    genuine = genuine_bytes(kilted, TF_MESSAGE, message)
    edges = tuple((parent, child) for parent, child, _ in transforms)
    poses = to_block(np.array([pose for _, _, pose in transforms], dtype=np.float64))
    ours = TfMessageEncoder(edges).encode(stamp, poses)
    pieces: list[Piece] = [("u32", len(edges))]
    for parent, child in edges:
        pieces += [*header(parent), ("text", child), *[("f64", 0.0)] * len(XYZ + XYZW)]
    assert_same(ours, genuine, mask(pieces))
    assert genuine_message(kilted, TF_MESSAGE, ours) == message
    decoded = TfMessageDecoder().decode(genuine)
    assert (decoded.stamps, decoded.edges, decoded.poses) == ((stamp,) * len(edges), edges, poses)


PLAIN = FrameNames(Ros2Options(), "r1")

frames = texts.filter(lambda text: text.strip("/") == text != "" and text.isprintable())
floats = st.floats(width=32, allow_nan=False)


def encoded(message: Message) -> bytes:
    return RosStreamEncoder(PLAIN, SampleLayout()).encode(message)


def decoded(stream: StreamName, payload: bytes) -> Message:
    (message,) = RosDecoder().messages(stream, payload, 77, 5, PLAIN)
    return message


@many
@given(stamps.filter(bool), frames, st.lists(floats, max_size=6))
def test_scans_are_the_same_bytes(kilted: Program, stamp: int, frame: str, ranges: list[float]):
    # exact in float32: 1953125 ns and 31250000 ns are 2^-9 s and 2^-5 s
    angle_max = -0.5 + 0.25 * max(0, len(ranges) - 1)
    numbers = (-0.5, angle_max, 0.25, 2.0**-9, 2.0**-5, 0.125, 8.0)
    message = laser_scan(stamp, frame, numbers, ranges, ranges)
    genuine = genuine_bytes(kilted, types.LASER_SCAN.name, message)
    block = to_float32_block(ranges)
    times = (1_953_125, 31_250_000)
    scan = LaserScan(stamp, 5, 77, frame, -0.5, 0.25, *times, 0.125, 8.0, block, block or None)
    rays: list[Piece] = [("u32", 0), *[("f32", 0.0)] * len(ranges)]
    assert_same(encoded(scan), genuine, mask([*header(frame), *[("f32", 0.0)] * 7, *rays, *rays]))
    assert decoded("scan", genuine) == scan


@many
@given(stamps, frames, st.lists(st.integers(-1, 100), max_size=6))
def test_grids_are_the_same_bytes(kilted: Program, stamp: int, frame: str, cells: list[int]):
    pose7 = [1, 2, 3, 0, 0, 0, 1]
    message = occupancy_grid(stamp, frame, 0.25, pose7, [cells])
    genuine = genuine_bytes(kilted, types.OCCUPANCY_GRID.name, message)
    origin, block = to_block(pose7), np.array(cells, np.int8).tobytes()
    grid = OccupancyGrid(77, stamp, frame, 0.25, len(cells), 1, origin, block)
    pieces = [*header(frame), *[("u32", 0)] * 5, *[("f64", 0.0)] * 7, ("u32", 0), *[("i8", 0)] * len(cells)]
    assert_same(encoded(grid), genuine, mask(pieces))
    assert genuine_message(kilted, types.OCCUPANCY_GRID.name, encoded(grid)) == message
    assert decoded("map", genuine) == grid


@many
@given(texts)
def test_texts_are_the_same_bytes(kilted: Program, text: str):
    genuine = genuine_bytes(kilted, STRING, {"data": text})
    assert_same(encode_string(text), genuine, mask([("text", text)]))
    assert genuine_message(kilted, STRING, encode_string(text)) == {"data": text}
    assert decode_string(genuine) == text


@many
@given(stamps)
def test_clocks_are_the_same_bytes(kilted: Program, stamp: int):
    genuine = genuine_bytes(kilted, CLOCK, {"clock": time(stamp)})
    assert_same(encode_clock(stamp), genuine, mask([("u32", 0), ("u32", 0)]))
    assert genuine_message(kilted, CLOCK, encode_clock(stamp)) == {"clock": time(stamp)}
    assert decode_clock(genuine) == stamp
