"""Node: this process as a node of ROS 1, by rospy."""

from __future__ import annotations

import logging
import os
import tempfile
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from zstate.closing import Closing
from zstate.errors import LibraryMissing
from zstate.ros1.master import Master

NAME = "zstate_ros1"

# What ROS 1 programs use for /tf.
_QUEUE_SIZE = 100
_CLOSE_WITHIN_S = 0.7
_LOG_VARIABLE = "ROS_PYTHON_LOG_CONFIG_FILE"


@dataclass(frozen=True)
class Ros:
    """What of ROS 1 is used here: rospy, and the classes of the messages. None of it has types."""

    rospy: Any
    JointState: Any
    TFMessage: Any
    TransformStamped: Any


def load_ros() -> Ros:
    """Import rospy and its messages. Raises LibraryMissing saying what to install."""
    logger_class = logging.getLoggerClass()
    try:
        return Ros(
            import_module("rospy"),
            import_module("sensor_msgs.msg").JointState,
            import_module("tf2_msgs.msg").TFMessage,
            import_module("geometry_msgs.msg").TransformStamped,
        )
    except ImportError as error:
        raise LibraryMissing(
            f"ROS 1 is not to be found from this Python ({error}). On Debian 12: `apt-get install "
            "python3-rospy python3-sensor-msgs python3-tf2-msgs`, and install zstate where these are seen: "
            "`/usr/bin/python3 -m venv --system-site-packages .venv`"
        ) from None
    finally:
        # rospy puts a class of its own behind every logger that is made from now on.
        logging.setLoggerClass(logger_class)


class Node(Closing):
    """A node of ROS 1, there until closed; one in the life of a process, for rospy cannot begin again.

    Raises LibraryMissing without rospy, Unreachable without a master.
    """

    def __init__(self) -> None:
        self.ros = load_ros()
        self.master = Master()
        self.master_pid = self.master.pid()
        with _logging_untouched():
            # Without its own handling of signals, of time and of log messages, all of which are ours.
            self.ros.rospy.init_node(
                NAME, anonymous=True, disable_signals=True, disable_rostime=True, disable_rosout=True
            )
        self.name: str = self.ros.rospy.get_name()

    @property
    def has_ended(self) -> bool:
        """Whether it is closed, or was ended from outside (``rosnode kill``)."""
        return bool(self.ros.rospy.is_shutdown())

    def resolved(self, name: str) -> str:
        """``name`` in the namespace of this node (ROS_NAMESPACE)."""
        return str(self.ros.rospy.resolve_name(name))

    def publisher(self, topic: str, kind: Any, *, latch: bool = False) -> Publisher:
        """A publisher of messages of class ``kind``; a latched one keeps its last for late joiners."""
        return Publisher(self.ros.rospy, topic, kind, latch)

    def subscribe(self, topic: str, kind: Any, callback: Callable[[Any], None]) -> None:
        """Call ``callback(message)`` for each message, on a thread of rospy."""
        self.ros.rospy.Subscriber(topic, kind, callback, tcp_nodelay=True)

    def close(self) -> None:
        """Leave ROS within a second. A second call does nothing."""
        # A master that is gone, or a frozen subscriber, would hold it up.
        leaving = threading.Thread(
            target=self.ros.rospy.signal_shutdown, args=("closed",), name="zstate ros1 close", daemon=True
        )
        leaving.start()
        leaving.join(_CLOSE_WITHIN_S)


class Publisher:
    """A publisher of one topic."""

    def __init__(self, rospy: Any, topic: str, kind: Any, latch: bool) -> None:
        self._rospy = rospy
        self._publisher = rospy.Publisher(topic, kind, latch=latch, queue_size=_QUEUE_SIZE)

    @property
    def has_readers(self) -> bool:
        """Whether anybody subscribes now."""
        return bool(self._publisher.get_num_connections())

    def publish(self, message: Any) -> None:
        """Send ``message``, which may be changed afterwards unless it is latched. Nothing after the end."""
        try:
            self._publisher.publish(message)
        except self._rospy.ROSException:
            if not self._rospy.is_shutdown():
                raise


def writer_of(message: Any) -> str:
    """The name of the node that sent ``message``."""
    return str(message._connection_header["callerid"])  # rospy tells it nowhere else


@contextmanager
def _logging_untouched() -> Generator[None]:
    """Give rospy the configuration of logging that changes nothing: its own replaces everybody's handlers."""
    with tempfile.NamedTemporaryFile("w", suffix=".yaml") as file:
        file.write("{version: 1, incremental: true}")
        file.flush()
        before = os.environ.get(_LOG_VARIABLE)
        os.environ[_LOG_VARIABLE] = file.name
        try:
            yield
        finally:
            del os.environ[_LOG_VARIABLE]
            if before is not None:
                os.environ[_LOG_VARIABLE] = before
