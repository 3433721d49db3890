"""A user's function, called apart from the streams."""

from __future__ import annotations

import math
import threading

import pytest
from support import until

from zstate.following.teller import WAITING, Teller


def idle(_: float) -> float:
    return math.inf


def test_everything_told_is_passed_on_in_order_from_one_thread():
    heard: list[tuple[int, int]] = []
    with Teller[int](lambda one: heard.append((one, threading.get_ident())), idle) as teller:
        for number in range(100):
            teller.tell(number)
        until(lambda: len(heard) == 100)
    assert [one for one, _ in heard] == list(range(100))
    assert len({thread for _, thread in heard} - {threading.get_ident()}) == 1


def test_a_slow_callback_delays_nobody_and_loses_the_oldest():
    begun, go_on = threading.Event(), threading.Event()
    heard: list[int] = []

    def slow(one: int) -> None:
        heard.append(one)
        begun.set()
        go_on.wait(10.0)

    with Teller[int](slow, idle) as teller:
        teller.tell(-1)
        assert begun.wait(10.0)
        for number in range(WAITING + 5):
            teller.tell(number)
        go_on.set()
        until(lambda: len(heard) == 1 + WAITING)
    assert heard[1:] == list(range(5, WAITING + 5))


def test_an_exception_is_counted_and_the_first_is_shown(monkeypatch: pytest.MonkeyPatch):
    shown: list[str] = []
    monkeypatch.setattr(threading, "excepthook", lambda hook: shown.append(str(hook.exc_value)))

    def wrong(_: int) -> None:
        raise ValueError("not mine")

    with Teller[int](wrong, idle) as teller:
        for number in range(3):
            teller.tell(number)
        until(lambda: teller.failures == 3)
    assert shown == ["not mine"]


def test_it_looks_when_it_was_asked_to_and_may_be_told_something_by_that():
    looked: list[float] = []
    heard: list[int] = []

    def look(now: float) -> float:
        looked.append(now)
        teller.tell(len(looked))
        return now + 0.05

    opened = threading.Event()
    with Teller[int](heard.append, lambda now: look(now) if opened.is_set() else now) as teller:
        opened.set()
        until(lambda: len(heard) >= 3)
    assert len(looked) >= 3


def test_it_may_be_closed_from_the_callback():
    closed = threading.Event()

    def end(_: int) -> None:
        teller.close()
        closed.set()

    teller = Teller[int](end, idle)
    teller.tell(1)
    assert closed.wait(10.0)
    teller.close()
