"""A real ROS 1: master, nodes and zstate's bridge, each in its own process.

    apt-get install -y --no-install-recommends \\
        python3-roslaunch ros-robot-state-publisher python3-tf2-ros python3-sensor-msgs
"""

from __future__ import annotations

import json
import signal
import subprocess
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from helpers.processes import Child, find_free_port, until

from zstate.bridges.ros1.node import Master
from zstate.errors import Unreachable

DEBIAN_PYTHON = "/usr/bin/python3"
DEBIAN_PACKAGES = "/usr/lib/python3/dist-packages"
STATE_PUBLISHER = Path("/usr/lib/robot_state_publisher/robot_state_publisher")
ROSCORE = Path("/usr/bin/roscore")
RRBOT = Path(__file__).parents[2] / "models" / "rrbot.urdf"
JOINTS = ("shoulder", "elbow")

# rospy has no extension modules: Debian's packages work with any Python of the same version.
BRIDGE = f"""
    import sys
    sys.path.append({DEBIAN_PACKAGES!r})
    from zstate.cli.main import main
    main()
"""

# Replies to lookups with the real tf2_ros: [pose7, stamp], or the text of the error.
TF2_LISTENER = """
    import json, sys
    import rospy, tf2_ros
    rospy.init_node("tf2_listener", anonymous=True, disable_signals=True)
    buffer = tf2_ros.Buffer()
    listener = tf2_ros.TransformListener(buffer)
    print("ready")
    for line in sys.stdin:
        target, source, stamp, wait_s = json.loads(line)
        time = rospy.Time(*divmod(stamp, 10**9))
        try:
            found = buffer.lookup_transform(target, source, time, rospy.Duration(wait_s))
        except tf2_ros.TransformException as error:
            print(json.dumps(str(error)))
            continue
        t, q, at = found.transform.translation, found.transform.rotation, found.header.stamp
        print(json.dumps([[t.x, t.y, t.z, q.x, q.y, q.z, q.w], at.secs * 10**9 + at.nsecs]))
"""

# Publishes requested messages on /joint_states, /tf and /tf_static; reports received ones of the first two.
ROS_PEER = """
    import json, sys
    import rospy
    from geometry_msgs.msg import TransformStamped
    from sensor_msgs.msg import JointState
    from tf2_msgs.msg import TFMessage

    rospy.init_node("peer", anonymous=True, disable_signals=True)
    joints = rospy.Publisher("joint_states", JointState, queue_size=1000)
    latched = {"latch": True, "queue_size": 10}
    edges = {name: rospy.Publisher(name, TFMessage, **latched) for name in ("/tf", "/tf_static")}
    joint_messages, edge_messages = [], []

    def when(header):
        return header.stamp.secs * 10**9 + header.stamp.nsecs

    def on_joints(message):
        numbers = [message.position, message.velocity, message.effort]
        joint_messages.append([when(message.header), message.name, numbers])

    def on_edges(message):
        writer = message._connection_header["callerid"]
        for edge in message.transforms:
            t, q = edge.transform.translation, edge.transform.rotation
            pose = [t.x, t.y, t.z, q.x, q.y, q.z, q.w]
            edge_messages.append([writer, edge.header.frame_id, edge.child_frame_id, when(edge.header), pose])

    def publish_joints(stamp, names, positions):
        message = JointState(name=names, position=positions)
        message.header.stamp = rospy.Time(*divmod(stamp, 10**9))
        joints.publish(message)

    def publish_edge(topic, parent, child, pose):
        edge = TransformStamped(child_frame_id=child)
        edge.header.frame_id = parent
        edge.header.stamp = rospy.Time(1)
        t, q = edge.transform.translation, edge.transform.rotation
        t.x, t.y, t.z, q.x, q.y, q.z, q.w = pose
        edges[topic].publish(TFMessage([edge]))

    def received():
        messages = [joint_messages[:], edge_messages[:]]
        del joint_messages[:len(messages[0])], edge_messages[:len(messages[1])]
        return messages

    if "subscribe" in sys.argv:
        rospy.Subscriber("joint_states", JointState, on_joints)
        rospy.Subscriber("/tf", TFMessage, on_edges)
    answers = {
        "joints": publish_joints,
        "edge": publish_edge,
        "received": received,
        "readers": joints.get_num_connections,
        "parameter": lambda name: rospy.get_param(name, None),
    }
    print("ready")
    for line in sys.stdin:
        name, *arguments = json.loads(line)
        print(json.dumps(answers[name](*arguments)))
"""


class RosPeer:
    """A ROS node that publishes and subscribes (``ROS_PEER``)."""

    def __init__(self, child: Child) -> None:
        self._child = child
        self.joints: list[tuple[int, list[str], list[list[float]]]] = []
        self.edges: dict[tuple[str, str, int], tuple[str, list[float]]] = {}

    def query(self, *question: Any) -> Any:
        self._child.send_line(json.dumps(question))
        return json.loads(self._child.line())

    def collect(self) -> None:
        """Adds newly received messages to ``joints`` and ``edges``: writer and pose, by edge and stamp."""
        joints, edges = self.query("received")
        self.joints += map(tuple, joints)
        for writer, parent, child, stamp, pose in edges:
            self.edges[parent, child, stamp] = (writer, pose)

    def counts(self) -> Counter[int]:
        """How often each stamp was received on ``joint_states``."""
        self.collect()
        return Counter(stamp for stamp, *_ in self.joints)


class Roscore:
    """A real ``roscore`` on its own port."""

    def __init__(self, environment: dict[str, str]) -> None:
        self._master = Master(environment["ROS_MASTER_URI"])
        self._process = subprocess.Popen(
            [ROSCORE, "-p", self._master.uri.rpartition(":")[2]],
            # Its programs run with the first python3 in the PATH.
            env={**environment, "PATH": "/usr/bin:/bin"},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        until(self._answers)

    def _answers(self) -> bool:
        try:
            return bool(self._master.pid())
        except Unreachable:
            return False

    def close(self) -> None:
        """Sends SIGINT, again if it is lost while roscore starts.

        It then ends its own children, which a kill would leave behind.
        """

        def has_ended() -> bool:
            self._process.send_signal(signal.SIGINT)
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(5)
            return self._process.returncode is not None

        until(has_ended)


def ros_environment(home: Path) -> dict[str, str]:
    """The environment of ROS programs: files in ``home``, a master at a free port."""
    return {
        "HOME": str(home),
        "ROS_HOME": str(home / "ros"),
        "ROS_LOG_DIR": str(home / "log"),
        "ROS_IP": "127.0.0.1",
        "ROS_MASTER_URI": f"http://127.0.0.1:{find_free_port()}",
    }


Spawn = Callable[..., Child]
