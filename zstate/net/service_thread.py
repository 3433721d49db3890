"""A thread that subscriptions and requests share, each of which has a turn when something arrives for it."""

from __future__ import annotations

import heapq
import itertools
import queue
import sys
import threading
import time
from collections.abc import Callable

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate.net.at_exit import join_at_exit
from zstate.net.session import Session

JOIN_WITHIN_S = 0.8


class ServiceThread(Closeable):
    """Calls functions one after the other, until it is closed or ``session`` is.

    The thread starts with the first of them. A function that takes long delays those of all others. An
    exception is counted in ``failures``; the first goes to ``threading.excepthook``.
    """

    def __init__(self, session: Session, name: str) -> None:
        self.failures = 0
        self._session = session
        self._name = name
        self._calls: queue.SimpleQueue[tuple[float, Callable[[], object]]] = queue.SimpleQueue()
        self._later: list[tuple[float, int, Callable[[], object]]] = []
        """A heap; the number keeps the order of functions that are due at the same time."""
        self._numbers = itertools.count()
        self._closed = False
        self._lock = fork_safe_lock()
        self._thread: threading.Thread | None = None

    def call(self, function: Callable[[], object], delay_s: float = 0.0) -> None:
        """Call ``function()`` after ``delay_s`` [s]; without a delay in order. Does not wait."""
        self._calls.put((time.monotonic() + delay_s if delay_s else 0.0, function))
        if self._thread is None:
            self._start()

    def wake(self) -> None:
        """Let the thread end if its session is closed. Subscriptions call it when theirs ends."""
        self._calls.put((0.0, lambda: None))

    def close(self) -> None:
        """Call no further function, and wait at most 0.8 s for the current one, unless that closes it."""
        self._closed = True
        self.wake()
        with self._lock:
            thread = self._thread
        if thread not in (None, threading.current_thread()):
            thread.join(JOIN_WITHIN_S)

    @property
    def _is_open(self) -> bool:
        return not self._closed and self._session.is_usable

    def _start(self) -> None:
        with self._lock:
            if self._thread is not None or not self._is_open:
                return
            thread = threading.Thread(target=self._run, name=f"zstate {self._name}", daemon=True)
            try:
                join_at_exit(thread).start()
            except RuntimeError:
                if threading.main_thread().is_alive():
                    raise
                return  # Python is ending, and starts no more threads
            self._thread = thread

    def _run(self) -> None:
        while self._is_open:
            function = self._next()
            try:
                if function is not None:
                    function()
            except Exception:
                if self._is_open:  # else it found the session closed
                    self.failures += 1
                    if self.failures == 1:
                        threading.excepthook(
                            threading.ExceptHookArgs((*sys.exc_info(), threading.current_thread()))
                        )

    def _next(self) -> Callable[[], object] | None:
        """The next function; None after waiting for one that is due now, or for a new one."""
        pause_s = self._later[0][0] - time.monotonic() if self._later else None
        if pause_s is not None and pause_s <= 0.0:
            return heapq.heappop(self._later)[-1]
        try:
            due_s, function = self._calls.get(timeout=pause_s)
        except queue.Empty:
            return None
        if not due_s:
            return function
        heapq.heappush(self._later, (due_s, next(self._numbers), function))
        return None
