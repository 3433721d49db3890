"""The ROS 1 master, asked with a deadline: rospy itself would wait for one for ever."""

from __future__ import annotations

import http.client
import os
import threading
import xmlrpc.client
from typing import Any

from zstate.errors import NetworkError, Unreachable

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
            self._proxy = xmlrpc.client.ServerProxy(self.uri, transport=_Hasty())
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


class _Hasty(xmlrpc.client.Transport):
    def make_connection(self, host: Any) -> http.client.HTTPConnection:
        connection = super().make_connection(host)
        connection.timeout = ANSWER_WITHIN_S
        return connection
