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
from typing import Any, TypeVar

from zstate.driving.messages import DriverState, JointCommand, Stop, state_text
from zstate.errors import InvalidInput
from zstate.wire.identity import WriterId
from zstate.wire.measurements import message_fields, message_from_fields
from zstate.wire.messages import order_digest
from zstate.wire.ros2.cdr import CdrReader, CdrWriter
from zstate.wire.ros2.streams import RecordedForm
from zstate.wire.ros2.types import DIAGNOSTIC_ARRAY, JOINT_STATE

_Status = TypeVar("_Status", DriverState, Stop)

_TEXTS = frozenset({"program", "state", "reason", "commander", "last_refusal", "how"})
"""The fields that are texts."""

_TTL = "ttl_ns="
_OK, _WARN, _ERROR = 0, 1, 2
_LEVELS = {"stopped": _WARN, "fault": _ERROR}
"""Those of the states of a driver that are not OK."""


def encode_command(command: JointCommand, robot: str, program: str) -> bytes | None:
    """The JointState with the numbers of ``command``; None for one that keeps a motion valid and has none.

    Raises InvalidInput for one without joint names.
    """
    if command.motion is not None:
        return None
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


def program_of_stop(message: Stop, identity: str) -> str:
    """The program that sent ``message``, by the ``identity`` in its key.

    Raises InvalidInput if that is of another program.
    """
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


def decode_state(payload: bytes, session: int, seq: int) -> DriverState:
    """The state of a driver in ``payload``, which has its own session. Raises MessageError."""
    return _decode_status(DriverState, payload)


def decode_stop(payload: bytes, session: int, seq: int) -> Stop:
    """The stop in ``payload``, which has its own session and seq. Raises MessageError."""
    return _decode_status(Stop, payload)


def _decode_status(kind: type[_Status], payload: bytes) -> _Status:
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
        return message_from_fields(kind, fields)
    except (ValueError, RecursionError) as error:
        raise reader.malformed(str(error)) from None


def _program_of_state(message: DriverState, identity: str) -> str:
    return message.program


COMMANDS = RecordedForm(JOINT_STATE, "joint_commands", encode_command, decode_command)
STATES = RecordedForm(
    DIAGNOSTIC_ARRAY, "diagnostics", encode_status, decode_state, _program_of_state, is_shared=True
)
STOPS = RecordedForm(DIAGNOSTIC_ARRAY, "stops", encode_status, decode_stop, program_of_stop)
