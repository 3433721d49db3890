"""Queryables on one key, whose replies come from threads of their session."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterable
from concurrent.futures import Future
from contextlib import ExitStack
from pathlib import Path

import pytest
import zenoh
from helpers.processes import DEADLINE_S, until

from zstate.net import query_workers
from zstate.net.queryable import Queryable, Reply, parse_parameters, query
from zstate.net.request_queryable import RequestQueryable
from zstate.net.session import Session, connect
from zstate.net.streams import KeyPublisher, StreamSubscriber

KEY = "zstate/r1/lookup"


def peer_is_linked(session: Session, zid: str) -> bool:
    return zid in map(str, session.zenoh.info.peers_zid())


def replies(session: Session, selector: str, timeout_s: float = DEADLINE_S) -> list[tuple[bool, bytes, str]]:
    """The replies: whether it is no error, the payload and its encoding. A timeout is an error, "Timeout"."""
    found = []
    for reply in session.zenoh.get(selector, timeout=timeout_s):
        value = reply.ok or reply.err
        assert value is not None
        found.append((reply.ok is not None, value.payload.to_bytes(), str(value.encoding)))
    return found


def answered(session: Session, selector: str) -> list[tuple[bool, bytes, str]]:
    """The same, once the query reaches the queryable."""
    found: list[tuple[bool, bytes, str]] = []

    def is_answered() -> bool:
        found.extend(replies(session, selector))
        return bool(found)

    until(is_answered)
    return found


def test_query_gets_its_reply_and_errors_are_zenoh_error_replies(sessions: tuple[Session, Session]):
    def answer(parameters):
        return Reply(repr(parameters).encode(), "text/plain", is_error="wrong" in parameters)

    with Queryable(sessions[0], KEY, answer) as service:
        value = answered(sessions[1], f"{KEY}?a=1;b=x=y")
        assert value == [(True, b"{'a': '1', 'b': 'x=y'}", "text/plain")]
        assert replies(sessions[1], f"{KEY}?wrong") == [(False, b"{'wrong': ''}", "text/plain")]
        until(lambda: service.answered == 2)
    assert replies(sessions[1], KEY) == []


def test_a_query_ends_with_its_replies_after_one_of_two_equal_queryables_and_its_session_are_closed(
    sessions: tuple[Session, Session],
):
    with connect() as other, Queryable(other, KEY, lambda _: Reply(b"other", "")):
        with connect() as first:
            with Queryable(first, KEY, lambda _: Reply(b"first", "")) as service:
                until(lambda: bool(replies(sessions[1], KEY)) and service.answered > 0)
            until(lambda: [payload for _, payload, _ in replies(sessions[1], KEY)] == [b"other"])
        until(lambda: not peer_is_linked(sessions[1], first.zid))
        # Of a query that ends by its timeout Zenoh's error is a reply.
        assert [payload for _, payload, _ in replies(sessions[1], KEY)] == [b"other"]


def test_query_without_a_reply_ends_before_its_timeout(sessions: tuple[Session, Session]):
    with Queryable(sessions[0], KEY, lambda parameters: Reply(b"x", "") if parameters else None):
        answered(sessions[1], f"{KEY}?a=1")
        assert replies(sessions[1], KEY) == []  # nor Zenoh's error of a timeout


def test_a_request_whose_answer_is_not_done_delays_no_other_one(sessions: tuple[Session, Session]):
    slow: Future[Reply | None] = Future()

    def answer(payload: bytes, encoding: str) -> Reply | Future[Reply | None]:
        return slow if payload == b"slow" else Reply(payload, encoding)

    def ask(payload: bytes) -> list[bytes]:
        found = query(sessions[1].zenoh, KEY, 10.0, payload=payload, encoding="text/plain")
        return [reply.ok.payload.to_bytes() for reply in found if reply.ok is not None]

    with RequestQueryable(sessions[0], KEY, answer) as service:
        until(lambda: ask(b"quick") == [b"quick"])
        waiting = query(sessions[1].zenoh, KEY, 10.0, payload=b"slow")
        answered_before = service.answered
        assert ask(b"quick") == [b"quick"]
        assert service.answered > answered_before
        slow.set_result(Reply(b"done", ""))
        assert [reply.ok.payload.to_bytes() for reply in waiting if reply.ok is not None] == [b"done"]


def test_failing_answer_is_counted_and_reported_once_and_the_next_query_is_answered(
    sessions: tuple[Session, Session], monkeypatch: pytest.MonkeyPatch
):
    reported: list[threading.ExceptHookArgs] = []
    monkeypatch.setattr(threading, "excepthook", reported.append)

    def answer(parameters):
        return Reply(str(1 / int(parameters["n"])).encode(), "")

    with Queryable(sessions[0], KEY, answer) as service:
        answered(sessions[1], f"{KEY}?n=1")
        for _ in range(2):
            assert replies(sessions[1], f"{KEY}?n=0") == []
        assert replies(sessions[1], f"{KEY}?n=2")[0][1] == b"0.5"
        until(lambda: service.failures == 2)
    assert [args.exc_type for args in reported] == [ZeroDivisionError]


def test_slow_answer_delays_no_subscription_and_overflows_are_counted(
    sessions: tuple[Session, Session],
):
    writer, reader = sessions
    may_answer, asked = threading.Event(), threading.Event()

    def answer(parameters):
        if parameters:
            asked.set()
            may_answer.wait(30.0)
        return Reply(b"x", "")

    received: list[bytes] = []
    with (
        KeyPublisher(reader, "zstate/r1/tf", "") as stream,
        StreamSubscriber(
            writer, "zstate/r1/tf", lambda arrivals: received.extend(one.payload for one in arrivals)
        ),
        Queryable(writer, KEY, answer, capacity=4) as service,
    ):
        until(lambda: stream.has_readers)
        answered(reader, KEY)
        slow = reader.zenoh.get(f"{KEY}?slow", timeout=30.0)
        assert asked.wait(15.0)
        flood = [reader.zenoh.get(KEY, timeout=30.0) for _ in range(40)]
        # Those that found no room are over before anything was answered.
        until(lambda: sum(not next_reply(get) for get in flood[:36]) == 36)
        stream.put(b"live")
        until(lambda: received == [b"live"])
        may_answer.set()
        assert len(list(slow)) == 1
        assert [len(list(get)) for get in flood[36:]] == [1, 1, 1, 1]
        until(lambda: service.full_batches == 1)


def next_reply(get) -> bool:
    return bool(list(get))


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_thread_of_a_queryable_without_queries_does_not_wake_up(sessions: tuple[Session, Session]):
    before = set(threading.enumerate())
    with Queryable(sessions[0], KEY, lambda _: Reply(b"x", "")):
        assert answered(sessions[1], KEY) == [(True, b"x", "zenoh/bytes")]
        threads = set(threading.enumerate()) - before
        channel = zenoh.handlers.FifoChannel(1)
        with sessions[0].zenoh.declare_subscriber("nobody/writes/here", channel) as subscriber:
            waiting = threading.Thread(target=lambda: list(subscriber), name="a channel of Zenoh")
            waiting.start()
            until(lambda: waiting.native_id and _voluntary_switches([waiting]) >= 3)
            idle, woken = _voluntary_switches(threads), _voluntary_switches([waiting])
            until(lambda: _voluntary_switches([waiting]) >= woken + 8)
            assert _voluntary_switches(threads) - idle <= 1, "a thread in a channel of Zenoh woke up 8 times"
        waiting.join(DEADLINE_S)


def _voluntary_switches(threads: Iterable[threading.Thread]) -> int:
    statuses = [Path(f"/proc/self/task/{thread.native_id}/status") for thread in threads]
    lines = [line for status in statuses for line in status.read_text().splitlines()]
    return sum(int(line.split()[1]) for line in lines if line.startswith("voluntary_ctxt_switches"))


def query_threads() -> int:
    return sum(thread.name == "zstate queries" for thread in threading.enumerate())


def test_queryables_of_a_session_share_their_threads(sessions: tuple[Session, Session]):
    """One that is busy with a quick answer and one that waits, however many queryables there are."""
    writer, reader = sessions
    with ExitStack() as opened:
        keys = [f"zstate/r{number}/lookup" for number in range(30)]
        for key in keys:
            opened.enter_context(Queryable(writer, key, lambda _: Reply(b"x", "")))
        assert query_threads() == 1
        for key in keys:
            answered(reader, key)
        assert query_threads() <= 3
    until(lambda: query_threads() == 0)


def test_answers_that_take_long_delay_no_other_queryable(sessions: tuple[Session, Session]):
    """A lookup in a huge buffer, or a page of history for a reader that is frozen."""
    writer, reader = sessions
    may_answer, busy = threading.Event(), threading.Semaphore(0)

    def slow(parameters):
        if parameters:
            busy.release()
            may_answer.wait(30.0)
        return Reply(b"late", "")

    with ExitStack() as opened:
        keys = [f"zstate/r{number}/lookup" for number in range(5)]
        for key in keys:
            opened.enter_context(Queryable(writer, key, slow))
            answered(reader, key)
        opened.enter_context(Queryable(writer, KEY.replace("r1", "quick"), lambda _: Reply(b"quick", "")))
        waiting = [reader.zenoh.get(f"{key}?slow", timeout=30.0) for key in keys]
        for _ in keys:
            assert busy.acquire(timeout=15.0)
        assert answered(reader, KEY.replace("r1", "quick")) == [(True, b"quick", "zenoh/bytes")]
        may_answer.set()
        assert [len(list(get)) for get in waiting] == [1] * len(keys)


def test_threads_that_are_not_needed_any_more_end(sessions: tuple[Session, Session], monkeypatch):
    monkeypatch.setattr(query_workers, "IDLE_S", 0.05)
    with Queryable(sessions[0], KEY, lambda _: Reply(b"x", "")):
        answered(sessions[1], KEY)
        until(lambda: query_threads() == 1)
        answered(sessions[1], KEY)
    until(lambda: query_threads() == 0)


def test_queryables_end_with_their_session_and_close_afterwards(sessions: tuple[Session, Session]):
    with connect() as session:
        services = [Queryable(session, KEY, lambda _: Reply(b"x", "")) for _ in range(2)]
        answered(sessions[1], KEY)
    until(lambda: query_threads() == 0)
    for service in services:
        service.close()


def test_answer_may_close_its_own_queryable(sessions: tuple[Session, Session]):
    def answer(parameters):
        if parameters:
            service.close()
        return Reply(b"x", "")

    service = Queryable(sessions[0], KEY, answer)
    answered(sessions[1], KEY)
    assert (False, b"Timeout") not in [one[:2] for one in replies(sessions[1], f"{KEY}?close")]
    assert replies(sessions[1], KEY) == []
    until(lambda: query_threads() == 0)


def test_close_may_be_repeated(sessions: tuple[Session, Session]):
    service = Queryable(sessions[0], KEY, lambda _: None)
    service.close()
    service.close()


@pytest.mark.parametrize(
    ("text", "parameters"),
    [
        ("", {}),
        ("a=1", {"a": "1"}),
        ("a=1;b=2", {"a": "1", "b": "2"}),
        (";a;", {"a": ""}),
        ("a=b=c", {"a": "b=c"}),
    ],
)
def test_parameters_are_pairs(text: str, parameters: dict[str, str]):
    assert parse_parameters(text) == parameters
