from __future__ import annotations

import threading
import time

import pytest
from helpers.processes import DEADLINE_S

from zstate.cli import waiting
from zstate.cli.waiting import ConditionWaiter


@pytest.fixture
def notes(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    texts: list[str] = []
    monkeypatch.setattr(waiting, "print_status", lambda text, **_: texts.append(text))
    return texts


def test_true_condition_ends_the_wait_at_once():
    assert ConditionWaiter().wait_for(lambda: True, timeout_s=0.0)


def test_a_notification_from_another_thread_ends_the_wait():
    waiter, checked, done = ConditionWaiter(), threading.Event(), threading.Event()

    def condition() -> bool:
        checked.set()
        return done.is_set()

    def work() -> None:
        checked.wait(DEADLINE_S)
        done.set()
        waiter.notify("any", "arguments")

    thread = threading.Thread(target=work)
    thread.start()
    assert waiter.wait_for(condition, DEADLINE_S)
    thread.join()


def test_nothing_is_checked_again_without_a_notification():
    checks: list[None] = []
    assert not ConditionWaiter().wait_for(lambda: checks.append(None), timeout_s=0.2)
    assert len(checks) == 2  # at the start and at the end


def test_a_burst_of_notifications_costs_few_checks():
    waiter, checks = ConditionWaiter(), list[int]()

    def condition() -> bool:
        checks.append(len(checks))
        waiter.notify()
        return False

    began = time.monotonic()
    assert not waiter.wait_for(condition, timeout_s=0.2)
    assert len(checks) <= 2 + (time.monotonic() - began) / 0.02


def test_reason_is_printed_once_and_only_in_a_long_wait(notes: list[str]):
    waiter = ConditionWaiter()
    assert not waiter.wait_for(lambda: False, 0.1, lambda: "no robot")
    assert (notes, waiter.last_reason) == ([], "")
    assert not waiter.wait_for(lambda: False, 1.2, lambda: "no robot")
    assert notes == ["waiting: no robot"]
    assert waiter.last_reason == "no robot"


def test_changed_reason_is_printed_again(notes: list[str]):
    reasons = iter(["no robot", "no model", "no samples", "no samples", "no samples"])
    assert not ConditionWaiter().wait_for(lambda: False, 1.7, lambda: next(reasons))
    assert notes == ["waiting: no robot", "waiting: no model", "waiting: no samples"]


def test_a_state_is_stable_once_it_has_not_changed_for_the_quiet_time():
    waiter, calls = ConditionWaiter(), list[bool]()

    def is_complete(stable: bool) -> bool:
        calls.append(stable)
        return stable

    began = time.monotonic()
    waiter.wait_until_stable(lambda: 1, is_complete, quiet_s=0.1, timeout_s=DEADLINE_S)
    assert time.monotonic() - began >= 0.1
    assert calls == [False, True]


def test_a_state_that_keeps_changing_is_waited_for_until_the_timeout():
    waiter, states = ConditionWaiter(), iter(range(10_000))

    def state() -> int:
        waiter.notify()
        return next(states)

    waiter.wait_until_stable(state, lambda stable: stable, quiet_s=0.1, timeout_s=0.3)
    assert next(states) > 3
