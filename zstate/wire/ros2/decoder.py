"""Hearing: ROS messages as the messages that listeners know."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from hashlib import blake2b

import numpy as np

from zstate.errors import MessageError
from zstate.wire.keys import Stream
from zstate.wire.messages import (
    ClockMessage,
    Edges,
    JointState,
    Message,
    RobotDescription,
    StaticTransforms,
    TransformSample,
    order_digest,
    poses_from_block,
    to_block,
)
from zstate.wire.ros2.frame_names import FrameNames
from zstate.wire.ros2.joint_state import JointStateDecoder
from zstate.wire.ros2.simple_messages import decode_clock, decode_string
from zstate.wire.ros2.tf_message import RosTransforms, TfMessageDecoder


class RosDecoder:
    """Reads what ROS nodes write. Remembers the shapes of their messages, so that the next is quick."""

    def __init__(self) -> None:
        self._joints = JointStateDecoder()
        self._edges = TfMessageDecoder()

    def messages(
        self, stream: Stream, payload: bytes, session: int, seq: int, names: FrameNames
    ) -> Sequence[Message]:
        """What ``payload`` says on ``stream``. Raises MessageError.

        A message of transforms with several stamps is several samples.
        """
        if stream == "joint_states":
            return (self._joint_state(payload, session, seq),)
        if stream == "tf":
            return tuple(self._samples(payload, session, seq, names))
        if stream == "tf_static":
            said = self._edges.decode(payload)
            return (StaticTransforms(session, names.edges_to_zstate(said.edges), said.poses),)
        if stream == "robot_description":
            return (_description(decode_string(payload), session),)
        return (ClockMessage(decode_clock(payload), seq, session),)

    def _joint_state(self, payload: bytes, session: int, seq: int) -> JointState:
        said = self._joints.decode(payload)
        stamp, order = _dated(said.stamp), order_digest(said.names)
        return JointState(
            stamp, seq, session, order, said.positions, said.velocities, said.efforts, said.names
        )

    def _samples(self, payload: bytes, session: int, seq: int, names: FrameNames) -> Iterator[Message]:
        said = self._edges.decode(payload)
        edges = names.edges_to_zstate(said.edges)
        for stamp, part, poses in _by_stamp(said, edges):
            yield TransformSample(_dated(stamp), seq, session, order_digest(part), poses, part)


def _by_stamp(said: RosTransforms, edges: Edges) -> Iterator[tuple[int, Edges, bytes]]:
    if said.stamp is not None:
        yield said.stamp, edges, said.poses
        return
    stamps, poses = np.array(said.stamps, dtype=np.int64), poses_from_block(said.poses)
    for stamp in sorted(set(said.stamps)):
        rows = np.flatnonzero(stamps == stamp)
        yield stamp, tuple(edges[row] for row in rows), to_block(poses[rows])


def _description(urdf: str, session: int) -> RobotDescription:
    digest = blake2b(urdf.encode(), digest_size=8).hexdigest()
    return RobotDescription(session, urdf, digest, joint_names=(), moving_edges=(), clock="")


def _dated(stamp: int) -> int:
    if not stamp:
        raise MessageError(
            "its stamp is zero, by which ROS means that there is none; let the writer fill header.stamp",
            reason="no stamp",
        )
    return stamp
