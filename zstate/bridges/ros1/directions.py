"""The two directions of the bridge to ROS 1: a robot of zstate in ROS, and a robot of ROS in zstate."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from contextlib import ExitStack, suppress
from typing import Any

import numpy as np

from zstate._util.bounded import BoundedDict
from zstate._util.closeable import Closeable
from zstate._util.refusals import Refusals
from zstate.bridges.ros1.messages import (
    Ros1Encoder,
    Ros1FrameNames,
    Ros1JointReader,
    TransformsWriter,
    get_stamp,
    partial_joint_state,
    pose_from_ros,
    read_transforms,
    refusal_reason,
)
from zstate.bridges.ros1.node import NAME, Ros1Node, sender
from zstate.bridges.transforms import TransformRelay, edge_writer_of_node
from zstate.checks import Floats
from zstate.errors import Closed, InvalidInput, MessageError, ModelError, SecondWriter, Unreachable
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf
from zstate.net.session import Session
from zstate.net.subscription import Received, subscribe
from zstate.nodes.publisher import StatePublisher
from zstate.nodes.static_publisher import StaticPublisher
from zstate.nodes.transform_publisher import TransformPublisher
from zstate.sources.joint_state_listener import MAX_AGE_S
from zstate.sources.joint_state_merger import JointStateMerger
from zstate.stream_registry import edge_streams
from zstate.streams import JOINT_STREAMS
from zstate.transform import Transform
from zstate.wire.joint_order import JointNumbers
from zstate.wire.keys import MODEL_WRITER
from zstate.wire.messages import (
    Edges,
    JointState,
    RobotDescription,
    StaticTransforms,
    WriterTransforms,
    poses_from_block,
)
from zstate.wire.native import NativeWire

_LOG = logging.getLogger("zstate")


class NativeToRos1(Closeable):
    """Publishes a robot of zstate in ROS, every sample at its own stamp.

    Joints go to ``joint_states``, those of several drivers as merged readings, moving edges of the model and
    of other writers to ``/tf``, without covariances, and all static edges together, latched, to
    ``/tf_static``; ``with_description`` sets the parameter ``robot_description`` if it is not set. Messages
    for which ``is_own(session, writer)`` holds, and transforms for which ``is_own_writer(writer)`` does, came
    from ROS and are skipped. ``carried`` counts
    joint states. Each stream has a thread of its own.
    """

    def __init__(
        self,
        session: Session,
        node: Ros1Node,
        names: Ros1FrameNames,
        refusals: Refusals,
        *,
        is_own: Callable[[int, str], bool],
        is_own_writer: Callable[[str], bool],
        with_description: bool = True,
    ) -> None:
        self.carried = 0
        self.robot: Ros1Encoder | None = None
        self._node = node
        self._names = names
        self._is_own = is_own
        self._is_own_writer = is_own_writer
        self._with_description = with_description
        self._refusals = refusals
        self._wire = NativeWire()
        self._statics: dict[str, dict[tuple[str, str], Floats]] = {}
        self._transforms: BoundedDict[Edges, TransformsWriter] = BoundedDict()
        self._whole_key = self._wire.expression(names.robot, "joint_states")
        self._merger: JointStateMerger | None = None
        self._joints_lock = threading.Lock()  # joint states come on two streams
        self._joints = node.publisher("joint_states", node.ros.JointState)
        self._moving = node.publisher("/tf", node.ros.TFMessage)
        self._fixed = node.publisher("/tf_static", node.ros.TFMessage, latch=True)
        with ExitStack() as opening:
            for stream in ("robot_description", "tf_static", *JOINT_STREAMS, *edge_streams()):
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
                    self._publish_joints(key, message)
                elif isinstance(message, WriterTransforms):
                    self._publish_transforms(self._wire.edge_writer_name(key), message)
                elif isinstance(message, StaticTransforms):
                    self._publish_statics(self._wire.edge_writer_name(key), message)
                elif isinstance(message, RobotDescription):
                    self._set_model(message)
            except (MessageError, InvalidInput) as error:
                self._refusals.count(refusal_reason(error), f"{key}: {error}")

    def _on_withdrawn(self, key: str) -> None:
        with suppress(InvalidInput):  # a key without a writer's name
            self._publish_statics(self._wire.edge_writer_name(key), None)

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
        with self._joints_lock:
            self.robot = Ros1Encoder(model, self._node.ros, self._names)
            self._merger = JointStateMerger(model, MAX_AGE_S)
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

    def _publish_transforms(self, writer: str, sample: WriterTransforms) -> None:
        """Publish one sample of a ``TransformPublisher``."""
        if sample.edges is None or self._is_own_writer(writer) or not self._moving.has_readers:
            return
        poses = poses_from_block(sample.poses)
        if not np.isfinite(poses).all():
            raise InvalidInput(f"a transform of {writer!r} is NaN or infinite")
        encoder = self._transforms.get(sample.edges)
        if encoder is None:
            in_ros = self._names.in_ros
            edges = [(in_ros(parent), in_ros(child)) for parent, child in sample.edges]
            encoder = self._transforms[sample.edges] = TransformsWriter(self._node.ros, edges)
        self._moving.publish(encoder.message(sample.stamp, poses))

    def _publish_joints(self, key: str, state: JointState) -> None:
        """Publish one sample, or the reading with it. Samples before the description are skipped."""
        with self._joints_lock:
            robot = self.robot
            if robot is None or self._merger is None or self._is_own(state.session, ""):
                return
            if key == self._whole_key:
                stamp, numbers = state.stamp, robot.validator.read(state)
            else:
                merged = _merge(self._merger, state, self._wire.edge_writer_name(key), self._refusals)
                if merged is None:
                    return
                stamp, numbers = merged
            if self._joints.has_readers:
                self._joints.publish(robot.joints.message(stamp, numbers))
            if self._moving.has_readers and robot.has_moving_edges:
                self._moving.publish(robot.transforms(stamp, numbers.positions))
            self.carried += 1

    def close(self) -> None:
        """Stop. A second call does nothing."""
        self._opened.close()


def _merge(
    merger: JointStateMerger, state: JointState, writer: str, refusals: Refusals
) -> tuple[int, JointNumbers] | None:
    """The stamp and the numbers of all joints once ``state``, of ``writer``, completes them.

    Counts states that do not while joints are missing for long. Raises as ``JointStateMerger.add``.
    """
    reading = merger.add(state, writer)
    if reading is not None:
        assert reading.stamp is not None
        return reading.stamp, JointNumbers(reading.positions, reading.velocities, reading.efforts)
    if merger.missing_joints():
        refusals.count("missing joints", f"no whole joint states: {merger.explanation()}")
    return None


_SILENT_S = 10.0
"""rospy does not report that a node has left: after this time without /tf its writer in zstate is closed."""


class Ros1ToNative(Closeable):
    """Publishes a robot of ROS 1, whose ``model`` is known, in zstate.

    ``joint_states`` become joint states at their own stamps, those of several nodes merged into whole ones,
    and zstate computes the kinematics; the edges on ``/tf_static`` that are not the model's become static
    edges, and those on ``/tf`` transforms under the name of their node. ``at_once`` publishes the model at
    once, not with the first joint state. ``carried``
    counts joint states. Messages of bridges are skipped.
    """

    def __init__(
        self,
        session: Session,
        node: Ros1Node,
        model: RobotModel,
        names: Ros1FrameNames,
        refusals: Refusals,
        *,
        at_once: bool,
    ) -> None:
        self.carried = 0
        self._session = session
        self._node = node
        self._model = model
        self._names = names
        self._refusals = refusals
        # With both directions the user expects writers on both sides.
        self._takeover = not at_once
        self._links = frozenset(model.links)
        self._model_children = frozenset(joint.child for joint in model.joints)
        self._reader = Ros1JointReader(model)
        self._merger = JointStateMerger(model, MAX_AGE_S, others=True)
        self._lock = threading.Lock()
        self._closed = False
        self._opened = ExitStack()
        self._states: StatePublisher | None = None
        self._statics: StaticPublisher | None = None
        self._edges: dict[str, tuple[str, tuple[float, ...]]] = {}
        self._known_names: BoundedDict[tuple[str, ...], None] = BoundedDict()
        self._joints_lock = threading.Lock()  # rospy has a thread for each node
        self._transforms = self._opened.enter_context(
            TransformRelay(names.robot, model, self._open_transforms, refusals.count)
        )
        if at_once:
            self._publisher()
        node.subscribe("joint_states", node.ros.JointState, self._on_joints)
        node.subscribe("/tf_static", node.ros.TFMessage, self._on_statics)
        node.subscribe("/tf", node.ros.rospy.AnyMsg, self._on_transforms)

    def wrote(self, session: int, writer: str) -> bool:
        """Whether a zstate message of this session, or static edges of this writer, came from here."""
        states, statics = self._states, self._statics
        if states is not None and session == states.description().session:
            return True
        return statics is not None and writer == statics.writer

    def wrote_transforms(self, writer: str) -> bool:
        """Whether the transforms of this writer come from here."""
        return writer in self._transforms.writers

    def _publisher(self) -> StatePublisher:
        with self._lock:
            if self._closed:
                raise Closed("the bridge is closed")
            if self._states is None:
                self._states = self._opened.enter_context(
                    StatePublisher(self._session, self._model, self._names.robot, takeover=self._takeover)
                )
            return self._states

    def _is_of_a_bridge(self, message: Any) -> bool:
        writer = sender(message)
        if writer == self._node.name:
            return True
        if writer.rpartition("/")[2].startswith(f"{NAME}_"):
            self._refusals.count("another bridge", f"{writer!r} is a bridge too; its messages are zstate's")
            return True
        return False

    def _on_joints(self, message: Any) -> None:
        if self._is_of_a_bridge(message):
            return
        try:
            stamp = get_stamp(message.header)
            with self._joints_lock:
                self._publish_joints(message, stamp)
        except (MessageError, InvalidInput, SecondWriter) as error:
            self._refusals.count(refusal_reason(error), f"joint_states of {sender(message)!r}: {error}")
        except Closed:
            pass  # received while closing

    def _publish_joints(self, message: Any, stamp: int) -> None:
        names = tuple(message.name)
        if names not in self._known_names:
            self._known_names[names] = None
            if unknown := ", ".join(map(repr, self._reader.unknown(message))):
                self._refusals.count("unknown joints", f"{self._model.name!r} has no {unknown}, left out")
        numbers = self._reader.read(message)
        if numbers is None:
            node = sender(message)
            state = partial_joint_state(message, stamp, node)
            merged = _merge(self._merger, state, repr(node), self._refusals)
            if merged is None:
                return
            stamp, numbers = merged
        self._publisher().publish(*numbers, stamp)
        self.carried += 1

    def _on_statics(self, message: Any) -> None:
        if self._is_of_a_bridge(message):
            return
        for transform in message.transforms:
            if self._names.bare(transform.child_frame_id) not in self._model_children:
                try:
                    self._publish_static(transform)
                except (InvalidInput, SecondWriter) as error:
                    self._refusals.count(refusal_reason(error), f"/tf_static of {sender(message)!r}: {error}")
                except Closed:
                    return

    def _publish_static(self, transform: Any) -> None:
        parent = self._names.in_zstate(transform.header.frame_id, self._links)
        child = self._names.in_zstate(transform.child_frame_id, self._links)
        edge = (parent, pose_from_ros(transform.transform))
        with self._lock:
            before = self._edges.get(child)
            if before == edge:
                return
            if self._closed:
                raise Closed("the bridge is closed")
            if self._statics is None:
                self._statics = self._opened.enter_context(StaticPublisher(self._session, self._names.robot))
            if before is not None and before[0] != parent:
                # In ROS the newest parent wins.
                self._statics.withdraw(child)
                del self._edges[child]
            self._statics.set(Transform.from_pose7(parent, child, edge[1]))
            self._edges[child] = edge

    def _on_transforms(self, raw: Any) -> None:
        if self._is_of_a_bridge(raw):
            return
        node = sender(raw)
        try:
            transforms = read_transforms(raw._buff)  # rospy has no public name for the bytes
        except MessageError as error:
            self._refusals.count(error.reason, f"/tf of {node!r}: {error}")
            return
        in_zstate, links = self._names.in_zstate, self._links
        with suppress(Closed):  # received while closing
            for stamp in sorted({transform.stamp for transform in transforms}):
                if not stamp:
                    self._refusals.count("zero stamp", f"/tf of {node!r}: a transform without a stamp")
                    continue
                part = [transform for transform in transforms if transform.stamp == stamp]
                edges = tuple((in_zstate(one.parent, links), in_zstate(one.child, links)) for one in part)
                poses = poses_from_block(b"".join(one.pose for one in part))
                self._transforms.publish(edge_writer_of_node(node), edges, poses, stamp)

    def _open_transforms(self, writer: str) -> TransformPublisher:
        return TransformPublisher(self._session, self._names.robot, writer)

    def check(self) -> None:
        """Close the writers of nodes that have stopped publishing on /tf. Call it regularly."""
        self._transforms.remove_silent(_SILENT_S)

    def close(self) -> None:
        """Stop, and withdraw what was published in zstate. A second call does nothing."""
        with self._lock:
            self._closed = True
            self._opened.close()
