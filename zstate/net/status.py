"""Status of writers: published once a second while subscribed, on the native wire only.

ROS's diagnostics are not among the message types of zstate.
"""

from __future__ import annotations

import sys
import threading
import time
import weakref
from collections.abc import Callable

import zenoh

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe, fork_safe_lock
from zstate.errors import Closed
from zstate.net.session import Session
from zstate.net.streams import KeyPublisher
from zstate.wire.keys import STATUS
from zstate.wire.messages import Status
from zstate.wire.native import encode, encoding_of

PERIOD_S = 1.0
JOIN_WITHIN_S = 0.5


class StatusPublisher(Closeable):
    """Calls ``status()`` once a second, and publishes the result if it has subscribers.

    Called from a thread of the session, for one publisher after the other: it has to return at once. So the
    status continues if the writer stands still, and ends with the process.
    """

    def __init__(self, session: Session, robot: str, identity: str, status: Callable[[], Status]) -> None:
        self._session = session
        self._status = status
        self._publisher = KeyPublisher(session, STATUS.key(robot, identity), encoding_of(Status))
        with _LOCK:
            self._timer = _TIMERS.setdefault(session, _StatusTimer())
        self._timer.add(self)

    def close(self) -> None:
        self._timer.remove(self)
        self._publisher.close()

    def publish(self) -> None:
        """Publish the status now. Raises Closed."""
        self._session.check()
        status = self._status()
        if self._publisher.has_readers:
            self._publisher.put(encode(status))


class _StatusTimer:
    """Publishes the status of each publisher of a session once a second, in one thread for all of them."""

    def __init__(self) -> None:
        self._changed = fork_safe(threading.Condition())
        self._due: dict[StatusPublisher, float] = {}
        self._thread: threading.Thread | None = None
        self._current: StatusPublisher | None = None

    def add(self, publisher: StatusPublisher) -> None:
        """Publish its status from now on, the first one after a period."""
        with self._changed:
            self._due[publisher] = time.monotonic() + PERIOD_S
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="zstate status", daemon=True)
                self._thread.start()

    def remove(self, publisher: StatusPublisher) -> None:
        """End that. Waits for a status that is being published, or gives up after half a second."""
        with self._changed:
            self._due.pop(publisher, None)
            self._changed.notify_all()
            thread = self._thread
            if thread is threading.current_thread():
                return
            self._changed.wait_for(lambda: self._current is not publisher, JOIN_WITHIN_S)
            is_last = not self._due
        if is_last and thread is not None:
            thread.join(JOIN_WITHIN_S)

    def _run(self) -> None:
        while (publisher := self._wait_for_next()) is not None:
            try:
                publisher.publish()
            except (Closed, zenoh.ZError):
                self._forget(publisher)
            except Exception:
                threading.excepthook(threading.ExceptHookArgs((*sys.exc_info(), threading.current_thread())))
                self._forget(publisher)
            with self._changed:
                self._current = None
                self._changed.notify_all()

    def _forget(self, publisher: StatusPublisher) -> None:
        with self._changed:
            self._due.pop(publisher, None)

    def _wait_for_next(self) -> StatusPublisher | None:
        """The publisher whose status is due, once one is; None, and the end of the thread, without any."""
        with self._changed:
            while self._due:
                publisher = min(self._due, key=self._due.__getitem__)
                now = time.monotonic()
                if self._due[publisher] <= now:
                    # After a pause (a suspended laptop) one status is enough.
                    self._due[publisher] = max(self._due[publisher] + PERIOD_S, now)
                    self._current = publisher
                    return publisher
                self._changed.wait(self._due[publisher] - now)
            self._thread = None
            return None


_TIMERS: weakref.WeakKeyDictionary[Session, _StatusTimer] = weakref.WeakKeyDictionary()
_LOCK = fork_safe_lock()
