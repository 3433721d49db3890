"""How ROS 2 nodes command a robot: the topics of a controller of ros2_control, over Zenoh.

Loaded by drivers that take such commands.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zstate.driving.messages import JointTrajectory
from zstate.errors import InvalidInput, MessageError
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.messages import check_size, from_block, to_block
from zstate.wire.protocol import SerializedSample
from zstate.wire.registry import ros_options
from zstate.wire.ros2.cdr import SECOND_NS, CdrReader
from zstate.wire.ros2.graph import (
    EndpointToken,
    NodeToken,
    gid,
    graph_expression,
    parse_token,
    session_from_gid,
    unpack_attachment,
)
from zstate.wire.ros2.options import Ros2Options, check_token
from zstate.wire.ros2.qos import Qos
from zstate.wire.ros2.topics import HUMBLE_HASH
from zstate.wire.ros2.types import FLOAT64_MULTI_ARRAY, JOINT_TRAJECTORY, RosType


class RosCommand(NamedTuple):
    """``positions`` (n,) that a ROS node with the writer number ``session`` has sent as message ``seq``.

    ``stamp`` [ns] is the time of sending, by the clock of the node.
    """

    session: int
    seq: int
    stamp: int
    positions: NDArray[np.float64]


class RosMotion(NamedTuple):
    """The motion that a ROS node with the writer number ``session`` requests; None ends its motion.

    ``stamp`` is when it was sent [ns].
    """

    session: int
    stamp: int
    request: JointTrajectory | None


class Ros2Controller:
    """The topics of a controller of ros2_control, on which ROS nodes command a robot, in rmw_zenoh_cpp.

    They are in the namespace of ``robot``. ``<name>/commands`` is a Float64MultiArray: a position for each
    joint, in an order that both sides know. ``<name>/joint_trajectory`` is a JointTrajectory. Raises
    InvalidInput for a name that ROS does not allow.
    """

    def __init__(self, options: Ros2Options, robot: str, name: str) -> None:
        check_token("controller", name, ", which becomes a part of ROS topics")
        self._options = options
        self._name = name
        self._namespace = f"/{options.robot_namespace(robot)}"
        root = f"{self._namespace.rstrip('/')}/{name}"
        self.topics = {f"{root}/commands": FLOAT64_MULTI_ARRAY, f"{root}/joint_trajectory": JOINT_TRAJECTORY}
        """The names of both topics, and their types."""
        self.commands, self.trajectories = (
            f"{options.domain}{topic}/{kind.dds}/*" for topic, kind in self.topics.items()
        )
        """The key expressions of both topics."""

    def decode_command(self, arrival: SerializedSample) -> RosCommand:
        """The command in a sample received under ``commands``. Raises MessageError."""
        session, seq, stamp = self._origin(arrival)
        return RosCommand(session, seq, stamp, decode_numbers(arrival.payload))

    def decode_trajectory(self, arrival: SerializedSample) -> RosMotion:
        """The motion in a sample received under ``trajectories``. Raises MessageError."""
        session, seq, stamp = self._origin(arrival)
        return RosMotion(session, stamp, decode_trajectory(arrival.payload, session, seq))

    def _origin(self, arrival: SerializedSample) -> tuple[int, int, int]:
        """The writer's session, the sequence number, and the time of sending. Raises MessageError."""
        check_size("joint_commands", arrival.size or len(arrival.payload))
        attachment = unpack_attachment(arrival.attachment)
        return session_from_gid(attachment.gid), attachment.seq, attachment.source_time

    def reader_tokens(self, zid: str, number: Callable[[], int]) -> tuple[str, ...]:
        """The liveliness tokens of the controller as a node with its subscriptions, in the session ``zid``.

        ``number()`` returns the next unused number of the session.
        """
        node = NodeToken(self._options.domain, zid, number(), "/", self._namespace, self._name)
        endpoints = [
            EndpointToken(node, number(), "MS", topic, kind.dds, self._hash_of(kind), Qos()).key
            for topic, kind in self.topics.items()
        ]
        return node.key, *endpoints

    def _hash_of(self, kind: RosType) -> str:
        return kind.hash if self._options.hash == "iron" else HUMBLE_HASH

    def writers_expression(self, robot: str) -> str:
        return graph_expression(self._options.domain)

    def parse_token(self, token: str, robot: str) -> tuple[Announcement, ...]:
        parsed = parse_token(token)
        if not isinstance(parsed, EndpointToken) or parsed.kind != "MP" or parsed.topic not in self.topics:
            return ()
        writer = WriterId(parsed.full_name, host="", pid=0, since=0, session=session_from_gid(gid(token)))
        return (Announcement(robot, "joint_commands", writer),)


def get_controller(wires: Sequence[str], robot: str, name: str) -> Ros2Controller:
    """The topics of the controller ``name`` of ``robot``, on the one wire "ros2" among ``wires``.

    Raises InvalidInput if there is none, or more than one, and for names that ROS does not allow.
    """
    texts = [wire.partition(":")[2] for wire in wires if wire.partition(":")[0] == "ros2"]
    if len(texts) != 1:
        raise InvalidInput(
            f"the commands of ROS nodes to {name!r} arrive on one wire 'ros2', not on {tuple(wires)}: pass "
            "wires=('native', 'ros2'), or with its options, such as 'ros2:domain=5,namespace=r1'"
        )
    return Ros2Controller(ros_options(texts[0]), robot, name)


def decode_numbers(payload: bytes) -> NDArray[np.float64]:
    """The data of a Float64MultiArray: (n,), read-only. Its layout is ignored, as by ros2_control.

    Raises MessageError with the reason "truncated" or "malformed".
    """
    reader = CdrReader(payload, FLOAT64_MULTI_ARRAY.name)
    for _ in range(reader.count()):
        reader.text()  # label
        reader.count()  # size
        reader.count()  # stride
    reader.count()  # data_offset
    return from_block(reader.sequence())


def decode_trajectory(payload: bytes, session: int, seq: int) -> JointTrajectory | None:
    """The motion in a JointTrajectory of ROS; None for one without points, which ends a motion.

    It starts at its stamp, or at its arrival if that is zero. Does not check that numbers are finite, and
    times ascend. Raises MessageError with the reason "truncated", "malformed", or "mode" for efforts.
    """
    reader = CdrReader(payload, JOINT_TRAJECTORY.name)
    stamp, _ = reader.stamp(), reader.text()
    names = tuple(reader.text() for _ in range(reader.count()))
    blocks: tuple[list[bytes], ...] = [], [], [], []
    times: list[int] = []
    for _ in range(reader.count()):
        for block in blocks:
            block.append(reader.sequence())
        times.append(reader.stamp())
    points, velocities, accelerations, efforts = (b"".join(block) for block in blocks)
    if efforts:
        raise MessageError("a trajectory with efforts, which are not supported", reason="mode")
    if not times:
        return None
    if any(len(block) not in (0, 8 * len(names)) for each in blocks for block in each):
        raise reader.malformed(f"a point has not one number for each of {len(names)} joints")
    numbers = to_block(np.array(times) / SECOND_NS), points, velocities or None, accelerations or None
    try:
        return JointTrajectory(stamp, seq, session, names, *numbers, start=stamp or None)
    except InvalidInput as error:
        raise reader.malformed(str(error)) from None
