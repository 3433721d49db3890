"""Helpers for listeners among ROS nodes."""

from __future__ import annotations

from helpers.processes import until
from helpers.raw_ros_nodes import (
    DESCRIPTION,
    JOINT_STATES,
    RosNode,
    RosPublisher,
)
from helpers.robots import RRBOT

from zstate.net.session import Session
from zstate.nodes.listener import TransformListener


def writers(listener: TransformListener) -> dict[str, str | None]:
    """The writer of each frame, by its short name."""
    frames = [frame for frame in listener.buffer.frames() if frame.parent is not None]
    return {frame.name.partition("/")[2]: frame.writer for frame in frames}


def x_of(listener: TransformListener, target: str, source: str, at: int | None = None) -> float | None:
    reason = listener.buffer.explain(target, source, at)
    return None if reason is not None else listener.buffer.lookup(target, source, at).translation[0]


def publish_description(session: Session, text: str = RRBOT.urdf) -> RosPublisher:
    publisher = RosNode(session, "robot_state_publisher").publisher(DESCRIPTION).announce()
    publisher.text(text)
    return publisher


def publish_known_joints(session: Session, listener: TransformListener, name: str = "driver") -> RosPublisher:
    """A node that publishes joint states, after the listener has the robot's model."""
    driver = RosNode(session, name).publisher(JOINT_STATES).announce().wait_for_reader()
    until(lambda: "r1/tool" in {frame.name for frame in listener.buffer.frames()})
    return driver
