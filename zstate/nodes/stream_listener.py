"""Listener to any stream, also to those that other packages bring."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import ExitStack
from typing import NamedTuple

from zstate._util.closeable import Closeable
from zstate._util.inbox import Inbox
from zstate._util.refusals import Refusals
from zstate.net.presence import announce_reader
from zstate.net.session import Session
from zstate.net.streams import BULK_CAPACITY
from zstate.net.subscription import Received, subscribe
from zstate.nodes.stream_publisher import checked_stream
from zstate.streams import Stream
from zstate.wire.messages import Message
from zstate.wire.protocol import selected_robots
from zstate.wire.registry import get_wire

_CAPACITY = 4096


class ReceivedMessage(NamedTuple):
    """A message of ``robot``, of the writer ``name``, which is empty on a stream without names.

    ``received_at`` [ns] is by the system clock.
    """

    robot: str
    name: str
    message: Message
    received_at: int


class StreamListener(Closeable):
    """Receives the messages of ``stream``, a row or its name, of a robot, of several, or of all with ``"*"``.

    ``for received in listener`` and ``async for received in listener`` return each message once, in the order
    of arrival, and end with ``close()``; ``get`` returns the next one. If more than 4096 messages are unread,
    8 of bulk data, the oldest are lost, and counted in ``lost``. ``refused`` counts payloads that are no
    message of the stream, by reason; the first of each reason is also logged. A context manager.

    Raises InvalidInput for a stream that no installed package brings, or that ``wire`` does not carry.
    """

    def __init__(
        self, session: Session, robot: str | Sequence[str], stream: Stream | str, *, wire: str = "native"
    ) -> None:
        self.stream = checked_stream(stream)
        self.lost = 0
        self._wire = get_wire(wire)
        self._refusals = Refusals(self.stream.name)
        self.refused: dict[str, int] = self._refusals.counts
        capacity = BULK_CAPACITY if self.stream.bulk else _CAPACITY
        self._unread: Inbox[ReceivedMessage] = Inbox(capacity, session.check)
        robots = selected_robots(robot, self._wire)
        with ExitStack() as opening:
            opening.enter_context(
                subscribe(
                    session,
                    self._wire,
                    robots,
                    self.stream.name,
                    self._on_messages,
                    on_error=self._refusals.count,
                )
            )
            for one in robots:
                for announcement in announce_reader(session, self._wire, one, (self.stream.name,)):
                    opening.enter_context(announcement)
            self._opened = opening.pop_all()

    def __repr__(self) -> str:
        return f"<StreamListener of {self.stream.name!r}: {len(self)} unread messages>"

    def __len__(self) -> int:
        """How many messages are unread."""
        return len(self._unread)

    def _on_messages(self, received: list[Received]) -> None:
        now = time.time_ns()
        named = self.stream.named
        self.lost += self._unread.add(
            ReceivedMessage(robot, (self._wire.edge_writer_name(key) or "") if named else "", message, now)
            for robot, key, message in received
        )

    def get(self, timeout_s: float | None = None) -> ReceivedMessage | None:
        """The next message; None if none arrives within ``timeout_s`` (None: for ever), or after the end.

        Raises Closed if the session is closed.
        """
        return self._unread.take(timeout_s)

    def __iter__(self) -> Iterator[ReceivedMessage]:
        return iter(self._unread)

    def __aiter__(self) -> AsyncIterator[ReceivedMessage]:
        return aiter(self._unread)

    def close(self) -> None:
        """Stop listening; iterations end. A second call does nothing."""
        self._opened.close()
        self._unread.close()
