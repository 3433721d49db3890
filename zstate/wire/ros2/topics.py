"""ROS 2 topics of the streams, and their Zenoh keys in rmw_zenoh_cpp and zenoh-plugin-ros2dds.

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

from zstate.errors import InvalidInput
from zstate.wire.keys import ANY, Stream
from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.types import CLOCK, JOINT_STATE, STRING, TF_MESSAGE, RosType

SHARED = "ros"
"""The robot of topics in the root namespace, and of frames that belong to no robot."""

HUMBLE_HASH = "TypeHashNotSupported"
"""Type hash in the keys of ROS 2 Humble, whose types have none."""

_TYPES: dict[Stream, RosType] = {
    "joint_states": JOINT_STATE,
    "robot_description": STRING,
    "tf": TF_MESSAGE,
    "tf_static": TF_MESSAGE,
    "clock": CLOCK,
}


def ros_type(stream: Stream) -> RosType:
    """The ROS type that carries ``stream``. Raises InvalidInput for a stream without a ROS topic."""
    if stream not in _TYPES:
        raise InvalidInput(
            f"the stream {stream!r} is not carried by ROS 2; carried are {', '.join(map(repr, _TYPES))}"
        )
    return _TYPES[stream]


class RmwKeys:
    """The topics of robots, and their keys in rmw_zenoh_cpp: ``<domain>/<topic>/<type>/<hash>``."""

    def __init__(self, options: Ros2Options) -> None:
        self._options = options

    def topic(self, robot: str, stream: Stream) -> str:
        """The full ROS name of the topic, with its leading slash."""
        return self._topic(self._options.robot_namespace(robot), stream)

    def key(self, robot: str, stream: Stream) -> str:
        """The Zenoh key of ``stream``. Raises InvalidInput for a name that ROS does not allow."""
        kind = ros_type(stream)
        type_hash = kind.hash if self._options.hash == "iron" else HUMBLE_HASH
        return f"{self._options.domain}{self.topic(robot, stream)}/{kind.dds}/{type_hash}"

    def expression(self, robot: str, stream: Stream) -> str:
        """The key expression of ``stream``; robot ``"*"`` means all robots in the namespace.

        With ``namespace=*`` these are all robots in a namespace of one token.
        """
        return f"{self._options.domain}{self._topic_pattern(robot, stream)}/{ros_type(stream).dds}/*"

    def robot_from_key(self, key: str) -> str:
        """The robot of ``key``: the last token of its namespace, SHARED in the root.

        Raises InvalidInput for a key that is not of this layout.
        """
        _domain, *path = key.split("/")
        if len(path) < 3:
            raise InvalidInput(f"the key {key!r} is not of the form '<domain>/<topic>/<type>/<hash>'")
        return robot_from_topic("/".join(path[:-2]))

    def _topic_pattern(self, robot: str, stream: Stream) -> str:
        return self._topic(self._options.namespace, stream) if robot == ANY else self.topic(robot, stream)

    def _topic(self, namespace: str, stream: Stream) -> str:
        ros_type(stream)
        is_global = stream == "clock" or (stream.startswith("tf") and self._options.tf == "global")
        return f"/{namespace}/{stream}" if namespace and not is_global else f"/{stream}"


class DdsKeys(RmwKeys):
    """The same in zenoh-plugin-ros2dds: a key is the name of the topic, without its leading slash.

    A bridge puts its namespace before every topic, before /tf and /clock too. Its keys have no
    domain and no type hash.
    """

    def key(self, robot: str, stream: Stream) -> str:
        return self.topic(robot, stream)[1:]

    def expression(self, robot: str, stream: Stream) -> str:
        return self._topic_pattern(robot, stream)[1:]

    def robot_from_key(self, key: str) -> str:
        return robot_from_topic(key)

    def _topic(self, namespace: str, stream: Stream) -> str:
        ros_type(stream)
        return f"/{namespace}/{stream}" if namespace else f"/{stream}"


def robot_from_topic(topic: str) -> str:
    """The robot of ``topic``: the last token of its namespace, SHARED in the root."""
    tokens = topic.strip("/").split("/")
    return tokens[-2] if len(tokens) > 1 else SHARED
