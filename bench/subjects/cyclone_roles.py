"""A writer and a reader on Cyclone DDS in Python, with ROS 2's IDL of JointState and TFMessage."""

# Cyclone evaluates the annotations of its types: they must not be postponed.
import os
from dataclasses import dataclass
from typing import Any

from cyclonedds.core import Listener, Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int32, sequence, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from bench.job import Job
from bench.subjects.subject import Answered
from bench.subjects.tf_messages import DOMAIN_VARIABLE, TfBytes, TfReader

MAX_SAMPLES = 100


@dataclass
class _Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32 = 0
    nanosec: uint32 = 0


@dataclass
class _Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: _Time
    frame_id: str = ""


@dataclass
class _JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    header: _Header
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]


@dataclass
class _Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    x: float64
    y: float64
    z: float64


@dataclass
class _Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class _Transform(IdlStruct, typename="geometry_msgs::msg::dds_::Transform_"):
    translation: _Vector3
    rotation: _Quaternion


@dataclass
class _TransformStamped(IdlStruct, typename="geometry_msgs::msg::dds_::TransformStamped_"):
    header: _Header
    child_frame_id: str
    transform: _Transform


@dataclass
class _TFMessage(IdlStruct, typename="tf2_msgs::msg::dds_::TFMessage_"):
    transforms: sequence[_TransformStamped]


class _Serialized(_TFMessage):
    """A message with ready bytes, which the writer sends unchanged."""

    def __init__(self, content: bytes) -> None:
        self._content = content

    def serialize(self, *_: object, **__: object) -> bytes:
        return self._content


def _qos(depth: int, durability: Any = Policy.Durability.Volatile) -> Qos:
    """Reliable QoS, as in ROS 2 publishers."""
    return Qos(
        Policy.Reliability.Reliable(duration(seconds=1)),
        Policy.History.KeepLast(depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        durability,
    )


JOINTS, TF = _qos(10), _qos(100)
LATCHED = _qos(1, Policy.Durability.TransientLocal)


def _participant() -> DomainParticipant:
    return DomainParticipant(int(os.environ[DOMAIN_VARIABLE]))


class Writer:
    """Publishes joint states as messages and transforms as bytes."""

    def __init__(self, job: Job) -> None:
        self._participant = _participant()
        self._joints = self._writer("rt/joint_states", _JointState, JOINTS)
        self._tf = self._writer("rt/tf", _TFMessage, TF)
        self._static = self._writer("rt/tf_static", _TFMessage, LATCHED)
        self._bytes = TfBytes(job)
        self._rows = [list(row) for row in job.rows]
        self._message = _JointState(_Header(_Time()), list(job.joints), [], [], [])
        self._static.write(_Serialized(self._bytes.static))

    def _writer(self, topic: str, kind: type, qos: Qos) -> Any:
        return DataWriter(self._participant, Topic(self._participant, topic, kind), qos=qos)

    def send(self, row: int, stamp: int) -> None:
        """Joint states first, as in a real chain."""
        message, at = self._message, self._message.header.stamp
        at.sec, at.nanosec = divmod(stamp, 10**9)
        message.position = self._rows[row]
        self._joints.write(message)
        self._tf.write(_Serialized(self._bytes.message(row, stamp)))

    def close(self) -> None:
        """Nothing: the end of the process closes the domain."""


class _Callback(Listener):
    """Calls a function with every message, in the receiving thread."""

    def __init__(self, callback: Any) -> None:
        super().__init__()
        self._callback = callback

    def on_data_available(self, reader: Any) -> None:
        """Takes all available messages: one call may stand for several."""
        for message in reader.take(MAX_SAMPLES):
            self._callback(message)


class Reader(TfReader):
    """Receives the messages of one domain."""

    def __init__(self, job: Job, answered: Answered) -> None:
        super().__init__(job, answered)
        self._participant = _participant()
        self._readers = [
            self._reader("rt/tf_static", LATCHED, self.on_statics),
            self._reader("rt/tf", TF, self.on_transforms),
        ]

    def _reader(self, topic: str, qos: Qos, callback: Any) -> Any:
        source = Topic(self._participant, topic, _TFMessage)
        return DataReader(self._participant, source, qos=qos, listener=_Callback(callback))

    def close(self) -> None:
        """Nothing: the end of the process closes the domain."""
