"""Ingests of all writers of a stream, while tokens vanish and come back and strangers publish."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import count

import pytest
from helpers.robots import RRBOT

from zstate.buffer.buffer import TransformBuffer
from zstate.ingest.base import StreamIngest
from zstate.ingest.counters import Counters
from zstate.ingest.frame_ownership import FrameOwnership
from zstate.ingest.joint_parts import PartialJointStateIngest, RobotParts
from zstate.ingest.joint_states import JointStateIngest
from zstate.ingest.stream_ingests import MAX_DEPARTED, MAX_STRANGERS, StreamIngests
from zstate.ingest.transforms import TransformIngest
from zstate.odometry.messages import Odometry
from zstate.wire.messages import (
    JointState,
    RobotDescription,
    Sample,
    WriterTransforms,
    order_digest,
    to_block,
)

STRANGER = 10**6
"""The first session of writers that are never announced."""


class Reader:
    """What a listener does with tokens and samples of one stream, without a network."""

    stream = "transforms"

    def __init__(self) -> None:
        self.ownership = FrameOwnership(TransformBuffer(), Counters())
        self.buffer = self.ownership.buffer
        self.streams = {self.stream: StreamIngests(self.stream, is_shared=True)}
        self.seqs: dict[int, int] = {}
        self.clock = count(1)

    @property
    def ingests(self) -> StreamIngests:
        return self.streams[self.stream]

    @property
    def refused(self) -> dict[str, int]:
        return self.ownership.counters.stats().refused

    def new_ingest(self, robot: str) -> StreamIngest:
        return TransformIngest(robot, self.ownership)

    def joined(self, robot: str, session: int) -> None:
        self.ownership.live[robot, session] = f"writer {session}"
        self.ownership.add_robot(robot)
        self.ownership.add_writer(robot, session)
        self.ingests.announce(robot, session, f"writer {session}")

    def left(self, robot: str, session: int) -> None:
        self.ownership.live.pop((robot, session), None)
        self.ownership.remove_writer(robot, session)
        self.ingests.writer_left(robot, session)

    def receive(self, robot: str, session: int, child: str = "base", stream: str = "") -> int:
        """A sample of ``odom -> child`` arrives; returns its stamp."""
        ingests = self.streams.setdefault(stream or self.stream, StreamIngests("odometry", is_shared=True))
        ingest = ingests.find(robot, session)
        if ingest is None:
            self.ownership.add_robot(robot)
            ingest = ingests.add(self.new_ingest(robot), session)
        seq = self.seqs[session] = self.seqs.get(session, -1) + 1
        stamp = next(self.clock)
        ingest.insert_sample(self.sample(stamp, seq, session, child), overflowed=False)
        return stamp

    def sample(self, stamp: int, seq: int, session: int, child: str) -> Sample:
        edges = (("odom", child),)
        pose = to_block((seq, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
        return WriterTransforms(stamp, seq, session, order_digest(edges), pose, edges)

    def newest(self, robot: str, child: str = "base") -> int | None:
        return self.buffer.latest(f"{robot}/odom", f"{robot}/{child}")


class OdometryReader(Reader):
    stream = "odometry"

    def sample(self, stamp: int, seq: int, session: int, child: str) -> Sample:
        edges = (("odom", child),)
        pose = to_block((seq, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
        return Odometry(stamp, seq, session, order_digest(edges), pose, edges, twist=to_block([0.0] * 6))


class PartReader(Reader):
    """A reader of drivers of some joints: ``child`` is the joint."""

    stream = "partial_joint_states"

    def __init__(self) -> None:
        super().__init__()
        self.wholes: dict[str, JointStateIngest] = {}

    def parts(self, robot: str) -> RobotParts:
        if robot not in self.wholes:
            self.wholes[robot] = JointStateIngest(robot, self.ownership)
            self.wholes[robot].describe(RobotDescription(1, RRBOT.urdf, RRBOT.digest, RRBOT.joint_names, ()))
        return self.wholes[robot].parts

    def new_ingest(self, robot: str) -> StreamIngest:
        return PartialJointStateIngest(robot, self.ownership, self.parts(robot))

    def joined(self, robot: str, session: int) -> None:
        super().joined(robot, session)
        self.parts(robot).add_writer(session, session)

    def left(self, robot: str, session: int) -> None:
        self.parts(robot).remove_writer(session)
        super().left(robot, session)

    def sample(self, stamp: int, seq: int, session: int, child: str) -> Sample:
        names = ("shoulder",)
        return JointState(stamp, seq, session, order_digest(names), to_block((0.1,)), None, None, names)

    def newest(self, robot: str, child: str = "base") -> int | None:
        return self.buffer.latest(f"{robot}/base", f"{robot}/upper")


READERS = pytest.mark.parametrize("make", [Reader, OdometryReader, PartReader])


def robots(number: int) -> list[tuple[str, int]]:
    """Robots, each with the session of its writer."""
    return [(f"r{index}", index + 1) for index in range(number)]


def frozen(reader: Reader, fleet: Iterable[tuple[str, int]]) -> list[str]:
    """The robots of which a new sample does not arrive."""
    return [robot for robot, session in fleet if reader.receive(robot, session) != reader.newest(robot)]


@READERS
@pytest.mark.parametrize("between", ["silent", "publishing"])
def test_all_writers_of_1000_robots_go_on_after_the_tokens_of_all_were_away(make: type[Reader], between: str):
    reader, fleet = make(), robots(1000 if make is not PartReader else 300)
    for _ in range(2):
        for robot, session in fleet:
            reader.joined(robot, session)
            reader.receive(robot, session)
        for robot, session in fleet:
            reader.left(robot, session)
        if between == "publishing":
            assert frozen(reader, fleet) == []
        for robot, session in fleet:
            reader.joined(robot, session)
        assert frozen(reader, fleet) == []
    assert reader.refused == {}


@READERS
@pytest.mark.parametrize("attacked", ["another robot", "the same robot"])
@pytest.mark.long
def test_strangers_push_out_no_writer_whose_token_is_away(make: type[Reader], attacked: str):
    reader = make()
    reader.joined("rb", 1)
    reader.receive("rb", 1)
    reader.left("rb", 1)
    ingest = reader.ingests.find("rb", 1)
    for number in range(2 * MAX_STRANGERS):
        reader.receive("ra" if attacked == "another robot" else "rb", STRANGER + number, f"f{number}")
    assert reader.ingests.find("rb", 1) is ingest
    assert reader.refused["too many writers"] == MAX_STRANGERS
    reader.joined("rb", 1)
    assert frozen(reader, [("rb", 1)]) == []


def test_first_samples_of_a_writer_survive_the_strangers_of_another_robot():
    reader = Reader()
    before = reader.receive("rb", 1)
    for number in range(2 * MAX_STRANGERS):
        reader.receive("ra", STRANGER + number, f"f{number}")
    reader.joined("rb", 1)
    assert reader.newest("rb") == before
    assert frozen(reader, [("rb", 1)]) == []


def test_writer_that_was_dropped_is_accepted_again():
    reader = Reader()
    reader.joined("r1", 1)
    reader.receive("r1", 1)
    reader.left("r1", 1)
    for session in range(2, 2 + MAX_DEPARTED):
        reader.joined("r1", session)
        reader.receive("r1", session, f"f{session}")
        reader.left("r1", session)
    assert reader.ingests.find("r1", 1) is None
    assert not reader.buffer.can_lookup("r1/odom", "r1/base")
    assert reader.buffer.can_lookup("r1/odom", "r1/f2")
    reader.joined("r1", 1)
    assert frozen(reader, [("r1", 1)]) == []
    assert reader.refused == {"too many writers": 1}


def test_writers_without_a_token_are_bounded_over_all_robots(monkeypatch: pytest.MonkeyPatch):
    """Without access control a hostile writer can make up robots, too."""
    monkeypatch.setattr("zstate.ingest.stream_ingests._MAX_ALL_STRANGERS", 20)
    monkeypatch.setattr("zstate.ingest.stream_ingests._MAX_ALL_DEPARTED", 30)
    reader, fleet = Reader(), robots(40)
    for robot, session in fleet:
        reader.joined(robot, session)
        reader.receive(robot, session)
    for robot, session in fleet:
        reader.left(robot, session)
    for number in range(100):
        reader.receive(f"made up {number}", STRANGER + number)
    assert len(reader.ingests.all()) == 50
    for robot, session in fleet:
        reader.joined(robot, session)
    assert frozen(reader, fleet) == []


def test_dropped_ingest_inserts_nothing_and_counts_it():
    """As a thread that looked the ingest up before another thread has dropped it."""
    reader = Reader()
    reader.receive("r1", 1)
    ingest = reader.ingests.find("r1", 1)
    assert ingest is not None
    ingest.drop()
    ingest.insert_sample(reader.sample(10, 1, 1, "base"), overflowed=False)
    assert ingest.insert_history([reader.sample(11, 2, 1, "base")]) is False
    assert [frame.name for frame in reader.buffer.frames() if frame.parent] == []
    assert reader.refused == {"too many writers": 2}


def test_writer_is_not_refused_because_of_its_own_other_stream():
    reader = Reader()
    reader.joined("r1", 1)
    reader.receive("r1", 1)
    at = reader.receive("r1", 1, stream="odometry")
    assert reader.newest("r1") == at
    assert reader.refused == {}
