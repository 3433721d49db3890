"""History on join: the samples of the last seconds, for listeners that start later.

A writer caches its last samples, and replies to a query on the key of the stream page by page, the newest
first::

    zstate/<robot>/joint_states?session=<session>;before=<seq>

The reply is one ``HistoryPage`` of at most 32 kB; without ``before`` it is the newest, without ``session``
that of any writer. A reader requests the next page when it has one, so at most one page is in flight to it.
That fits into the queues on the way, and no live sample waits behind it. Page by page its history grows
backwards from the present, at no moment with a gap.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, NamedTuple

import zenoh

from zstate.clock import SET_BACK_NS
from zstate.errors import InvalidInput, MessageError
from zstate.extension import kernel
from zstate.net.queryable import Queryable, Reply
from zstate.net.requests import ReplyHandler, Request
from zstate.net.session import Session
from zstate.net.streams import to_serialized
from zstate.streams import StreamName
from zstate.wire.keys import stream_key
from zstate.wire.messages import HistoryPage
from zstate.wire.native import decode, encode, encoding_of, stream_encoding
from zstate.wire.protocol import SerializedSample

PAGE_BYTES = 32_000
PAGE_SAMPLES = 256
"""Limit for a page of small samples: a page takes well below a millisecond to make."""

MAX_CACHE_BYTES = 8_000_000
TIMEOUTS_S = (0.25, 0.5, 1.0)
"""Time for a page; a writer that exceeds it three times in a row gets no more requests."""

RETRY_DELAY_S = 0.05
MAX_ATTEMPTS = 5
"""Requests for a page without a reply, with growing delays: 1.5 s in all."""

MAX_PAGE_BYTES = 524_288
"""A longer page is refused: one has at most 32 kB, or a single sample."""

_OVERHEAD = 300
"""Size of a cached sample without its numbers [bytes]."""

MAX_IN_FLIGHT = 4
"""Requests for pages that a reader sends at the same time."""

_MAX_PAGES = 4096


class CachedSample(NamedTuple):
    """A sample as published on the native wire, with its stamp [ns] and sequence number."""

    stamp: int
    seq: int
    payload: bytes


if TYPE_CHECKING or kernel == "c":
    from zstate._kernel import SampleRing
else:
    from zstate.net.reference_ring import ReferenceRing as SampleRing


class SampleCache:
    """The samples of the session ``writer``: the last ``span_s`` seconds before the newest, by their stamps.

    Holds at most 8 MB, with ``numbers`` numbers in each sample. One thread at a time appends; any reads.
    """

    def __init__(self, span_s: float, numbers: int, writer: int) -> None:
        if not 0.0 < span_s < 1e9:
            raise InvalidInput(f"cache_s is a number of seconds, 0 for no cache; not {span_s!r}")
        self.span_s = span_s
        self.writer = writer
        capacity = MAX_CACHE_BYTES // (8 * numbers + _OVERHEAD)
        self.ring = SampleRing(capacity, round(span_s * 1e9), SET_BACK_NS)
        self.append = self.ring.append

    def since(self, seq: int) -> list[CachedSample]:
        """The cached samples from ``seq`` on."""
        samples = self.ring.samples()
        first = seq - samples[0][1] if samples else 0
        return [CachedSample(*sample) for sample in samples[max(0, first) :]]

    def before(self, seq: int | None, count: int) -> tuple[list[CachedSample], bool]:
        """The last ``count`` samples before ``seq``, or the newest, and whether there are older ones."""
        samples = self.ring.samples()
        if not samples:
            return [], False
        stop = len(samples) if seq is None else min(max(0, seq - samples[0][1]), len(samples))
        first = max(0, stop - count)
        return [CachedSample(*sample) for sample in samples[first:stop]], first > 0


def serve_history(
    session: Session,
    robot: str,
    stream: StreamName,
    cache: SampleCache,
    convert: Callable[[bytes], bytes] | None = None,
    *,
    writer: str = "",
) -> Queryable:
    """Reply on the key of ``stream`` with the samples in ``cache``, in the encoding of the stream.

    ``convert`` makes a payload of the stream of a cached one, if they differ. ``writer`` is the name in the
    key of a named stream.
    """
    encoding = stream_encoding(stream)

    def answer(parameters: Mapping[str, str]) -> Reply | None:
        if parameters.get("session", str(cache.writer)) != str(cache.writer):
            return None  # the query is for another writer of this key
        before = parameters.get("before", "")
        is_count = before.isascii() and before.isdecimal() and len(before) <= 19
        cached, more = cache.before(int(before) if is_count else None, PAGE_SAMPLES)
        samples: list[bytes] = []  # newest first, as many as fit into a page, at least one if there is any
        room = PAGE_BYTES
        for sample in reversed(cached):
            samples.append(sample.payload if convert is None else convert(sample.payload))
            room -= len(samples[-1])
            if room < len(samples[-1]):
                break
        is_all = not more and len(samples) == len(cached)
        next_before = None if is_all else cached[-len(samples)].seq
        page = HistoryPage(encoding, tuple(reversed(samples)), next_before)
        return Reply(encode(page), encoding_of(HistoryPage))

    return Queryable(session, stream_key(robot, stream, writer), answer)


class HistoryRequest(Request):
    """Requests the cached samples on ``key`` from the session ``writer``, page by page from the newest.

    ``on_page(samples, writer)`` is called in the thread of the requests; the samples of a page are oldest
    first. It returns whether to request older ones. A request without a reply is repeated a few times; a page
    that cannot be decoded goes to ``on_error``. ``on_done()`` is called once no more requests follow.
    """

    def __init__(
        self,
        key: str,
        writer: int,
        on_page: Callable[[list[SerializedSample], int], bool],
        on_error: Callable[[str, MessageError], None],
        on_done: Callable[[], object] = lambda: None,
    ) -> None:
        self._on_done = on_done
        self.source = self._key = key
        self._writer = writer
        self._on_page = on_page
        self._on_error = on_error
        self._before: int | None = None
        self._pages = self._attempts = self._timeouts = 0
        self._reply: zenoh.Sample | None = None

    def send(self, session: zenoh.Session, handler: ReplyHandler) -> None:
        selector = f"{self._key}?session={self._writer}"
        if self._before is not None:
            selector += f";before={self._before}"
        self._reply = None
        session.get(
            selector,
            handler,
            timeout=TIMEOUTS_S[self._timeouts],
            consolidation=zenoh.ConsolidationMode.NONE,
            # Replies have the priority of their queries: behind live samples, and dropped under congestion.
            priority=zenoh.Priority.DATA_LOW,
            congestion_control=zenoh.CongestionControl.DROP,
        )

    def on_reply(self, reply: zenoh.Reply) -> None:
        # The first is the page. More of them, or on another key, were not requested.
        if self._reply is None and reply.ok is not None and str(reply.ok.key_expr) == self._key:
            self._reply = reply.ok

    def on_end(self) -> float | None:
        delay_s = self._on_page_end()
        if delay_s is None:
            self._on_done()
        return delay_s

    def _on_page_end(self) -> float | None:
        if self._reply is None:
            # The token of a new writer may be known before its queryable; or a page was lost.
            self._attempts += 1
            self._timeouts += self.duration_s > 0.9 * TIMEOUTS_S[self._timeouts]
            is_last = self._attempts >= MAX_ATTEMPTS or self._timeouts >= len(TIMEOUTS_S)
            return None if is_last else RETRY_DELAY_S * 2**self._attempts
        self._attempts = self._timeouts = 0
        received = to_serialized(self._reply, self._key)
        if len(received.payload) > MAX_PAGE_BYTES:
            text = f"a page of {len(received.payload)} bytes, more than {MAX_PAGE_BYTES}"
            self._on_error(received.key, MessageError(text, reason="too large"))
            return None
        try:
            page = decode(received.payload, received.encoding, HistoryPage)
        except MessageError as error:
            self._on_error(received.key, error)
            return None
        samples = [SerializedSample(received.key, sample, page.encoding) for sample in page.samples]
        wants_more = bool(samples) and self._on_page(samples, self._writer)
        self._pages += 1
        goes_back = page.before is not None and (self._before is None or page.before < self._before)
        self._before = page.before
        return 0.0 if wants_more and goes_back and self._pages < _MAX_PAGES else None
