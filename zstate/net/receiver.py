"""One daemon thread that drains a Zenoh channel in batches."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterable
from typing import Generic, Protocol, TypeAlias, TypeVar

import zenoh

from zstate.net.at_exit import join_at_exit
from zstate.net.session import Session
from zstate.net.undeclaring import Undeclarable

JOIN_WITHIN_S = 0.8

Ring: TypeAlias = "zenoh.handlers.RingChannel[zenoh.Sample]"

T = TypeVar("T")


class Subscribed(Undeclarable, Protocol[T]):
    """A Zenoh subscriber or queryable of any kind that delivers into a channel."""

    @property
    def handler(self) -> zenoh.Handler[T]: ...


def take_each(batch: Iterable[T], take: Callable[[T], object]) -> None:
    """Call ``take`` with each item of ``batch``; an exception of one is raised after the last item."""
    failure: Exception | None = None
    for item in batch:
        try:
            take(item)
        except Exception as error:  # noqa: PERF203 - the other items are not to blame
            failure = error
    if failure is not None:
        raise failure


class Receiver(Generic[T]):
    """Hands what arrives to ``on_batch``, everything that waits at once, oldest first.

    A ring of ``capacity`` lies between: when it is full the oldest samples are lost. A batch that
    fills it is counted in ``full_batches``, so that a gap in front of it, or in it, can be told from
    one of the network. An exception of ``on_batch`` is counted in ``failures``; the first also goes to
    ``threading.excepthook``. The thread goes on.
    """

    def __init__(
        self,
        session: Session,
        subscribed: Subscribed[T],
        on_batch: Callable[[list[T]], None],
        capacity: int,
    ) -> None:
        self.full_batches = 0
        self.failures = 0
        self._session = session
        self._subscribed = subscribed
        self._on_batch = on_batch
        self._capacity = capacity
        self._closed = False
        thread = threading.Thread(target=self._run, name="zstate receiver", daemon=True)
        self._thread = join_at_exit(thread)
        self._thread.start()

    def close(self) -> None:
        """Stop within a second; nothing is handed over afterwards. May be called from ``on_batch``."""
        self._closed = True
        self._session.release(self._subscribed)
        if threading.current_thread() is not self._thread:
            self._thread.join(JOIN_WITHIN_S)

    def _run(self) -> None:
        handler = self._subscribed.handler
        while not self._closed:
            try:
                batch = [handler.recv()]
                while len(batch) < self._capacity and (sample := handler.try_recv()) is not None:
                    batch.append(sample)
            except zenoh.ZError:
                return  # undeclared, or the session was closed
            self._hand_over(batch)

    def _hand_over(self, batch: list[T]) -> None:
        if len(batch) >= self._capacity:
            self.full_batches += 1
        if self._closed:
            return
        try:
            self._on_batch(batch)
        except Exception:
            self.failures += 1
            if self.failures == 1:
                threading.excepthook(threading.ExceptHookArgs((*sys.exc_info(), self._thread)))
