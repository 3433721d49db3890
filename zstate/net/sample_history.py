"""History on join: what a writer said in the last seconds, for whoever begins to listen.

A writer remembers its last samples, and answers a query on the key of the stream, page by page, the
newest first::

    zstate/<robot>/joint_states?session=<session>;before=<seq>

The answer is one ``HistoryPage`` of at most 32 kB; without ``before`` it is the newest, without ``session``
that of any writer. A reader asks for the next page when it has one: so no more than a page is ever under way
to it, which fits into the queues between, and no live sample of anybody waits behind it. Page by page its
history grows backwards from the present, without a gap at any moment.

Turns: the order in which the requests to many writers are sent.

A listener of all robots requests the history and the clock of each writer that is announced, a few at a
time. An announced writer need not answer: in the order of arrival a thousand silent writers of one robot
would keep those of another robot waiting for minutes.
"""

# pyright: reportUnknownMemberType=false
# zenoh's stubs leave the return types of some methods out

from __future__ import annotations

import heapq
import itertools
import queue
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from typing import Generic, TypeVar

import zenoh

from zstate._util.closeable import Closeable
from zstate.clock import SET_BACK_NS
from zstate.errors import Closed, InvalidInput, MessageError
from zstate.net.queryable import Queryable, Reply
from zstate.net.session import Session
from zstate.net.streams import JOIN_WITHIN_S, to_serialized
from zstate.wire.keys import Stream, stream_key
from zstate.wire.messages import HistoryPage, JointState
from zstate.wire.native import ENCODINGS, STREAM_TYPES, decode, encode
from zstate.wire.protocol import SerializedSample

T = TypeVar("T")


