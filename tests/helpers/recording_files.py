"""Recordings of one robot's description and joint states, written by a RecordingWriter."""

from __future__ import annotations

import random
from pathlib import Path

from rosbags.typesys import Stores, get_typestore

from zstate.recording.mcap.writer import ChannelId, RecordingWriter
from zstate.wire.ros2.qos import Qos
from zstate.wire.ros2.types import JOINT_STATE, STRING

MS = 1_000_000
S = 1_000_000_000
START = 1_700_000_000 * S
LATCHED = Qos(durability="transient_local", depth=1)

STORE = get_typestore(Stores.ROS2_HUMBLE)
_STRING = STORE.types["std_msgs/msg/String"]
_JOINT_STATE = STORE.types["sensor_msgs/msg/JointState"]
_HEADER = STORE.types["std_msgs/msg/Header"]
_TIME = STORE.types["builtin_interfaces/msg/Time"]


def string_bytes(text: str) -> bytes:
    return bytes(STORE.serialize_cdr(_STRING(text), "std_msgs/msg/String"))


def joint_bytes(stamp: int, positions: list[float]) -> bytes:
    import numpy as np

    names = [f"joint_{number}" for number in range(len(positions))]
    header = _HEADER(_TIME(stamp // S, stamp % S), "")
    empty = np.array([])
    message = _JOINT_STATE(header, names, np.array(positions), empty, empty)
    return bytes(STORE.serialize_cdr(message, "sensor_msgs/msg/JointState"))


DESCRIPTION = string_bytes("<robot name='r'/>")


def joint_states(count: int, every_ns: int = 10 * MS) -> list[tuple[int, bytes]]:
    """Log times and incompressible payloads."""
    dice = random.Random(5)
    stamps = [START + number * every_ns for number in range(count)]
    return [(stamp, joint_bytes(stamp, [dice.random() for _ in range(7)])) for stamp in stamps]


def declare_channels(writer: RecordingWriter) -> tuple[ChannelId, ChannelId]:
    """The channels of a description and of joint states."""
    metadata = {"zstate.robot": "panda"}
    described = writer.channel("/robot_description", STRING, LATCHED, metadata)
    return described, writer.channel("/joint_states", JOINT_STATE, Qos(), metadata)


def write_run(path: Path, states: list[tuple[int, bytes]], flush_every: int = 50, **options: object) -> None:
    """A description, latched, and the joint states."""
    with RecordingWriter(path, **options) as writer:
        described, joints = declare_channels(writer)
        writer.latch(described, "", DESCRIPTION, START, START)
        for number, (stamp, payload) in enumerate(states):
            writer.write(joints, payload, stamp, stamp - MS, sequence=number)
            if number % flush_every == flush_every - 1:
                writer.flush()
