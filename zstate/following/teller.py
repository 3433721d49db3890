"""Teller: calls a user's function from a thread of its own, and looks after something meanwhile."""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

from zstate.closing import Closing
from zstate.locks import outlive_fork

T = TypeVar("T")

WAITING = 1024
_LOOK_AT_MOST_EVERY_S = 0.02
_LOOK_AT_LEAST_EVERY_S = 0.5
_ENDS_WITHIN_S = 0.8


class Teller(Closing, Generic[T]):
    """Calls ``callback`` with everything that is told, in order; of more than 1024 the oldest are lost.

    ``look(now)`` is called from the same thread, at the latest half a second after the last time; it
    gives when it wants to be called again, both by ``time.monotonic`` [s]. An exception of ``callback``
    is counted in ``failures``; the first also goes to ``threading.excepthook``.
    """

    def __init__(self, callback: Callable[[T], None], look: Callable[[float], float]) -> None:
        self.failures = 0
        self._callback = callback
        self._look = look
        self._waiting: deque[T] = deque(maxlen=WAITING)
        self._wake = outlive_fork(threading.Condition())
        self._is_open = True
        self._thread = threading.Thread(target=self._run, name="zstate events", daemon=True)
        self._thread.start()

    def tell(self, one: T) -> None:
        """Call back with ``one``, soon."""
        with self._wake:
            self._waiting.append(one)
            self._wake.notify_all()

    def close(self) -> None:
        """Stop within a second, also from inside ``callback``. A second call does nothing."""
        with self._wake:
            self._is_open = False
            self._wake.notify_all()
        if threading.current_thread() is not self._thread:
            self._thread.join(_ENDS_WITHIN_S)

    def _run(self) -> None:
        while self._is_open:
            # Not under the lock: it tells something itself.
            wait_s = self._look(time.monotonic()) - time.monotonic()
            with self._wake:
                if not self._waiting and self._is_open:
                    self._wake.wait(min(max(wait_s, _LOOK_AT_MOST_EVERY_S), _LOOK_AT_LEAST_EVERY_S))
                told = list(self._waiting)
                self._waiting.clear()
            for one in told:
                if self._is_open:
                    self._call(one)

    def _call(self, one: T) -> None:
        try:
            self._callback(one)
        except Exception:
            self.failures += 1
            if self.failures == 1:
                threading.excepthook(threading.ExceptHookArgs((*sys.exc_info(), self._thread)))