class RoundRobinQueue(Generic[T]):
    """Items of several sources, each due at a time: one item of each source in turn (round robin).

    A source with a thousand items delays those of another source by one item, not by a thousand. Adding and
    taking cost O(log n). Times are seconds of one clock. Not safe from several threads.
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
        """Have ``item`` taken at ``due_s`` or later."""
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


PAGE_BYTES = 32_000
PAGE_SAMPLES = 256
"""So many make a page where samples are small: then a page takes well below a millisecond to make."""

MAX_CACHE_BYTES = 8_000_000
TIMEOUTS_S = (0.25, 0.5, 1.0)
"""So long a writer may take for its page; one that takes longer three times in a row is not asked again."""

RETRY_DELAY_S = 0.05
MAX_ATTEMPTS = 5
"""So often a page is asked for where nothing answers yet, with longer and longer rests: 1.5 s in all."""

MAX_PAGE_BYTES = 524_288
"""A longer page is refused: one has at most 32 kB, or a single sample."""

_OVERHEAD = 300
"""What a remembered sample takes besides its numbers [bytes]."""

_IN_FLIGHT = 4
_MOST_PAGES = 4096


class SampleCache:
    """The samples of the session ``writer``: the last ``span_s`` seconds before the newest, by their stamps.

    At most as many as fit into 8 MB, ``numbers`` numbers in each. One thread at a time remembers; any
    thread may ask meanwhile.
    """

    def __init__(self, span_s: float, numbers: int, writer: int) -> None:
        if not 0.0 < span_s < 1e9:
            raise InvalidInput(f"cache_s is a number of seconds, 0 for no cache; not {span_s!r}")
        self.span_s = span_s
        self.writer = writer
        self._span_ns = round(span_s * 1e9)
        self._states: deque[JointState] = deque(maxlen=MAX_CACHE_BYTES // (8 * numbers + _OVERHEAD))
        self._newest = 0

    def append(self, state: JointState) -> None:
        """Cache ``state``, whose ``seq`` is one more than that of the last."""
        states, stamp = self._states, state.stamp
        limit = stamp - self._span_ns
        if stamp >= self._newest:
            self._newest = stamp
        elif states and stamp < self._newest - SET_BACK_NS:
            states.clear()  # the clock was set back: readers begin a new history, too
        if not states:
            self._newest = stamp
        states.append(state)
        while states[0].stamp < limit:
            states.popleft()

    def since(self, seq: int) -> list[JointState]:
        """What is remembered from the sample ``seq`` on."""
        states = self._states.copy()  # at once: the writer goes on meanwhile
        first = seq - states[0].seq if states else 0
        return list(islice(states, max(0, first), None))

    def before(self, seq: int | None, count: int) -> tuple[list[JointState], bool]:
        """The last ``count`` samples before ``seq``, or the newest, and whether there are older ones."""
        states = self._states.copy()
        if not states:
            return [], False
        end = len(states) if seq is None else min(max(0, seq - states[0].seq), len(states))
        first = max(0, end - count)
        return list(islice(states, first, end)), first > 0


def serve_history(
    session: Session, robot: str, stream: Stream, memory: SampleCache, say: Callable[[JointState], bytes]
) -> Queryable:
    """Answer on the key of ``stream`` with what ``memory`` holds, each sample as ``say`` says it there."""
    encoding = ENCODINGS[STREAM_TYPES[stream]]

    def answer(parameters: Mapping[str, str]) -> Reply | None:
        if parameters.get("session", str(memory.writer)) != str(memory.writer):
            return None  # another writer of this key is asked
        before = parameters.get("before", "")
        states, more = memory.before(int(before) if _is_count(before) else None, PAGE_SAMPLES)
        samples = _page(states, say)
        is_all = not more and len(samples) == len(states)
        past = HistoryPage(encoding, samples, None if is_all else states[-len(samples)].seq)
        return Reply(encode(past), ENCODINGS[HistoryPage])

    return Queryable(session, stream_key(robot, stream), answer)


def _page(states: Sequence[JointState], say: Callable[[JointState], bytes]) -> tuple[bytes, ...]:
    """The newest of ``states`` as they are said, as many as fit into a page, at least one if there is any."""
    samples: list[bytes] = []
    room = PAGE_BYTES
    for state in reversed(states):
        samples.append(say(state))
        room -= len(samples[-1])
        if room < len(samples[-1]):
            break
    return tuple(reversed(samples))


def _history_request(page: SerializedSample) -> HistoryPage:
    if len(page.payload) > MAX_PAGE_BYTES:
        text = f"a page of {len(page.payload)} bytes, more than {MAX_PAGE_BYTES}"
        raise MessageError(text, reason="too large")
    return decode(page.payload, page.encoding, HistoryPage)


def _is_count(text: str) -> bool:
    return text.isascii() and text.isdecimal() and len(text) <= 19


@dataclass(eq=False)
class _Request:
    """One writer who is asked, and how far that has come."""

    key: str
    writer: int
    before: int | None = None
    pages: int = 0
    tries: int = 0
    timeouts: int = 0
    sent_s: float = 0.0
    page: zenoh.Sample | None = None


class HistoryReader(Closeable):
    """Asks writers what they said before, all of them from one thread.

    ``on_page(arrivals, writer)`` is called from that thread, page by page from the newest to the oldest; the
    arrivals of a page are oldest first, and ``writer`` is the session that was asked. It says whether older
    ones are wanted. Who does not answer is asked a few times more; a page that cannot be read goes to
    ``on_error``. Each key has its turn, so that many silent writers of one robot do not delay those of
    another. An exception of ``on_page`` ends the asking of that writer, and goes to
    ``threading.excepthook``, the first of all.
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
        self._waiting: RoundRobinQueue[_Request] = RoundRobinQueue()
        self._in_flight = 0
        self._failures = 0
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="zstate past", daemon=True)
        self._thread.start()

    def ask(self, key: str, writer: int) -> None:
        """Ask the writer whose session that is for what it said on ``key``. Returns at once."""
        self._events.put((_Request(key, writer), False))

    def _run(self) -> None:
        while not self._closed:
            with suppress(queue.Empty):
                event = self._events.get(timeout=self._pause())
                if event is not None:
                    self._receive(*event)
            self._send_due()

    def _receive(self, asked: _Request, is_over: bool) -> None:
        if not is_over:
            self._waiting.add(asked.key, asked)
            return
        self._in_flight -= 1
        try:
            due_s = self._hand_over(asked)
        except Exception:
            self._failures += 1
            if self._failures == 1:
                threading.excepthook(threading.ExceptHookArgs((*sys.exc_info(), self._thread)))
        else:
            if due_s is not None:
                self._waiting.add(asked.key, asked, due_s)

    def _pause(self) -> float | None:
        """How long [s] nothing is to be done but to wait for events; None is for ever."""
        now_s = time.monotonic()
        next_s = self._waiting.next_s(now_s)
        return None if next_s is None or self._in_flight >= _IN_FLIGHT else next_s - now_s

    def _send_due(self) -> None:
        now_s = time.monotonic()
        while self._in_flight < _IN_FLIGHT and not self._closed:
            asked = self._waiting.pop(now_s)
            if asked is None:
                return
            self._send(asked)

    def _send(self, asked: _Request) -> None:
        selector = f"{asked.key}?session={asked.writer}"
        if asked.before is not None:
            selector += f";before={asked.before}"
        asked.page, asked.sent_s = None, time.monotonic()
        try:
            self._get(selector, asked)
            self._in_flight += 1
        except (zenoh.ZError, Closed):
            self._closed = True  # with the session

    def _get(self, selector: str, asked: _Request) -> None:
        def take(reply: zenoh.Reply) -> None:
            # The first is the page. More of them, or on another key, nobody has asked for.
            if asked.page is None and reply.ok is not None and str(reply.ok.key_expr) == asked.key:
                asked.page = reply.ok

        # Called in a thread of Zenoh's, which this and a queue do not hold up.
        handler = zenoh.handlers.Callback(take, lambda: self._events.put((asked, True)), indirect=False)
        self._session.zenoh.get(
            selector,
            handler,
            timeout=TIMEOUTS_S[asked.timeouts],
            consolidation=zenoh.ConsolidationMode.NONE,
            # Replies travel as their queries do: behind all that is live, and sooner lost than waited for.
            priority=zenoh.Priority.DATA_LOW,
            congestion_control=zenoh.CongestionControl.DROP,
        )

    def _hand_over(self, asked: _Request) -> float | None:
        """When [s] there is something more to ask for; None for never."""
        if asked.page is None:
            return self._try_again_at(asked)
        asked.tries = asked.timeouts = 0
        page = to_serialized(asked.page, asked.key)
        asked.page = None
        try:
            past = _history_request(page)
        except MessageError as error:
            self._on_error(page.key, error)
            return None
        arrivals = [SerializedSample(page.key, sample, past.encoding) for sample in past.samples]
        is_wanted = bool(arrivals) and self._on_page(arrivals, asked.writer)
        asked.pages += 1
        goes_back = past.before is not None and (asked.before is None or past.before < asked.before)
        asked.before = past.before
        return 0.0 if is_wanted and goes_back and asked.pages < _MOST_PAGES else None

    @staticmethod
    def _try_again_at(asked: _Request) -> float | None:
        # The token of a writer just met may be known before what answers there; or a page was lost.
        now_s = time.monotonic()
        asked.tries += 1
        asked.timeouts += now_s - asked.sent_s > 0.9 * TIMEOUTS_S[asked.timeouts]
        if asked.tries >= MAX_ATTEMPTS or asked.timeouts >= len(TIMEOUTS_S):
            return None
        return now_s + RETRY_DELAY_S * 2**asked.tries

    def close(self) -> None:
        """Stop asking, within a second. A second call does nothing."""
        self._closed = True
        self._events.put(None)
        if threading.current_thread() is not self._thread:
            self._thread.join(JOIN_WITHIN_S)
