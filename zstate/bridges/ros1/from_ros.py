"""FromRos: a robot of ROS 1, as zstate knows robots."""

from __future__ import annotations

import threading
import time
from contextlib import ExitStack
from typing import Any

from zstate._util.closeable import Closeable
from zstate._util.refusals import Refusals
from zstate.bridges.ros1.messages import JointStateReader, Ros1FrameNames, get_stamp, pose_from_ros
from zstate.bridges.ros1.node import NAME, Node, sender
from zstate.errors import Closed, InsertRefused, InvalidInput, MessageError, SecondWriter
from zstate.model.robot import RobotModel
from zstate.net.session import Session
from zstate.nodes.publisher import StatePublisher
from zstate.nodes.static_publisher import StaticPublisher
from zstate.transform import Transform

# A node's /tf is looked into so often; it may come a thousand times a second.
_LOOK_EVERY_S = 1.0


class Ros1ToNative(Closeable):
    """Publishes in zstate what ROS says of a robot whose ``model`` is known.

    ``joint_states`` become joint states at their own stamps, and zstate does the kinematics; the edges
    on ``/tf_static`` that are not the model's become static edges. Moving edges on ``/tf`` that are not the
    model's are only named. ``at_once`` says not to wait for the first joint state with the model.
    ``carried`` counts samples. What a bridge says in ROS is passed over.
    """

    def __init__(
        self,
        session: Session,
        node: Node,
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
        # Whoever carries both ways has been told that the robot is written on both sides.
        self._beside_others = not at_once
        self._links = frozenset(model.links)
        self._placed_by_model = frozenset(joint.child for joint in model.joints)
        self._reader = JointStateReader(model)
        self._lock = threading.Lock()
        self._closed = False
        self._opened = ExitStack()
        self._states: StatePublisher | None = None
        self._statics: StaticPublisher | None = None
        self._edges: dict[str, tuple[str, tuple[float, ...]]] = {}
        self._joints_seen: list[str] = []
        self._looked_at: dict[str, float] = {}
        self._not_carried: set[tuple[str, str]] = set()
        if at_once:
            self._publisher()
        node.subscribe("joint_states", node.ros.JointState, self._on_joints)
        node.subscribe("/tf_static", node.ros.TFMessage, self._on_statics)
        node.subscribe("/tf", node.ros.rospy.AnyMsg, self._on_transforms)

    def wrote(self, session: int, writer: str) -> bool:
        """Whether a message of zstate with this session, or static edges of this writer, are ours."""
        states, statics = self._states, self._statics
        if states is not None and session == states.description().session:
            return True
        return statics is not None and writer == statics.writer

    def _publisher(self) -> StatePublisher:
        with self._lock:
            if self._closed:
                raise Closed("the bridge is closed")
            if self._states is None:
                self._states = self._opened.enter_context(
                    StatePublisher(
                        self._session, self._model, self._names.robot, takeover=self._beside_others
                    )
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
            self._mention_unknown(message)
            self._publisher().publish(*self._reader.read(message), stamp)
            self.carried += 1
        except MessageError as error:
            self._refuse(error.reason, message, error)
        except InvalidInput as error:
            self._refuse("bad numbers", message, error)
        except SecondWriter as error:
            self._refuse("second writer", message, error)
        except Closed:
            pass  # it came while we were leaving

    def _refuse(self, reason: str, message: Any, error: Exception) -> None:
        self._refusals.count(reason, f"joint_states of {sender(message)!r}: {error}")

    def _mention_unknown(self, message: Any) -> None:
        if message.name != self._joints_seen:
            self._joints_seen = message.name
            unknown = self._reader.unknown(message)
            if unknown:
                names = ", ".join(map(repr, unknown))
                self._refusals.count("unknown joints", f"{self._model.name!r} has no {names}, left out")

    def _on_statics(self, message: Any) -> None:
        if self._is_of_a_bridge(message):
            return
        for transform in message.transforms:
            if self._names.bare(transform.child_frame_id) not in self._placed_by_model:
                try:
                    self._place(transform)
                except InsertRefused as error:
                    self._refusals.count(error.reason, f"/tf_static of {sender(message)!r}: {error}")
                except InvalidInput as error:
                    self._refusals.count("bad numbers", f"/tf_static of {sender(message)!r}: {error}")
                except SecondWriter as error:
                    self._refusals.count("second writer", f"/tf_static of {sender(message)!r}: {error}")
                except Closed:
                    return

    def _place(self, transform: Any) -> None:
        parent = self._names.in_zstate(transform.header.frame_id, self._links)
        child = self._names.in_zstate(transform.child_frame_id, self._links)
        edge = (parent, pose_from_ros(transform.transform))
        with self._lock:
            before = self._edges.get(child)
            if before == edge:
                return
            statics = self._static_publisher()
            if before is not None and before[0] != parent:
                # In ROS the newest parent wins.
                statics.withdraw(child)
                del self._edges[child]
            statics.set(Transform.from_pose7(parent, child, edge[1]))
            self._edges[child] = edge

    def _static_publisher(self) -> StaticPublisher:
        if self._closed:
            raise Closed("the bridge is closed")
        if self._statics is None:
            self._statics = self._opened.enter_context(StaticPublisher(self._session, self._names.robot))
        return self._statics

    def _on_transforms(self, raw: Any) -> None:
        """Look into the /tf of each node now and then: nothing in zstate would carry a moving edge."""
        now, writer = time.monotonic(), sender(raw)
        if now - self._looked_at.get(writer, -_LOOK_EVERY_S) < _LOOK_EVERY_S or self._is_of_a_bridge(raw):
            return
        self._looked_at[writer] = now
        message = self._node.ros.TFMessage()
        message.deserialize(raw._buff)  # rospy has no other name for the bytes
        for transform in message.transforms:
            edge = (transform.header.frame_id, transform.child_frame_id)
            if edge not in self._not_carried and self._names.bare(edge[1]) not in self._placed_by_model:
                self._not_carried.add(edge)
                self._refusals.count(
                    "not carried",
                    f"{edge[0]!r} -> {edge[1]!r} of {writer!r} moves on /tf and is not a joint of the model",
                )

    def close(self) -> None:
        """Stop, and take back what was said in zstate. A second call does nothing."""
        with self._lock:
            self._closed = True
            self._opened.close()
