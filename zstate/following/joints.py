"""JointFollower: joint positions and a model, into a buffer."""

from __future__ import annotations

from functools import lru_cache

from zstate.buffer.tracks import JointTrack
from zstate.errors import InsertRefused, ModelError
from zstate.following.follower import Follower, SetBack
from zstate.following.ownership import FrameOwnership
from zstate.model.coordinates import coordinate_names, velocity_slots
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf
from zstate.wire.joint_order import JointOrder
from zstate.wire.messages import JointState, RobotDescription, Sample


@lru_cache(maxsize=16)
def _parsed(urdf: str) -> RobotModel:
    """The robots of a fleet are described alike, again and again: a model is the same for all of them."""
    return parse_urdf(urdf, "its URDF")


class JointFollower(Follower):
    """Follows joint states, with the robot's model."""

    def __init__(self, robot: str, ownership: FrameOwnership, on_set_back: SetBack | None = None) -> None:
        super().__init__(robot, ownership, on_set_back)
        self._digest = ""
        self._describer: int | None = None
        self._track: JointTrack | None = None
        self._order = JointOrder(())

    def describe(self, description: RobotDescription) -> None:
        self.heard = True
        with self._lock:
            self._describer = description.session
            self._writer_changed()
        self._learn_domain(description)
        if description.digest == self._digest:
            return
        with self._lock:
            try:
                # Text and nothing else: what comes over the network opens no files and runs no xacro.
                self._replace_model(_parsed(description.urdf))
            except (ModelError, InsertRefused) as error:
                self._tally.refuse("robot description", f"{self.robot!r}: {error}")
                return
            self._digest = description.digest
            self._writer_changed()
            self._insert_early()

    def _replace_model(self, model: RobotModel) -> None:
        self._order = JointOrder(model.joint_names, coordinate_names(model), velocity_slots(model))
        before, self._track = self._track, None
        self._track = self._ownership.place_model(self.robot, model, before)

    def _can_read(self, sample: Sample) -> bool:
        return self._track is not None

    def _insert(self, sample: Sample) -> bool:
        assert isinstance(sample, JointState)
        assert self._track is not None
        if self._order.is_plain(sample):
            return self._buffer.insert_joints(self._track, sample.stamp, sample.positions)
        numbers = self._order.read(sample)
        return self._buffer.insert_joints(self._track, sample.stamp, numbers.positions, numbers.velocities)

    def _may_begin_again(self) -> bool:
        return True  # a robot has one writer of joint states at a time

    def _restart(self) -> None:
        if self._track is not None:
            self._buffer.restart(self._track)

    def _writer_changed(self) -> None:
        if self._track is not None:
            self._track.writer = self.writer
            self._track.model_writer = self._writers.get(self._describer or 0)
