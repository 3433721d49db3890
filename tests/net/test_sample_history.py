"""Sample caches of writers, and history readers."""

from __future__ import annotations

import threading

import pytest
import zenoh
from helpers.processes import until
from helpers.robots import SECOND, STAMP
from hypothesis import given, settings
from hypothesis import strategies as st

from zstate.errors import InvalidInput, MessageError
from zstate.net.queryable import Queryable, Reply
from zstate.net.reference_ring import ReferenceRing
from zstate.net.requests import Requests
from zstate.net.sample_history import CachedSample, HistoryRequest, SampleCache, SampleRing, serve_history
from zstate.net.service_thread import ServiceThread
from zstate.net.session import Session
from zstate.wire.messages import HistoryPage, JointState
from zstate.wire.native import decode, encode, encoding_of
from zstate.wire.protocol import SerializedSample

KEY = "zstate/r1/joint_states"
ORDER = bytes(8)
MS = SECOND // 1000


def state(seq: int, stamp: int | None = None, session: int = 7, numbers: int = 2) -> JointState:
    return JointState(STAMP + seq * MS if stamp is None else stamp, seq, session, ORDER, bytes(8 * numbers))


def cache_of(count: int, span_s: float = 1e6, numbers: int = 2, session: int = 7) -> SampleCache:
    cache = SampleCache(span_s, numbers, session)
    for seq in range(count):
        append(cache, state(seq, session=session, numbers=numbers))
    return cache


def append(cache: SampleCache, sample: JointState) -> None:
    cache.append(sample.stamp, sample.seq, encode(sample))


def seqs(states: list[CachedSample]) -> list[int]:
    return [one.seq for one in states]


def test_cache_holds_exactly_the_span_before_the_newest():
    cache = cache_of(100, span_s=0.010)
    assert seqs(cache.since(0)) == list(range(89, 100))
    assert seqs(cache.since(97)) == [97, 98, 99]
    assert cache.since(100) == []


def test_pages_go_back_from_the_newest_sample():
    cache = cache_of(10)
    assert [(seqs(page), more) for page, more in (cache.before(None, 4), cache.before(6, 4))] == [
        ([6, 7, 8, 9], True),
        ([2, 3, 4, 5], True),
    ]
    assert [(seqs(page), more) for page, more in (cache.before(2, 4), cache.before(0, 4))] == [
        ([0, 1], False),
        ([], False),
    ]
    assert seqs(cache.before(10**15, 4)[0]) == [6, 7, 8, 9]
    assert SampleCache(1.0, 2, 7).before(None, 4) == ([], False)


def test_cache_restarts_when_the_clock_is_set_back():
    cache = cache_of(10, span_s=1.0)
    append(cache, state(10, STAMP - 3600 * SECOND))
    append(cache, state(11, STAMP - 3600 * SECOND + MS))
    assert seqs(cache.since(0)) == [10, 11]


def test_cache_restarts_when_the_clock_is_set_back_by_less_than_the_span():
    cache = cache_of(10, span_s=10.0)
    append(cache, state(10, STAMP - 5 * SECOND))
    append(cache, state(11, STAMP - 5 * SECOND + MS))
    assert seqs(cache.since(0)) == [10, 11]


def test_cache_restarts_when_the_clock_is_set_forward():
    cache = cache_of(10, span_s=1.0)
    append(cache, state(10, STAMP + 3600 * SECOND))
    assert seqs(cache.since(0)) == [10]


def test_slightly_older_stamp_keeps_the_cache():
    cache = cache_of(10, span_s=1.0)
    append(cache, state(10, STAMP - 85_000))
    assert seqs(cache.since(0)) == list(range(11))


def test_cache_size_is_bounded_for_any_stamps():
    cache = SampleCache(1e6, 100_000, 7)
    for seq in range(100):
        append(cache, state(seq, STAMP, numbers=1))
    kept = seqs(cache.since(0))
    assert kept == list(range(100 - len(kept), 100))
    assert len(kept) == 9  # of 800 kB of numbers, and their headers: ten exceed 8 MB


