"""History on join: the samples of the last seconds, for listeners that start later.

A writer caches its last samples, and replies to a query on the key of the stream page by page, the newest
first::

    zstate/<robot>/joint_states?session=<session>;before=<seq>

The reply is one ``HistoryPage`` of at most 32 kB; without ``before`` it is the newest, without ``session``
that of any writer. A reader requests the next page when it has one, so at most one page is in flight to it.
That fits into the queues on the way, and no live sample waits behind it. Page by page its history grows
backwards from the present, at no moment with a gap.

A listener of all robots requests the history and the clock of each announced writer, a few at a time. An
announced writer may never reply: in the order of arrival a thousand silent writers of one robot would delay
those of another robot by minutes. So robots take turns.
"""

from __future__ import annotations

import heapq
import itertools
import queue
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, NamedTuple, TypeVar

import zenoh

from zstate._util.closeable import Closeable
from zstate.clock import SET_BACK_NS
from zstate.errors import Closed, InvalidInput, MessageError
from zstate.extension import kernel
from zstate.net.queryable import Queryable, Reply
from zstate.net.session import Session
from zstate.net.streams import JOIN_WITHIN_S, to_serialized
from zstate.streams import StreamName
from zstate.wire.keys import stream_key
from zstate.wire.messages import HistoryPage
from zstate.wire.native import decode, encode, encoding_of, stream_encoding
from zstate.wire.protocol import SerializedSample

T = TypeVar("T")

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

_MAX_IN_FLIGHT = 4
_MAX_PAGES = 4096


class RoundRobinQueue(Generic[T]):
    """Items of several sources, each due at a time: one item of each source in turn.

    A source with a thousand items delays those of another source by one item, not by a thousand. ``add`` and
    ``pop`` cost O(log n). Times are seconds of one clock. Not thread-safe.
    """

    def __init__(self) -> None:
        self._later: list[tuple[float, int, str, T]] = []
        """A heap; the number keeps the order of items that are due at the same time."""
        self._due: dict[str, deque[T]] = {}
        """By source; the first source is the next."""
        self._numbers = itertools.count()

    def __len__(self) -> int:
        return len(self._later) + sum(map(len, self._due.values()))

    def add(self, source: str, item: T, due_s: float = 0.0) -> None:
        """Add an item that ``pop`` returns at ``due_s`` or later."""
        heapq.heappush(self._later, (due_s, next(self._numbers), source, item))

    def pop(self, now_s: float) -> T | None:
        """The next item that is due; None if there is none."""
        while self._later and self._later[0][0] <= now_s:
            _, _, source, item = heapq.heappop(self._later)
            self._due.setdefault(source, deque()).append(item)
        if not self._due:
            return None
        source = next(iter(self._due))
        items = self._due.pop(source)
        item = items.popleft()
        if items:
            self._due[source] = items  # behind all other sources
        return item

    def next_s(self, now_s: float) -> float | None:
        """When the next item is due, ``now_s`` at the earliest; None if there is no item."""
        if self._due:
            return now_s
        return max(now_s, self._later[0][0]) if self._later else None

    def clear(self) -> None:
        """Drop all items."""
        self._later.clear()
        self._due.clear()


class CachedSample(NamedTuple):
    """A sample as published on the native wire, with its stamp [ns] and sequence number."""

    stamp: int
    seq: int
    payload: bytes


class ReferenceRing:
    """The last ``capacity`` samples, and of these the ones of the ``span_ns`` [ns] before the newest.

    A stamp more than ``set_back_ns`` before an earlier one means that the clock was set back: then the
    earlier samples are dropped. The reference of the kernel's ``SampleRing``.
    """

    def __init__(self, capacity: int, span_ns: int, set_back_ns: int) -> None:
        self._span_ns, self._set_back_ns = span_ns, set_back_ns
        # Plain tuples: a named one takes longer to create than all the rest of ``append``.
        self._samples: deque[tuple[int, int, bytes]] = deque(maxlen=capacity)
        self._newest = 0

    def append(self, stamp: int, seq: int, payload: bytes) -> None:
        """Add a sample, whose ``seq`` is one more than that of the last."""
        samples = self._samples
        limit = stamp - self._span_ns
        if stamp >= self._newest:
            self._newest = stamp
        elif samples and stamp < self._newest - self._set_back_ns:
            samples.clear()  # readers start a new history, too
        if not samples:
            self._newest = stamp
        samples.append((stamp, seq, payload))
        while samples[0][0] < limit:
            samples.popleft()

    def samples(self) -> list[tuple[int, int, bytes]]:
        """The samples (stamp, seq, payload), the oldest first."""
        return list(self._samples.copy())  # the copy is atomic: the writer appends at the same time


if TYPE_CHECKING or kernel == "c":
    from zstate._kernel import SampleRing
else:
    SampleRing = ReferenceRing


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


