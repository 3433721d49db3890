"""How a robot's frames are called in zstate and in ROS 2, where all frames stand in one flat tree."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial

from zstate.wire.keys import wire_name
from zstate.wire.messages import Edges
from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.topics import SHARED

_REMEMBERED = 64
"""Orders of edges whose names are kept: each writer of a topic has its own, few change theirs."""


class FrameNames:
    """The frames of one robot, whose prefix on ROS's side is ``options.prefix_of(robot)``.

    =====================  ============  ==================  =======================
    frame                  in zstate     in ROS, prefix ""   in ROS, prefix "r1/"
    =====================  ============  ==================  =======================
    the robot's own hand   ``hand``      ``hand``            ``r1/hand``
    of somebody else       ``fleet/map`` ``fleet/map``       ``fleet/map``
    of nobody              ``ros/map``   ``map``             ``map``
    =====================  ============  ==================  =======================

    What is written and read again is the same frame, and what is read is written by the same name,
    but where ROS's flat names leave a doubt. Without a prefix a frame of nobody is read as the
    robot's own, and an own link with a slash in it as somebody else's. A name of somebody else, or of
    nobody, that begins with the prefix is read as the robot's own. And a ROS frame whose name without
    the prefix is ``r1/...`` or ``ros/...`` is written as a frame of the robot, or of nobody.

    The slash that programs of old put before a frame is no part of its name in tf2, and is dropped.
    """

    def __init__(self, options: Ros2Options, robot: str) -> None:
        self._robot = robot
        # Beside robots in a namespace, SHARED stands for the tf that all of them speak on.
        self._prefix = "" if robot == SHARED and options.namespace else options.robot_frame_prefix(robot)
        self._edges_to_ros = lru_cache(_REMEMBERED)(partial(_renamed, self.to_ros))
        self._edges_to_zstate = lru_cache(_REMEMBERED)(partial(_renamed, self.to_zstate))

    def to_ros(self, name: str) -> str:
        """What a ROS node calls the frame that this robot calls ``name``."""
        owner, slash, rest = name.partition("/")
        if not slash:
            return self._prefix + name
        # the robot heard in the root namespace is called SHARED, too; with a prefix its own differ
        if owner == SHARED:
            return rest
        return self._prefix + rest if owner == self._robot else name

    def to_zstate(self, name: str) -> str:
        """What this robot calls the frame that a ROS node calls ``name``."""
        name = name.removeprefix("/")
        if not self._prefix:
            return name
        own = name.removeprefix(self._prefix)
        if own and own != name:
            return wire_name(self._robot, own)
        return name if "/" in name else f"{SHARED}/{name}"

    def edges_to_ros(self, edges: Edges) -> Edges:
        """``to_ros`` of both ends of each edge; the orders seen last are remembered."""
        return self._edges_to_ros(edges)

    def edges_to_zstate(self, edges: Edges) -> Edges:
        """``to_zstate`` of both ends of each edge; the orders seen last are remembered."""
        return self._edges_to_zstate(edges)


def _renamed(rename: Callable[[str], str], edges: Edges) -> Edges:
    return tuple((rename(parent), rename(child)) for parent, child in edges)
