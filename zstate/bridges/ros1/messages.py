"""Conversion between zstate and ROS 1: stamps, JointState, TFMessage, frame names.

ROS 1 has one name space of frames for all robots, zstate has one for each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from struct import Struct, error
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zstate._util.bounded import BoundedDict
from zstate._util.format import SECOND_NS
from zstate.bridges.ros1.node import RospyModules
from zstate.checks import Floats
from zstate.errors import InsertRefused, MessageError, SecondWriter
from zstate.model.joint_transforms import JointTransforms
from zstate.model.robot import RobotModel, coordinate_names, velocity_columns_by_position
from zstate.sources.joint_source import JointStateValidator
from zstate.wire.joint_order import JointNumbers
from zstate.wire.keys import wire_name
from zstate.wire.messages import POSE_BYTES, JointState, order_digest, to_block

_COUNT = Struct("<I")
_HEADER = Struct("<III")  # sequence number, seconds and nanoseconds
# A ROS 1 time is two unsigned numbers of 32 bits.
_END_OF_TIME = 2**32 * SECOND_NS


def set_stamp(header: Any, stamp: int) -> None:
    """Write a stamp [ns] into a ROS header, exactly. Raises MessageError if it exceeds a ROS time."""
    if not 0 < stamp < _END_OF_TIME:
        raise MessageError(
            f"the stamp {stamp} is not a time of ROS 1: these are after the start of 1970 and before "
            "2106, and zero means no stamp",
            reason="stamp",
        )
    header.stamp.secs, header.stamp.nsecs = divmod(stamp, SECOND_NS)


def get_stamp(header: Any) -> int:
    """The stamp of a ROS header [ns], exactly. Raises MessageError for zero, which means none."""
    stamp = header.stamp.secs * SECOND_NS + header.stamp.nsecs
    if not stamp:
        raise MessageError(
            "a JointState without a stamp; set header.stamp where it is published, for instance to "
            "rospy.Time.now()",
            reason="zero stamp",
        )
    return stamp


class JointStateWriter:
    """Encodes joints of ``model`` in one JointState, which is reused.

    ROS has one number for each name: planar and floating joints become "base.x", "base.y" ...
    """

    def __init__(self, ros: RospyModules, model: RobotModel) -> None:
        names = coordinate_names(model)
        self._count = len(names)
        # None if velocities match positions one by one, which is nearly always so.
        slots = velocity_columns_by_position(model)
        self._slots = None if slots == tuple(range(self._count)) else list(slots)
        self._message = ros.JointState(name=list(names))

    def message(self, stamp: int, numbers: JointNumbers) -> Any:
        """The message, valid until the next call. Raises MessageError as ``set_stamp``."""
        message = self._message
        set_stamp(message.header, stamp)
        message.position = numbers.positions.tolist()
        message.velocity = self._rates(numbers.velocities)
        message.effort = self._rates(numbers.efforts)
        return message

    def _rates(self, values: Floats | None) -> list[float]:
        if values is None:
            return []
        if self._slots is not None:
            padded = np.full(self._count, np.nan)
            padded[self._slots] = values
            values = padded
        return values.tolist()


class TransformsWriter:
    """Encodes the poses of ``edges`` (parent and child, by their ROS names) in one TFMessage."""

    def __init__(self, ros: RospyModules, edges: Sequence[tuple[str, str]]) -> None:
        self._message = ros.TFMessage()
        for parent, child in edges:
            transform = ros.TransformStamped(child_frame_id=child)
            transform.header.frame_id = parent
            self._message.transforms.append(transform)

    def message(self, stamp: int | None, poses: Floats) -> Any:
        """The message, valid until the next call. Raises MessageError as ``set_stamp``.

        Row i of ``poses`` (n, 7) is ``parent_from_child``. Static edges have no stamp.
        """
        for transform, pose in zip(self._message.transforms, poses.tolist(), strict=True):
            if stamp is not None:
                set_stamp(transform.header, stamp)
            place, turn = transform.transform.translation, transform.transform.rotation
            place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w = pose
        return self._message


class Ros1Encoder:
    """Encodes samples of one model as ROS 1 messages."""

    def __init__(self, model: RobotModel, ros: RospyModules, names: Ros1FrameNames) -> None:
        self.digest = model.digest
        self.joints = JointStateWriter(ros, model)
        self.validator = JointStateValidator(model)
        self._table = JointTransforms(model)
        forms = self._table.forms
        self._rows = [row for row, form in enumerate(forms) if form.kind != "fixed"]
        self.has_moving_edges = bool(self._rows)
        edges = [(names.prefix + forms[row].parent, names.prefix + forms[row].child) for row in self._rows]
        self._transforms = TransformsWriter(ros, edges)

    def transforms(self, stamp: int, positions: Floats) -> Any:
        return self._transforms.message(stamp, self._table.poses(positions).take(self._rows, axis=0))


class RosTransform(NamedTuple):
    """One transform of a TFMessage: ``stamp`` [ns], frame names, and pose7 of the child in the parent."""

    stamp: int
    parent: str
    child: str
    pose: bytes


def read_transforms(data: bytes) -> list[RosTransform]:
    """The transforms in a serialized TFMessage, some ten times as fast as by rospy. Raises MessageError."""
    transforms: list[RosTransform] = []
    try:
        (count,) = _COUNT.unpack_from(data)
        position = _COUNT.size
        for _ in range(count):
            _, seconds, nanoseconds = _HEADER.unpack_from(data, position)
            parent, position = _read_text(data, position + _HEADER.size)
            child, position = _read_text(data, position)
            pose = data[position : position + POSE_BYTES]
            position += POSE_BYTES
            transforms.append(RosTransform(seconds * SECOND_NS + nanoseconds, parent, child, pose))
    except (error, UnicodeDecodeError) as problem:
        raise MessageError(f"a malformed TFMessage: {problem}", reason="malformed") from None
    if position > len(data):
        raise MessageError(f"a TFMessage cut off after {len(data)} bytes", reason="truncated")
    return transforms


def _read_text(data: bytes, position: int) -> tuple[str, int]:
    """The string at ``position``, and the position after it."""
    (length,) = _COUNT.unpack_from(data, position)
    end = position + _COUNT.size + length
    return data[position + _COUNT.size : end].decode(), end


def pose_from_ros(transform: Any) -> tuple[float, ...]:
    """pose7 of a ROS Transform: x y z [m], qx qy qz qw."""
    place, turn = transform.translation, transform.rotation
    return (place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w)


class Ros1JointReader:
    """Decodes JointState messages with names in any order into the order of ``model``."""

    def __init__(self, model: RobotModel) -> None:
        self._coordinates = coordinate_names(model)
        self._slots = np.array(velocity_columns_by_position(model), dtype=np.intp)
        self._names = frozenset(self._coordinates) | {joint.name for joint in model.joints}
        # By the names in a message; None if joints are missing.
        self._picks: BoundedDict[tuple[str, ...], NDArray[np.intp] | None] = BoundedDict()

    def read(self, message: Any) -> JointNumbers | None:
        """The numbers of all joints of the model; None for a message without some of them.

        Raises MessageError for a message that cannot be used.
        """
        pick = self._pick(tuple(message.name))
        if pick is None:
            return None
        count = len(message.name)
        rates = pick[self._slots]
        positions = _picked("position", message.position, count, pick)
        if positions is None:
            raise _without_positions()
        velocities = _picked("velocity", message.velocity, count, rates)
        return JointNumbers(positions, velocities, _picked("effort", message.effort, count, rates))

    def unknown(self, message: Any) -> tuple[str, ...]:
        """The joints in ``message`` that the model does not have."""
        return tuple(name for name in message.name if name not in self._names)

    def _pick(self, names: tuple[str, ...]) -> NDArray[np.intp] | None:
        if names not in self._picks:
            if len(set(names)) < len(names):
                raise MessageError(f"a JointState that names a joint twice: {names}", reason="names")
            is_whole = set(names).issuperset(self._coordinates)
            columns = [names.index(name) for name in self._coordinates] if is_whole else ()
            self._picks[names] = np.array(columns, dtype=np.intp) if is_whole else None
        return self._picks[names]


def partial_joint_state(message: Any, stamp: int, node: str) -> JointState:
    """The joint state of ``node``, which publishes some of the joints. Raises MessageError."""
    names = tuple(message.name)
    in_order = np.arange(len(names))
    values = {"position": message.position, "velocity": message.velocity, "effort": message.effort}
    blocks = [_picked(what, numbers, len(names), in_order) for what, numbers in values.items()]
    positions, velocities, efforts = (None if block is None else to_block(block) for block in blocks)
    if positions is None:
        raise _without_positions()
    # The session only distinguishes nodes.
    return JointState(stamp, 0, hash(node), order_digest(names), positions, velocities, efforts, names)


def _without_positions() -> MessageError:
    return MessageError("a JointState without positions", reason="sizes")


def _picked(what: str, values: Sequence[float], count: int, pick: NDArray[np.intp]) -> Floats | None:
    if not values:
        return None
    if len(values) != count:
        raise MessageError(
            f"a JointState with {count} names and {len(values)} numbers of {what}", reason="sizes"
        )
    return np.array(values, dtype=np.float64)[pick]


@dataclass(frozen=True, slots=True)
class Ros1FrameNames:
    """ROS names of the frames of ``robot``: ``prefix`` and the bare name.

    Frames of other robots have their full name, ``robot/frame``, on both sides.
    """

    robot: str
    prefix: str = ""

    def in_ros(self, frame: str) -> str:
        """The ROS name of a frame in a message of this robot."""
        bare = frame.removeprefix(f"{self.robot}/")
        return frame if bare == frame and "/" in frame else f"{self.prefix}{bare}"

    def bare(self, frame_id: str) -> str:
        """A ``frame_id`` without the prefix, and without the leading slash of old programs."""
        return frame_id.removeprefix("/").removeprefix(self.prefix)

    def in_zstate(self, frame_id: str, links: frozenset[str]) -> str:
        """The zstate name of a ``frame_id`` in messages of this robot, whose model has ``links``."""
        bare = self.bare(frame_id)
        return wire_name(self.robot, bare) if bare in links else bare


def refusal_reason(error: Exception) -> str:
    """The counter of a refusal."""
    if isinstance(error, MessageError | InsertRefused):
        return error.reason
    return "second writer" if isinstance(error, SecondWriter) else "bad numbers"