@dataclass(eq=False)
class _Request:
    """The requests to one writer, and their progress."""

    key: str
    writer: int
    before: int | None = None
    pages: int = 0
    attempts: int = 0
    timeouts: int = 0
    sent_s: float = 0.0
    reply: zenoh.Sample | None = None


class HistoryReader(Closeable):
    """Requests cached samples from writers; one worker thread serves all requests.

    ``on_page(samples, writer)`` is called from that thread, page by page from the newest to the oldest; the
    samples of a page are oldest first, and ``writer`` is the requested session. It returns whether to request
    older ones. A request without a reply is repeated a few times; a page that cannot be decoded goes
    to ``on_error``. Keys take turns, so that many silent writers of one robot do not delay those of another.
    An exception of ``on_page`` ends the requests to that writer; the first goes to ``threading.excepthook``.
    """

    def __init__(
        self,
        session: Session,
        on_page: Callable[[list[SerializedSample], int], bool],
        on_error: Callable[[str, MessageError], None],
    ) -> None:
        self._session = session
        self._on_page = on_page
        self._on_error = on_error
        self._events: queue.SimpleQueue[tuple[_Request, bool] | None] = queue.SimpleQueue()
        """New requests, and requests whose query has ended (True)."""
        self._waiting: RoundRobinQueue[_Request] = RoundRobinQueue()
        self._in_flight = 0
        self._failures = 0
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="zstate past", daemon=True)
        self._thread.start()

    def request(self, key: str, writer: int) -> None:
        """Request the cached samples of ``key`` from the writer with that session. Returns at once."""
        self._events.put((_Request(key, writer), False))

    def _run(self) -> None:
        while not self._closed:
            now_s = time.monotonic()
            next_s = self._waiting.next_s(now_s)
            pause_s = None if next_s is None or self._in_flight >= _MAX_IN_FLIGHT else next_s - now_s
            with suppress(queue.Empty):
                event = self._events.get(timeout=pause_s)
                if event is not None:
                    self._on_event(*event)
            now_s = time.monotonic()
            while self._in_flight < _MAX_IN_FLIGHT and not self._closed:
                request = self._waiting.pop(now_s)
                if request is None:
                    break
                try:
                    self._send(request)
                    self._in_flight += 1
                except (zenoh.ZError, Closed):
                    self._closed = True  # with the session

    def _on_event(self, request: _Request, has_ended: bool) -> None:
        due_s: float | None = 0.0
        if has_ended:
            self._in_flight -= 1
            try:
                due_s = self._on_reply(request)
            except Exception:
                due_s = None
                self._failures += 1
                if self._failures == 1:
                    threading.excepthook(threading.ExceptHookArgs((*sys.exc_info(), self._thread)))
        if due_s is not None:
            self._waiting.add(request.key, request, due_s)

    def _send(self, request: _Request) -> None:
        selector = f"{request.key}?session={request.writer}"
        if request.before is not None:
            selector += f";before={request.before}"
        request.reply, request.sent_s = None, time.monotonic()

        def on_reply(reply: zenoh.Reply) -> None:
            # The first is the page. More of them, or on another key, were not requested.
            if request.reply is None and reply.ok is not None and str(reply.ok.key_expr) == request.key:
                request.reply = reply.ok

        # Called in a thread of Zenoh, which these functions do not block.
        handler = zenoh.handlers.Callback(on_reply, lambda: self._events.put((request, True)), indirect=False)
        self._session.zenoh.get(
            selector,
            handler,
            timeout=TIMEOUTS_S[request.timeouts],
            consolidation=zenoh.ConsolidationMode.NONE,
            # Replies have the priority of their queries: behind live samples, and dropped under congestion.
            priority=zenoh.Priority.DATA_LOW,
            congestion_control=zenoh.CongestionControl.DROP,
        )

    def _on_reply(self, request: _Request) -> float | None:
        """Deliver the page, if there is a reply. Returns when [s] to request again; None for never."""
        if request.reply is None:
            # The token of a new writer may be known before its queryable; or a page was lost.
            now_s = time.monotonic()
            request.attempts += 1
            request.timeouts += now_s - request.sent_s > 0.9 * TIMEOUTS_S[request.timeouts]
            is_last = request.attempts >= MAX_ATTEMPTS or request.timeouts >= len(TIMEOUTS_S)
            return None if is_last else now_s + RETRY_DELAY_S * 2**request.attempts
        request.attempts = request.timeouts = 0
        received = to_serialized(request.reply, request.key)
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
        wants_more = bool(samples) and self._on_page(samples, request.writer)
        request.pages += 1
        goes_back = page.before is not None and (request.before is None or page.before < request.before)
        request.before = page.before
        return 0.0 if wants_more and goes_back and request.pages < _MAX_PAGES else None

    def close(self) -> None:
        """Stop the thread, within a second. A second call does nothing."""
        self._closed = True
        self._events.put(None)
        if threading.current_thread() is not self._thread:
            self._thread.join(JOIN_WITHIN_S)
