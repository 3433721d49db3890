"""Outlets: all that one writer puts on one wire, announced to everybody."""

from __future__ import annotations

import time
from contextlib import ExitStack, suppress

from zstate.closing import Closing
from zstate.errors import Closed
from zstate.net.latched import LatchedPublisher
from zstate.net.permission import check_may_write
from zstate.net.presence import announce
from zstate.net.session import Session
from zstate.net.streams import StreamPublisher
from zstate.wire.keys import Stream
from zstate.wire.messages import Message
from zstate.wire.sample_names import SampleNames
from zstate.wire.wire import Outlet, Place, Wire
from zstate.wire.writer import Writer


class Outlets(Closing):
    """One writer of ``robot`` on ``wire``: opens its streams and latched values, closes them together."""

    def __init__(
        self,
        session: Session,
        wire: Wire,
        robot: str,
        writer: Writer,
        sample_names: SampleNames | None = None,
    ) -> None:
        self._session = session
        place = Place(session.zid, session.next_number())
        self._voice = wire.voice(robot, writer, place, sample_names or SampleNames())
        self._robot = robot
        self._is_permitted = wire.name == "ros2dds"  # what bridges are permitted, theirs have to say
        self._opened = ExitStack()
        if self._voice.token is not None:
            self._opened.enter_context(announce(session, self._voice.token))

    def stream(self, stream: Stream) -> StreamOutlet:
        """Open ``stream`` for samples, and announce it."""
        outlet = self._voice.outlet(stream, self._session.next_number())
        publisher = StreamPublisher(self._session, outlet.key, outlet.encoding)
        self._open(publisher, outlet)
        return StreamOutlet(outlet, publisher)

    def latched(self, stream: Stream, name: str = "") -> LatchedOutlet:
        """Open ``stream`` for a value that late joiners receive too, and announce it."""
        outlet = self._voice.outlet(stream, self._session.next_number(), name)
        publisher = LatchedPublisher(self._session, outlet.key, outlet.encoding)
        self._open(publisher, outlet)
        return LatchedOutlet(outlet, publisher)

    def _open(self, publisher: Closing, outlet: Outlet) -> None:
        self._opened.enter_context(publisher)
        if outlet.token is not None:
            self._opened.enter_context(announce(self._session, outlet.token))
            self._check_permission(outlet.token)

    def _check_permission(self, token: str) -> None:
        # One stands for all: they are of the same robot.
        if not self._is_permitted:
            check_may_write(self._session, self._robot, token)
            self._is_permitted = True

    def close(self) -> None:
        """Withdraw from all of it. A second call does nothing."""
        self._opened.close()


class StreamOutlet:
    """One stream of one writer. ``samples`` and ``bytes`` count what was put."""

    def __init__(self, outlet: Outlet, publisher: StreamPublisher) -> None:
        self._outlet = outlet
        self._publisher = publisher
        self.encode = outlet.encode
        self.samples = 0
        self.bytes = 0

    @property
    def has_readers(self) -> bool:
        """Whether anybody subscribes now."""
        return self._publisher.has_readers

    def put(self, payload: bytes) -> None:
        """Send what ``encode`` made of a message. Raises Closed."""
        self._publisher.put(payload, self._outlet.attachment(time.time_ns()))
        self.samples += 1
        self.bytes += len(payload)


class LatchedOutlet:
    """One latched value of one writer."""

    def __init__(self, outlet: Outlet, publisher: LatchedPublisher) -> None:
        self._outlet = outlet
        self._publisher = publisher
        self.encode = outlet.encode

    def put(self, payload: bytes) -> None:
        """Replace the value, for everybody, by what ``encode`` made of a message. Raises Closed."""
        self._publisher.set(payload, self._outlet.attachment(time.time_ns()))

    def set(self, message: Message) -> None:
        """Replace the value, for everybody. Raises Closed."""
        self.put(self.encode(message))

    def withdraw(self) -> None:
        """Take the value back, from everybody, where the wire can say that."""
        # If the session went first, everything declared on it went with it.
        with suppress(Closed):
            if self._outlet.can_withdraw:
                self._publisher.withdraw()
