"""What driving brings: the streams between commanders and drivers; and commands."""

from zstate.plugins import Command, Plugin
from zstate.streams import SAMPLE_BYTES, Stream

_MESSAGES = "zstate.driving.messages"

JOINT_COMMANDS = Stream(
    "joint_commands",
    f"{_MESSAGES}:JointCommand",
    summary="setpoints and motions for a driver",
    group="driver",
    max_bytes=SAMPLE_BYTES,
    recorded="zstate.driving.recorded:COMMANDS",
)
JOINT_SETPOINTS = Stream(
    "joint_setpoints",
    "zstate.wire.messages:JointState",
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
    recorded="zstate.driving.recorded:STATES",
)
STOP = Stream(
    "stop",
    f"{_MESSAGES}:Stop",
    summary="of each program that stops the driver: the joints hold",
    group="driver",
    named=True,
    max_bytes=SAMPLE_BYTES,
    recorded="zstate.driving.recorded:STOPS",
)
RELAX = Stream(
    "relax",
    f"{_MESSAGES}:Stop",
    summary="the same, without torque",
    group="driver",
    named=True,
    max_bytes=SAMPLE_BYTES,
    recorded="zstate.driving.recorded:STOPS",
)

PLUGIN = Plugin(
    "driving",
    streams=(JOINT_COMMANDS, JOINT_SETPOINTS, DRIVER, STOP, RELAX),
    commands={
        "drive": Command(
            "zstate.driving.cli.drive:drive_command",
            "Drive",
            "Host the driver of a robot: the program that owns its hardware.",
        ),
        "move": Command(
            "zstate.driving.cli.move:move_command",
            "Drive",
            "Move joints of a robot that has a driver, and wait until they are there.",
        ),
        "stop": Command(
            "zstate.driving.cli.move:stop_command",
            "Drive",
            "Stop a robot that has a driver, until that is released.",
        ),
    },
    synonyms={
        "controller_manager": "drive",
        "joint_trajectory_controller": "move",
        "ros2_control": "drive | move | stop",
        "ros2_control_node": "drive",
    },
    checks="zstate.driving.cli.checks:DriverChecks",
    metrics="zstate.driving.cli.metrics:DriverMetrics",
)
