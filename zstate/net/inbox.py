"""Inbox: what several subscriptions hear, with the time of hearing, in one queue for one thread."""

from __future__ import annotations

import threading
import time
from contextlib import ExitStack
from typing import NamedTuple

from zstate.closing import Closing
from zstate.locks import outlive_fork
from zstate.net.latched import LatchedSubscriber
from zstate.net.session import Session
from zstate.net.streams import StreamSubscriber, capacity_for
from zstate.wire.keys import Stream
from zstate.wire.protocol import SerializedSample

ROOM_BYTES = 64 * 2**20
ROOM = 8192
"""So many arrivals wait here, and then in the rings of the subscriptions, which lose the oldest."""


class Heard(NamedTuple):
    """Arrivals of one stream, oldest first. ``robot`` is None where only their keys tell.

    ``stamp`` [ns] is when they were heard, by the system clock; ``overflowed`` says that a ring of ours
    lost some before or among them.
    """

    stream: Stream
    robot: str | None
    arrivals: list[SerializedSample]
    stamp: int
    overflowed: bool


class Inbox(Closing):
    """Hears until it is closed; ``take`` gives what has come."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._heard: list[Heard] = []
        self._waiting = self._bytes = 0
        self._has_room = outlive_fork(threading.Condition())
        self._is_open = True
        self._opened = ExitStack()

    def hear(self, stream: Stream, expression: str, robot: str | None) -> None:
        """Subscribe to samples."""
        capacity = capacity_for(expression)

        def put(arrivals: list[SerializedSample]) -> None:
            self._put(Heard(stream, robot, arrivals, time.time_ns(), len(arrivals) >= capacity))

        self._opened.enter_context(StreamSubscriber(self._session, expression, put))

    def hear_latched(self, stream: Stream, expression: str, robot: str | None) -> None:
        """Subscribe to latched values; an empty payload is one that was withdrawn."""

        def put(arrival: SerializedSample) -> None:
            self._put(Heard(stream, robot, [arrival], time.time_ns(), overflowed=False))

        self._opened.enter_context(LatchedSubscriber(self._session, expression, put))

    def take(self) -> list[Heard]:
        """All that waits, in the order of hearing."""
        with self._has_room:
            heard, self._heard = self._heard, []
            self._waiting = self._bytes = 0
            self._has_room.notify_all()
        return heard

    def close(self) -> None:
        """Stop hearing, within a second; what waits may still be taken."""
        with self._has_room:
            self._is_open = False
            self._has_room.notify_all()
        self._opened.close()

    def _put(self, heard: Heard) -> None:
        with self._has_room:
            # Who takes too slowly must not fill the memory: it is the ring that loses, and counts.
            while self._is_open and (self._waiting >= ROOM or self._bytes >= ROOM_BYTES):
                self._has_room.wait()
            if self._is_open:
                self._heard.append(heard)
                self._waiting += len(heard.arrivals)
                self._bytes += sum(len(arrival.payload) for arrival in heard.arrivals)
