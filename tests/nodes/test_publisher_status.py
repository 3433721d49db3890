"""Health of a publisher, derived from its counts."""

from __future__ import annotations

from dataclasses import replace

import pytest

from zstate.nodes.publisher_status import Health, PublisherStats, StatusReporter, assess_health
from zstate.rate import RateReport
from zstate.wire.identity import WriterId

SECOND = 1_000_000_000
OK = Health("ok")


def counts(
    sent: int = 0,
    *,
    refused: int = 0,
    refusal: str = "",
    rate_hz: float | None = None,
    late: int = 0,
    skipped: int = 0,
) -> PublisherStats:
    rate = None if rate_hz is None else RateReport(rate_hz, rate_hz, sent, skipped, late)
    return PublisherStats(sent, refused, refusal, {}, rate)


def test_punctual_publisher_is_ok():
    assert assess_health(counts(5), counts(6), quiet_ns=0) == OK
    assert assess_health(counts(5, rate_hz=100.0), counts(105, rate_hz=100.0), quiet_ns=0) == OK


def test_publisher_without_new_samples_is_stale_after_two_seconds():
    assert assess_health(counts(5), counts(5), quiet_ns=2 * SECOND) == OK
    level, text = assess_health(counts(5), counts(5), quiet_ns=2 * SECOND + 1)
    assert (level, text) == ("stale", "nothing was published for 2.0 s")
    assert assess_health(counts(), counts(), quiet_ns=3 * SECOND).text.endswith("since this publisher opened")


def test_slow_commanded_rate_is_not_stale_before_two_periods():
    slow = counts(5, rate_hz=0.25)
    assert assess_health(slow, slow, quiet_ns=8 * SECOND) == OK
    assert assess_health(slow, slow, quiet_ns=8 * SECOND + 1).level == "stale"


def test_newly_late_or_skipped_ticks_are_a_warning():
    before = counts(100, rate_hz=100.0, late=3, skipped=1)
    level, text = assess_health(before, counts(140, rate_hz=100.0, late=43, skipped=21), quiet_ns=0)
    assert level == "warn"
    assert "40 ticks late and 20 skipped: 100 Hz" in text
    assert assess_health(before, counts(200, rate_hz=100.0, late=3, skipped=1), quiet_ns=0) == OK


def test_samples_outside_joint_limits_are_a_warning_that_names_the_joint():
    before = replace(counts(5), outside_limits=2, last_excess="'lift' at 3.0 rad is outside -2 to 2")
    now = replace(counts(9), outside_limits=5, last_excess="'lift' at 4.0 rad is outside -2 to 2")
    text = "3 samples are outside joint limits: 'lift' at 4.0 rad is outside -2 to 2"
    assert assess_health(before, now, quiet_ns=0) == Health("warn", text)
    assert assess_health(now, replace(now, sent=12), quiet_ns=0) == OK


def test_ticks_of_an_earlier_run_are_not_counted_again():
    before = counts(100, rate_hz=100.0, late=50, skipped=20)
    assert assess_health(before, counts(110, rate_hz=10.0), quiet_ns=0) == OK


@pytest.mark.parametrize(("sent", "level", "share"), [(3, "warn", "2 of 5"), (0, "error", "2 of 2")])
def test_refused_samples_are_a_warning_and_an_error_if_none_was_published(sent: int, level: str, share: str):
    now = counts(10 + sent, refused=2, refusal="joint 'elbow' is nan")
    assert assess_health(counts(10), now, quiet_ns=0) == (
        level,
        f"{share} samples cannot be published: joint 'elbow' is nan",
    )


def test_warning_of_the_program_lasts_until_it_is_empty():
    slow_wheels = "wheels: NIS 14.2 for 3 numbers, expected 0.2 to 9.3"
    before, now = replace(counts(5), warning=slow_wheels), replace(counts(6), warning=slow_wheels)
    assert assess_health(before, now, quiet_ns=0) == Health("warn", slow_wheels)
    assert assess_health(now, counts(7), quiet_ns=0) == OK
    silent = assess_health(now, replace(now, warning="the IMU is silent"), quiet_ns=3 * SECOND)
    assert silent == Health("stale", "nothing was published for 3.0 s: the IMU is silent")


def test_status_has_writer_counts_and_commanded_rate():
    read = [counts(), counts(7, rate_hz=50.0, late=2)]
    reporter = StatusReporter(WriterId("driver", "nuc", 412, 5, 9), lambda: read.pop(0))
    status = reporter.status()
    assert (status.program, status.host, status.pid, status.session) == ("driver", "nuc", 412, 9)
    assert (status.sent, status.late) == (7, 2)
    assert status.rate_hz > 7.0  # less than a second has passed
    assert status.values == {"refused": "0", "commanded": "50 Hz", "skipped": "0"}
