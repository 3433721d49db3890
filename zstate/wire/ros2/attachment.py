"""The 33-byte attachment that rmw_zenoh_cpp sends with each message; a ROS node drops one without it."""

from __future__ import annotations

from struct import Struct
from typing import NamedTuple

from zstate.errors import MessageError

GID_BYTES = 16

_LAYOUT = Struct("<qqB16s")  # the third is the length of the gid, as Zenoh serialises a slice
ATTACHMENT_BYTES = _LAYOUT.size
_LABEL = b"sequence_number"


class Attachment(NamedTuple):
    """Sequence number, time and writer of a message.

    ``seq`` begins at 1 and grows by one; ``source_time`` [ns since the Unix epoch] is the time of sending
    by the writer's clock; ``gid`` identifies the writer, see ``zstate.wire.ros2.graph.gid``.
    """

    seq: int
    source_time: int
    gid: bytes


def pack(seq: int, source_time_ns: int, gid: bytes) -> bytes:
    """The attachment of one message. A ROS node that reads another length exits with an exception."""
    return _LAYOUT.pack(seq, source_time_ns, GID_BYTES, gid)


def unpack(data: bytes | None) -> Attachment:
    """The fields of an attachment.

    Raises MessageError with the reason "no attachment" for None, and "foreign" if it is not of
    rmw_zenoh_cpp.
    """
    if data is None:
        raise MessageError(
            "no attachment: every message of rmw_zenoh_cpp has one; another program writes on this key, "
            "or a bridge that drops it",
            reason="no attachment",
        )
    if len(data) == _LAYOUT.size and data[16] == GID_BYTES:
        seq, source_time, _length, gid = _LAYOUT.unpack(data)
        if seq >= 0:
            return Attachment(seq, source_time, gid)
    if _LABEL in data[: len(_LABEL) + 1]:
        raise MessageError(
            f"an attachment of {len(data)} bytes with labels, as rmw_zenoh_cpp wrote before mid 2025: "
            "upgrade it to humble 0.1.2, jazzy 0.2.4, kilted 0.6.0 or later",
            reason="foreign",
        )
    raise MessageError(
        f"an attachment of {len(data)} bytes that is not rmw_zenoh_cpp's, which has {_LAYOUT.size} bytes, "
        f"a sequence number from 0 on, and a {GID_BYTES} before the gid; another program writes on this key",
        reason="foreign",
    )


def session_from_gid(gid: bytes) -> int:
    """The session number of a writer, from its ``gid``; a restarted writer has another one."""
    return int.from_bytes(gid[:8], "little")
