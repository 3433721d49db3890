"""What a writer remembers, and how readers get it."""

from __future__ import annotations

import threading

import pytest
import zenoh
from helpers.processes import until
from helpers.robots import SECOND, STAMP

from zstate.errors import InvalidInput, MessageError
from zstate.net.queryable import Queryable, Reply
from zstate.net.sample_history import (
    MAX_CACHE_BYTES,
    MAX_PAGE_BYTES,
    PAGE_BYTES,
    PAGE_SAMPLES,
    HistoryReader,
    SampleCache,
    serve_history,
)
from zstate.net.session import Session
from zstate.wire.messages import HistoryPage, JointState
from zstate.wire.native import ENCODINGS, decode, encode
from zstate.wire.protocol import SerializedSample

KEY = "zstate/r1/joint_states"
ORDER = bytes(8)
MS = SECOND // 1000


def state(seq: int, stamp: int | None = None, session: int = 7, numbers: int = 2) -> JointState:
    return JointState(STAMP + seq * MS if stamp is None else stamp, seq, session, ORDER, bytes(8 * numbers))


def remembering(count: int, span_s: float = 1e6, numbers: int = 2, session: int = 7) -> SampleCache:
    memory = SampleCache(span_s, numbers, session)
    for seq in range(count):
        memory.append(state(seq, session=session, numbers=numbers))
    return memory


def seqs(states: list[JointState]) -> list[int]:
    return [one.seq for one in states]


def test_exactly_the_span_before_the_newest_is_remembered():
    memory = remembering(100, span_s=0.010)
    assert seqs(memory.since(0)) == list(range(89, 100))
    assert seqs(memory.since(97)) == [97, 98, 99]
    assert memory.since(100) == []


def test_pages_go_back_from_the_newest():
    memory = remembering(10)
    assert [(seqs(page), more) for page, more in (memory.before(None, 4), memory.before(6, 4))] == [
        ([6, 7, 8, 9], True),
        ([2, 3, 4, 5], True),
    ]
    assert [(seqs(page), more) for page, more in (memory.before(2, 4), memory.before(0, 4))] == [
        ([0, 1], False),
        ([], False),
    ]
    assert seqs(memory.before(10**15, 4)[0]) == [6, 7, 8, 9]
    assert SampleCache(1.0, 2, 7).before(None, 4) == ([], False)


def test_after_a_clock_was_set_back_only_what_came_then_is_remembered():
    memory = remembering(10, span_s=1.0)
    memory.append(state(10, STAMP - 3600 * SECOND))
    memory.append(state(11, STAMP - 3600 * SECOND + MS))
    assert seqs(memory.since(0)) == [10, 11]


def test_a_clock_set_back_by_less_than_the_span_leaves_nothing_of_before():
    memory = remembering(10, span_s=10.0)
    memory.append(state(10, STAMP - 5 * SECOND))
    memory.append(state(11, STAMP - 5 * SECOND + MS))
    assert seqs(memory.since(0)) == [10, 11]


def test_after_a_clock_was_set_forward_only_what_came_then_is_remembered():
    memory = remembering(10, span_s=1.0)
    memory.append(state(10, STAMP + 3600 * SECOND))
    assert seqs(memory.since(0)) == [10]


def test_a_stamp_slightly_back_forgets_nothing():
    memory = remembering(10, span_s=1.0)
    memory.append(state(10, STAMP - 85_000))
    assert seqs(memory.since(0)) == list(range(11))


def test_memory_is_bounded_whatever_the_stamps_say():
    memory = SampleCache(1e6, 100_000, 7)
    for seq in range(100):
        memory.append(state(seq, STAMP, numbers=1))
    kept = seqs(memory.since(0))
    assert kept == list(range(100 - len(kept), 100))
    assert 1 <= len(kept) <= MAX_CACHE_BYTES // 800_000


@pytest.mark.parametrize("span_s", [-1.0, 0.0, float("nan"), float("inf")])
def test_a_span_that_is_none_is_refused(span_s: float):
    with pytest.raises(InvalidInput, match="cache_s"):
        SampleCache(span_s, 2, 7)


class Heard:
    """The pages that came."""

    def __init__(self, session: Session, most: int = 1000) -> None:
        self.pages: list[list[SerializedSample]] = []
        self.errors: list[MessageError] = []
        self._most = most
        self.reader = HistoryReader(session, self._take, lambda _, error: self.errors.append(error))

    def _take(self, arrivals: list[SerializedSample], writer: int) -> bool:
        self.pages.append(arrivals)
        return len(self.pages) < self._most

    def seqs(self) -> list[list[int]]:
        return [
            [decode(one.payload, one.encoding, JointState).seq for one in page] for page in list(self.pages)
        ]


def await_answers(session: Session) -> None:
    until(lambda: any(reply.ok for reply in session.zenoh.get(KEY, timeout=5.0)))


