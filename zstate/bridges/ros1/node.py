"""Node: this process as a node of ROS 1, by rospy.

The ROS 1 master, asked with a deadline: rospy itself would wait for one for ever.
"""

from __future__ import annotations

import http.client
import logging
import os
import tempfile
import threading
import xmlrpc.client
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from zstate._util.closeable import Closeable
from zstate.errors import LibraryMissing, NetworkError, Unreachable

URI_VARIABLE = "ROS_MASTER_URI"
DEFAULT_URI = "http://localhost:11311"
ANSWER_WITHIN_S = 2.0

_CALLER = "/zstate"
_SUCCESS = 1


class Master:
    """The master at ``uri``, which is that of ROS_MASTER_URI unless given. Any thread may ask."""

    def __init__(self, uri: str | None = None) -> None:
        self._lock = threading.Lock()
        self.uri = uri or os.environ.get(URI_VARIABLE) or DEFAULT_URI
        try:
            self._proxy = xmlrpc.client.ServerProxy(self.uri, transport=_TimeoutTransport())
        except OSError as error:
            raise NetworkError(f"{URI_VARIABLE} is {self.uri!r}, not http://HOST:PORT ({error})") from None

    def pid(self) -> int:
        """The process it is: another one knows nothing of what this one was told. Raises Unreachable."""
        return int(self._ask("getPid")[1])

    def parameter(self, name: str) -> Any:
        """The value of the parameter ``name``; None when it is not set. Raises Unreachable."""
        found, value = self._ask("getParam", name)
        return value if found else None

    def set_parameter(self, name: str, value: str) -> None:
        """Set the parameter ``name``. Raises Unreachable."""
        self._ask("setParam", name, value)

    def _ask(self, method: str, *arguments: str) -> tuple[bool, Any]:
        try:
            with self._lock:  # there is one connection
                code, _, value = getattr(self._proxy, method)(_CALLER, *arguments)  # type: ignore[misc]
        except (OSError, http.client.HTTPException, xmlrpc.client.Error, ValueError, TypeError) as error:
            raise Unreachable(
                f"no ROS master answers at {self.uri!r} ({error}); start one with `roscore`, or say where it "
                f"is: export {URI_VARIABLE}={DEFAULT_URI}",
                endpoints=[self.uri],
            ) from None
        return code == _SUCCESS, value


class _TimeoutTransport(xmlrpc.client.Transport):
    def make_connection(self, host: Any) -> http.client.HTTPConnection:
        connection = super().make_connection(host)
        connection.timeout = ANSWER_WITHIN_S
        return connection


NAME = "zstate_ros1"

# What ROS 1 programs use for /tf.
_QUEUE_SIZE = 100
_CLOSE_WITHIN_S = 0.7
_LOG_VARIABLE = "ROS_PYTHON_LOG_CONFIG_FILE"


@dataclass(frozen=True)
class RospyModules:
    """What of ROS 1 is used here: rospy, and the classes of the messages. None of it has types."""

    rospy: Any
    JointState: Any
    TFMessage: Any
    TransformStamped: Any


def load_ros() -> RospyModules:
    """Import rospy and its messages. Raises LibraryMissing saying what to install."""
    logger_class = logging.getLoggerClass()
    try:
        return RospyModules(
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


class Node(Closeable):
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


def sender(message: Any) -> str:
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
