"""Size limits of messages, which bound the memory that a writer can make a reader use."""

from __future__ import annotations

from collections.abc import Mapping

from zstate.errors import MessageError
from zstate.wire.keys import Stream
from zstate.wire.messages import JointState, Message, StaticTransforms, TransformSample

SAMPLE_BYTES = 256_000
"""The transforms of 2000 links, names included, take less; in CDR they take up to four times as many."""

LATCHED_BYTES = 16 * 2**20
ATTACHMENT_BYTES = 1_024
STATIC_EDGES = 10_000

MOST_BYTES: Mapping[Stream, int] = {
    "joint_states": SAMPLE_BYTES,
    "tf": SAMPLE_BYTES,
    "joint_commands": SAMPLE_BYTES,
    "tf_static": 1_000_000,
    "robot_description": LATCHED_BYTES,
    "clock": 1_000,
}

_OVERHEAD = 200
"""What a decoded message takes beside its numbers and names [bytes], at least."""


def check_size(stream: Stream, size: int, factor: int = 1) -> None:
    """Raise MessageError for a payload of ``size`` bytes that is too large for ``stream``."""
    most = MOST_BYTES[stream] * factor
    if size > most:
        raise MessageError(f"{size} bytes on {stream}, where {most} are allowed", reason="too large")


def check_edges(message: Message) -> None:
    """Raise MessageError for more than 10,000 static edges in one message."""
    if isinstance(message, StaticTransforms) and len(message.edges) > STATIC_EDGES:
        text = f"{len(message.edges)} static edges of one writer, where {STATIC_EDGES} are allowed"
        raise MessageError(text, reason="too large")


def size_of(message: Message) -> int:
    """About how many bytes a decoded sample keeps."""
    if isinstance(message, JointState):
        blocks = len(message.positions) + len(message.velocities or b"") + len(message.efforts or b"")
        return _OVERHEAD + blocks + 60 * len(message.names or ())
    if isinstance(message, TransformSample):
        return _OVERHEAD + len(message.poses) + 200 * len(message.edges or ())
    return _OVERHEAD
