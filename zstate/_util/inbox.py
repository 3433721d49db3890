"""Received items that wait for a reader, which takes them with ``for``, ``async for`` or the newest alone."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterable, Iterator
from contextlib import suppress
from typing import Generic, TypeVar

from zstate._util.bounded import BoundedQueue
from zstate._util.fork_safe import fork_safe

T = TypeVar("T")

# Ctrl-C that arrives as a thread starts to wait is handled only after that wait; so is the end of reception.
_LONGEST_WAIT_S = 0.5


class Inbox(Generic[T]):
    """The last ``capacity`` items that were added and not taken. Any thread may add.

    With ``size_of``, which returns the bytes of an item, also no more than ``max_bytes``.

    Iterations return each item once, in the order of arrival, and end with ``close()``, after the last item.
    ``check_reception()`` is called before a wait and every 0.5 s of it; it raises if nothing can arrive, as
    in a forked process.
    """

    def __init__(
        self,
        capacity: int,
        check_reception: Callable[[], object],
        *,
        max_bytes: int = 0,
        size_of: Callable[[T], int] = lambda _: 0,
    ) -> None:
        self._items: BoundedQueue[T] = BoundedQueue(capacity, max_bytes)
        self._size_of = size_of
        self._check_reception = check_reception
        self._changed = fork_safe(threading.Condition())
        self._waiting_tasks: list[Callable[[], object]] = []
        self._closed = False

    def __len__(self) -> int:
        return len(self._items)

    def add(self, items: Iterable[T]) -> int:
        """Add items, oldest first; after ``close()`` none.

        Beyond a limit the oldest are lost; returns how many.
        """
        added = [(item, self._size_of(item)) for item in items]
        with self._changed:
            if self._closed:
                return 0
            lost = sum(self._items.append(item, size) for item, size in added)
            self._wake()
        return lost

    def take_newest(self) -> T | None:
        """The newest item, None if there is none; the others are lost."""
        with self._changed:
            self._check()
            newest = self._items[-1] if self._items else None
            self._items.clear()
        return newest

    def take(self, timeout_s: float | None = None) -> T | None:
        """The oldest item; None if none arrives within ``timeout_s``, or after the end."""
        deadline = math.inf if timeout_s is None else time.monotonic() + timeout_s
        while True:
            with self._changed:
                self._check()
                left_s = max(0.0, min(deadline - time.monotonic(), _LONGEST_WAIT_S))
                if self._changed.wait_for(lambda: self._items or self._closed, left_s):
                    return self._items.popleft() if self._items else None
                if time.monotonic() >= deadline:
                    return None

    def __iter__(self) -> Iterator[T]:
        while True:
            with self._changed:
                self._check()
                if not self._changed.wait_for(lambda: self._items or self._closed, _LONGEST_WAIT_S):
                    continue
                if not self._items:
                    return
                item = self._items.popleft()
            yield item

    async def __aiter__(self) -> AsyncIterator[T]:
        import asyncio  # noqa: PLC0415  # a caller has it already, and others do not need it

        loop = asyncio.get_running_loop()
        while True:
            arrived = asyncio.Event()

            def wake(arrived: asyncio.Event = arrived) -> None:
                # The loop may be closed by the time an item arrives.
                with suppress(RuntimeError):
                    loop.call_soon_threadsafe(arrived.set)

            with self._changed:
                self._check()
                items = [self._items.popleft()] if self._items else []
                if not items:
                    if self._closed:
                        return
                    self._waiting_tasks.append(wake)
            if items:
                yield items[0]
                continue
            try:
                with suppress(TimeoutError, asyncio.TimeoutError):
                    await asyncio.wait_for(arrived.wait(), _LONGEST_WAIT_S)
            finally:
                self._remove_task(wake)

    def close(self) -> None:
        """End the iterations. A second call does nothing."""
        with self._changed:
            self._closed = True
            self._wake()

    def _check(self) -> None:
        if not (self._items or self._closed):
            self._check_reception()

    def _remove_task(self, wake: Callable[[], object]) -> None:
        """Remove the callback of a task that was cancelled, or has waited long enough."""
        with self._changed:
            if wake in self._waiting_tasks:
                self._waiting_tasks.remove(wake)

    def _wake(self) -> None:
        self._changed.notify_all()
        for wake in self._waiting_tasks:
            wake()
        self._waiting_tasks.clear()
