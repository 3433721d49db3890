"""How ROS 2 carries the streams: the type and the QoS of their topics, as ``Stream.ros`` names them.

Those of plugins are in their folders, next to the functions that encode and decode their messages.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

from zstate.errors import InvalidInput
from zstate.message import Message
from zstate.stream_registry import own_streams
from zstate.streams import StreamName
from zstate.wire.ros2.qos import Qos
from zstate.wire.ros2.types import CLOCK, JOINT_STATE, STRING, TF_MESSAGE, RosType


class DisplayedForm(NamedTuple):
    """The form of those messages of a stream that viewers do not display as ROS carries them.

    ``applies(message)`` is true of a message that is one of these. ``type``, ``suffix``, ``encode`` and
    ``decode`` are as in RosStream. Without ``decode`` recordings have ROS's form, and only viewers of live
    robots get this one.
    """

    type: RosType
    suffix: str
    applies: Callable[..., bool]
    encode: Callable[..., bytes]
    decode: Callable[..., Message] | None = None


class RosStream(NamedTuple):
    """The ``type`` of a stream's topics, and the ``qos`` that its writers offer.

    Topics with ``is_named`` have the name of the sensor, or of the writer, and are found by their type.
    ``encode(message, names)`` makes the payload of a message, ``decode(payload, session, seq, names)`` the
    message in one, with the frames as ``names`` has them (FrameNames); those of the streams of the core are
    in ``RosStreamEncoder`` and ``RosDecoder``. ``suffix`` are the last names of a topic below that of the
    sensor, as cameras have them: /r1/wrist/camera_info. With ``is_of_sensor`` their namespace may be that of
    the sensor: /r1/imu/data is a topic of the robot r1. ``uncarried`` is the field with a frame that ROS does
    not carry: a recording has a channel for each, and for each value of ``uncarried_number``, a field with an
    integer of a latched message. ``withdrawn`` is recorded when a latched value is
    withdrawn, which ROS cannot express; ``is_withdrawn`` whether a message is such a one. ``displayed`` is
    the form of some of the messages in recordings and for viewers.
    """

    type: RosType
    qos: Qos
    is_named: bool = False
    encode: Callable[..., bytes] | None = None
    decode: Callable[..., Message] | None = None
    is_of_sensor: bool = False
    suffix: str = ""
    uncarried: str = ""
    uncarried_number: str = ""
    withdrawn: Message | None = None
    is_withdrawn: Callable[..., bool] | None = None
    displayed: DisplayedForm | None = None

    def recorded_form(self, type_name: str) -> DisplayedForm | None:
        """The form of recorded messages of the type ``type_name``; None for those of ``type``."""
        form = self.displayed
        if form is None or form.decode is None or form.type.name != type_name:
            return None
        return form


class RecordedForm(NamedTuple):
    """How recordings have a stream that ROS 2 does not carry: as messages that ROS tools display.

    ``topic`` is the last name of its topics, of type ``type``; with ``is_shared`` there is one for all
    robots. ``encode(message, robot, program)`` makes the payload of a message, None of one that is not
    recorded; ``decode(payload, session, seq)`` the message in one. ``program_of(message, writer)`` is the
    program that has sent it. They are never published again: a replay must not move hardware.
    """

    type: RosType
    topic: str
    encode: Callable[..., bytes | None]
    decode: Callable[..., Message]
    program_of: Callable[..., str] | None = None
    is_shared: bool = False

    def topic_in(self, namespace: str) -> str:
        """The topic for a robot in ``namespace`` ("" is the root)."""
        return f"/{namespace}/{self.topic}" if namespace and not self.is_shared else f"/{self.topic}"


@cache
def recorded_forms() -> dict[StreamName, RecordedForm]:
    """The streams that only recordings have."""
    return {row.name: row.recorded_form for row in own_streams() if row.recorded}


# The QoS of robot_state_publisher, tf2 and map_server, and of the broadcasters of ros2_control: readers of
# sensor data request best effort, others reliable.
JOINT_STATES = RosStream(JOINT_STATE, Qos(depth=10))
TF = RosStream(TF_MESSAGE, Qos(depth=100))
TF_STATIC = RosStream(TF_MESSAGE, Qos(durability="transient_local", depth=1))
ROBOT_DESCRIPTION = RosStream(STRING, Qos(durability="transient_local", depth=1))
# Readers request best effort (rclcpp's ClockQoS) or reliable (a plain subscription). DDS matches a reliable
# writer with both, a best-effort writer with the former only. An old time is useless.
SIMULATED_TIME = RosStream(CLOCK, Qos(depth=1))


@cache
def ros_streams() -> dict[StreamName, RosStream]:
    """The streams that ROS 2 carries."""
    return {row.name: row.ros_form for row in own_streams() if row.ros}


def ros_stream(stream: StreamName) -> RosStream:
    """How ROS 2 carries ``stream``. Raises InvalidInput for a stream without a ROS topic."""
    carried = ros_streams()
    if stream not in carried:
        raise InvalidInput(
            f"the stream {stream!r} is not carried by ROS 2; carried are {', '.join(map(repr, carried))}"
        )
    return carried[stream]


@cache
def _encoders() -> dict[type[Message], Callable[..., bytes]]:
    rows = [row for row in own_streams() if row.ros and row.ros_form.encode is not None]
    return {row.type: row.ros_form.encode for row in rows}


def ros_encoder(kind: type[Message]) -> Callable[..., bytes] | None:
    """``RosStream.encode`` for messages of the type ``kind``; None for those of the core."""
    return _encoders().get(kind)


def ros_type(stream: StreamName) -> RosType:
    """The ROS type that carries ``stream``. Raises InvalidInput as ``ros_stream`` does."""
    return ros_stream(stream).type


def has_named_topics(stream: StreamName) -> bool:
    """Whether the topics of the stream have the names of its writers."""
    carried = ros_streams().get(stream)
    return carried is not None and carried.is_named


def has_sensor_topics(stream: StreamName) -> bool:
    """Whether the namespace of the stream's topics may be that of a sensor."""
    carried = ros_streams().get(stream)
    return carried is not None and carried.is_of_sensor


def displayed_form(stream: StreamName) -> DisplayedForm | None:
    """The form of some of the messages of ``stream`` in recordings and for viewers, if it has one."""
    carried = ros_streams().get(stream)
    return None if carried is None else carried.displayed


def uncarried_number(stream: StreamName) -> str:
    """The field with a number that ROS does not carry; empty if the messages of ``stream`` have none."""
    carried = ros_streams().get(stream)
    return "" if carried is None else carried.uncarried_number


def topic_suffix(stream: StreamName) -> str:
    """What follows the name of a sensor in the topics of the stream: "/" and names, or nothing."""
    carried = ros_streams().get(stream)
    return f"/{carried.suffix}" if carried is not None and carried.suffix else ""


def without_suffix(topic: str) -> str:
    """``topic`` up to the name of its sensor."""
    for stream in ros_streams():
        form = displayed_form(stream)
        for suffix in (topic_suffix(stream), "" if form is None else f"/{form.suffix}"):
            if suffix and topic.endswith(suffix):
                return topic.removesuffix(suffix)
    return topic


def topic_stream(topic: str, dds_type: str) -> StreamName | None:
    """The stream that ``topic`` carries by its type and its last name; None if it is none."""
    last_name = topic.rpartition("/")[2]
    for stream, carried in ros_streams().items():
        if not topic.endswith(topic_suffix(stream)):
            continue
        if dds_type == carried.type.dds and (carried.is_named or last_name == stream):
            return stream
    return None
