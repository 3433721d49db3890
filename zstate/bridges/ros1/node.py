"""ROS 1 node of this process (rospy), and a client of the ROS 1 master with a timeout.

rospy itself would wait for a master for ever.
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
    """Client of the master at ``uri`` (default: ROS_MASTER_URI). Thread-safe."""

    def __init__(self, uri: str | None = None) -> None:
        self._lock = threading.Lock()
        self.uri = uri or os.environ.get(URI_VARIABLE) or DEFAULT_URI
        try:
            self._proxy = xmlrpc.client.ServerProxy(self.uri, transport=_TimeoutTransport())
        except OSError as error:
            raise NetworkError(f"{URI_VARIABLE} is {self.uri!r}, not http://HOST:PORT ({error})") from None

    def pid(self) -> int:
        """The process id of the master; a restarted one has lost its registrations. Raises Unreachable."""
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
                f"no ROS master answers at {self.uri!r} ({error}); start one with `roscore`, or set its "
                f"address: export {URI_VARIABLE}={DEFAULT_URI}",
                endpoints=[self.uri],
            ) from None
        return code == _SUCCESS, value


class _TimeoutTransport(xmlrpc.client.Transport):
    def make_connection(self, host: Any) -> http.client.HTTPConnection:
        connection = super().make_connection(host)
        connection.timeout = ANSWER_WITHIN_S
        return connection


NAME = "zstate_ros1"

# As usual for /tf in ROS 1.
_QUEUE_SIZE = 100
_CLOSE_WITHIN_S = 0.7
_LOG_VARIABLE = "ROS_PYTHON_LOG_CONFIG_FILE"


@dataclass(frozen=True)
class RospyModules:
    """rospy and its message classes. They have no types."""

    rospy: Any
    JointState: Any
    TFMessage: Any
    TransformStamped: Any


def load_ros() -> RospyModules:
    """Import rospy and its messages. Raises LibraryMissing, which names the packages to install."""
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
            f"this Python does not find ROS 1 ({error}). On Debian 12: `apt-get install "
            "python3-rospy python3-sensor-msgs python3-tf2-msgs`, and install zstate where they are visible: "
            "`/usr/bin/python3 -m venv --system-site-packages .venv`"
        ) from None
    finally:
        # rospy sets a class of its own for all new loggers.
        logging.setLoggerClass(logger_class)


class Ros1Node(Closeable):
    """A node of ROS 1; a process can have one in its lifetime, because rospy cannot be restarted.

    Raises LibraryMissing without rospy, Unreachable without a master.
    """

    def __init__(self) -> None:
        self.ros = load_ros()
        self.master = Master()
        self.master_pid = self.master.pid()
        with _keep_logging():
            # Signals, time and log messages are handled by this process, not by rospy.
            self.ros.rospy.init_node(
                NAME, anonymous=True, disable_signals=True, disable_rostime=True, disable_rosout=True
            )
        self.name: str = self.ros.rospy.get_name()

    @property
    def has_ended(self) -> bool:
        """Whether the node is closed, or was killed (``rosnode kill``)."""
        return bool(self.ros.rospy.is_shutdown())

    def resolved(self, name: str) -> str:
        """``name`` in the namespace of this node (ROS_NAMESPACE)."""
        return str(self.ros.rospy.resolve_name(name))

    def publisher(self, topic: str, kind: Any, *, latch: bool = False) -> Publisher:
        """A publisher of messages of class ``kind``; latched ones keep the last for late joiners."""
        return Publisher(self.ros.rospy, topic, kind, latch)

    def subscribe(self, topic: str, kind: Any, callback: Callable[[Any], None]) -> None:
        """Call ``callback(message)`` for each message, on a thread of rospy."""
        self.ros.rospy.Subscriber(topic, kind, callback, tcp_nodelay=True)

    def close(self) -> None:
        """Leave ROS within a second. A second call does nothing."""
        # In a thread, because a missing master or a frozen subscriber would block it.
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
        """Whether there is a subscriber."""
        return bool(self._publisher.get_num_connections())

    def publish(self, message: Any) -> None:
        """Send ``message``, which may be changed afterwards unless latched. No effect after shutdown."""
        try:
            self._publisher.publish(message)
        except self._rospy.ROSException:
            if not self._rospy.is_shutdown():
                raise


def sender(message: Any) -> str:
    """The name of the node that sent ``message``."""
    return str(message._connection_header["callerid"])  # rospy has no public name for it


@contextmanager
def _keep_logging() -> Generator[None]:
    """Give rospy a logging configuration that changes nothing: its default replaces all handlers."""
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
