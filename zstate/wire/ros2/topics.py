"""Names in ROS 2: of the streams' topics, with their Zenoh keys, and of frames.

Keys are those of rmw_zenoh_cpp and zenoh-plugin-ros2dds.

===================  ========================================  ===========================================
stream               type                                      topic of robot r1 with ``namespace=r1``
===================  ========================================  ===========================================
joint_states         sensor_msgs/JointState                    ``/r1/joint_states``
robot_description    std_msgs/String                           ``/r1/robot_description``
tf, tf_static        tf2_msgs/TFMessage                        ``/tf``; ``/r1/tf`` with ``tf=namespace``
scan                 sensor_msgs/LaserScan                     ``/r1/<sensor>``, such as ``/r1/scan``
image                sensor_msgs/CompressedImage               ``/r1/<camera>/image_raw/compressed``
camera_info          sensor_msgs/CameraInfo                    ``/r1/<camera>/camera_info``
others of sensors    that of their row (``RosStream.type``)    likewise
clock                rosgraph_msgs/Clock                       ``/clock``
===================  ========================================  ===========================================

The topics with a name of a sensor, or of a writer, are found by their type, whatever their last name is;
those of cameras by their last names as well, as image_transport has them.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, lru_cache, partial

from zstate.errors import InvalidInput
from zstate.streams import StreamName
from zstate.wire.keys import ANY, wire_name
from zstate.wire.messages import Edges
from zstate.wire.ros2.options import Ros2Options, check_token
from zstate.wire.ros2.streams import (
    has_named_topics,
    ros_streams,
    ros_type,
    topic_stream,
    topic_suffix,
    without_suffix,
)

SHARED = "ros"
"""The robot of topics in the root namespace, and of frames that belong to no robot."""

HUMBLE_HASH = "TypeHashNotSupported"
"""Type hash in the keys of ROS 2 Humble, whose types have none."""

_CACHED_ORDERS = 64
"""Edge orders with cached names: each writer of a topic has its own, and few change theirs."""


class RmwKeys:
    """The topics of robots, and their keys in rmw_zenoh_cpp: ``<domain>/<topic>/<type>/<hash>``."""

    def __init__(self, options: Ros2Options) -> None:
        self._options = options

    def topic(self, robot: str, stream: StreamName, name: str = "") -> str:
        """The full ROS name of the topic, with its leading slash.

        ``name`` is that of a sensor or a map, by default the stream's. Raises InvalidInput if it is no ROS
        name.
        """
        last_name = stream
        if has_named_topics(stream) and name:
            check_token(f"{stream} name", name, ", which becomes the name of a ROS topic")
            last_name = name
        return self._topic(self._options.robot_namespace(robot), stream, last_name)

    def key(self, robot: str, stream: StreamName, name: str = "") -> str:
        """The Zenoh key of ``stream``. Raises InvalidInput for a name that ROS does not allow."""
        kind = ros_type(stream)
        type_hash = kind.hash if self._options.hash == "iron" else HUMBLE_HASH
        return f"{self._options.domain}{self.topic(robot, stream, name)}/{kind.dds}/{type_hash}"

    def expression(self, robot: str, stream: StreamName, name: str = ANY) -> str:
        """The key expression of ``stream``; robot ``"*"`` means all robots in the namespace.

        With ``namespace=*`` these are all robots in a namespace of one token. ``name`` selects one sensor.
        """
        last_name = name if has_named_topics(stream) else stream
        return (
            f"{self._options.domain}{self._topic_pattern(robot, stream, last_name)}/{ros_type(stream).dds}/*"
        )

    def robot_from_key(self, key: str) -> str:
        """The robot of ``key``: the last token of its namespace, SHARED in the root.

        Raises InvalidInput for a key that is not of this layout.
        """
        *topic, _dds_type, _hash = self._path(key)
        return robot_from_topic("/".join(topic))

    def writer_name(self, key: str) -> str | None:
        """The name of the sensor or map of ``key``; None for other topics. Raises InvalidInput as above."""
        *topic, dds_type, _hash = self._path(key)
        stream = topic_stream("/".join(topic), dds_type)
        return name_from_topic("/".join(topic)) if stream is not None and has_named_topics(stream) else None

    @staticmethod
    def _path(key: str) -> list[str]:
        _domain, *path = key.split("/")
        if len(path) < 3:
            raise InvalidInput(f"the key {key!r} is not of the form '<domain>/<topic>/<type>/<hash>'")
        return path

    def _topic_pattern(self, robot: str, stream: StreamName, last_name: str) -> str:
        namespace = self._options.namespace if robot == ANY else self._options.robot_namespace(robot)
        return self._topic(namespace, stream, last_name)

    def _topic(self, namespace: str, stream: StreamName, last_name: str) -> str:
        ros_type(stream)
        is_global = stream == "clock" or (stream.startswith("tf") and self._options.tf == "global")
        path = f"/{last_name}{topic_suffix(stream)}"
        return f"/{namespace}{path}" if namespace and not is_global else path


class DdsKeys(RmwKeys):
    """The same in zenoh-plugin-ros2dds: a key is the name of the topic, without its leading slash.

    A bridge puts its namespace before every topic, before /tf and /clock too. Its keys have no
    domain, no type and no type hash. So of the topics that writers name, a reader of all of them finds those
    with the names of the streams, ``scan``, ``imu``, ``map`` and so on, and those of cameras; any other one
    is read by its name.
    """

    def key(self, robot: str, stream: StreamName, name: str = "") -> str:
        return self.topic(robot, stream, name)[1:]

    def expression(self, robot: str, stream: StreamName, name: str = ANY) -> str:
        is_found = has_named_topics(stream) and (name != ANY or bool(topic_suffix(stream)))
        return self._topic_pattern(robot, stream, name if is_found else stream)[1:]

    def robot_from_key(self, key: str) -> str:
        return robot_from_topic(key)

    def writer_name(self, key: str) -> str | None:
        name = name_from_topic(key)
        is_own = name in ros_streams() and not has_named_topics(name) and without_suffix(key) == key
        return None if is_own else name

    def _topic(self, namespace: str, stream: StreamName, last_name: str) -> str:
        ros_type(stream)
        path = f"/{last_name}{topic_suffix(stream)}"
        return f"/{namespace}{path}" if namespace else path


def robot_from_topic(topic: str) -> str:
    """The robot of ``topic``: the last token of its namespace, SHARED in the root."""
    tokens = without_suffix(topic).strip("/").split("/")
    return tokens[-2] if len(tokens) > 1 else SHARED


def name_from_topic(topic: str) -> str:
    """The name of the stream or of the sensor of ``topic``."""
    return without_suffix(topic).rpartition("/")[2]


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

    # Made when used: a recording may have 65,535 channels, each with its names.
    @cached_property
    def edges_to_ros(self) -> Callable[[Edges], Edges]:
        """Renames both frames of each edge."""
        return lru_cache(_CACHED_ORDERS)(partial(_renamed, self.to_ros))

    @cached_property
    def edges_to_zstate(self) -> Callable[[Edges], Edges]:
        """Renames both frames of each edge."""
        return lru_cache(_CACHED_ORDERS)(partial(_renamed, self.to_zstate))

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
        if not (self._prefix and name):
            return name
        local = name.removeprefix(self._prefix)
        if local and local != name:
            return wire_name(self._robot, local)
        return name if "/" in name else f"{SHARED}/{name}"


def _renamed(rename: Callable[[str], str], edges: Edges) -> Edges:
    return tuple((rename(parent), rename(child)) for parent, child in edges)
