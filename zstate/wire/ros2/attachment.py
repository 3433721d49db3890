"""The 33 bytes that rmw_zenoh_cpp puts beside every message; a ROS node drops one that has none."""

from __future__ import annotations

from struct import Struct
from typing import NamedTuple

from zstate.errors import MessageError

GID_BYTES = 16

_LAYOUT = Struct("<qqB16s")  # the third is the length of what follows, as Zenoh serialises a slice
_LABEL = b"sequence_number"


class Attachment(NamedTuple):
    """Which message of which writer this is.

    ``seq`` begins at 1 and grows by one; ``source_time`` [ns since the Unix epoch] is the clock of
    the writer when it wrote; ``gid`` tells the writer, see ``zstate.wire.ros2.graph.gid``.
    """

    seq: int
    source_time: int
    gid: bytes


def pack(seq: int, source_time_ns: int, gid: bytes) -> bytes:
    """The attachment of one message. A ROS node that reads another length ends in an exception."""
    return _LAYOUT.pack(seq, source_time_ns, GID_BYTES, gid)


def unpack(data: bytes | None) -> Attachment:
    """What stood beside a message.

    Raises MessageError with the reason "no attachment" when nothing did, or "foreign" when it was
    not rmw_zenoh_cpp's.
    """
    if data is None:
        raise MessageError(
            "no attachment: every message of rmw_zenoh_cpp has one; another program writes on this key, "
            "or a bridge that drops it",
            reason="no attachment",
        )
    if len(data) != _LAYOUT.size or data[16] != GID_BYTES:
        raise _foreign(data)
    seq, source_time, _length, gid = _LAYOUT.unpack(data)
    if seq < 0:
        raise _foreign(data)
    return Attachment(seq, source_time, gid)


def session_from_gid(gid: bytes) -> int:
    """The number that tells this start of a writer from others, made of its ``gid``."""
    return int.from_bytes(gid[:8], "little")


def _foreign(data: bytes) -> MessageError:
    if _LABEL in data[: len(_LABEL) + 1]:
        return MessageError(
            f"an attachment of {len(data)} bytes with labels, as rmw_zenoh_cpp wrote before mid 2025: "
            "upgrade it to humble 0.1.2, jazzy 0.2.4, kilted 0.6.0 or later",
            reason="foreign",
        )
    return MessageError(
        f"an attachment of {len(data)} bytes that is not rmw_zenoh_cpp's, which has {_LAYOUT.size} bytes, "
        f"a sequence number from 0 on, and a {GID_BYTES} before the gid; another program writes on this key",
        reason="foreign",
    )
