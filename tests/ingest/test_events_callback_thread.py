"""A user's function, called on a thread of its own."""

from __future__ import annotations

import math
import threading

import pytest
from helpers.processes import until

from zstate.ingest.events import _QUEUE_SIZE as QUEUE_SIZE
from zstate.ingest.events import CallbackThread


def idle(_: float) -> float:
    return math.inf


def test_items_are_passed_on_in_order_from_one_thread():
    received: list[tuple[int, int]] = []
    with CallbackThread[int](lambda one: received.append((one, threading.get_ident())), idle) as thread:
        for number in range(100):
            thread.submit(number)
        until(lambda: len(received) == 100)
    assert [one for one, _ in received] == list(range(100))
    assert len({ident for _, ident in received} - {threading.get_ident()}) == 1


def test_a_slow_callback_blocks_no_caller_and_drops_the_oldest_items():
    begun, go_on = threading.Event(), threading.Event()
    received: list[int] = []

    def slow(one: int) -> None:
        received.append(one)
        begun.set()
        go_on.wait(10.0)

    with CallbackThread[int](slow, idle) as thread:
        thread.submit(-1)
        assert begun.wait(10.0)
        for number in range(QUEUE_SIZE + 5):
            thread.submit(number)
        go_on.set()
        until(lambda: len(received) == 1 + QUEUE_SIZE)
    assert received[1:] == list(range(5, QUEUE_SIZE + 5))


def test_exceptions_are_counted_and_the_first_goes_to_excepthook(monkeypatch: pytest.MonkeyPatch):
    shown: list[str] = []
    monkeypatch.setattr(threading, "excepthook", lambda hook: shown.append(str(hook.exc_value)))

    def wrong(_: int) -> None:
        raise ValueError("not mine")

    with CallbackThread[int](wrong, idle) as thread:
        for number in range(3):
            thread.submit(number)
        until(lambda: thread.failures == 3)
    assert shown == ["not mine"]


def test_tick_is_called_when_due_and_may_submit_items():
    looked: list[float] = []
    received: list[int] = []

    def look(now: float) -> float:
        looked.append(now)
        thread.submit(len(looked))
        return now + 0.05

    opened = threading.Event()
    with CallbackThread[int](received.append, lambda now: look(now) if opened.is_set() else now) as thread:
        opened.set()
        until(lambda: len(received) >= 3)
    assert len(looked) >= 3


def test_close_works_inside_the_callback():
    closed = threading.Event()

    def end(_: int) -> None:
        thread.close()
        closed.set()

    thread = CallbackThread[int](end, idle)
    thread.submit(1)
    assert closed.wait(10.0)
    thread.close()
