"""What driving brings: the streams between commanders and drivers."""

from zstate.plugins import Plugin
from zstate.streams import SAMPLE_BYTES, Stream

_MESSAGES = "zstate.wire.messages"

JOINT_COMMANDS = Stream(
    "joint_commands",
    f"{_MESSAGES}:JointCommand",
    summary="setpoints and motions for a driver",
    group="driver",
    max_bytes=SAMPLE_BYTES,
)
JOINT_SETPOINTS = Stream(
    "joint_setpoints",
    f"{_MESSAGES}:JointState",
    summary="what a driver writes to the hardware",
    group="driver",
    max_bytes=SAMPLE_BYTES,
)
DRIVER = Stream(
    "driver",
    f"{_MESSAGES}:DriverState",
    summary="whether a driver follows commands, and why not",
    group="driver",
    max_bytes=SAMPLE_BYTES,
)
STOP = Stream(
    "stop",
    f"{_MESSAGES}:Stop",
    summary="of each program that stops the driver: the joints hold",
    group="driver",
    named=True,
    max_bytes=SAMPLE_BYTES,
)
RELAX = Stream(
    "relax",
    f"{_MESSAGES}:Stop",
    summary="the same, without torque",
    group="driver",
    named=True,
    max_bytes=SAMPLE_BYTES,
)

PLUGIN = Plugin("driving", streams=(JOINT_COMMANDS, JOINT_SETPOINTS, DRIVER, STOP, RELAX))
