"""Which topic carries which stream, and under which Zenoh key the two ROS 2 worlds put a topic.

===================  ======================  ===========================================
stream               type                    topic of robot r1 with ``namespace=r1``
===================  ======================  ===========================================
joint_states         sensor_msgs/JointState  ``/r1/joint_states``
robot_description    std_msgs/String         ``/r1/robot_description``
tf, tf_static        tf2_msgs/TFMessage      ``/tf``; ``/r1/tf`` with ``tf=namespace``
clock                rosgraph_msgs/Clock     ``/clock``
===================  ======================  ===========================================
"""

from __future__ import annotations

from typing import Protocol

from zstate.errors import InvalidInput
from zstate.wire.keys import ANY, Stream
from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.types import CLOCK, JOINT_STATE, STRING, TF_MESSAGE, RosType

SHARED = "ros"
"""The robot to whom belongs what is in the root namespace, and the frames of nobody in particular."""

HUMBLE_HASH = "TypeHashNotSupported"
"""What ROS 2 Humble, whose types have no hash, writes in its place."""

_TYPES: dict[Stream, RosType] = {
    "joint_states": JOINT_STATE,
    "robot_description": STRING,
    "tf": TF_MESSAGE,
    "tf_static": TF_MESSAGE,
    "clock": CLOCK,
}


def ros_type(stream: Stream) -> RosType:
    """The ROS type that carries ``stream``. InvalidInput for one that ROS has no topic for."""
    if stream not in _TYPES:
        raise InvalidInput(
            f"the stream {stream!r} is not carried by ROS 2; carried are {', '.join(map(repr, _TYPES))}"
        )
    return _TYPES[stream]


class TopicKeys(Protocol):
    """The seam between what a stream is and where ROS 2 looks for it."""

    def topic(self, robot: str, stream: Stream) -> str:
        """The full ROS name of the topic, with its leading slash."""
        ...

    def key(self, robot: str, stream: Stream) -> str:
        """The Zenoh key to put ``stream`` on. InvalidInput for a name that ROS would not take."""
        ...

    def expression(self, robot: str, stream: Stream) -> str:
        """The key expression that hears ``stream``; robot ``"*"`` means whoever is in the namespace.

        With ``namespace=*`` those are all robots in a namespace of one token.
        """
        ...

    def robot_from_key(self, key: str) -> str:
        """The robot whose key this is: the last token of its namespace, SHARED in the root.

        InvalidInput for a key that is not of this layout.
        """
        ...


class RmwKeys:
    """The keys of rmw_zenoh_cpp: ``<domain>/<topic>/<type>/<hash>``."""

    def __init__(self, options: Ros2Options) -> None:
        self._options = options

    def topic(self, robot: str, stream: Stream) -> str:
        return f"/{self._path(self._options.robot_namespace(robot), stream)}"

    def key(self, robot: str, stream: Stream) -> str:
        kind = ros_type(stream)
        written = kind.hash if self._options.hash == "iron" else HUMBLE_HASH
        return f"{self._options.domain}{self.topic(robot, stream)}/{kind.dds}/{written}"

    def expression(self, robot: str, stream: Stream) -> str:
        path = self._path(_namespace_pattern(self._options, robot), stream)
        return f"{self._options.domain}/{path}/{ros_type(stream).dds}/*"

    def robot_from_key(self, key: str) -> str:
        _domain, *path = key.split("/")
        if len(path) < 3:
            raise InvalidInput(f"the key {key!r} is not of the form '<domain>/<topic>/<type>/<hash>'")
        return robot_from_topic("/".join(path[:-2]))

    def _path(self, namespace: str, stream: Stream) -> str:
        ros_type(stream)
        is_global = stream == "clock" or (stream.startswith("tf") and self._options.tf == "global")
        return stream if is_global else _joined(namespace, stream)


class DdsKeys:
    """The keys of zenoh-plugin-ros2dds: the name of the topic, without its leading slash.

    A bridge puts its namespace before everything that passes, before /tf and /clock too. Domains
    and type hashes are the bridge's business and do not stand in its keys.
    """

    def __init__(self, options: Ros2Options) -> None:
        self._options = options

    def topic(self, robot: str, stream: Stream) -> str:
        return f"/{self.key(robot, stream)}"

    def key(self, robot: str, stream: Stream) -> str:
        ros_type(stream)
        return _joined(self._options.robot_namespace(robot), stream)

    def expression(self, robot: str, stream: Stream) -> str:
        ros_type(stream)
        return _joined(_namespace_pattern(self._options, robot), stream)

    def robot_from_key(self, key: str) -> str:
        return robot_from_topic(key)


def _namespace_pattern(options: Ros2Options, robot: str) -> str:
    return options.namespace if robot == ANY else options.robot_namespace(robot)


def _joined(namespace: str, name: str) -> str:
    return f"{namespace}/{name}" if namespace else name


def robot_from_topic(topic: str) -> str:
    """The robot that a topic speaks of: the last token of its namespace, SHARED in the root."""
    tokens = topic.strip("/").split("/")
    return tokens[-2] if len(tokens) > 1 else SHARED
