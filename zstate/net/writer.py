"""Writers of one robot on one wire: publishers that own their encoder, announced by liveliness tokens."""

from __future__ import annotations

import time
from collections.abc import Iterable
from contextlib import ExitStack, suppress

from zstate._util.closeable import Closeable
from zstate.errors import Closed
from zstate.net.latched import LatchedPublisher
from zstate.net.presence import announce
from zstate.net.security.write_permission import check_may_write
from zstate.net.session import Session
from zstate.net.streams import StreamPublisher
from zstate.wire.identity import WriterId
from zstate.wire.joint_order import SampleLayout
from zstate.wire.keys import Stream
from zstate.wire.messages import Message
from zstate.wire.protocol import StreamEncoder, Wire, WriterNode


class SampleWriter(StreamPublisher):
    """Publishes the samples of one stream of one writer.

    Encoding and sending are two calls, so that a message which one of several wires cannot represent is
    sent on none: encode for all of them first. ``samples`` and ``bytes`` count what was sent.
    """

    def __init__(self, session: Session, encoder: StreamEncoder) -> None:
        super().__init__(session, encoder.key, encoder.encoding)
        self.encoder = encoder
        self.samples = 0
        self.bytes = 0

    def write(self, payload: bytes) -> None:
        """Send a payload of ``encoder``. Raises Closed."""
        self.put(payload, self.encoder.attachment(time.time_ns()))
        self.samples += 1
        self.bytes += len(payload)


class LatchedWriter(LatchedPublisher):
    """Publishes one latched value of one writer; for encoding and sending see ``SampleWriter``."""

    def __init__(self, session: Session, encoder: StreamEncoder) -> None:
        super().__init__(session, encoder.key, encoder.encoding)
        self.encoder = encoder

    def write(self, payload: bytes) -> None:
        """Replace the value by a payload of ``encoder``. Raises Closed."""
        self.set(payload, self.encoder.attachment(time.time_ns()))

    def withdraw(self) -> None:
        """Withdraw the value, if the wire format can. Does nothing once the session is closed."""
        # A closed session has undeclared everything already.
        with suppress(Closed):
            if self.encoder.can_withdraw:
                super().withdraw()


def write_all(writers: Iterable[SampleWriter | LatchedWriter], message: Message) -> None:
    """Encode ``message`` for each of ``writers``, then send it. Raises InvalidInput and Closed."""
    payloads = [(writer, writer.encoder.encode(message)) for writer in writers]
    for writer, payload in payloads:
        writer.write(payload)


class WireWriter(Closeable):
    """One writer of ``robot`` on ``wire``: opens and announces its streams, and closes them together."""

    def __init__(
        self,
        session: Session,
        wire: Wire,
        robot: str,
        writer: WriterId,
        sample_names: SampleLayout | None = None,
    ) -> None:
        self._session = session
        self._wire = wire
        names = sample_names or SampleLayout()
        self._node = WriterNode(robot, writer, session.zid, session.next_number(), names)
        self._is_permitted = wire.name == "ros2dds"  # the permissions of these are the bridges' own
        self._opened = ExitStack()
        token = wire.node_token(self._node)
        if token is not None:
            self._opened.enter_context(announce(session, token))

    def open_stream(self, stream: Stream) -> SampleWriter:
        """Open and announce ``stream``. Raises AccessDenied if the router drops what it writes."""
        writer = SampleWriter(self._session, self._encoder(stream))
        self._announce(writer)
        return writer

    def open_latched(self, stream: Stream, name: str = "") -> LatchedWriter:
        """Open and announce ``stream`` for a latched value; static edges under ``name``. Raises as above."""
        writer = LatchedWriter(self._session, self._encoder(stream, name))
        self._announce(writer)
        return writer

    def _encoder(self, stream: Stream, name: str = "") -> StreamEncoder:
        return self._wire.stream_encoder(self._node, stream, self._session.next_number(), name)

    def _announce(self, writer: SampleWriter | LatchedWriter) -> None:
        self._opened.enter_context(writer)
        token = writer.encoder.token
        if token is None:
            return
        self._opened.enter_context(announce(self._session, token))
        if not self._is_permitted:
            # One check is enough: all streams of a robot have the same permissions.
            check_may_write(self._session, self._node.robot, token)
            self._is_permitted = True

    def close(self) -> None:
        """Close all streams and withdraw their tokens. A second call does nothing."""
        self._opened.close()
