"""A writer and a reader on Cyclone DDS in Python."""

from __future__ import annotations

import os
from typing import Any

from cyclonedds.core import Listener, Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from bench.job import Job
from bench.subjects.cyclone_idl import Header, JointState, TFMessage, Time
from bench.subjects.dds import DOMAIN_VARIABLE
from bench.subjects.subject import Answered
from bench.subjects.tf_messages import TfBytes
from bench.subjects.tf_reader import TfReader

MAX_SAMPLES = 100


def qos(depth: int, durability: Any = Policy.Durability.Volatile) -> Qos:
    """Reliable QoS, as in ROS 2 publishers."""
    return Qos(
        Policy.Reliability.Reliable(duration(seconds=1)),
        Policy.History.KeepLast(depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        durability,
    )


JOINTS, TF = qos(10), qos(100)
LATCHED = qos(1, Policy.Durability.TransientLocal)


class Serialized(TFMessage):
    """A message with ready bytes, which the writer sends unchanged."""

    def __init__(self, content: bytes) -> None:
        self._content = content

    def serialize(self, *_: object, **__: object) -> bytes:
        """The ready bytes."""
        return self._content


def participant() -> DomainParticipant:
    """A participant in the domain of this run."""
    return DomainParticipant(int(os.environ[DOMAIN_VARIABLE]))


class Writer:
    """Publishes joint states as messages and transforms as bytes."""

    def __init__(self, job: Job) -> None:
        self._participant = participant()
        self._joints = self._writer("rt/joint_states", JointState, JOINTS)
        self._tf = self._writer("rt/tf", TFMessage, TF)
        self._static = self._writer("rt/tf_static", TFMessage, LATCHED)
        self._bytes = TfBytes(job)
        self._rows = [list(row) for row in job.rows]
        self._message = JointState(Header(Time()), list(job.joints), [], [], [])
        self._static.write(Serialized(self._bytes.static))

    def _writer(self, topic: str, kind: type, qos_: Qos) -> Any:
        return DataWriter(self._participant, Topic(self._participant, topic, kind), qos=qos_)

    def send(self, row: int, stamp: int) -> None:
        """Joint states first, as in a real chain."""
        message, at = self._message, self._message.header.stamp
        at.sec, at.nanosec = divmod(stamp, 10**9)
        message.position = self._rows[row]
        self._joints.write(message)
        self._tf.write(Serialized(self._bytes.message(row, stamp)))

    def close(self) -> None:
        """Nothing: the end of the process closes the domain."""


class CallbackListener(Listener):
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
        self._participant = participant()
        self._readers = [
            self._reader("rt/tf_static", LATCHED, self._history.add_statics),
            self._reader("rt/tf", TF, self._on_transforms),
        ]

    def _reader(self, topic: str, qos_: Qos, callback: Any) -> Any:
        source = Topic(self._participant, topic, TFMessage)
        return DataReader(self._participant, source, qos=qos_, listener=CallbackListener(callback))
