"""Stamps far from now; a LagDetector separates a backlog from clock offsets and from bursts after a cut."""

from __future__ import annotations

import logging
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.clock_domain import ClockDomain
from zstate.clock import ManualClock
from zstate.ingest.counters import Counters
from zstate.ingest.stamp_checks import LagDetector, StampCheck, likely_cause
from zstate.wire.messages import JointState

MS = 1_000_000
S = 1_000 * MS
MINUTE = 60 * S
HOUR = 60 * MINUTE
NOW = 1_700_000_000 * S


def warning_count(caplog: pytest.LogCaptureFixture, ages_s: list[float], every_s: float = 0.2) -> int:
    """The number of lag warnings for samples with these ages at arrival."""
    lag = LagDetector(Counters())
    with caplog.at_level(logging.WARNING, "zstate"):
        for number, age_s in enumerate(ages_s):
            now = round(number * every_s * S)
            lag.add("r1", "driver", JointState(now - round(age_s * S), number, 7, b"order", b""), now)
    return len(caplog.records)


def test_growing_lag_is_logged_once(caplog):
    assert warning_count(caplog, [1.0 + 0.1 * number for number in range(50)]) == 1
    assert "samples of 'r1', which driver writes, come 2.1 s after their stamps" in caplog.text
    assert "1.0 s shortly before" in caplog.text
    assert "more is sent than the network carries" in caplog.text


def test_writer_whose_stamps_stand_still_is_blamed_for_that(caplog):
    assert warning_count(caplog, [1.0 + 0.1 * number for number in range(50)], every_s=0.1) == 1
    assert "driver of 'r1' gives every sample the same stamp, " in caplog.text
    assert "its source stands still" in caplog.text
    assert "network" not in caplog.text


def test_writer_whose_stamps_freeze_after_a_while_is_blamed_for_that(caplog):
    running, frozen = [1.5] * 10, [1.5 + 0.2 * number for number in range(20)]
    assert warning_count(caplog, running + frozen) == 1
    assert "gives every sample the same stamp" in caplog.text


@pytest.mark.parametrize("steps_s", [[5.0, 8.0], [1.2, 3.0, 9.0, 20.0]])
def test_clock_that_is_set_back_while_it_is_off_is_no_backlog(caplog, steps_s):
    assert warning_count(caplog, [step_s for step_s in steps_s for _ in range(5)]) == 0


@pytest.mark.parametrize(
    "ages_s",
    [
        [30.0, 30.1, 29.9] * 20,
        [5.0 - 0.1 * number for number in range(40)],
        [1.0, 1.9] * 20,
    ],
    ids=["a clock that is off", "a burst after a cut", "an unsteady network"],
)
def test_lag_that_grows_by_less_than_a_second_is_not_logged(caplog, ages_s):
    assert warning_count(caplog, ages_s) == 0


@pytest.mark.parametrize(("pause_s", "expected"), [(2.0, 1), (2.001, 0)])
def test_backlog_after_more_than_two_seconds_starts_with_its_own_least_age(caplog, pause_s, expected):
    assert warning_count(caplog, [1.0, 2.9], every_s=pause_s) == expected


@pytest.mark.long
def test_threads_share_the_checks(monkeypatch: pytest.MonkeyPatch):
    """The streams of a listener have a thread each; a bounded dict alone loses entries of another thread."""
    monkeypatch.setattr("zstate._util.bounded.MAX_ENTRIES", 8)
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    domain, lag, started = ClockDomain("system"), LagDetector(Counters()), threading.Barrier(4)

    def add(thread: int) -> None:
        # Large batches: with single calls, threads rarely meet in the few instructions that need the lock.
        states = [JointState(0, 0, 10**6 * thread + number, b"order", b"") for number in range(20_000)]
        started.wait(60)
        domain.assign("r1", [f"other/{thread}-{number}" for number in range(60_000)])
        for state in states:
            lag.add("r1", None, state, 2 * S)

    try:
        with ThreadPoolExecutor(4) as pool:
            for done in [pool.submit(add, thread) for thread in range(4)]:
                done.result()
    finally:
        sys.setswitchinterval(interval)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("off_ns", "counted"), [(MINUTE, 0), (MINUTE + 1, 1)])
def test_stamps_more_than_a_minute_from_now_are_counted_as_off_clock(sign: int, off_ns: int, counted: int):
    counters = Counters()
    check = StampCheck(TransformBuffer(clock=ManualClock(NOW)), counters, is_described=False)
    check.check("r1", "driver", JointState(NOW + sign * off_ns, 0, 7, b"order", b""))
    assert counters.stats().off_clock == counted


@pytest.mark.parametrize(
    "zone_ns", [HOUR, -HOUR, -3 * HOUR - HOUR // 2, 5 * HOUR + HOUR // 2, 14 * HOUR, -12 * HOUR]
)
@pytest.mark.parametrize("off_ns", [-MINUTE, -50 * S, 0, 50 * S, MINUTE - 1])
def test_stamp_off_by_a_time_zone_within_a_minute_is_local_time(zone_ns: int, off_ns: int):
    assert "local time for UTC" in likely_cause(NOW + zone_ns + off_ns, NOW)


@pytest.mark.parametrize(
    "offset_ns", [HOUR + MINUTE, HOUR - MINUTE - 1, HOUR + HOUR // 4, 15 * HOUR, -15 * HOUR]
)
def test_stamp_off_by_no_time_zone_is_that_of_a_clock_never_set(offset_ns: int):
    assert "never set" in likely_cause(NOW + offset_ns, NOW)
