"""Encoder of one ROS 2 topic: CDR payloads, and attachments with the writer's gid."""

from __future__ import annotations

import numpy as np

from zstate.errors import InvalidInput
from zstate.wire.joint_order import SampleLayout
from zstate.wire.messages import (
    ClockMessage,
    Edges,
    JointState,
    Message,
    RobotDescription,
    StaticTransforms,
    TransformSample,
    from_block,
    to_block,
)
from zstate.wire.ros2.attachment import pack
from zstate.wire.ros2.cdr import encode_clock, encode_string
from zstate.wire.ros2.frame_names import FrameNames
from zstate.wire.ros2.joint_state import JointStateEncoder
from zstate.wire.ros2.tf_message import TfMessageEncoder


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

    def attachment(self, now: int) -> bytes | None:
        """Sequence number, time of sending ``now`` [ns] and gid, which ROS nodes require."""
        if self._gid is None:
            return None
        self._seq += 1
        return pack(self._seq, now, self._gid)

    def encode(self, message: Message) -> bytes:
        """``message`` as CDR.

        Raises InvalidInput for a stamp that ROS cannot represent, and for numbers without names.
        """
        if isinstance(message, JointState):
            names = self._sample_names.coordinates if message.names is None else message.names
            if self._joints is None or self._joints[0] is not names:
                self._joints = names, JointStateEncoder(names)
            velocities, efforts = message.velocities, message.efforts
            if len(self._sample_names.velocity_slots) != len(names):
                velocities, efforts = self._spread(velocities, len(names)), self._spread(efforts, len(names))
            stamp = _checked_stamp(message.stamp)
            return self._joints[1].encode(stamp, message.positions, velocities, efforts)
        if isinstance(message, TransformSample):
            edges = self._sample_names.moving_edges if message.edges is None else message.edges
            return self._encode_edges(edges, _checked_stamp(message.stamp), message.poses)
        if isinstance(message, StaticTransforms):
            return self._encode_edges(message.edges, 0, message.poses)
        if isinstance(message, RobotDescription):
            return encode_string(message.urdf)
        if isinstance(message, ClockMessage):
            return encode_clock(message.stamp)
        raise InvalidInput(f"ROS 2 has no topic for a {type(message).__name__}")

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


def _checked_stamp(stamp: int) -> int:
    if not stamp:
        raise InvalidInput("the stamp is 0, which means no stamp in ROS; give the time of the sample")
    return stamp
