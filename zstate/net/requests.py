"""Requests to many writers: a few at a time, repeated while there is no reply.

A reader of all robots requests the history, the clock and the latched values of each announced writer. A
writer may never reply: in the order of arrival a thousand silent writers of one robot would delay those of
another robot by minutes. So robots take turns.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import deque
from functools import partial
from typing import Generic, TypeAlias, TypeVar

import zenoh

from zstate.net.service_thread import ServiceThread
from zstate.net.session import Session

T = TypeVar("T")

ReplyHandler: TypeAlias = "zenoh.handlers.Callback[zenoh.Reply]"


class RoundRobinQueue(Generic[T]):
    """Items of several sources: one item of each source in turn.

    A source with a thousand items delays those of another source by one item, not by a thousand. Not
    thread-safe.
    """

    def __init__(self) -> None:
        self._items: dict[str, deque[T]] = {}
        """By source; the first source is the next."""

    def __len__(self) -> int:
        return sum(map(len, self._items.values()))

    def add(self, source: str, item: T) -> None:
        """Add an item of ``source``."""
        self._items.setdefault(source, deque()).append(item)

    def pop(self) -> T | None:
        """Take out the next item; None if there is none."""
        if not self._items:
            return None
        source = next(iter(self._items))
        items = self._items.pop(source)
        item = items.popleft()
        if items:
            self._items[source] = items  # behind all other sources
        return item


class Request(ABC):
    """A query to one writer, and its repetitions. The last one took ``duration_s`` [s].

    Requests with the same ``source`` are sent one after the other, between those of other sources.
    """

    source: str
    duration_s = 0.0

    @abstractmethod
    def send(self, session: zenoh.Session, handler: ReplyHandler) -> None:
        """Send the query, with ``handler`` for its replies."""

    @abstractmethod
    def on_reply(self, reply: zenoh.Reply) -> None:
        """Called in a thread of Zenoh, which must not wait."""

    @abstractmethod
    def on_end(self) -> float | None:
        """Handle the end of a query, in the thread of the requests.

        Returns after how long [s] to send the next one; None for never.
        """


class Requests:
    """Sends requests from ``thread``, of which at most ``limit`` are in flight. Their sources take turns."""

    def __init__(self, session: Session, thread: ServiceThread, limit: int) -> None:
        self._session = session
        self._thread = thread
        self._limit = limit
        self._waiting: RoundRobinQueue[Request] = RoundRobinQueue()
        self._in_flight = 0

    def add(self, request: Request, delay_s: float = 0.0) -> None:
        """Send ``request`` after ``delay_s`` [s], when it has its turn. Any thread may call it."""
        self._thread.call(partial(self._add, request), delay_s)

    def _add(self, request: Request) -> None:
        self._waiting.add(request.source, request)
        self._send_waiting()

    def _send_waiting(self) -> None:
        while self._in_flight < self._limit and (request := self._waiting.pop()) is not None:
            on_end = partial(self._note_end, request, time.monotonic())
            handler = zenoh.handlers.Callback(request.on_reply, on_end, indirect=False)
            request.send(self._session.zenoh, handler)
            self._in_flight += 1

    def _note_end(self, request: Request, sent_s: float) -> None:
        """Called in a thread of Zenoh: that of the requests may be busy when a query ends."""
        request.duration_s = time.monotonic() - sent_s
        self._thread.call(partial(self._on_end, request))

    def _on_end(self, request: Request) -> None:
        self._in_flight -= 1
        try:
            delay_s = request.on_end()
            if delay_s is not None:
                self.add(request, delay_s)
        finally:
            self._send_waiting()
