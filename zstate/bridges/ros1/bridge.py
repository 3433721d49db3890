"""Bridge of one robot between zstate and ROS 1: joint states, transforms and the model."""

from __future__ import annotations

import logging
from contextlib import ExitStack

from zstate._util.closeable import Closeable
from zstate._util.refusals import Refusals
from zstate.bridges.ros1.directions import NativeToRos1, Ros1ToNative
from zstate.bridges.ros1.messages import Ros1FrameNames
from zstate.bridges.ros1.node import Ros1Node
from zstate.errors import InvalidInput, NetworkError, Unreachable
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf
from zstate.net.session import Session
from zstate.wire.keys import check_robot

_LOG = logging.getLogger("zstate")


class Ros1Bridge(Closeable):
    """Carries the joint states and transforms of ``robot`` between zstate and the ROS 1 of ``node``.

    ``to_ros`` and ``from_ros`` select the directions. The model of a robot from ROS is ``model``, or the
    parameter ``robot_description`` as soon as it is set; ``with_description`` sets it for a robot of
    zstate. ``frame_prefix`` precedes the robot's own frames in ROS, and is removed on the way back.
    Call ``check`` regularly. A context manager.
    """

    def __init__(
        self,
        session: Session,
        node: Ros1Node,
        robot: str,
        *,
        to_ros: bool = False,
        from_ros: bool = False,
        model: RobotModel | None = None,
        frame_prefix: str = "",
        with_description: bool = True,
    ) -> None:
        if not (to_ros or from_ros):
            raise InvalidInput("a bridge carries something: to_ros, from_ros, or both")
        self.robot = check_robot(robot)
        self._session = session
        self._node = node
        self._model = model
        self._names = Ros1FrameNames(robot, frame_prefix)
        self._refusals = Refusals()
        self._needs_from_ros = from_ros
        self._lost_master = False
        self._from_ros: Ros1ToNative | None = None
        self._to_ros: NativeToRos1 | None = None
        self._opened = ExitStack()
        try:
            if to_ros:
                self._to_ros = self._opened.enter_context(
                    NativeToRos1(
                        session,
                        node,
                        self._names,
                        self._refusals,
                        is_own=self._is_own,
                        is_own_writer=self._is_own_writer,
                        with_description=with_description,
                    )
                )
            self._open_from_ros()
        except BaseException:
            self.close()
            raise

    @property
    def carried(self) -> tuple[int, int]:
        """The count of joint states to ROS, and from ROS."""
        return (
            0 if self._to_ros is None else self._to_ros.carried,
            0 if self._from_ros is None else self._from_ros.carried,
        )

    @property
    def refused(self) -> dict[str, int]:
        """Counts of refused messages by reason; the first of each is also logged."""
        return dict(self._refusals.counts)

    def waits_for(self) -> str:
        """The message or parameter that is still missing; empty once samples are carried."""
        if self._to_ros is not None and self._to_ros.robot is None:
            return f"the robot_description of {self.robot!r} in zstate"
        if self._needs_from_ros and self._from_ros is None:
            return f"the parameter {self._node.resolved('robot_description')} in ROS"
        if any(self.carried):
            return ""
        places = ["in zstate"] * (self._to_ros is not None) + ["in ROS"] * self._needs_from_ros
        return f"joint_states of {self.robot!r} {' or '.join(places)}"

    def check(self) -> None:
        """Check ROS and its nodes. Raises NetworkError if this bridge must be restarted."""
        if self._node.has_ended:
            raise NetworkError("ROS has ended the node of this bridge (`rosnode kill` does that)")
        try:
            if self._node.master.pid() != self._node.master_pid:
                raise NetworkError(
                    "the ROS master was restarted and does not know this bridge; start the bridge again"
                )
            self._lost_master = False
            self._open_from_ros()
            if self._from_ros is not None:
                self._from_ros.check()
        except Unreachable as error:
            if not self._lost_master:
                self._lost_master = True
                _LOG.warning("%s. Existing connections continue; new nodes do not find this bridge", error)

    def _open_from_ros(self) -> None:
        if not self._needs_from_ros or self._from_ros is not None:
            return
        model = self._model
        if model is None:
            name = self._node.resolved("robot_description")
            urdf = self._node.master.parameter(name)
            if urdf is None:
                return
            model = parse_urdf(str(urdf), f"the ROS parameter {name}")
        at_once = self._to_ros is None
        self._from_ros = self._opened.enter_context(
            Ros1ToNative(self._session, self._node, model, self._names, self._refusals, at_once=at_once)
        )

    def _is_own(self, session: int, writer: str) -> bool:
        return self._from_ros is not None and self._from_ros.wrote(session, writer)

    def _is_own_writer(self, writer: str) -> bool:
        return self._from_ros is not None and self._from_ros.wrote_transforms(writer)

    def close(self) -> None:
        """Stop carrying; the node stays. A second call does nothing."""
        self._opened.close()
