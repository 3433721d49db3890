"""The end of a command by a signal."""

from __future__ import annotations

import _thread
import signal
import sys
import threading
import time
from collections.abc import Generator
from contextlib import contextmanager
from typing import NoReturn

CHECKED_AFTER_S = 0.5
"""An orderly exit takes well under it."""


class SignalExit(SystemExit):
    """Raised by the handlers of signals; a SystemExit of another kind is that of a user's program."""


class Ending:
    """Raises SignalExit in the main thread until it is on its way.

    Zenoh calls functions in the thread that declares something, and Python calls some of its own: what a
    handler raises in one of these is logged, and lost. A moment later the handler is called again.
    """

    def __init__(self) -> None:
        self.has_begun = False
        self._is_check = False
        self._lock = threading.Lock()

    def begin(self, number: int) -> NoReturn:
        """Raise SignalExit. For the handler of the signal ``number``, once."""
        self.has_begun = True
        # Not by threading, whose lock the main thread may hold.
        _thread.start_new_thread(self._check, (number, threading.get_ident()))
        raise SignalExit(128 + number)

    def is_repeated(self, number: int) -> bool:
        """Whether a further call of the handler is no signal, but a check.

        Raises SignalExit if the one before has been lost.
        """
        if not self._is_check:
            return False
        self._is_check = False
        if self.has_begun and not _is_on_its_way():
            self.begin(number)
        return True

    def close(self) -> None:
        """Check no more, because the command ends now."""
        self.has_begun = False
        with self._lock:  # a check that is under way calls the handler before this returns
            pass

    def _check(self, number: int, main_thread: int) -> None:
        time.sleep(CHECKED_AFTER_S)
        with self._lock:  # the handler is still in place
            if self.has_begun:
                self._is_check = True
                signal.pthread_kill(main_thread, number)


def _is_on_its_way() -> bool:
    """Whether SignalExit is handled now, by what it passes, such as a ``finally``."""
    error = sys.exc_info()[1]
    while error is not None and not isinstance(error, SignalExit):
        error = error.__context__
    return error is not None


@contextmanager
def deferred_signals() -> Generator[None]:
    """A signal to end that arrives in the block is handled after it. For the main thread."""
    arrived: list[int] = []
    handlers = {one: signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        for number in handlers:
            signal.signal(number, lambda number, _: arrived.append(number))
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for number in arrived:
            signal.raise_signal(number)
