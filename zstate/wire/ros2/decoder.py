"""Decoder of ROS 2 topics into zstate's messages: joint states, transforms, measurements, maps, commands."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from hashlib import blake2b
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zstate._util.format import SECOND_NS
from zstate.errors import MessageError
from zstate.streams import StreamName
from zstate.wire.messages import (
    ClockMessage,
    Edges,
    JointState,
    Message,
    RobotDescription,
    StampedMessage,
    StaticTransforms,
    TransformSample,
    order_digest,
    poses_from_block,
    to_block,
)
from zstate.wire.ros2.cdr import (
    STAMP_BYTES,
    CdrReader,
    TemplateCache,
    decode_clock,
    decode_string,
    unpack_stamps,
)
from zstate.wire.ros2.streams import ros_stream
from zstate.wire.ros2.topics import FrameNames
from zstate.wire.ros2.types import (
    JOINT_STATE,
    TF_MESSAGE,
)

_SCAN_FLOATS = 7
_POSE_NUMBERS = 7
_STAMP_WORDS = STAMP_BYTES // 4


class RosDecoder:
    """Decodes the messages of ROS nodes. Caches their templates, for speed."""

    def __init__(self) -> None:
        self._joints = JointStateDecoder()
        self._edges = TfMessageDecoder()

    def messages(
        self, stream: StreamName, payload: bytes, session: int, seq: int, names: FrameNames
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
        message: Message
        if stream == "robot_description":
            urdf = decode_string(payload)
            digest = blake2b(urdf.encode(), digest_size=8).hexdigest()
            message = RobotDescription(session, urdf, digest, joint_names=(), moving_edges=(), clock="")
        elif (decode := ros_stream(stream).decode) is not None:
            message = decode(payload, session, seq, names)
            if isinstance(message, StampedMessage):
                _checked_stamp(message.stamp)
        else:
            message = ClockMessage(decode_clock(payload), seq, session)
        return (message,)

    def joint_states(self, payloads: Sequence[bytes]) -> RosJointStates | None:
        """The joint states in ``payloads``, of one length and channel, decoded together.

        None unless they differ only in numbers and all have a stamp: ``messages`` then decodes each.
        """
        states = self._joints.decode_many(payloads)
        return states if states is not None and states.stamps.all() else None

    def edges(self, payloads: Sequence[bytes]) -> Edges | None:
        """The edges of transforms, by their names in ROS, in ``payloads``, of one length and channel.

        None unless they differ only in numbers and all have a stamp: ``messages`` then decodes each.
        """
        return self._edges.edges_of(payloads)

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


class RosJointStates(NamedTuple):
    """Decoded JointStates of the same joints: row i of each array is of message i.

    ``stamps`` (N,) [ns]; the blocks are (N, n) with a column for each of ``names``.
    """

    stamps: NDArray[np.int64]
    names: tuple[str, ...]
    positions: NDArray[np.float64]
    velocities: NDArray[np.float64] | None
    efforts: NDArray[np.float64] | None


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
            state = read_joint_state(reader)
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

    def decode_many(self, payloads: Sequence[bytes]) -> RosJointStates | None:
        """The messages in ``payloads``, of one length; None unless they differ only in numbers."""
        try:
            self.decode(payloads[0])  # adds its template
        except MessageError:
            return None
        found = self._templates.find_many(payloads)
        if found is None:
            return None
        (_, _, names, _, velocities, efforts), numbers = found
        times, blocks = numbers[:, :_STAMP_WORDS], numbers[:, _STAMP_WORDS:]
        seconds, nanoseconds = times[:, 0].astype(np.int32).astype(np.int64), times[:, 1].astype(np.int64)
        if (nanoseconds >= SECOND_NS).any():
            return None
        columns = np.ascontiguousarray(blocks).view("<f8")
        size = len(names)
        first_effort = size if velocities is None else 2 * size
        return RosJointStates(
            seconds * SECOND_NS + nanoseconds,
            names,
            columns[:, :size],
            None if velocities is None else columns[:, size : 2 * size],
            None if efforts is None else columns[:, first_effort:],
        )


def read_joint_state(reader: CdrReader) -> RosJointState:
    """A JointState, read value by value. Raises MessageError."""
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
        raise reader.malformed(duplicate_text(names))
    return RosJointState(stamp, frame_id, names, positions, velocities or None, efforts or None)


def duplicate_text(names: Sequence[str]) -> str:
    """The first of ``names`` that is not unique, for an error."""
    counts = Counter(names)
    name = next(name for name in names if counts[name] > 1)
    return f"the joint {name!r} comes {counts[name]} times among {len(names)} names"


class RosTransforms(NamedTuple):
    """A decoded TFMessage: row i of ``poses`` is ``parent_from_child`` of ``edges[i]``.

    ``poses`` is a block of x y z [m], qx qy qz qw. ``stamps`` [ns] has one for each edge; ``stamp`` is
    their common value, or None if they differ or there are none. Payloads that differ only in numbers have
    the same ``edges`` object.
    """

    stamp: int | None
    stamps: tuple[int, ...]
    edges: Edges
    poses: bytes


class TfMessageDecoder:
    """Decodes payloads of any number of writers; after the first of its template, in one step."""

    def __init__(self) -> None:
        self._templates: TemplateCache[Edges] = TemplateCache()

    def decode(self, payload: bytes) -> RosTransforms:
        """The message in ``payload``.

        Raises MessageError with the reason "truncated" or "malformed". Does not check that numbers are
        finite, quaternions have length 1 and frames form a tree.
        """
        found = self._templates.find(payload)
        if found is None:
            reader = CdrReader(payload, TF_MESSAGE.name)
            transforms = read_tf_message(reader)
            self._templates.add(reader, transforms.edges)
            return transforms
        edges, numbers = found
        count = len(edges)
        times, poses = numbers[: STAMP_BYTES * count], numbers[STAMP_BYTES * count :]
        first = times[:STAMP_BYTES]
        if not count or times != first * count:
            return RosTransforms(None, unpack_stamps(times), edges, poses)
        (stamp,) = unpack_stamps(first)
        return RosTransforms(stamp, (stamp,) * count, edges, poses)

    def edges_of(self, payloads: Sequence[bytes]) -> Edges | None:
        """The edges of ``payloads``, of one length; None unless they differ only in numbers, with stamps."""
        try:
            self.decode(payloads[0])  # adds its template
        except MessageError:
            return None
        found = self._templates.find_many(payloads)
        if found is None:
            return None
        edges, numbers = found
        times = numbers[:, : _STAMP_WORDS * len(edges)].reshape(len(payloads), len(edges), _STAMP_WORDS)
        is_valid = times.any(axis=2) & (times[:, :, 1] < SECOND_NS)
        return edges if is_valid.all() else None


def read_tf_message(reader: CdrReader) -> RosTransforms:
    """A TFMessage, read value by value. Raises MessageError."""
    stamps: list[int] = []
    edges: list[tuple[str, str]] = []
    poses: list[bytes] = []
    for _ in range(reader.count()):
        stamps.append(reader.stamp())
        edges.append((reader.text(), reader.text()))
        poses.append(reader.numbers(_POSE_NUMBERS))
    shared = stamps[0] if len(set(stamps)) == 1 else None
    return RosTransforms(shared, tuple(stamps), tuple(edges), b"".join(poses))
