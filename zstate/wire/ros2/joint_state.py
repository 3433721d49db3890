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
    """A JointState as received: ``stamp`` [ns], and blocks with one number for each of ``names``.

    Payloads that differ in numbers only come with the very same ``names``.
    """

    stamp: int
    frame_id: str
    names: tuple[str, ...]
    positions: bytes
    velocities: bytes | None = None
    efforts: bytes | None = None


class JointStateEncoder:
    """Says joint states of ``names``, a block of numbers in their order each time.

    Raises InvalidInput for a name that comes twice or that is no text for ROS 2.
    """

    def __init__(self, names: Sequence[str], frame_id: str = "") -> None:
        if len(set(names)) != len(names):
            raise InvalidInput(_twice(names))
        self._count = len(names)
        self._size = 8 * len(names)
        empty = RosJointState(0, frame_id, tuple(names), bytes(self._size))
        choices = [
            (has_velocities, has_efforts) for has_velocities in (False, True) for has_efforts in (False, True)
        ]
        self._prefix_blocks = {choice: _prefix_blocks(empty, *choice) for choice in choices}

    def encode(
        self, stamp: int, positions: bytes, velocities: bytes | None = None, efforts: bytes | None = None
    ) -> bytes:
        """The payload of one instant.

        Raises InvalidInput for a block that has not one number for each name, and for a ``stamp`` [ns]
        outside the years 1901 to 2038.
        """
        size = self._size
        if (
            len(positions) != size
            or (velocities is not None and len(velocities) != size)
            or (efforts is not None and len(efforts) != size)
        ):
            raise self._misfit(positions, velocities, efforts)
        head, names, second, third = self._prefix_blocks[velocities is not None, efforts is not None]
        time = pack_stamp(stamp)
        return b"".join((head, time, names, positions, second, velocities or b"", third, efforts or b""))

    def _misfit(self, *blocks: bytes | None) -> InvalidInput:
        given = ", ".join("none" if block is None else f"{len(block)} bytes" for block in blocks)
        return InvalidInput(
            f"{self._count} names need blocks of {self._size} bytes, 8 for each number; "
            f"positions, velocities, efforts: {given}"
        )


class JointStateDecoder:
    """Reads the payloads of any number of writers; those it has seen the like of, in one step."""

    def __init__(self) -> None:
        self._layouts: TemplateCache[RosJointState] = TemplateCache()

    def decode(self, payload: bytes) -> RosJointState:
        """The message in ``payload``.

        Raises MessageError with the reason "truncated", "malformed", or "no positions" where joints are
        named but only velocities or efforts are told. Whether numbers are finite is not looked at.
        """
        found = self._layouts.find(payload)
        if found is None:
            return self._decode_new(payload)
        known, numbers = found
        return _with_numbers(known, numbers)

    def _decode_new(self, payload: bytes) -> RosJointState:
        reader = CdrReader(payload, JOINT_STATE.name)
        state = _read(reader)
        self._layouts.add(reader, state)
        return state


def _with_numbers(known: RosJointState, numbers: bytes) -> RosJointState:
    _, frame_id, names, _, velocities, efforts = known
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
    positions, velocities, efforts = reader.sequence(), reader.sequence(), reader.sequence()
    if names and not positions:
        raise _without_positions(names)
    _check_counts(reader, len(names), len(positions) // 8, len(velocities) // 8, len(efforts) // 8)
    if len(set(names)) != len(names):
        raise reader.malformed(_twice(names))
    return RosJointState(stamp, frame_id, names, positions, velocities or None, efforts or None)


def _without_positions(names: Sequence[str]) -> MessageError:
    return MessageError(
        f"a {JOINT_STATE.name} without positions of {', '.join(map(repr, names))}: velocities alone place no "
        "link; let its writer tell positions, or leave those joints out",
        reason="no positions",
    )


def _check_counts(reader: CdrReader, names: int, positions: int, velocities: int, efforts: int) -> None:
    counts = f"{names} names, {positions} positions, {velocities} velocities, {efforts} efforts"
    if names != positions or velocities not in (0, names) or efforts not in (0, names):
        raise reader.malformed(f"its counts do not agree: {counts}")


def _twice(names: Sequence[str]) -> str:
    counts = Counter(names)
    name = next(name for name in names if counts[name] > 1)
    return f"the joint {name!r} comes {counts[name]} times among {len(names)} names"


def _prefix_blocks(
    state: RosJointState, has_velocities: bool, has_efforts: bool
) -> tuple[bytes, bytes, bytes, bytes]:
    """What stands before the stamp, the positions, the velocities and the efforts."""
    zeros = state.positions
    payload = _write(state, zeros if has_velocities else b"", zeros if has_efforts else b"")
    reader = CdrReader(payload, JOINT_STATE.name)
    _read(reader)
    (stamp, stamp_end), (first, first_end), (second, second_end), (third, _) = *reader.stamps, *reader.blocks
    return payload[:stamp], payload[stamp_end:first], payload[first_end:second], payload[second_end:third]


def _write(state: RosJointState, velocities: bytes, efforts: bytes) -> bytes:
    writer = CdrWriter()
    writer.stamp(state.stamp)
    writer.text(state.frame_id)
    writer.count(len(state.names))
    for name in state.names:
        writer.text(name)
    for block in (state.positions, velocities, efforts):
        writer.sequence(block)
    return writer.payload()
