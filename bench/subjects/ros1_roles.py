"""A writer of joint states and a tf2_ros listener, both of ROS 1 in Python."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import rospy
import tf2_ros
from sensor_msgs.msg import JointState
from tf2_msgs.msg import TFMessage

from bench.job import Job
from bench.subjects.awakening import Awakening
from bench.subjects.subject import Answered

NAME = "bench"


def start_node() -> None:
    """Once in a process; a late joiner's node begins with its session."""
    rospy.init_node(NAME, anonymous=True, disable_signals=True, disable_rosout=True)


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
        """One message object serves all samples when nothing keeps it."""
        message = self._message
        message.position = self._rows[row]
        message.header.stamp = rospy.Time(*divmod(stamp, 10**9))
        self._publisher.publish(message)

    def close(self) -> None:
        """Leave the master."""
        rospy.signal_shutdown("done")


class Reader:
    """tf2_ros.Buffer, filled by tf2_ros.TransformListener, asked when that has taken a message in."""

    def __init__(self, job: Job, answered: Answered, *, nodelay: bool = True) -> None:
        start_node()
        self._base, self._tip, self._links = job.base, job.tip, job.links
        self._answered = answered
        self._buffer = tf2_ros.Buffer()
        self._awakening = Awakening(job, self._answer)
        self._listener = tf2_ros.TransformListener(self._buffer, tcp_nodelay=nodelay)
        # Subscribers of a topic share its connection and are called in the order of their registration.
        self._woken = rospy.Subscriber("/tf", TFMessage, self._on_transforms, tcp_nodelay=nodelay)

    def _on_transforms(self, message: Any) -> None:
        at = message.transforms[0].header.stamp
        self._awakening.heard(at.secs * 10**9 + at.nsecs)

    def _answer(self, stamp: int) -> None:
        try:
            self._lookup(stamp)
        except tf2_ros.TransformException:
            return  # static edges may come after moving ones; what is never answered is counted as lost
        self._answered(stamp)

    def _lookup(self, stamp: int) -> Any:
        time = rospy.Time(*divmod(stamp, 10**9))
        return self._buffer.lookup_transform_core(self._base, self._tip, time).transform

    def pose(self, stamp: int, robot: int = 0) -> Sequence[float]:
        """From the buffer."""
        found = self._lookup(stamp)
        t, q = found.translation, found.rotation
        return (t.x, t.y, t.z, q.x, q.y, q.z, q.w)

    def has_tree(self) -> bool:
        """As the buffer says."""
        latest = rospy.Time(0)
        return all(self._buffer.can_transform_core(self._base, link, latest)[0] for link in self._links)

    def close(self) -> None:
        """Leave the master."""
        self._awakening.close()
        rospy.signal_shutdown("done")
