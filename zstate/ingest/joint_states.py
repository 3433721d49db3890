"""Ingest of joint states: joint positions and the robot's model, into a buffer."""

from __future__ import annotations

from functools import lru_cache

from zstate.buffer.tracks import JointTrack
from zstate.errors import InsertRefused, ModelError
from zstate.ingest.base import ClockSetBack
from zstate.ingest.frame_ownership import FrameOwnership
from zstate.ingest.joint_parts import JointIngest, JointPart, RobotParts
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf
from zstate.wire.messages import RobotDescription, Sample


@lru_cache(maxsize=16)
def _parsed(urdf: str) -> RobotModel:
    """The model of a URDF; the robots of a fleet have the same one and share it."""
    return parse_urdf(urdf, "its URDF")


class JointStateIngest(JointIngest):
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
        self._whole: JointPart | None = None

    @property
    def _track(self) -> JointTrack | None:
        return None if self._whole is None else self._whole.track

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
        before, self._whole = self._track, None
        self._whole = self.parts.set_model(self._ownership.place_model(self.robot, model, before))

    def _part(self, sample: Sample) -> JointPart | None:
        return self._whole

    def _drop_history(self) -> None:
        if self._track is not None:
            self._feed.restart(self._track)

    def _on_writer_changed(self) -> None:
        self.parts.set_whole_writer(self.session)
        if self._track is not None:
            self._track.writer = self.writer
            self._track.model_writer = self._sessions.names.get(self._description_session or 0)
