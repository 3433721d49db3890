"""Commands, states and stops of drivers in a recording, as ROS 2 messages that ROS tools display.

==================  ===================================  ====================================================
stream              topic                                type
==================  ===================================  ====================================================
``joint_commands``  ``/joint_commands``                  sensor_msgs/JointState
``driver``          ``/diagnostics``                     diagnostic_msgs/DiagnosticArray
``stop, relax``     ``/stops``                           diagnostic_msgs/DiagnosticArray
==================  ===================================  ====================================================

The ttl of a command is its ``header.frame_id``, as "ttl_ns=250000000", since joint states have no frame. A
state or a stop is one status, whose ``values`` are the fields of the message: texts unchanged, and others in
JSON. Recordings have the stops of both streams as "stop". /diagnostics is the topic that Foxglove's and rqt's
panels show; as in ROS it is one for all robots.
"""

from __future__ import annotations

import json
from typing import Any

from zstate.errors import InvalidInput
from zstate.streams import StreamName
from zstate.wire.identity import WriterId
from zstate.wire.messages import (
    DriverState,
    JointCommand,
    Stop,
    message_fields,
    message_from_fields,
    order_digest,
    state_text,
)
from zstate.wire.ros2.cdr import CdrReader, CdrWriter
from zstate.wire.ros2.types import DIAGNOSTIC_ARRAY, JOINT_STATE, RosType

DRIVER_TYPES: dict[StreamName, RosType] = {
    "joint_commands": JOINT_STATE,
    "driver": DIAGNOSTIC_ARRAY,
    "stop": DIAGNOSTIC_ARRAY,
    "relax": DIAGNOSTIC_ARRAY,
}
"""The streams of drivers and their types, in recordings by zstate. They are never published again, since a
replay must not move hardware."""

_LAST_NAMES: dict[StreamName, str] = {
    "joint_commands": "joint_commands",
    "driver": "diagnostics",
    "stop": "stops",
    "relax": "stops",
}
"""The last names of their topics."""

_KINDS: dict[StreamName, type[DriverState] | type[Stop]] = {"driver": DriverState, "stop": Stop}
_TEXTS = frozenset({"program", "state", "reason", "commander", "last_refusal", "how"})
"""The fields that are texts."""

_TTL = "ttl_ns="
_OK, _WARN, _ERROR = 0, 1, 2
_LEVELS = {"stopped": _WARN, "fault": _ERROR}
"""Those of the states of a driver that are not OK."""


def driver_topic(namespace: str, stream: StreamName) -> str:
    """The topic of a stream of drivers, for a robot in ``namespace`` ("" is the root)."""
    topic = f"/{_LAST_NAMES[stream]}"
    return f"/{namespace}{topic}" if namespace and stream != "driver" else topic


def driver_stream(topic: str, type_name: str) -> StreamName | None:
    """The stream of drivers that has this topic; None if it is another topic."""
    last_name = topic.rpartition("/")[2]
    for stream, kind in DRIVER_TYPES.items():
        if (last_name, type_name) == (_LAST_NAMES[stream], kind.name):
            return stream
    return None


def encode_command(command: JointCommand) -> bytes:
    """The JointState with the numbers of ``command``. Raises InvalidInput for one without joint names."""
    if not command.names:
        raise InvalidInput("a command without the names of its joints, which drivers refuse")
    writer = CdrWriter()
    writer.stamp(command.stamp)
    writer.text(f"{_TTL}{command.ttl}" if command.ttl else "")
    writer.count(len(command.names))
    for name in command.names:
        writer.text(name)
    for block in (command.positions, command.velocities, command.efforts):
        writer.sequence(block or b"")
    return writer.payload()


def decode_command(payload: bytes, session: int, seq: int) -> JointCommand:
    """The command in ``payload``. Raises MessageError."""
    reader = CdrReader(payload, JOINT_STATE.name)
    stamp, frame = reader.stamp(), reader.text()
    names = tuple(reader.text() for _ in range(reader.count()))
    blocks = [reader.sequence() or None for _ in range(3)]
    ttl = frame.removeprefix(_TTL)
    try:
        head = (stamp, seq, session, order_digest(names))
        return JointCommand(*head, *blocks, names=names, ttl=int(ttl) if ttl.isdecimal() else 0)
    except InvalidInput as error:
        raise reader.malformed(str(error)) from None


def program_of(message: DriverState | Stop, identity: str) -> str:
    """The program that sent ``message``: of a Stop by the ``identity`` in its key.

    Raises InvalidInput if that is of another program.
    """
    if isinstance(message, DriverState):
        return message.program
    writer = WriterId.parse(identity)
    if writer.session != message.session:
        raise InvalidInput(f"a stop of another program on the key of {str(writer)!r}")
    return str(writer)


def encode_status(message: DriverState | Stop, robot: str, program: str) -> bytes:
    """The DiagnosticArray of ``message``, which ``program`` sent. Raises InvalidInput as CdrWriter does."""
    fields = message_fields(message)
    writer = CdrWriter()
    writer.stamp(fields.pop("stamp"))
    writer.text("")
    writer.count(1)
    if isinstance(message, DriverState):
        writer.numbers(bytes([_LEVELS.get(message.state, _OK)]), 1)
        writer.text(f"{robot}: driver")
        writer.text(state_text(message))
    else:
        writer.numbers(bytes([_WARN]), 1)
        writer.text(f"{robot}: stop")
        writer.text(f"stopped by {program}{message.reason and f': {message.reason}'}")
    writer.text(robot)
    writer.count(len(fields))
    for name, value in fields.items():
        writer.text(name)
        writer.text(value if name in _TEXTS else json.dumps(value))
    return writer.payload()


def decode_status(stream: StreamName, payload: bytes) -> DriverState | Stop:
    """The message of ``stream`` in ``payload``. Raises MessageError."""
    reader = CdrReader(payload, DIAGNOSTIC_ARRAY.name)
    fields: dict[str, Any] = {"stamp": reader.stamp()}
    reader.text()
    if reader.count() != 1:
        raise reader.malformed("it has not one status")
    reader.numbers(1, 1)
    for _ in ("name", "message", "hardware_id"):
        reader.text()
    try:
        for _ in range(reader.count()):
            name, value = reader.text(), reader.text()
            fields[name] = value if name in _TEXTS else json.loads(value)
        return message_from_fields(_KINDS[stream], fields)
    except (ValueError, RecursionError) as error:
        raise reader.malformed(str(error)) from None
