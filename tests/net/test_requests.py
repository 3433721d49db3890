"""The order of requests to many writers, their number in flight, and their repetitions."""

from __future__ import annotations

import threading

import pytest
import zenoh
from helpers.processes import until
from hypothesis import given
from hypothesis import strategies as st

from zstate.net.requests import ReplyHandler, Request, Requests, RoundRobinQueue
from zstate.net.service_thread import ServiceThread


def popped(queue: RoundRobinQueue[str]) -> list[str]:
    return list(iter(queue.pop, None))


def test_sources_take_turns_and_keep_their_own_order():
    queue: RoundRobinQueue[str] = RoundRobinQueue()
    for item in ("a1", "a2", "a3", "b1", "c1", "c2"):
        queue.add(item[0], item)
    assert popped(queue) == ["a1", "b1", "c1", "a2", "c2", "a3"]
    assert len(queue) == 0


def test_a_source_with_many_items_delays_another_by_one():
    queue: RoundRobinQueue[str] = RoundRobinQueue()
    for number in range(1000):
        queue.add("a", f"a{number}")
    assert queue.pop() == "a0"
    queue.add("b", "b")
    assert [queue.pop() for _ in range(3)] == ["a1", "b", "a2"]


@given(st.lists(st.sampled_from("abc")))
def test_each_item_is_popped_once(sources: list[str]):
    queue: RoundRobinQueue[str] = RoundRobinQueue()
    items = [f"{source}{number}" for number, source in enumerate(sources)]
    for item in items:
        queue.add(item[0], item)
    assert len(queue) == len(items)
    assert sorted(popped(queue)) == sorted(items)


class Recorded(Request):
    """A request whose queries nobody answers; ``ends`` are what each end returns, or raises."""

    def __init__(self, source: str, sent: list[str], ends: list[float | Exception | None]) -> None:
        self.source = source
        self._sent = sent
        self._ends = ends
        self.handlers: list[ReplyHandler] = []

    def send(self, session: zenoh.Session, handler: ReplyHandler) -> None:
        self._sent.append(self.source)
        self.handlers.append(handler)

    def on_reply(self, reply: zenoh.Reply) -> None:
        raise AssertionError("nobody answers")

    def on_end(self) -> float | None:
        end = self._ends.pop(0)
        if isinstance(end, Exception):
            raise end
        return end

    def end(self) -> None:
        """End the query that was sent last."""
        self.handlers[-1].drop()


def test_no_more_requests_than_the_limit_are_in_flight(sessions):
    sent: list[str] = []
    requests = [Recorded(source, sent, [None]) for source in "abcde"]
    with ServiceThread(sessions[0], "requests") as thread:
        sender = Requests(sessions[0], thread, 2)
        for request in requests:
            sender.add(request)
        for number, request in enumerate(requests):
            until(lambda number=number: sent == list("abcde"[: number + 2]))
            request.end()


def test_a_request_is_repeated_as_often_as_its_end_says(sessions):
    sent: list[str] = []
    request = Recorded("a", sent, [0.0, 0.01, None])
    with ServiceThread(sessions[0], "requests") as thread:
        Requests(sessions[0], thread, 1).add(request)
        for count in (1, 2, 3):
            until(lambda count=count: len(sent) == count)
            request.end()
        until(lambda: not request._ends)
    assert sent == ["a"] * 3


def test_an_exception_at_the_end_of_a_request_ends_only_that_one(sessions, monkeypatch: pytest.MonkeyPatch):
    reported: list[threading.ExceptHookArgs] = []
    monkeypatch.setattr(threading, "excepthook", reported.append)
    sent: list[str] = []
    first, second = Recorded("a", sent, [ValueError("bad page")]), Recorded("b", sent, [None])
    with ServiceThread(sessions[0], "requests") as thread:
        sender = Requests(sessions[0], thread, 1)
        sender.add(first)
        sender.add(second)
        until(lambda: sent == ["a"])
        first.end()
        until(lambda: sent == ["a", "b"])
    assert [str(one.exc_value) for one in reported] == ["bad page"]
