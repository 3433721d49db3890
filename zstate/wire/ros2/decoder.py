"""Decoder of ROS 2 topics into zstate's messages."""

from __future__ import annotations

from collections.abc import Sequence
from hashlib import blake2b

import numpy as np

from zstate.errors import MessageError
from zstate.wire.keys import Stream
from zstate.wire.messages import (
    ClockMessage,
    JointState,
    Message,
    RobotDescription,
    StaticTransforms,
    TransformSample,
    order_digest,
    poses_from_block,
    to_block,
)
from zstate.wire.ros2.cdr import decode_clock, decode_string
from zstate.wire.ros2.frame_names import FrameNames
from zstate.wire.ros2.joint_state import JointStateDecoder
from zstate.wire.ros2.tf_message import TfMessageDecoder


class RosDecoder:
    """Decodes the messages of ROS nodes. Caches their templates, for speed."""

    def __init__(self) -> None:
        self._joints = JointStateDecoder()
        self._edges = TfMessageDecoder()

    def messages(
        self, stream: Stream, payload: bytes, session: int, seq: int, names: FrameNames
    ) -> Sequence[Message]:
        """The messages of ``payload`` on ``stream``. Raises MessageError.

        A TFMessage with several stamps is one TransformSample for each, oldest first.
        """
        if stream == "joint_states":
            state = self._joints.decode(payload)
            stamp, order = _checked_stamp(state.stamp), order_digest(state.names)
            blocks = state.positions, state.velocities, state.efforts
            return (JointState(stamp, seq, session, order, *blocks, state.names),)
        if stream == "tf":
            return self._transform_samples(payload, session, seq, names)
        if stream == "tf_static":
            transforms = self._edges.decode(payload)
            return (StaticTransforms(session, names.edges_to_zstate(transforms.edges), transforms.poses),)
        if stream == "robot_description":
            urdf = decode_string(payload)
            digest = blake2b(urdf.encode(), digest_size=8).hexdigest()
            return (RobotDescription(session, urdf, digest, joint_names=(), moving_edges=(), clock=""),)
        return (ClockMessage(decode_clock(payload), seq, session),)

    def _transform_samples(
        self, payload: bytes, session: int, seq: int, names: FrameNames
    ) -> tuple[TransformSample, ...]:
        transforms = self._edges.decode(payload)
        edges = names.edges_to_zstate(transforms.edges)
        if transforms.stamp is not None:
            stamp, order = _checked_stamp(transforms.stamp), order_digest(edges)
            return (TransformSample(stamp, seq, session, order, transforms.poses, edges),)
        samples: list[TransformSample] = []
        stamps, poses = np.array(transforms.stamps, dtype=np.int64), poses_from_block(transforms.poses)
        for stamp in sorted(set(transforms.stamps)):
            rows = np.flatnonzero(stamps == stamp)
            part = tuple(edges[row] for row in rows)
            block = to_block(poses[rows])
            samples.append(
                TransformSample(_checked_stamp(stamp), seq, session, order_digest(part), block, part)
            )
        return tuple(samples)


def _checked_stamp(stamp: int) -> int:
    if not stamp:
        raise MessageError(
            "its stamp is zero, which means no stamp in ROS; let the writer fill header.stamp",
            reason="no stamp",
        )
    return stamp