@settings(deadline=None)
@given(
    st.integers(1, 90),
    st.integers(0, 200),
    st.integers(0, 50),
    st.lists(st.integers(-300, 300) | st.integers(-(2**63), 2**63 - 1), max_size=200),
)
def test_the_ring_of_the_kernel_holds_what_the_reference_holds(capacity, span_ns, set_back_ns, stamps):
    ring, reference = (kind(capacity, span_ns, set_back_ns) for kind in (SampleRing, ReferenceRing))
    for seq, stamp in enumerate(stamps):
        for one in (ring, reference):
            one.append(stamp, seq, encode(state(seq)))
        assert ring.samples() == reference.samples()


@pytest.mark.parametrize("span_s", [-1.0, 0.0, float("nan"), float("inf")])
def test_invalid_span_is_refused(span_s: float):
    with pytest.raises(InvalidInput, match="cache_s"):
        SampleCache(span_s, 2, 7)


class Pages:
    """The received pages and errors."""

    def __init__(self, session: Session, limit: int = 1000) -> None:
        self.pages: list[list[SerializedSample]] = []
        self.errors: list[MessageError] = []
        self._most = limit
        self.thread = ServiceThread(session, "requests")
        self.requests = Requests(session, self.thread, 4)

    def request(self, key: str, writer: int) -> None:
        self.requests.add(
            HistoryRequest(key, writer, self._on_page, lambda _, error: self.errors.append(error))
        )

    def _on_page(self, arrivals: list[SerializedSample], writer: int) -> bool:
        self.pages.append(arrivals)
        return len(self.pages) < self._most

    def seqs(self) -> list[list[int]]:
        return [
            [decode(one.payload, one.encoding, JointState).seq for one in page] for page in list(self.pages)
        ]


def wait_for_queryable(session: Session) -> None:
    until(lambda: any(reply.ok for reply in session.zenoh.get(KEY, timeout=5.0)))


def test_reader_receives_every_sample_as_sent_newest_page_first(sessions: tuple[Session, Session]):
    writer, reader = sessions
    cache = cache_of(256 + 3)
    received = Pages(reader)
    with serve_history(writer, "r1", "joint_states", cache), received.thread:
        wait_for_queryable(reader)
        received.request(KEY, 7)
        until(lambda: len(received.pages) == 2)
    assert received.seqs() == [list(range(3, 256 + 3)), [0, 1, 2]]
    assert received.pages[1] == [
        SerializedSample(KEY, encode(state(seq)), encoding_of(JointState)) for seq in range(3)
    ]


