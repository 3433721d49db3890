"""Messages of a single value: ``std_msgs/msg/String`` and ``rosgraph_msgs/msg/Clock``."""

from __future__ import annotations

from zstate.wire.ros2.cdr import CdrReader, CdrWriter
from zstate.wire.ros2.types import CLOCK, STRING


def encode_string(text: str) -> bytes:
    """The payload of a String. Raises InvalidInput for a text with a NUL or a lone surrogate in it."""
    writer = CdrWriter()
    writer.text(text)
    return writer.payload()


def decode_string(payload: bytes) -> str:
    """The text of a String. Raises MessageError with the reason "truncated" or "malformed"."""
    return CdrReader(payload, STRING.name).text()


def encode_clock(stamp: int) -> bytes:
    """The payload of a Clock at ``stamp`` [ns]. Raises InvalidInput outside the years 1901 to 2038."""
    writer = CdrWriter()
    writer.stamp(stamp)
    return writer.payload()


def decode_clock(payload: bytes) -> int:
    """The stamp [ns] of a Clock. Raises MessageError with the reason "truncated" or "malformed"."""
    return CdrReader(payload, CLOCK.name).stamp()
