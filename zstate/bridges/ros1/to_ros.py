"""One direction of the bridge to ROS 1: publishes a robot of zstate in ROS."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import ExitStack, suppress

import numpy as np

from zstate._util.closeable import Closeable
from zstate._util.refusals import Refusals
from zstate.bridges.ros1.messages import RobotWriter, Ros1FrameNames, TransformsWriter, refusal_reason
from zstate.bridges.ros1.node import Node
from zstate.errors import InvalidInput, MessageError, ModelError, Unreachable
from zstate.model.urdf import parse_urdf
from zstate.net.session import Session
from zstate.net.subscription import Received, subscribe
from zstate.wire.joint_order import Floats
from zstate.wire.keys import MODEL_WRITER
from zstate.wire.messages import JointState, RobotDescription, StaticTransforms, poses_from_block
from zstate.wire.native import NativeWire

_LOG = logging.getLogger("zstate")


class NativeToRos1(Closeable):
    """Publishes a robot of zstate in ROS, every sample at its own stamp.

    Joints go to ``joint_states``, moving edges to ``/tf``, and all static edges together, latched, to
    ``/tf_static``; ``with_description`` sets the parameter ``robot_description`` if it is not set. Messages
    for which ``is_own(session, writer)`` holds came from ROS and are skipped. ``carried`` counts samples.
    Each stream has a thread of its own.
    """

    def __init__(
        self,
        session: Session,
        node: Node,
        names: Ros1FrameNames,
        refusals: Refusals,
        *,
        is_own: Callable[[int, str], bool],
        with_description: bool = True,
    ) -> None:
        self.carried = 0
        self.robot: RobotWriter | None = None
        self._node = node
        self._names = names
        self._is_own = is_own
        self._with_description = with_description
        self._refusals = refusals
        self._wire = NativeWire()
        self._statics: dict[str, dict[tuple[str, str], Floats]] = {}
        self._joints = node.publisher("joint_states", node.ros.JointState)
        self._moving = node.publisher("/tf", node.ros.TFMessage)
        self._fixed = node.publisher("/tf_static", node.ros.TFMessage, latch=True)
        with ExitStack() as opening:
            for stream in ("robot_description", "tf_static", "joint_states"):
                opening.enter_context(
                    subscribe(
                        session,
                        self._wire,
                        names.robot,
                        stream,
                        self._on_messages,
                        on_error=refusals.count,
                        on_withdrawn=self._on_withdrawn if stream == "tf_static" else None,
                    )
                )
            self._opened = opening.pop_all()

    def _on_messages(self, received: list[Received]) -> None:
        for _, key, message in received:
            try:
                if isinstance(message, JointState):
                    self._publish_joints(message)
                elif isinstance(message, StaticTransforms):
                    self._publish_statics(self._wire.static_writer_name(key), message)
                elif isinstance(message, RobotDescription):
                    self._set_model(message)
            except (MessageError, InvalidInput) as error:  # noqa: PERF203 - the other messages may be good
                self._refusals.count(refusal_reason(error), f"{key}: {error}")

    def _on_withdrawn(self, key: str) -> None:
        with suppress(InvalidInput):  # a key without a writer's name
            self._publish_statics(self._wire.static_writer_name(key), None)

    def _set_model(self, description: RobotDescription) -> None:
        """Use the newest model, and set the ROS parameter."""
        robot = self.robot
        is_known = robot is not None and robot.digest == description.digest
        if is_known or self._is_own(description.session, MODEL_WRITER):
            return
        try:
            model = parse_urdf(description.urdf, f"the URDF of {self._names.robot!r}")
        except ModelError as error:
            self._refusals.count("robot description", str(error))
            return
        self.robot = RobotWriter(model, self._node.ros, self._names)
        if not self._with_description:
            return
        name, master = self._node.resolved("robot_description"), self._node.master
        try:
            urdf = master.parameter(name)
            if urdf is None:
                master.set_parameter(name, model.urdf)
            elif urdf != model.urdf:
                _LOG.warning("the ROS parameter %s has another robot; it is left unchanged", name)
        except Unreachable as error:
            _LOG.warning("the parameter %s is not set: %s", name, error)

    def _publish_statics(self, writer: str, statics: StaticTransforms | None) -> None:
        """Replace the static edges of one writer (None: withdrawn; ROS nodes keep withdrawn edges)."""
        if statics is not None and self._is_own(statics.session, writer):
            return
        edges: dict[tuple[str, str], Floats] = {}
        if statics is not None:
            poses = poses_from_block(statics.poses)
            if not np.isfinite(poses).all():
                raise InvalidInput("a static edge is NaN or infinite")
            in_ros = self._names.in_ros
            names = ((in_ros(parent), in_ros(child)) for parent, child in statics.edges)
            edges = dict(zip(names, poses, strict=True))
        self._statics[writer] = edges
        merged = {edge: pose for placed in self._statics.values() for edge, pose in placed.items()}
        message = TransformsWriter(self._node.ros, list(merged))
        self._fixed.publish(message.message(None, np.array(list(merged.values())).reshape(-1, 7)))

    def _publish_joints(self, state: JointState) -> None:
        """Publish one sample. Samples before the description are skipped."""
        robot = self.robot
        if robot is None or self._is_own(state.session, ""):
            return
        numbers = robot.validator.read(state)
        if self._joints.has_readers:
            self._joints.publish(robot.joints.message(state.stamp, numbers))
        if self._moving.has_readers and robot.has_moving_edges:
            self._moving.publish(robot.transforms(state.stamp, numbers.positions))
        self.carried += 1

    def close(self) -> None:
        """Stop. A second call does nothing."""
        self._opened.close()