def test_page_is_small_and_has_at_least_one_sample(sessions: tuple[Session, Session]):
    writer, reader = sessions
    for numbers in (100, 10_000):
        cache = cache_of(100, numbers=numbers)
        received = Pages(reader, limit=3)
        with serve_history(writer, "r1", "joint_states", cache), received.thread:
            wait_for_queryable(reader)
            received.request(KEY, 7)
            until(lambda received=received: len(received.pages) == 3)
        sizes = [sum(len(one.payload) for one in page) for page in received.pages]
        assert all(size <= 32_000 for size in sizes) if numbers == 100 else sizes[0] > 32_000
        assert len(received.pages[0]) == (32_000 // len(received.pages[0][0].payload) or 1)
        newest_first = [seq for page in received.seqs() for seq in reversed(page)]
        assert newest_first == list(range(99, 99 - len(newest_first), -1))


def test_writer_without_samples_replies_once_with_an_empty_page(sessions):
    writer, reader = sessions
    with serve_history(writer, "r1", "joint_states", SampleCache(1.0, 2, 7)) as service:
        wait_for_queryable(reader)
        before = service.answered
        received = Pages(reader)
        with received.thread:
            received.request(KEY, 7)
            until(lambda: service.answered == before + 1)
    assert (received.pages, received.errors) == ([], [])


def test_reply_on_another_key_is_ignored(sessions: tuple[Session, Session]):
    writer, reader = sessions
    reader_ = encode(HistoryPage(encoding_of(JointState), (encode(state(0)),), None))
    asked = threading.Semaphore(0)

    def answer(query: zenoh.Query) -> None:
        query.reply("zstate/*/joint_states", reader_, encoding=encoding_of(HistoryPage))
        query.drop()
        asked.release()

    forged = writer.zenoh.declare_queryable("zstate/*/joint_states", answer)
    wait_for_queryable(reader)
    while asked.acquire(blocking=False):
        pass
    received = Pages(reader)
    with received.thread:
        received.request(KEY, 7)
        assert all(asked.acquire(timeout=5.0) for _ in range(2)), "no answer is asked for again"
    assert (received.pages, received.errors) == ([], [])
    forged.undeclare()


def test_each_writer_of_a_key_is_requested_separately(sessions: tuple[Session, Session]):
    writer, reader = sessions
    one, other = cache_of(3, session=7), cache_of(5, session=8)
    received = Pages(reader)
    with (
        serve_history(writer, "r1", "joint_states", one),
        serve_history(writer, "r1", "joint_states", other),
        received.thread,
    ):
        wait_for_queryable(reader)
        for session in (7, 8, 9):
            received.request(KEY, session)
        until(lambda: len(received.pages) == 2)
    assert sorted(received.seqs()) == [[0, 1, 2], [0, 1, 2, 3, 4]]


def test_more_writers_than_the_in_flight_limit_are_all_requested(sessions: tuple[Session, Session]):
    writer, reader = sessions
    cache = cache_of(2)
    received = Pages(reader)
    with serve_history(writer, "r1", "joint_states", cache), received.thread:
        wait_for_queryable(reader)
        for _ in range(30):
            received.request(KEY, 7)
        until(lambda: len(received.pages) == 30)


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        (Reply(b"\x93", encoding_of(HistoryPage)), "truncated"),
        (Reply(encode(state(0)), encoding_of(JointState)), "foreign"),
    ],
)
def test_invalid_page_is_reported_and_ends_the_requests(sessions, answer: Reply, reason: str):
    writer, reader = sessions
    received = Pages(reader)
    with Queryable(writer, KEY, lambda _: answer), received.thread:
        wait_for_queryable(reader)
        received.request(KEY, 7)
        until(lambda: len(received.errors) == 1)
    assert (received.errors[0].reason, received.pages) == (reason, [])


def test_writer_that_repeats_a_page_is_not_requested_for_ever(sessions):
    writer, reader = sessions
    page = encode(HistoryPage(encoding_of(JointState), (encode(state(5)),), 5))
    asked: list[str] = []

    def answer(parameters):
        asked.append(parameters.get("before", ""))
        return Reply(page, encoding_of(HistoryPage))

    received = Pages(reader)
    with Queryable(writer, KEY, answer), received.thread:
        wait_for_queryable(reader)
        asked.clear()
        received.request(KEY, 7)
        until(lambda: len(received.pages) == 2)
        received.request(KEY, 8)
        until(lambda: len(received.pages) == 4)
    assert asked == ["", "5", "", "5"]


def test_late_reply_is_received(sessions: tuple[Session, Session]):
    writer, reader = sessions
    received = Pages(reader)
    with received.thread:
        received.request(KEY, 7)
        asked = threading.Event()

        def answer(parameters):
            first = not asked.is_set()
            asked.set()
            return (
                None
                if first
                else Reply(encode(HistoryPage(encoding_of(JointState), (b"x",))), encoding_of(HistoryPage))
            )

        with Queryable(writer, KEY, answer):
            until(lambda: received.pages)
    assert [[one.payload for one in page] for page in received.pages] == [[b"x"]]


