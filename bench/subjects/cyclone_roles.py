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
from bench.subjects.cyclone import DOMAIN_VARIABLE
from bench.subjects.cyclone_idl import Header, JointState, TFMessage, Time
from bench.subjects.subject import Answered
from bench.subjects.tf_messages import TfBytes
from bench.subjects.tf_reader import TfReader

MOST_TAKEN = 100


def qos(depth: int, durability: Any = Policy.Durability.Volatile) -> Qos:
    """Reliable, as ROS 2 publishes."""
    return Qos(
        Policy.Reliability.Reliable(duration(seconds=1)),
        Policy.History.KeepLast(depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        durability,
    )


JOINTS, TF = qos(10), qos(100)
LATCHED = qos(1, Policy.Durability.TransientLocal)


class Serialized(TFMessage):
    """A message whose bytes are there already; a writer takes them as its own."""

    def __init__(self, content: bytes) -> None:
        self._content = content

    def serialize(self, *_: object, **__: object) -> bytes:
        """As they are."""
        return self._content


def participant() -> DomainParticipant:
    """In the domain of this run."""
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

    def _writer(self, topic: str, kind: type, of: Qos) -> Any:
        return DataWriter(self._participant, Topic(self._participant, topic, kind), qos=of)

    def send(self, row: int, stamp: int) -> None:
        """Joint states first, as they would be."""
        message, at = self._message, self._message.header.stamp
        at.sec, at.nanosec = divmod(stamp, 10**9)
        message.position = self._rows[row]
        self._joints.write(message)
        self._tf.write(Serialized(self._bytes.row(row, stamp)))

    def close(self) -> None:
        """The process's end closes the domain."""


class Taking(Listener):
    """Gives every message to a function, in the thread that received it."""

    def __init__(self, take: Any) -> None:
        super().__init__()
        self._take = take

    def on_data_available(self, reader: Any) -> None:
        """All of them: one call may stand for several."""
        for message in reader.take(MOST_TAKEN):
            self._take(message)


class Reader(TfReader):
    """Hears the messages of one domain."""

    def __init__(self, job: Job, answered: Answered) -> None:
        super().__init__(job, answered)
        self._participant = participant()
        self._readers = [
            self._reader("rt/tf_static", LATCHED, self._history.add_statics),
            self._reader("rt/tf", TF, self._on_transforms),
        ]

    def _reader(self, topic: str, of: Qos, take: Any) -> Any:
        into = Topic(self._participant, topic, TFMessage)
        return DataReader(self._participant, into, qos=of, listener=Taking(take))
