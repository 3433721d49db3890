"""JointFollower: joint positions and a model, into a buffer."""

from __future__ import annotations

from functools import lru_cache

from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.frames import FrameInfo
from zstate.buffer.tracks import JointTrack
from zstate.errors import InsertRefused, ModelError
from zstate.following.follower import Follower
from zstate.following.statics import are_same
from zstate.following.tally import Tally
from zstate.model.coordinates import coordinate_names, velocity_slots
from zstate.model.robot import Joint, RobotModel
from zstate.model.urdf import parse_urdf
from zstate.transform import Transform
from zstate.wire.joint_order import JointOrder
from zstate.wire.messages import JointState, RobotDescription, Sample


@lru_cache(maxsize=16)
def _parsed(urdf: str) -> RobotModel:
    """The robots of a fleet are described alike, again and again: a model is the same for all of them."""
    return parse_urdf(urdf, "its URDF")


class JointFollower(Follower):
    """Follows joint states, with the robot's model."""

    def __init__(self, robot: str, buffer: TransformBuffer, tally: Tally) -> None:
        super().__init__(robot, buffer, tally)
        self._digest = ""
        self._describer: int | None = None
        self._track: JointTrack | None = None
        self._order = JointOrder(())

    def describe(self, description: RobotDescription) -> None:
        self.heard = True
        with self._lock:
            self._describer = description.session
            self._writer_changed()
        if not self._keeps_our_time(description) or description.digest == self._digest:
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
        if self._track is not None:
            self._buffer.remove_robot(self._track)
            self._track = None
        self._order = JointOrder(model.joint_names, coordinate_names(model), velocity_slots(model))
        self._make_room(model)
        self._track = self._buffer.add_robot(model, self.robot)

    def _make_room(self, model: RobotModel) -> None:
        # The robot's own model knows best: whoever else placed one of its links gives way.
        joints = {f"{self.robot}/{joint.child}": joint for joint in model.joints}
        for frame in self._buffer.frames(joints):
            if frame.parent is not None:
                if not self._says_the_same(frame, joints[frame.name]):
                    self._tally.refuse(
                        "second writer", f"{frame.writer!r} placed {frame.name!r}, a link of the model"
                    )
                self._buffer.withdraw(frame.name)

    def _says_the_same(self, frame: FrameInfo, joint: Joint) -> bool:
        """In ROS the fixed edges of a model are among the static ones of its state publisher."""
        parent = f"{self.robot}/{joint.parent}"
        if frame.kind != "static" or joint.type != "fixed" or frame.parent != parent:
            return False
        said = self._buffer.lookup(parent, frame.name)
        return are_same(said, Transform.from_pose7(parent, frame.name, joint.origin))

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
