"""A writer of joint states and tf2_ros listeners, all of ROS 1."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import rospy
import tf2_ros
from sensor_msgs.msg import JointState
from tf2_msgs.msg import TFMessage

from bench.job import Job
from bench.subjects.ros1 import LISTENER
from bench.subjects.subject import Answered


def start_node() -> None:
    """Starts the node of this process; a late joiner starts it with its session."""
    rospy.init_node("bench", anonymous=True, disable_signals=True, disable_rosout=True)


class Writer:
    """Publishes on /joint_states."""

    def __init__(self, job: Job, *, nodelay: bool = True, queue_size: int | None = None) -> None:
        start_node()
        self._publisher = rospy.Publisher(
            "/joint_states", JointState, tcp_nodelay=nodelay, queue_size=queue_size
        )
        self._rows = [list(row) for row in job.rows]
        self._message = JointState(name=list(job.joints))

    def send(self, row: int, stamp: int) -> None:
        """Publishes one reused message object, which nothing keeps."""
        message = self._message
        message.position = self._rows[row]
        message.header.stamp = rospy.Time(*divmod(stamp, 10**9))
        self._publisher.publish(message)

    def close(self) -> None:
        """Leaves the master."""
        rospy.signal_shutdown("done")


class Reader:
    """tf2_ros.Buffer, filled by tf2_ros.TransformListener, with a lookup after each message."""

    def __init__(self, job: Job, answered: Answered, *, nodelay: bool = True) -> None:
        start_node()
        self._base, self._tip, self._links = job.base, job.tip, job.links
        self._answered = answered
        self._buffer = tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(self._buffer, tcp_nodelay=nodelay)
        # Subscribers of a topic share its connection and are called in the order of their registration.
        self._subscriber = rospy.Subscriber("/tf", TFMessage, self._on_transforms, tcp_nodelay=nodelay)

    def _on_transforms(self, message: Any) -> None:
        at = message.transforms[0].header.stamp
        stamp = at.secs * 10**9 + at.nsecs
        try:
            self._lookup(stamp)
        except tf2_ros.TransformException:
            return  # static edges may arrive after moving ones; stamps never answered count as lost
        self._answered(stamp)

    def _lookup(self, stamp: int) -> Any:
        time = rospy.Time(*divmod(stamp, 10**9))
        return self._buffer.lookup_transform_core(self._base, self._tip, time).transform

    def pose(self, stamp: int, robot: int = 0) -> Sequence[float]:
        """Looks up the pose in the buffer."""
        found = self._lookup(stamp)
        t, q = found.translation, found.rotation
        return (t.x, t.y, t.z, q.x, q.y, q.z, q.w)

    def has_tree(self) -> bool:
        """Whether the buffer has every link."""
        latest = rospy.Time(0)
        return all(self._buffer.can_transform_core(self._base, link, latest)[0] for link in self._links)

    def close(self) -> None:
        """Leaves the master."""
        rospy.signal_shutdown("done")


class CppReader:
    """The library ros1_listener.cpp, which holds the buffer; one reader per process."""

    def __init__(self, job: Job, answered: Answered) -> None:
        self._library = ctypes.CDLL(str(LISTENER))
        self._library.ros1_pose.argtypes = (ctypes.c_int64, ctypes.POINTER(ctypes.c_double))
        self._library.ros1_pose.restype = self._library.ros1_knows.restype = ctypes.c_bool
        self._links = [link.encode() for link in job.links]
        self._answered = ctypes.CFUNCTYPE(None, ctypes.c_int64)(answered)  # the library keeps no reference
        self._library.ros1_listen(job.base.encode(), job.tip.encode(), self._answered)

    def pose(self, stamp: int, robot: int = 0) -> Sequence[float]:
        """Looks up the pose in the buffer."""
        numbers = (ctypes.c_double * 7)()
        if not self._library.ros1_pose(stamp, numbers):
            raise LookupError(f"tf2 has no pose at {stamp}")
        return tuple(numbers)

    def has_tree(self) -> bool:
        """Whether the buffer has every link."""
        return all(self._library.ros1_knows(link) for link in self._links)

    def close(self) -> None:
        """Leaves the master."""
        self._library.ros1_close()
