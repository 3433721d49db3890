"""Writers of one robot on one wire: publishers that own their encoder, announced by liveliness tokens."""

from __future__ import annotations

import time
from collections.abc import Generator, Iterable
from contextlib import ExitStack, contextmanager, suppress
from typing import TYPE_CHECKING, TypeVar

from zstate._util.closeable import Closeable
from zstate.errors import Closed
from zstate.net.latched import LatchedPublisher
from zstate.net.presence import announce
from zstate.net.session import Session
from zstate.net.streams import KeyPublisher
from zstate.stream_registry import is_bulk, stream_named
from zstate.streams import StreamName
from zstate.wire.identity import WriterId
from zstate.wire.joint_order import SampleLayout
from zstate.wire.messages import Message
from zstate.wire.protocol import GraphNode, StreamEncoder, Wire

if TYPE_CHECKING:
    from zstate._kernel import PublishPath


W = TypeVar("W", "SampleWriter", "LatchedWriter")


class SampleWriter(KeyPublisher):
    """Publishes the samples of one stream of one writer.

    Encoding and sending are two calls, so that a message which one of several wires cannot represent is
    sent on none: encode for all of them first.
    """

    def __init__(self, session: Session, encoder: StreamEncoder, *, is_bulk: bool = False) -> None:
        super().__init__(session, encoder.key, encoder.encoding, is_bulk=is_bulk)
        self.encoder = encoder
        self.publish_path: PublishPath | None = None
        """The extension's publisher of this writer's usual samples, which counts them; None without it."""
        self._samples = self._bytes = 0
        self._attachment = encoder.attachment

    @property
    def sent(self) -> tuple[int, int]:
        """How many samples were sent, and the size of their payloads [bytes]."""
        more = (self.publish_path.samples, self.publish_path.bytes) if self.publish_path else (0, 0)
        return self._samples + more[0], self._bytes + more[1]

    def write(self, payload: bytes) -> None:
        """Send a payload of ``encoder``. Raises Closed."""
        self.put(payload, self._attachment and self._attachment(time.time_ns()))
        self._samples += 1
        self._bytes += len(payload)


class LatchedWriter(LatchedPublisher):
    """Publishes one latched value of one writer; for encoding and sending see ``SampleWriter``."""

    def __init__(self, session: Session, encoder: StreamEncoder, *, is_large: bool = False) -> None:
        super().__init__(session, encoder.key, encoder.encoding, is_large=is_large)
        self.encoder = encoder

    def write(self, payload: bytes) -> None:
        """Replace the value by a payload of ``encoder``. Raises Closed."""
        attachment = self.encoder.attachment
        self.set(payload, attachment and attachment(time.time_ns()))

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
    """One writer of ``robot`` on ``wire``: opens and announces its streams, and closes them together.

    Streams that open inside ``with writer.announced_together():`` are announced at its end, on the native
    wire by one token; others are announced when they open. Both raise AccessDenied if the router drops the
    token.
    """

    def __init__(
        self,
        session: Session,
        wire: Wire,
        robot: str,
        writer: WriterId,
        sample_names: SampleLayout | None = None,
    ) -> None:
        self._session = session
        self.wire = wire
        names = sample_names or SampleLayout()
        number = session.node_number(robot, writer.program, is_writer=True)
        self._node = GraphNode(robot, writer, session.zid, number, names)
        self._is_permitted = wire.name == "ros2dds"  # the permissions of these are the bridges' own
        self._opened = ExitStack()
        self._waiting: list[str] | None = None
        """The tokens of streams that will be announced together."""
        token = wire.node_token(self._node)
        if token is not None:
            self._opened.enter_context(announce(session, token))

    def open_stream(self, stream: StreamName, name: str = "") -> SampleWriter:
        """Open and announce ``stream``; edges under ``name``."""
        encoder = self._encoder(stream, name)
        return self._announced(SampleWriter(self._session, encoder, is_bulk=is_bulk(stream)))

    def open_latched(self, stream: StreamName, name: str = "") -> LatchedWriter:
        """Open and announce ``stream`` for a latched value; static edges under ``name``."""
        encoder = self._encoder(stream, name)
        return self._announced(
            LatchedWriter(self._session, encoder, is_large=stream_named(stream).group == "measurement")
        )

    def _encoder(self, stream: StreamName, name: str = "") -> StreamEncoder:
        return self.wire.stream_encoder(self._node, stream, self._session.next_number(), name)

    def _announced(self, writer: W) -> W:
        self._opened.enter_context(writer)
        token = writer.encoder.token
        if token is not None and self._waiting is not None:
            self._waiting.append(token)
        elif token is not None:
            self._announce(token)
        return writer

    @contextmanager
    def announced_together(self) -> Generator[None]:
        """Announce the streams that open in this block at its end."""
        self._waiting = tokens = []
        yield
        self._waiting = None
        for token in self.wire.joined_tokens(tokens):
            self._announce(token)

    def _announce(self, token: str) -> None:
        self._opened.enter_context(announce(self._session, token))
        if not self._is_permitted and self._session.probe is not None:
            from zstate.net.security.write_permission import check_may_write  # noqa: PLC0415 - see there

            # One check is enough: all streams of a robot have the same permissions.
            check_may_write(self._session, self._node.robot, token)
            self._is_permitted = True

    def close(self) -> None:
        """Close all streams and withdraw their tokens. A second call does nothing."""
        self._opened.close()
