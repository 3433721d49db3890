"""A thread that several subscriptions and requests share: order, delays, failures, end."""

from __future__ import annotations

import threading
import time

import pytest
from helpers.processes import DEADLINE_S, until

from zstate.net.service_thread import ServiceThread


def threads_named(name: str) -> int:
    return sum(thread.name == name for thread in threading.enumerate())


def test_functions_are_called_in_order_and_delayed_ones_when_they_are_due(sessions):
    called: list[str] = []
    with ServiceThread(sessions[0], "test") as thread:
        for name in ("first", "second"):
            thread.call(lambda name=name: called.append(name))
        start_s = time.monotonic()
        thread.call(lambda: called.append("later"), 0.5)
        thread.call(lambda: called.append("soon"), 0.01)
        until(lambda: len(called) == 4)
        assert time.monotonic() >= start_s + 0.5
    assert called == ["first", "second", "soon", "later"]


def test_functions_without_a_delay_do_not_hold_up_one_that_is_due(sessions):
    called = threading.Event()
    with ServiceThread(sessions[0], "test") as thread:

        def again() -> None:
            if not called.is_set():
                thread.call(again)

        thread.call(again)
        thread.call(called.set, 0.01)
        assert called.wait(DEADLINE_S)


def test_a_failing_function_is_counted_reported_once_and_ends_no_other(sessions, monkeypatch):
    reported: list[threading.ExceptHookArgs] = []
    monkeypatch.setattr(threading, "excepthook", reported.append)
    called = threading.Event()

    def fail() -> None:
        raise ValueError("a broken handler")

    with ServiceThread(sessions[0], "test") as thread:
        thread.call(fail)
        thread.call(fail)
        thread.call(called.set)
        assert called.wait(DEADLINE_S)
        assert thread.failures == 2
    assert [str(one.exc_value) for one in reported] == ["a broken handler"]


def test_close_waits_for_the_current_function_and_calls_no_other(sessions):
    called: list[str] = []
    is_busy, go_on = threading.Event(), threading.Event()

    def work() -> None:
        is_busy.set()
        go_on.wait(0.1)
        called.append("current")

    thread = ServiceThread(sessions[0], "test")
    thread.call(work)
    thread.call(lambda: called.append("next"))
    assert is_busy.wait(DEADLINE_S)
    thread.close()
    thread.close()
    assert called == ["current"]
    assert not threads_named("zstate test")


def test_a_thread_may_be_closed_by_what_it_calls(sessions):
    thread = ServiceThread(sessions[0], "test")
    thread.call(thread.close)
    until(lambda: not threads_named("zstate test"))


@pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_thread_that_finds_its_session_closed_ends_without_a_report(sessions):
    thread = ServiceThread(sessions[0], "test")
    sessions[0].close()
    thread.call(sessions[0].check)
    until(lambda: not threads_named("zstate test"))
    assert thread.failures == 0
