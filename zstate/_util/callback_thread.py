"""Thread for a user's callback, so that a slow one delays nothing else."""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe

T = TypeVar("T")

QUEUE_SIZE = 1024
_MIN_TICK_S = 0.02
_MAX_TICK_S = 0.5
_CLOSES_WITHIN_S = 0.8


class CallbackThread(Closeable, Generic[T]):
    """Calls ``callback`` with every submitted item, in order. Drops the oldest of more than 1024.

    ``tick(now)`` is called from the same thread at least every half second; it returns its next due time,
    both by ``time.monotonic`` [s]. An exception of ``callback`` is counted in ``failures``; the first also
    goes to ``threading.excepthook``.
    """

    def __init__(self, callback: Callable[[T], None], tick: Callable[[float], float]) -> None:
        self.failures = 0
        self._callback = callback
        self._tick = tick
        self._queue: deque[T] = deque(maxlen=QUEUE_SIZE)
        self._wake = fork_safe(threading.Condition())
        self._is_open = True
        self._thread = threading.Thread(target=self._run, name="zstate events", daemon=True)
        self._thread.start()

    def submit(self, item: T) -> None:
        """Queue ``item`` for the callback. Does not block."""
        with self._wake:
            self._queue.append(item)
            self._wake.notify_all()

    def close(self) -> None:
        """Stop within a second, also from inside ``callback``. A second call does nothing."""
        with self._wake:
            self._is_open = False
            self._wake.notify_all()
        if threading.current_thread() is not self._thread:
            self._thread.join(_CLOSES_WITHIN_S)

    def _run(self) -> None:
        while self._is_open:
            # Outside the lock, because ``tick`` may submit items itself.
            wait_s = self._tick(time.monotonic()) - time.monotonic()
            with self._wake:
                if not self._queue and self._is_open:
                    self._wake.wait(min(max(wait_s, _MIN_TICK_S), _MAX_TICK_S))
                items = list(self._queue)
                self._queue.clear()
            for item in items:
                if not self._is_open:
                    return
                try:
                    self._callback(item)
                except Exception:
                    self.failures += 1
                    if self.failures == 1:
                        threading.excepthook(threading.ExceptHookArgs((*sys.exc_info(), self._thread)))
