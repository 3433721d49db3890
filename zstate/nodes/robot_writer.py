"""One writer of a robot: what its publisher opens, in one place, and the way of its samples to all wires.

Each publisher has a ``RobotWriter``, and makes the messages.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any
from urllib.parse import quote

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate.clock import SYSTEM, Clock
from zstate.errors import Closed, InvalidInput, SecondWriter
from zstate.net.clock_service import ClockService
from zstate.net.ownership import WriterClaim
from zstate.net.presence import local_writer
from zstate.net.sample_history import SampleCache, serve_history
from zstate.net.session import Session
from zstate.net.status import StatusPublisher
from zstate.net.writer import LatchedWriter, SampleWriter, WireWriter
from zstate.nodes.publisher_status import PublisherStats, StatusReporter
from zstate.streams import StampedMessage, StreamName
from zstate.wire.identity import Announcement
from zstate.wire.joint_order import SampleLayout
from zstate.wire.keys import MODEL_WRITER, check_robot, check_writer
from zstate.wire.messages import Message
from zstate.wire.registry import as_wire_names, get_wire

_NEWEST_ONLY_S = 1e-9
"""Span of a cache that has no room for a second sample."""


class RobotWriter(Closeable):
    """One writer of ``robot`` on ``wires``: identity, ownership, clock, streams, status, cache and history.

    A new one has opened nothing. Its publisher opens what it needs inside ``with writer.opening():``, in the
    order in which others may see it, and ``close`` closes it in the reverse order. Ownership, clock, status,
    cache and history belong to the native wire; without it their methods do nothing. ``clock`` stamps the
    samples, which are numbered from 0 on in the session ``session_id``. ``lock`` is held while one is sent.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        wires: str | Sequence[str],
        program: str = "",
        clock: Clock | None = None,
    ) -> None:
        self.session = session
        self.robot = check_robot(robot)
        self.wires = as_wire_names(wires)
        self.is_native = "native" in self.wires
        self.identity = local_writer(secrets.randbits(32), program)
        self.session_id = self.identity.session
        self.title = f"the publisher of {robot!r}"
        """What it belongs to, for the text of Closed."""
        self.claim: WriterClaim | None = None
        self.checks: list[Callable[[], object]] = []
        """Each raises SecondWriter if another writer owns what this one publishes."""
        self.streams: dict[tuple[str, StreamName], SampleWriter] = {}
        """The streams of samples, by wire and stream."""
        self.cache: SampleCache | None = None
        self.seq = 0
        """The number of the next sample."""
        self.lock = fork_safe_lock()
        self.opened = ExitStack()
        """What is closed with this writer."""
        self.is_closed = False
        self._clock = clock
        self._wire_writers: dict[str, WireWriter] = {}
        self._native: SampleWriter | None = None
        self._encode: dict[SampleWriter, Callable[[Any], bytes]] = {}
        self._second_writer: SecondWriter | None = None

    def announcement(self, stream: StreamName, name: str = "") -> Announcement:
        """The content of the token of ``stream``, under ``name`` if its writers have names."""
        return Announcement(self.robot, stream, self.identity, name)

    @contextmanager
    def opening(self) -> Generator[None]:
        """Close all that is open if this block raises."""
        try:
            yield
        except BaseException:
            self.opened.close()
            raise

    def own(self, claimed: Sequence[Announcement]) -> None:
        """Own ``claimed``, if any, and reply to readers that measure the clock, unless it is simulated.

        Called before the writer is announced: readers that see its token measure its clock at once. Raises
        SecondWriter.
        """
        if not self.is_native:
            return
        if claimed:
            self.claim = self.opened.enter_context(WriterClaim(self.session, claimed))
            self.checks.append(self.claim.check)
        if self._clock is not None and self._clock.domain == SYSTEM:
            self.opened.enter_context(ClockService(self.session, self.robot, self.identity, self._clock))

    def open_wires(self, sample_names: SampleLayout | None = None) -> dict[str, WireWriter]:
        """Become a writer on each wire, by its name. Their streams are announced when they open."""
        for name in self.wires:
            writer = WireWriter(self.session, get_wire(name), self.robot, self.identity, sample_names)
            self._wire_writers[name] = self.opened.enter_context(writer)
        return self._wire_writers

    def open_stream(
        self,
        wire: str,
        stream: StreamName,
        name: str = "",
        convert: Callable[[Any], Message] | None = None,
    ) -> None:
        """Open and announce ``stream`` on ``wire``, under ``name`` if its writers have names.

        ``convert`` makes the message of this stream from a sample, if they differ.
        """
        writer = self.streams[wire, stream] = self._wire_writers[wire].open_stream(stream, name)
        encode = writer.encoder.encode
        self._encode[writer] = encode if convert is None else lambda sample: encode(convert(sample))
        if wire == "native":
            self._native = writer

    def report_status(self, stats: Callable[[], PublisherStats]) -> None:
        """Publish the status that follows from ``stats()`` once a second, while it has a reader."""
        if self.is_native:
            status = StatusReporter(self.identity, stats).status
            publisher = StatusPublisher(self.session, self.robot, self.identity.identity, status)
            self.opened.enter_context(publisher)

    def open_cache(self, cache_s: float, numbers: int) -> None:
        """Cache the samples of the last ``cache_s`` seconds, or the newest for 0, of ``numbers`` numbers."""
        if self.is_native:
            self.cache = SampleCache(cache_s or _NEWEST_ONLY_S, numbers, self.session_id)

    def serve_history(
        self, stream: StreamName, name: str = "", convert: Callable[[bytes], bytes] | None = None
    ) -> None:
        """Reply on ``stream`` with the cached samples; ``convert`` as in ``zstate.net.sample_history``."""
        if self.cache is not None:
            service = serve_history(self.session, self.robot, stream, self.cache, convert, writer=name)
            self.opened.enter_context(service)

    def check_open(self) -> None:
        """Raise Closed if this writer or its session is closed."""
        if self.is_closed:
            raise Closed(f"{self.title} is closed")
        self.session.check()

    def check(self) -> None:
        """Raise Closed, and SecondWriter (sticky) if an older writer owns the same: then all is closed.

        Called with the lock.
        """
        if self.is_closed or not self.session.is_usable:
            self.check_open()
        if self._second_writer is None:
            try:
                for check in self.checks:
                    check()
            except SecondWriter as error:
                self._second_writer = error
                self.opened.close()
        if self._second_writer is not None:
            raise self._second_writer.with_traceback(None)

    def send(self, sample: StampedMessage) -> None:
        """Publish ``sample``, whose number is ``seq``, on all wires or on none.

        Called after ``check``, with the lock. Raises Closed, and InvalidInput if a wire cannot represent it.
        """
        # Encode for all wires before sending on any: a wire may be unable to represent the stamp.
        payloads = {writer: encode(sample) for writer, encode in self._encode.items()}
        native = None if self._native is None else payloads[self._native]
        self.write(sample.stamp, native, payloads.items())

    def write(self, stamp: int, native: bytes | None, payloads: Iterable[tuple[SampleWriter, bytes]]) -> None:
        """Cache ``native``, the payload of the next sample, and send its ``payloads``; as ``send``."""
        if self.cache is not None and native is not None:
            # Before sending: a reader that misses this sample can then request it as history.
            self.cache.append(stamp, self.seq, native)
        self.seq += 1
        for writer, payload in payloads:
            writer.write(payload)

    def close(self, withdrawn: Iterable[LatchedWriter] = ()) -> None:
        """Withdraw the ``withdrawn`` values, and close all. A second call does nothing."""
        self.is_closed = True
        with self.lock:
            for latched in withdrawn:
                latched.withdraw()
            self.opened.close()

    def edge_writer_name(self, writer: str | None) -> str:
        """The name under which this one publishes edges: ``writer``, or its own. Raises InvalidInput."""
        if writer is None:
            # A script name may have blanks, which a key cannot.
            identity = self.identity
            writer = f"{quote(identity.program, safe='')}.{identity.pid}.{identity.session:08x}"
        if check_writer(writer) == MODEL_WRITER:
            raise InvalidInput(f"the writer name {MODEL_WRITER!r} belongs to the robot's own model")
        return writer