def test_silent_writer_costs_no_thread_and_does_not_delay_close(sessions):
    writer, reader = sessions
    queryable = writer.zenoh.declare_queryable(KEY)
    received = Pages(reader)
    received.request(KEY, 7)
    received.thread.close()
    received.thread.close()
    assert (received.pages, received.errors) == ([], [])
    queryable.undeclare()


def test_silent_writers_of_one_robot_do_not_delay_the_history_of_another(sessions):
    writer, reader = sessions
    kept: zenoh.handlers.RingChannel[zenoh.Query] = zenoh.handlers.RingChannel(10_000)
    silent = writer.zenoh.declare_queryable("zstate/r2/joint_states", kept)
    received = Pages(reader)
    with serve_history(writer, "r1", "joint_states", cache_of(256 + 3)), received.thread:
        wait_for_queryable(reader)
        for session in range(500):
            received.request("zstate/r2/joint_states", session)
        until(silent.handler.try_recv)
        received.request(KEY, 7)
        until(lambda: len(received.pages) == 2)
    assert not received.errors


def test_silent_writer_is_requested_three_times(sessions):
    writer, reader = sessions
    asked: list[str] = []
    silent = writer.zenoh.declare_queryable(KEY, zenoh.handlers.RingChannel(100))
    received, kept = Pages(reader), list[zenoh.Query]()
    with received.thread:
        received.request(KEY, 7)

        def requests_are_complete() -> bool:
            while (query := silent.handler.try_recv()) is not None:
                asked.append(str(query.parameters))
                kept.append(query)
            return len(asked) >= 3 and len(received.requests._waiting) == received.requests._in_flight == 0

        until(requests_are_complete)
    assert asked == ["session=7"] * 3


def test_first_of_many_replies_on_the_key_is_the_page(sessions):
    writer, reader = sessions
    right, wrong = (
        encode(HistoryPage(encoding_of(JointState), (sample,))) for sample in (b"right", b"wrong")
    )

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply("zstate/*/joint_states", wrong, encoding=encoding_of(HistoryPage))
            for payload in (right, wrong, wrong):
                query.reply(KEY, payload, encoding=encoding_of(HistoryPage))

    queryable = writer.zenoh.declare_queryable(KEY, answer)
    received = Pages(reader)
    with received.thread:
        received.request(KEY, 7)
        until(lambda: received.pages)
    assert [[one.payload for one in page] for page in received.pages] == [[b"right"]]
    queryable.undeclare()


@pytest.mark.parametrize(("size", "reason"), [(524_288, ""), (524_289, "too large")])
def test_page_of_more_than_524288_bytes_is_refused(sessions, size: int, reason: str):
    writer, reader = sessions
    others = len(encode(HistoryPage(encoding_of(JointState), (bytes(2**16),)))) - 2**16
    page = encode(HistoryPage(encoding_of(JointState), (bytes(size - others),)))
    assert len(page) == size
    received = Pages(reader)
    with Queryable(writer, KEY, lambda _: Reply(page, encoding_of(HistoryPage))), received.thread:
        wait_for_queryable(reader)
        received.request(KEY, 7)
        until(lambda: received.errors or received.pages)
    assert [error.reason for error in received.errors] == [reason] * bool(reason)
    assert bool(received.pages) != bool(reason)


def test_failing_page_callback_does_not_end_other_requests(sessions, monkeypatch):
    raised: list[object] = []
    monkeypatch.setattr(threading, "excepthook", raised.append)
    writer, reader = sessions
    pages: list[list[SerializedSample]] = []

    def take(arrivals: list[SerializedSample], _: int) -> bool:
        pages.append(arrivals)
        if len(pages) == 1:
            raise InvalidInput("the first")
        return True

    thread = ServiceThread(reader, "requests")
    requests = Requests(reader, thread, 4)
    with serve_history(writer, "r1", "joint_states", cache_of(3)), thread:
        wait_for_queryable(reader)
        for _ in range(2):
            requests.add(HistoryRequest(KEY, 7, take, lambda *_: None))
        until(lambda: len(pages) == 2)
    assert len(raised) == 1
