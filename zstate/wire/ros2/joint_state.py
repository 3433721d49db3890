"""``sensor_msgs/msg/JointState``: joint positions by name, with velocities and efforts if known."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

from zstate.errors import InvalidInput, MessageError
from zstate.wire.ros2.cdr import STAMP_BYTES, CdrReader, CdrWriter, pack_stamp, unpack_stamps
from zstate.wire.ros2.cdr_template import TemplateCache
from zstate.wire.ros2.types import JOINT_STATE


class RosJointState(NamedTuple):
    """A decoded JointState: ``stamp`` [ns], and blocks with one number for each of ``names``.

    Payloads that differ only in numbers have the same ``names`` object.
    """

    stamp: int
    frame_id: str
    names: tuple[str, ...]
    positions: bytes
    velocities: bytes | None = None
    efforts: bytes | None = None


class JointStateEncoder:
    """Encodes joint states of ``names``; blocks are in their order.

    Raises InvalidInput for a duplicate name and for a name that is no text for ROS 2.
    """

    def __init__(self, names: Sequence[str], frame_id: str = "") -> None:
        if len(set(names)) != len(names):
            raise InvalidInput(_duplicate_text(names))
        self._count = len(names)
        self._size = 8 * len(names)
        self._prefix_blocks = {
            (has_velocities, has_efforts): _prefix_blocks(names, frame_id, has_velocities, has_efforts)
            for has_velocities in (False, True)
            for has_efforts in (False, True)
        }

    def encode(
        self, stamp: int, positions: bytes, velocities: bytes | None = None, efforts: bytes | None = None
    ) -> bytes:
        """The payload of one instant.

        Raises InvalidInput for a block without one number for each name, and for a ``stamp`` [ns] outside
        the years 1901 to 2038.
        """
        size = self._size
        if (
            len(positions) != size
            or (velocities is not None and len(velocities) != size)
            or (efforts is not None and len(efforts) != size)
        ):
            blocks = (positions, velocities, efforts)
            sizes = ", ".join("none" if block is None else f"{len(block)} bytes" for block in blocks)
            raise InvalidInput(
                f"{self._count} names need blocks of {size} bytes, 8 for each number; "
                f"positions, velocities, efforts: {sizes}"
            )
        head, names, second, third = self._prefix_blocks[velocities is not None, efforts is not None]
        time = pack_stamp(stamp)
        return b"".join((head, time, names, positions, second, velocities or b"", third, efforts or b""))


class JointStateDecoder:
    """Decodes payloads of any number of writers; after the first of its template, in one step."""

    def __init__(self) -> None:
        self._templates: TemplateCache[RosJointState] = TemplateCache()

    def decode(self, payload: bytes) -> RosJointState:
        """The message in ``payload``.

        Raises MessageError with the reason "truncated", "malformed", or "no positions" if joints are named
        but have only velocities or efforts. Does not check that numbers are finite.
        """
        found = self._templates.find(payload)
        if found is None:
            reader = CdrReader(payload, JOINT_STATE.name)
            state = _read(reader)
            self._templates.add(reader, state)
            return state
        (_, frame_id, names, _, velocities, efforts), numbers = found
        size = 8 * len(names)
        end = STAMP_BYTES + size
        (stamp,) = unpack_stamps(numbers[:STAMP_BYTES])
        positions = numbers[STAMP_BYTES:end]
        if velocities is not None:
            velocities = numbers[end : end + size]
            end += size
        if efforts is not None:
            efforts = numbers[end:]
        return RosJointState(stamp, frame_id, names, positions, velocities, efforts)


def _read(reader: CdrReader) -> RosJointState:
    stamp, frame_id = reader.stamp(), reader.text()
    names = tuple(reader.text() for _ in range(reader.count()))
    positions, velocities, efforts = blocks = reader.sequence(), reader.sequence(), reader.sequence()
    if names and not positions:
        raise MessageError(
            f"a {JOINT_STATE.name} without positions of {', '.join(map(repr, names))}: velocities alone "
            "place no link; let its writer publish positions, or leave those joints out",
            reason="no positions",
        )
    counts = [len(block) // 8 for block in blocks]
    if counts[0] != len(names) or not {counts[1], counts[2]} <= {0, len(names)}:
        text = f"{len(names)} names, {counts[0]} positions, {counts[1]} velocities, {counts[2]} efforts"
        raise reader.malformed(f"its counts do not agree: {text}")
    if len(set(names)) != len(names):
        raise reader.malformed(_duplicate_text(names))
    return RosJointState(stamp, frame_id, names, positions, velocities or None, efforts or None)


def _duplicate_text(names: Sequence[str]) -> str:
    counts = Counter(names)
    name = next(name for name in names if counts[name] > 1)
    return f"the joint {name!r} comes {counts[name]} times among {len(names)} names"


def _prefix_blocks(
    names: Sequence[str], frame_id: str, has_velocities: bool, has_efforts: bool
) -> tuple[bytes, bytes, bytes, bytes]:
    """The bytes before the stamp, the positions, the velocities and the efforts."""
    writer = CdrWriter()
    writer.stamp(0)
    writer.text(frame_id)
    writer.count(len(names))
    for name in names:
        writer.text(name)
    zeros = bytes(8 * len(names))
    for is_sent in (True, has_velocities, has_efforts):
        writer.sequence(zeros if is_sent else b"")
    payload = writer.payload()
    reader = CdrReader(payload, JOINT_STATE.name)
    _read(reader)
    (stamp, stamp_end), (first, first_end), (second, second_end), (third, _) = *reader.stamps, *reader.blocks
    return payload[:stamp], payload[stamp_end:first], payload[first_end:second], payload[second_end:third]
