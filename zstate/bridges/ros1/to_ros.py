"""ToRos: a robot of zstate, as ROS 1 knows robots.

Hearing: all that is said about one robot, message by message.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import ExitStack, suppress
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from zstate._util.closeable import Closeable
from zstate._util.refusals import Refusals
from zstate.bridges.ros1.messages import JointStateWriter, Ros1FrameNames, TransformsWriter
from zstate.bridges.ros1.node import Node, RospyModules
from zstate.errors import InvalidInput, MessageError, ModelError, Unreachable
from zstate.model.joint_transforms import JointTransforms
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf
from zstate.net.session import Session
from zstate.net.subscription import Received, subscribe
from zstate.sources.joint_source import JointStateValidator
from zstate.wire.joint_order import JointNumbers
from zstate.wire.keys import MODEL_WRITER
from zstate.wire.messages import JointState, RobotDescription, StaticTransforms, poses_from_block
from zstate.wire.native import NativeWire


class RobotHandler(Protocol):
    """Who hears it. What it raises, InvalidInput or MessageError, is counted."""

    def describe(self, description: RobotDescription) -> None:
        """What the robot is."""
        ...

    def place(self, writer: str, statics: StaticTransforms | None) -> None:
        """All static edges of ``writer``; None when it takes them back."""
        ...

    def move(self, state: JointState) -> None:
        """Where its joints are."""
        ...


class RobotSubscriber(Closeable):
    """Calls ``hearer`` with the messages of ``robot``, each stream on a thread of its own."""

    def __init__(self, session: Session, robot: str, hearer: RobotHandler, refusals: Refusals) -> None:
        self._hearer = hearer
        self._refusals = refusals
        self._wire = wire = NativeWire()
        with ExitStack() as opening:
            for stream in ("robot_description", "tf_static", "joint_states"):
                on_withdrawn = self._on_withdrawn if stream == "tf_static" else None
                opening.enter_context(
                    subscribe(
                        session,
                        wire,
                        robot,
                        stream,
                        self._on_messages,
                        on_error=refusals.count,
                        on_withdrawn=on_withdrawn,
                    )
                )
            self._opened = opening.pop_all()

    def _on_messages(self, received: list[Received]) -> None:
        for _, key, message in received:
            try:
                if isinstance(message, JointState):
                    self._hearer.move(message)
                elif isinstance(message, StaticTransforms):
                    self._hearer.place(self._wire.static_writer_name(key), message)
                elif isinstance(message, RobotDescription):
                    self._hearer.describe(message)
            except (MessageError, InvalidInput) as error:  # noqa: PERF203 - the other messages may be good
                reason = error.reason if isinstance(error, MessageError) else "bad numbers"
                self._refusals.count(reason, f"{key}: {error}")

    def _on_withdrawn(self, key: str) -> None:
        with suppress(InvalidInput):  # a key without a writer's name
            self._hearer.place(self._wire.static_writer_name(key), None)

    def close(self) -> None:
        """Stop. A second call does nothing."""
        self._opened.close()


_LOG = logging.getLogger("zstate")

Edge = tuple[str, str]


class NativeToRos1(Closeable):
    """Publishes in ROS what is said of a robot in zstate, every sample at its own stamp.

    Joints go to ``joint_states``, moving edges to ``/tf``, and all static edges together, latched, to
    ``/tf_static``; ``with_description`` makes the model the parameter ``robot_description``, where there is
    none. What ``is_ours(session, writer)``, from ROS, does not go back there. ``carried`` counts samples.
    """

    def __init__(
        self,
        session: Session,
        node: Node,
        names: Ros1FrameNames,
        refusals: Refusals,
        *,
        is_ours: Callable[[int, str], bool],
        with_description: bool = True,
    ) -> None:
        self.carried = 0
        self.robot: _Robot | None = None
        self._node = node
        self._names = names
        self._is_ours = is_ours
        self._with_description = with_description
        self._refusals = refusals
        self._statics: dict[str, dict[Edge, NDArray[np.float64]]] = {}
        self._joints = node.publisher("joint_states", node.ros.JointState)
        self._moving = node.publisher("/tf", node.ros.TFMessage)
        self._fixed = node.publisher("/tf_static", node.ros.TFMessage, latch=True)
        self._hearing = RobotSubscriber(session, names.robot, self, refusals)

    def describe(self, description: RobotDescription) -> None:
        """Learn what the robot is; the newest to say so is believed."""
        if self._is_ours(description.session, MODEL_WRITER) or (
            self.robot and self.robot.digest == description.digest
        ):
            return
        try:
            model = parse_urdf(description.urdf, f"the URDF of {self._names.robot!r}")
        except ModelError as error:
            self._refusals.count("robot description", str(error))
            return
        self.robot = _Robot(model, self._node.ros, self._names)
        if self._with_description:
            self._set_parameter(model.urdf)

    def _set_parameter(self, urdf: str) -> None:
        name, master = self._node.resolved("robot_description"), self._node.master
        try:
            there = master.parameter(name)
            if there is None:
                master.set_parameter(name, urdf)
            elif there != urdf:
                _LOG.warning("ROS has another robot in the parameter %s, which is left as it is", name)
        except Unreachable as error:
            _LOG.warning("the parameter %s is not set: %s", name, error)

    def place(self, writer: str, statics: StaticTransforms | None) -> None:
        """Take all static edges of one writer; those that are withdrawn stay in ROS until its nodes end."""
        if statics is not None and self._is_ours(statics.session, writer):
            return
        self._statics[writer] = {} if statics is None else self._named(statics)
        edges = {edge: pose for placed in self._statics.values() for edge, pose in placed.items()}
        message = TransformsWriter(self._node.ros, list(edges))
        self._fixed.publish(message.message(None, np.array(list(edges.values())).reshape(-1, 7)))

    def _named(self, statics: StaticTransforms) -> dict[Edge, NDArray[np.float64]]:
        poses = poses_from_block(statics.poses)
        if not np.isfinite(poses).all():
            raise InvalidInput("a static edge is NaN or infinite")
        in_ros = self._names.in_ros
        edges = ((in_ros(parent), in_ros(child)) for parent, child in statics.edges)
        return dict(zip(edges, poses, strict=True))

    def move(self, state: JointState) -> None:
        """Carry one sample. Samples that come before the description are too early for ROS."""
        robot = self.robot
        if robot is None or self._is_ours(state.session, ""):
            return
        numbers = robot.read(state)
        if self._joints.has_readers:
            self._joints.publish(robot.joints.message(state.stamp, numbers))
        if self._moving.has_readers and robot.has_moving_edges:
            self._moving.publish(robot.transforms(state.stamp, numbers.positions))
        self.carried += 1

    def close(self) -> None:
        """Stop. A second call does nothing."""
        self._hearing.close()


class _Robot:
    """What is made of the samples of one model."""

    def __init__(self, model: RobotModel, ros: RospyModules, names: Ros1FrameNames) -> None:
        self.model = model
        self.digest = model.digest
        self.joints = JointStateWriter(ros, model)
        self._states = JointStateValidator(model)
        self._table = JointTransforms(model)
        forms = self._table.forms
        self._rows = [row for row, form in enumerate(forms) if form.kind != "fixed"]
        edges = [(names.prefix + forms[row].parent, names.prefix + forms[row].child) for row in self._rows]
        self._transforms = TransformsWriter(ros, edges)

    @property
    def has_moving_edges(self) -> bool:
        return bool(self._rows)

    def read(self, state: JointState) -> JointNumbers:
        """The numbers of a sample. Raises MessageError and InvalidInput for what cannot be used."""
        return self._states.read(state)

    def transforms(self, stamp: int, positions: NDArray[np.float64]) -> Any:
        return self._transforms.message(stamp, self._table.poses(positions).take(self._rows, axis=0))
