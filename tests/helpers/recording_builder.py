"""Builders of recordings: robot messages through a RecordingEncoder, and ROS 2 bags by rosbags."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from helpers.robots import RRBOT
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from zstate.buffer.buffer import TransformBuffer
from zstate.model.robot import RobotModel
from zstate.recording.encode import RecordingEncoder
from zstate.recording.mcap.writer import RecordingWriter
from zstate.recording.recording import Recording
from zstate.transform import Transform
from zstate.wire.messages import (
    JointState,
    RobotDescription,
    StaticTransforms,
    TransformSample,
    WriterTransforms,
    order_digest,
    to_block,
)

MS = 1_000_000
S = 1_000_000_000
START = 1_700_000_000 * S
LATENCY = 200_000
"""The delay from the stamp of a sample to its log time [ns]."""

Edge = tuple[str, str]


def recorded_buffer(path: Path, robot: str | None = None) -> TransformBuffer:
    """The whole recording in a buffer."""
    with Recording(path, robot) as recording:
        return recording.buffer()


class RecordingBuilder:
    """Writes a recording; every message is logged ``LATENCY`` after its stamp by default."""

    def __init__(
        self,
        path: Path,
        alone: str | None = None,
        programs: dict[int, str] | None = None,
        *,
        max_bytes: int | None = None,
    ) -> None:
        self.writer = RecordingWriter(path, max_bytes=max_bytes)
        self.refused: list[str] = []
        self.encoder = RecordingEncoder(
            self.writer, lambda reason, _: self.refused.append(reason), alone=alone, programs=programs or {}
        )
        self._seqs: dict[tuple[str, int], int] = {}

    def __enter__(self) -> RecordingBuilder:
        return self

    def __exit__(self, *_: object) -> None:
        self.writer.close()
        assert not self.refused

    def _seq(self, robot: str, session: int) -> int:
        seq = self._seqs.get((robot, session), 0)
        self._seqs[robot, session] = seq + 1
        return seq

    def describe(self, robot: str, model: RobotModel = RRBOT, session: int = 1, at: int = START) -> None:
        message = RobotDescription(session, model.urdf, model.digest, model.joint_names, ())
        self.encoder.write_message(robot, message, at)

    def joints(
        self,
        robot: str,
        stamp: int,
        positions: Sequence[float],
        velocities: Sequence[float] | None = None,
        *,
        session: int = 1,
        model: RobotModel = RRBOT,
        log_time: int | None = None,
    ) -> JointState:
        state = JointState(
            stamp,
            self._seq(robot, session),
            session,
            order_digest(model.joint_names),
            to_block(positions),
            None if velocities is None else to_block(velocities),
        )
        self.encoder.write_message(robot, state, stamp + LATENCY if log_time is None else log_time)
        return state

    def part(
        self,
        robot: str,
        stamp: int,
        named: dict[str, float],
        writer: str | None,
        *,
        session: int,
        velocities: Sequence[float] | None = None,
        log_time: int | None = None,
    ) -> JointState:
        """A joint state of some joints; without a ``writer`` as ROS nodes publish it."""
        head = (stamp, self._seq(robot, session), session, order_digest(tuple(named)))
        rates = None if velocities is None else to_block(velocities)
        state = JointState(*head, to_block(list(named.values())), rates, None, tuple(named))
        at = stamp + LATENCY if log_time is None else log_time
        self.encoder.write_message(robot, state, at, writer)
        return state

    def edges(
        self,
        robot: str,
        stamp: int,
        poses: dict[Edge, Sequence[float]],
        *,
        session: int = 2,
        writer: str | None = None,
        log_time: int | None = None,
        covariances: dict[Edge, np.ndarray] | None = None,
    ) -> TransformSample:
        names = tuple(poses)
        block = to_block(list(poses.values()))
        head = (stamp, self._seq(robot, session), session, order_digest(names))
        sample = TransformSample(*head, block, names)
        if covariances is not None:
            unknown = np.full((6, 6), np.nan)
            known = [covariances.get(edge, unknown)[np.triu_indices(6)] for edge in names]
            sample = WriterTransforms(*head, block, names, to_block(known))
        at = stamp + LATENCY if log_time is None else log_time
        self.encoder.write_message(robot, sample, at, writer)
        return sample

    def statics(
        self,
        robot: str,
        at: int,
        poses: dict[Edge, Sequence[float]],
        *,
        session: int = 3,
        writer: str | None = "camera",
    ) -> None:
        message = StaticTransforms(session, tuple(poses), to_block(list(poses.values())))
        self.encoder.write_message(robot, message, at, writer)


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> list[float]:
    return [x, y, z, 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)]


def swing_positions(seconds: float) -> list[float]:
    """The joint positions of rrbot at a time after the start."""
    return [math.sin(seconds), 0.5 * math.cos(2.0 * seconds)]


def swing_velocities(seconds: float) -> list[float]:
    return [math.cos(seconds), -math.sin(2.0 * seconds)]


STORE = get_typestore(Stores.ROS2_HUMBLE)
_TYPES = STORE.types
_DURABLE = {"/tf_static", "/robot_description"}


class Bag:
    """A ROS 2 bag, written by rosbags."""

    def __init__(self, path: Path, storage: StoragePlugin = StoragePlugin.SQLITE3) -> None:
        self._writer = Writer(path, version=9, storage_plugin=storage)
        self._writer.open()
        self._connections: dict[tuple[str, str], object] = {}

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def write(self, topic: str, log_time: int, message: object, kind: str) -> None:
        key = topic, kind
        if key not in self._connections:
            self._connections[key] = self._writer.add_connection(topic, kind, typestore=STORE)
        self._writer.write(self._connections[key], log_time, STORE.serialize_cdr(message, kind))

    def describe(self, topic: str = "/robot_description", urdf: str = RRBOT.urdf) -> None:
        self.write(topic, START, _TYPES["std_msgs/msg/String"](urdf), "std_msgs/msg/String")

    def joints(
        self, stamp: int, named: dict[str, float], topic: str = "/joint_states", log_time: int | None = None
    ) -> None:
        empty = np.array([])
        message = _TYPES["sensor_msgs/msg/JointState"](
            _header(stamp, ""), list(named), np.array(list(named.values())), empty, empty
        )
        log_time = stamp + LATENCY if log_time is None else log_time
        self.write(topic, log_time, message, "sensor_msgs/msg/JointState")

    def tf(self, log_time: int, transforms: Sequence[Transform], topic: str = "/tf") -> None:
        message = _TYPES["tf2_msgs/msg/TFMessage"]([_stamped(transform) for transform in transforms])
        self.write(topic, log_time, message, "tf2_msgs/msg/TFMessage")


def _header(stamp: int, frame: str) -> object:
    return _TYPES["std_msgs/msg/Header"](_TYPES["builtin_interfaces/msg/Time"](stamp // S, stamp % S), frame)


def _stamped(transform: Transform) -> object:
    x, y, z, qx, qy, qz, qw = map(float, transform.pose7)
    return _TYPES["geometry_msgs/msg/TransformStamped"](
        _header(transform.stamp or 0, transform.target),
        transform.source,
        _TYPES["geometry_msgs/msg/Transform"](
            _TYPES["geometry_msgs/msg/Vector3"](x, y, z),
            _TYPES["geometry_msgs/msg/Quaternion"](qx, qy, qz, qw),
        ),
    )
