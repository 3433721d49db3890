"""Base class of resources with ``close()``, and signals that wait for it."""

from __future__ import annotations

import signal
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator
from contextlib import contextmanager
from types import TracebackType
from typing import Any, TypeVar

Self = TypeVar("Self", bound="Closeable")


class Closeable(ABC):
    """A resource that is open until ``close()``; a context manager."""

    @abstractmethod
    def close(self) -> None:
        """Release the resource. A second call does nothing."""

    def __enter__(self: Self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __reduce__(self) -> str | tuple[Any, ...]:
        name = type(self).__name__
        raise TypeError(f"a {name} is not copied or pickled: it is open in this process; open one in each")


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
