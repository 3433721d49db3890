"""Encoder of one ROS 2 topic: CDR payloads, and attachments with the writer's gid."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from zstate.errors import InvalidInput
from zstate.extension import kernel
from zstate.wire.joint_order import SampleLayout
from zstate.wire.messages import (
    POSE_BYTES,
    ClockMessage,
    Edges,
    JointState,
    Message,
    RobotDescription,
    StampedMessage,
    StaticTransforms,
    TransformSample,
    from_block,
    to_block,
)
from zstate.wire.ros2.cdr import CdrReader, CdrTemplate, CdrWriter, encode_clock, encode_string, pack_stamp
from zstate.wire.ros2.decoder import (
    duplicate_text,
    read_joint_state,
    read_tf_message,
)
from zstate.wire.ros2.graph import pack_attachment
from zstate.wire.ros2.streams import ros_encoder
from zstate.wire.ros2.topics import FrameNames
from zstate.wire.ros2.types import JOINT_STATE, TF_MESSAGE

if TYPE_CHECKING or kernel == "c":
    from zstate._kernel import RosJointStateEncoder


class RosStreamEncoder:
    """Encodes one stream of one writer as ROS 2 messages.

    ``key`` and ``token`` are those of the topic and of its writer; ``gid`` is None if the wire sends none.
    """

    encoding = ""
    can_withdraw = False  # ROS nodes log a Zenoh delete as a malformed message

    def __init__(
        self,
        names: FrameNames,
        sample_names: SampleLayout,
        key: str = "",
        token: str = "",
        gid: bytes | None = None,
    ) -> None:
        self.key = key
        self.token: str | None = token
        self._gid = gid
        self._seq = 0
        self._names = names
        self._sample_names = sample_names
        self._joints: tuple[tuple[str, ...], JointStateEncoder] | None = None
        self._edges: tuple[Edges, TfMessageEncoder] | None = None
        self._compiled: RosJointStateEncoder | None = None

    def compile_joint_states(self) -> RosJointStateEncoder | None:
        if kernel != "c":
            return None
        names, slots = self._sample_names.coordinates, self._sample_names.velocity_slots
        with suppress(InvalidInput):  # ``encode`` raises it
            forms = tuple(
                _prefix_blocks(_unique(names), "", *sent) for sent in product((False, True), repeat=2)
            )
            self._compiled = RosJointStateEncoder(forms, len(names), slots, self._gid)
        return self._compiled

    def attachment(self, now: int) -> bytes | None:
        """Sequence number, time of sending ``now`` [ns] and gid, which ROS nodes require."""
        if self._gid is None:
            return None
        if self._compiled is not None:
            return self._compiled.attachment(now)
        self._seq += 1
        return pack_attachment(self._seq, now, self._gid)

    def encode(self, message: Message) -> bytes:
        """``message`` as CDR.

        Raises InvalidInput for a stamp that ROS cannot represent, and for numbers without names.
        """
        if isinstance(message, JointState):
            return self._encode_joints(message)
        if (encode := ros_encoder(type(message))) is not None:
            if isinstance(message, StampedMessage):
                checked_stamp(message.stamp)
            return encode(message, self._names)
        if isinstance(message, TransformSample):
            edges = self._sample_names.moving_edges if message.edges is None else message.edges
            return self._encode_edges(edges, checked_stamp(message.stamp), message.poses)
        if isinstance(message, StaticTransforms):
            return self._encode_edges(message.edges, 0, message.poses)
        if isinstance(message, RobotDescription):
            return encode_string(message.urdf)
        if isinstance(message, ClockMessage):
            return encode_clock(message.stamp)
        raise InvalidInput(f"ROS 2 has no topic for a {type(message).__name__}")

    def _encode_joints(self, state: JointState) -> bytes:
        names = self._sample_names.coordinates if state.names is None else state.names
        if self._joints is None or self._joints[0] is not names:
            self._joints = names, JointStateEncoder(names)
        velocities, efforts = state.velocities, state.efforts
        if len(self._sample_names.velocity_slots) != len(names):
            velocities, efforts = self._spread(velocities, len(names)), self._spread(efforts, len(names))
        return self._joints[1].encode(checked_stamp(state.stamp), state.positions, velocities, efforts)

    def _spread(self, block: bytes | None, count: int) -> bytes | None:
        """Each number at the index of its coordinate: in ROS there are as many velocities as positions."""
        slots = self._sample_names.velocity_slots
        if block is None or len(block) != 8 * len(slots):
            return block
        numbers = np.full(count, np.nan)
        numbers[list(slots)] = from_block(block)
        return to_block(numbers)

    def _encode_edges(self, edges: Edges, stamp: int, poses: bytes) -> bytes:
        if self._edges is None or self._edges[0] is not edges:
            self._edges = edges, TfMessageEncoder(self._names.edges_to_ros(edges))
        return self._edges[1].encode(stamp, poses)


def checked_stamp(stamp: int) -> int:
    """``stamp`` [ns]. Raises InvalidInput for 0."""
    if not stamp:
        raise InvalidInput("the stamp is 0, which means no stamp in ROS; give the time of the sample")
    return stamp


class JointStateEncoder:
    """Encodes joint states of ``names``; blocks are in their order.

    Raises InvalidInput for a duplicate name and for a name that is no text for ROS 2.
    """

    def __init__(self, names: Sequence[str], frame_id: str = "") -> None:
        self._count = len(_unique(names))
        self._size = 8 * len(names)
        self._prefix_blocks = {
            sent: _prefix_blocks(names, frame_id, *sent) for sent in product((False, True), repeat=2)
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


def _unique(names: Sequence[str]) -> Sequence[str]:
    """``names``. Raises InvalidInput for a duplicate."""
    if len(set(names)) != len(names):
        raise InvalidInput(duplicate_text(names))
    return names


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
    read_joint_state(reader)
    (stamp, stamp_end), (first, first_end), (second, second_end), (third, _) = *reader.stamps, *reader.blocks
    return payload[:stamp], payload[stamp_end:first], payload[first_end:second], payload[second_end:third]


class TfMessageEncoder:
    """Encodes the poses of ``edges`` at one instant.

    Raises InvalidInput for a frame name that is no text for ROS 2.
    """

    def __init__(self, edges: Edges) -> None:
        self._count = len(edges)
        writer = CdrWriter()
        writer.count(len(edges))
        for parent, child in edges:
            writer.stamp(0)
            writer.text(parent)
            writer.text(child)
            writer.numbers(bytes(POSE_BYTES))
        reader = CdrReader(writer.payload(), TF_MESSAGE.name)
        read_tf_message(reader)
        self._template = CdrTemplate(reader)
        self._fixed, _ = self._template.split(reader.payload)

    def encode(self, stamp: int, poses: bytes) -> bytes:
        """The payload of one instant; ``poses`` is a block of ``parent_from_child``, pose7 for each edge.

        Raises InvalidInput for a block without one pose for each edge, and for a ``stamp`` [ns] outside the
        years 1901 to 2038.
        """
        count = self._count
        if len(poses) != POSE_BYTES * count:
            raise InvalidInput(
                f"{count} edges need a block of {POSE_BYTES * count} bytes, {POSE_BYTES} for each pose, "
                f"not {len(poses)}"
            )
        return self._template.join(self._fixed, pack_stamp(stamp) * count + poses)
