"""Frame names of a robot in zstate, and in ROS 2, where all frames are in one flat tree."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial

from zstate.wire.keys import wire_name
from zstate.wire.messages import Edges
from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.topics import SHARED

_CACHED_ORDERS = 64
"""Edge orders with cached names: each writer of a topic has its own, and few change theirs."""


class FrameNames:
    """The frames of one robot; in ROS its own have the prefix ``options.robot_frame_prefix(robot)``.

    =====================  ============  ==================  =======================
    frame                  in zstate     in ROS, prefix ""   in ROS, prefix "r1/"
    =====================  ============  ==================  =======================
    the robot's own hand   ``hand``      ``hand``            ``r1/hand``
    of another robot       ``fleet/map`` ``fleet/map``       ``fleet/map``
    of no robot            ``ros/map``   ``map``             ``map``
    =====================  ============  ==================  =======================

    A name that is written and read again is the same frame, and vice versa, except where ROS's flat names
    are ambiguous. Without a prefix, a frame of no robot is read as the robot's own, and an own link with a
    slash as another robot's. A name of another robot, or of none, that begins with the prefix is read as
    the robot's own. A ROS frame whose name without the prefix is ``r1/...`` or ``ros/...`` is written as
    a frame of the robot, or of no robot.

    A leading slash, which tf1 programs wrote, is no part of the name in tf2, and is dropped.
    """

    def __init__(self, options: Ros2Options, robot: str) -> None:
        self._robot = robot
        # With robots in a namespace, SHARED is the owner of the tf topic that all of them publish on.
        self._prefix = "" if robot == SHARED and options.namespace else options.robot_frame_prefix(robot)
        self.edges_to_ros = lru_cache(_CACHED_ORDERS)(partial(_renamed, self.to_ros))
        self.edges_to_zstate = lru_cache(_CACHED_ORDERS)(partial(_renamed, self.to_zstate))

    def to_ros(self, name: str) -> str:
        """The name in ROS of the frame that this robot calls ``name``."""
        owner, slash, rest = name.partition("/")
        if not slash:
            return self._prefix + name
        # a robot in the root namespace is called SHARED, too; with a prefix its own frames differ
        if owner == SHARED:
            return rest
        return self._prefix + rest if owner == self._robot else name

    def to_zstate(self, name: str) -> str:
        """The name that this robot has for the ROS frame ``name``."""
        name = name.removeprefix("/")
        if not self._prefix:
            return name
        local = name.removeprefix(self._prefix)
        if local and local != name:
            return wire_name(self._robot, local)
        return name if "/" in name else f"{SHARED}/{name}"


def _renamed(rename: Callable[[str], str], edges: Edges) -> Edges:
    return tuple((rename(parent), rename(child)) for parent, child in edges)