def test_a_reader_gets_every_sample_as_it_was_sent_the_newest_page_first(sessions: tuple[Session, Session]):
    writer, reader = sessions
    memory = remembering(PAGE_SAMPLES + 3)
    heard = Heard(reader)
    with serve_history(writer, "r1", "joint_states", memory, encode), heard.reader:
        await_answers(reader)
        heard.reader.request(KEY, 7)
        until(lambda: len(heard.pages) == 2)
    assert heard.seqs() == [list(range(3, PAGE_SAMPLES + 3)), [0, 1, 2]]
    assert heard.pages[1] == [
        SerializedSample(KEY, encode(state(seq)), ENCODINGS[JointState]) for seq in range(3)
    ]


def test_a_page_is_small_and_has_at_least_one_sample(sessions: tuple[Session, Session]):
    writer, reader = sessions
    for numbers in (100, 10_000):
        memory = remembering(100, numbers=numbers)
        heard = Heard(reader, most=3)
        with serve_history(writer, "r1", "joint_states", memory, encode), heard.reader:
            await_answers(reader)
            heard.reader.request(KEY, 7)
            until(lambda heard=heard: len(heard.pages) == 3)
        sizes = [sum(len(one.payload) for one in page) for page in heard.pages]
        assert all(size <= PAGE_BYTES for size in sizes) if numbers == 100 else sizes[0] > PAGE_BYTES
        assert len(heard.pages[0]) == (PAGE_BYTES // len(heard.pages[0][0].payload) or 1)
        newest_first = [seq for page in heard.seqs() for seq in reversed(page)]
        assert newest_first == list(range(99, 99 - len(newest_first), -1))


def test_a_writer_that_has_said_nothing_says_so_and_is_not_asked_again(sessions):
    writer, reader = sessions
    with serve_history(writer, "r1", "joint_states", SampleCache(1.0, 2, 7), encode) as service:
        await_answers(reader)
        before = service.answered
        heard = Heard(reader)
        with heard.reader:
            heard.reader.request(KEY, 7)
            until(lambda: service.answered == before + 1)
    assert (heard.pages, heard.errors) == ([], [])


def test_an_answer_on_another_key_than_was_asked_is_none(sessions: tuple[Session, Session]):
    writer, reader = sessions
    past = encode(HistoryPage(ENCODINGS[JointState], (encode(state(0)),), None))
    asked = threading.Semaphore(0)

    def answer(query: zenoh.Query) -> None:
        query.reply("zstate/*/joint_states", past, encoding=ENCODINGS[HistoryPage])
        query.drop()
        asked.release()

    forged = writer.zenoh.declare_queryable("zstate/*/joint_states", answer)
    await_answers(reader)
    while asked.acquire(blocking=False):
        pass
    heard = Heard(reader)
    with heard.reader:
        heard.reader.request(KEY, 7)
        assert all(asked.acquire(timeout=5.0) for _ in range(2)), "no answer is asked for again"
    assert (heard.pages, heard.errors) == ([], [])
    forged.undeclare()


def test_each_writer_of_a_key_is_asked_for_itself(sessions: tuple[Session, Session]):
    writer, reader = sessions
    one, other = remembering(3, session=7), remembering(5, session=8)
    heard = Heard(reader)
    with (
        serve_history(writer, "r1", "joint_states", one, encode),
        serve_history(writer, "r1", "joint_states", other, encode),
        heard.reader,
    ):
        await_answers(reader)
        for session in (7, 8, 9):
            heard.reader.request(KEY, session)
        until(lambda: len(heard.pages) == 2)
    assert sorted(heard.seqs()) == [[0, 1, 2], [0, 1, 2, 3, 4]]


def test_more_writers_than_are_asked_at_once_all_have_their_turn(sessions: tuple[Session, Session]):
    writer, reader = sessions
    memory = remembering(2)
    heard = Heard(reader)
    with serve_history(writer, "r1", "joint_states", memory, encode), heard.reader:
        await_answers(reader)
        for _ in range(30):
            heard.reader.request(KEY, 7)
        until(lambda: len(heard.pages) == 30)


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        (Reply(b"\x93", ENCODINGS[HistoryPage]), "truncated"),
        (Reply(encode(state(0)), ENCODINGS[JointState]), "foreign"),
    ],
)
def test_an_answer_that_is_none_is_told_and_ends_the_asking(sessions, answer: Reply, reason: str):
    writer, reader = sessions
    heard = Heard(reader)
    with Queryable(writer, KEY, lambda _: answer), heard.reader:
        await_answers(reader)
        heard.reader.request(KEY, 7)
        until(lambda: len(heard.errors) == 1)
    assert (heard.errors[0].reason, heard.pages) == (reason, [])


