"""Signals that wait until a resource is closed."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager


@contextmanager
def held_back_signals(finish: Callable[[], None]) -> Generator[list[int], None, None]:
    """Hold back SIGTERM and SIGHUP inside the block, and yield the list of those that have arrived.

    At its end ``finish()`` is called if any has arrived, and the first one is raised again, which ends the
    process. Only in the main thread, and only for signals without a handler of the program.
    """
    arrived: list[int] = []
    held: list[int] = []
    if threading.current_thread() is threading.main_thread():
        held = [one for one in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(one) == signal.SIG_DFL]
    for one in held:
        # No event is set here: a thread that waits for one may hold its lock when its handler is called.
        signal.signal(one, lambda number, _: arrived.append(number))
    try:
        yield arrived
    finally:
        try:
            if arrived:
                finish()
        finally:
            for one in held:
                signal.signal(one, signal.SIG_DFL)
            if arrived:
                signal.raise_signal(arrived[0])
