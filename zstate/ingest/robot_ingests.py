"""The ingests of a reader: of all streams that it receives, of all robots, of all writers."""

from __future__ import annotations

from collections.abc import Collection
from typing import Literal

from zstate.buffer.buffer import TransformBuffer
from zstate.ingest.base import StreamIngest
from zstate.ingest.counters import Counters
from zstate.ingest.diagnostics import Diagnostics
from zstate.ingest.frame_ownership import FrameOwnership
from zstate.ingest.joint_parts import PartialJointStateIngest, RobotParts
from zstate.ingest.joint_states import JointStateIngest
from zstate.ingest.stream_ingests import StreamIngests
from zstate.ingest.transforms import StaticTransformIngests, TransformIngest
from zstate.stream_registry import edge_streams
from zstate.streams import StreamName
from zstate.wire.identity import Announcement
from zstate.wire.messages import RobotDescription, StaticTransforms
from zstate.wire.protocol import Wire

Follow = Literal["joint_states", "tf"]


def sample_streams(wire: Wire, follow: Follow) -> tuple[StreamName, ...]:
    """The streams of samples that a reader of ``follow`` receives on ``wire``."""
    parts = [wire.partial_joint_states] if follow == "joint_states" else []
    return tuple(dict.fromkeys((follow, *parts, *wire.edges)))


class RobotIngests:
    """The ingests of what a reader of ``follow`` receives on ``wire``, which insert it into ``buffer``.

    An ingest is made for the first message of its robot, or of its writer. Any thread may call the methods.
    """

    def __init__(
        self,
        buffer: TransformBuffer,
        counters: Counters,
        wire: Wire,
        follow: Follow,
        *,
        placers: Collection[str] | None = None,
        diagnostics: Diagnostics,
    ) -> None:
        self._wire = wire
        self._follow: Follow = follow
        self._diagnostics = diagnostics
        self._ownership = FrameOwnership(
            buffer,
            counters,
            is_shared=bool(wire.shared),
            placers=placers,
            on_conflict=diagnostics.on_conflict,
        )
        self.writers = self._ownership.live
        """The printed names of the announced writers, by robot and session."""
        self.followed = StreamIngests(follow, is_shared=follow in wire.shared)
        """The ingests of ``follow``; that of a robot is made for its first message of any kind."""
        self._parts = StreamIngests(wire.partial_joint_states, is_shared=True, has_parts=True)
        self.streams: dict[StreamName, StreamIngests] = {}
        """The ingests of samples, by the stream that carries them."""
        for stream in sample_streams(wire, follow):
            if stream == self._parts.stream:
                self.streams[stream] = self._parts  # in ROS any joint state may be a part
            elif stream == follow:
                self.streams[stream] = self.followed
            else:
                self.streams[stream] = StreamIngests(stream, is_shared=True)
        self._statics = StaticTransformIngests(self._ownership, diagnostics.on_static_children)

    @property
    def _has_joints(self) -> bool:
        return self._follow == "joint_states"

    def robots(self) -> tuple[str, ...]:
        """The robots that sent any message so far, sorted by name."""
        ingests = (one for samples in {self.followed, *self.streams.values()} for one in samples.all())
        return tuple(sorted({ingest.robot for ingest in ingests if ingest.has_data}))

    def find(self, samples: StreamIngests, robot: str, session: int) -> StreamIngest:
        """The ingest of the samples of a robot, or of this session if each writer has one."""
        ingest = samples.find(robot, session)
        if ingest is None:
            self._ownership.add_robot(robot)
            ingest = samples.add(self._new_ingest(samples, robot), session)
        return ingest

    def _new_ingest(self, samples: StreamIngests, robot: str) -> StreamIngest:
        on_set_back = self._diagnostics.on_set_back
        if samples.has_parts:
            others = bool(self._wire.shared)
            return PartialJointStateIngest(
                robot, self._ownership, self._joint_parts(robot), on_set_back, others=others
            )
        make = JointStateIngest if samples.stream == "joint_states" else TransformIngest
        return make(robot, self._ownership, on_set_back)

    def _joint_parts(self, robot: str) -> RobotParts:
        ingest = self.find(self.followed, robot, 0)
        assert isinstance(ingest, JointStateIngest)
        return ingest.parts

    def describe(self, robot: str, description: RobotDescription) -> None:
        """Use the description of a robot from now on."""
        self.find(self.followed, robot, description.session).describe(description)
        for part in self._parts.all(robot):
            part.describe(description)

    def insert_statics(self, key: str, robot: str, writer: str | None, statics: StaticTransforms) -> None:
        """Insert static edges received on ``key``; ``writer`` is the name in it, None in ROS."""
        self.find(self.followed, robot, statics.session).has_data = True
        self._statics.insert(key, robot, writer, statics)

    def withdraw_statics(self, key: str, robot: str, writer: str) -> None:
        """Withdraw the static edges received on ``key``."""
        self._statics.withdraw(key, robot, writer)

    def add_writer(self, announced: Announcement) -> None:
        """Add an announced writer of a stream: what it publishes counts before what strangers do."""
        robot, session, stream = announced.robot, announced.writer.session, announced.stream
        name = self.writers[robot, session] = str(announced.writer)
        self._diagnostics.on_writer(announced, alive=True)  # before conflicts of this writer
        self._ownership.add_robot(robot)
        if stream == "tf_static":
            self._ownership.add_writer(robot, session)
            self._statics.name_writer(session, name)
        elif stream == "robot_description" and self._has_joints:
            self.find(self.followed, robot, session).name_writer(session, name)
        elif stream in self.streams:
            samples = self.streams[stream]
            if self._has_edges(stream):
                self._ownership.add_writer(robot, session)
            elif self._has_joints:
                self._joint_parts(robot).add_writer(session, announced.writer.since)
            if samples.is_shared:
                samples.announce(robot, session, name)
            else:
                self.find(samples, robot, session).name_writer(session, name)

    def remove_writer(self, announced: Announcement) -> None:
        """Remove a writer that is not announced any more; its last samples may arrive later."""
        robot, session, stream = announced.robot, announced.writer.session, announced.stream
        self._diagnostics.on_writer(announced, alive=False)
        self.writers.pop((robot, session), None)
        if stream == "tf_static":
            self._ownership.remove_writer(robot, session)
        elif stream in self.streams:
            if self._has_edges(stream):
                self._ownership.remove_writer(robot, session)
            elif self._has_joints:
                self._joint_parts(robot).remove_writer(session)
            self.streams[stream].writer_left(robot, session)

    def _has_edges(self, stream: StreamName) -> bool:
        """Whether a writer of this stream owns the edges in it."""
        return stream in edge_streams() or (stream == "tf" and not self._wire.shared)
