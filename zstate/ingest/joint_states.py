"""Ingest of joint states: joint positions and the robot's model, into a buffer."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

from zstate.buffer.tracks import JointTrack
from zstate.errors import InsertRefused, ModelError
from zstate.ingest.base import ClockSetBack, StreamIngest
from zstate.ingest.frame_ownership import FrameOwnership
from zstate.ingest.joint_parts import RobotParts, insert_past, joint_order
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf
from zstate.wire.joint_order import JointOrder
from zstate.wire.messages import JointState, RobotDescription, Sample


@lru_cache(maxsize=16)
def _parsed(urdf: str) -> RobotModel:
    """The model of a URDF; the robots of a fleet have the same one and share it."""
    return parse_urdf(urdf, "its URDF")


class JointStateIngest(StreamIngest):
    """Inserts joint states as positions of the joints of the robot's model.

    ``parts`` has the drivers that publish only some of the joints.
    """

    def __init__(
        self, robot: str, ownership: FrameOwnership, on_set_back: ClockSetBack | None = None
    ) -> None:
        super().__init__(robot, ownership, on_set_back)
        self.parts = RobotParts(robot, ownership)
        self._digest = ""
        self._description_session: int | None = None
        self._track: JointTrack | None = None
        self._order = JointOrder(())

    def describe(self, description: RobotDescription) -> None:
        self.has_data = True
        with self._lock:
            self._description_session = description.session
            self._on_writer_changed()
        self._set_domain(description)
        if description.digest == self._digest:
            return
        with self._lock:
            try:
                # Plain URDF text: input from the network opens no files and runs no xacro.
                self._replace_model(_parsed(description.urdf))
            except (ModelError, InsertRefused) as error:
                self._counters.count_refusal("robot description", f"{self.robot!r}: {error}")
                return
            self._digest = description.digest
            self._on_writer_changed()
            self._insert_early()

    def _replace_model(self, model: RobotModel) -> None:
        self._order = joint_order(model)
        before, self._track = self._track, None
        self._track = self._ownership.place_model(self.robot, model, before)
        self.parts.set_model(self._track)

    def _insert(self, sample: Sample) -> bool | None:
        track = self._track
        if track is None:
            return None
        assert isinstance(sample, JointState)
        if self._order.is_plain(sample):
            return self._buffer.insert_joints(track, sample.stamp, sample.positions)
        numbers = self._order.read(sample)
        return self._buffer.insert_joints(track, sample.stamp, numbers.positions, numbers.velocities)

    def _insert_past(self, samples: Sequence[Sample]) -> int:
        return 0 if self._track is None else insert_past(self._feed, self._track, self._order, samples)

    def _fast_place(self, sample: Sample) -> JointTrack | None:
        return self._track if sample.order == self._order.digest else None

    def _may_restart_epoch(self) -> bool:
        return True  # a robot has one writer of joint states at a time

    def _drop_history(self) -> None:
        if self._track is not None:
            self._feed.restart(self._track)

    def _on_writer_changed(self) -> None:
        self.parts.set_whole_writer(self.session)
        if self._track is not None:
            self._track.writer = self.writer
            self._track.model_writer = self._sessions.names.get(self._description_session or 0)