def test_a_writer_that_always_names_the_same_older_page_is_not_asked_for_ever(sessions):
    writer, reader = sessions
    page = encode(HistoryPage(ENCODINGS[JointState], (encode(state(5)),), 5))
    asked: list[str] = []

    def answer(parameters):
        asked.append(parameters.get("before", ""))
        return Reply(page, ENCODINGS[HistoryPage])

    heard = Heard(reader)
    with Queryable(writer, KEY, answer), heard.reader:
        await_answers(reader)
        asked.clear()
        heard.reader.request(KEY, 7)
        until(lambda: len(heard.pages) == 2)
        heard.reader.request(KEY, 8)
        until(lambda: len(heard.pages) == 4)
    assert asked == ["", "5", "", "5"]


def test_who_answers_only_later_is_heard_all_the_same(sessions: tuple[Session, Session]):
    writer, reader = sessions
    heard = Heard(reader)
    with heard.reader:
        heard.reader.request(KEY, 7)
        asked = threading.Event()

        def answer(parameters):
            first = not asked.is_set()
            asked.set()
            return (
                None
                if first
                else Reply(encode(HistoryPage(ENCODINGS[JointState], (b"x",))), ENCODINGS[HistoryPage])
            )

        with Queryable(writer, KEY, answer):
            until(lambda: heard.pages)
    assert [[one.payload for one in page] for page in heard.pages] == [[b"x"]]


def test_who_does_not_answer_costs_no_thread_and_closing_does_not_wait_for_it(sessions):
    writer, reader = sessions
    queryable = writer.zenoh.declare_queryable(KEY)
    heard = Heard(reader)
    heard.reader.request(KEY, 7)
    heard.reader.close()
    heard.reader.close()
    assert (heard.pages, heard.errors) == ([], [])
    queryable.undeclare()


def test_many_silent_writers_of_one_robot_do_not_delay_the_history_of_another(sessions):
    writer, reader = sessions
    kept: zenoh.handlers.RingChannel[zenoh.Query] = zenoh.handlers.RingChannel(10_000)
    silent = writer.zenoh.declare_queryable("zstate/r2/joint_states", kept)
    heard = Heard(reader)
    with serve_history(writer, "r1", "joint_states", remembering(PAGE_SAMPLES + 3), encode), heard.reader:
        await_answers(reader)
        for session in range(500):
            heard.reader.request("zstate/r2/joint_states", session)
        until(silent.handler.try_recv)
        heard.reader.request(KEY, 7)
        until(lambda: len(heard.pages) == 2)
    assert not heard.errors


def test_a_writer_that_keeps_silent_is_asked_three_times(sessions):
    writer, reader = sessions
    asked: list[str] = []
    silent = writer.zenoh.declare_queryable(KEY, zenoh.handlers.RingChannel(100))
    heard, kept = Heard(reader), list[zenoh.Query]()
    with heard.reader:
        heard.reader.request(KEY, 7)

        def is_asked_in_all() -> bool:
            while (query := silent.handler.try_recv()) is not None:
                asked.append(str(query.parameters))
                kept.append(query)
            return len(heard.reader._waiting) == 0 and heard.reader._in_flight == 0 and len(asked) >= 3

        until(is_asked_in_all)
    assert asked == ["session=7"] * 3


def test_of_many_replies_the_first_on_the_right_key_is_the_page(sessions):
    writer, reader = sessions
    right, wrong = (encode(HistoryPage(ENCODINGS[JointState], (sample,))) for sample in (b"right", b"wrong"))

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply("zstate/*/joint_states", wrong, encoding=ENCODINGS[HistoryPage])
            for payload in (right, wrong, wrong):
                query.reply(KEY, payload, encoding=ENCODINGS[HistoryPage])

    queryable = writer.zenoh.declare_queryable(KEY, answer)
    heard = Heard(reader)
    with heard.reader:
        heard.reader.request(KEY, 7)
        until(lambda: heard.pages)
    assert [[one.payload for one in page] for page in heard.pages] == [[b"right"]]
    queryable.undeclare()


def test_a_page_that_is_too_large_is_refused(sessions):
    writer, reader = sessions
    page = encode(HistoryPage(ENCODINGS[JointState], (bytes(MAX_PAGE_BYTES),)))
    heard = Heard(reader)
    with Queryable(writer, KEY, lambda _: Reply(page, ENCODINGS[HistoryPage])), heard.reader:
        await_answers(reader)
        heard.reader.request(KEY, 7)
        until(lambda: heard.errors)
    assert (heard.errors[0].reason, heard.pages) == ("too large", [])


def test_a_page_that_cannot_be_taken_does_not_end_the_asking_of_others(sessions, monkeypatch):
    raised: list[object] = []
    monkeypatch.setattr(threading, "excepthook", raised.append)
    writer, reader = sessions
    pages: list[list[SerializedSample]] = []

    def take(arrivals: list[SerializedSample], _: int) -> bool:
        pages.append(arrivals)
        if len(pages) == 1:
            raise InvalidInput("the first")
        return True

    past = HistoryReader(reader, take, lambda *_: None)
    with serve_history(writer, "r1", "joint_states", remembering(3), encode), past:
        await_answers(reader)
        past.request(KEY, 7)
        past.request(KEY, 7)
        until(lambda: len(pages) == 2)
    assert len(raised) == 1
