from __future__ import annotations

import pytest

from zstate.cli.commands.hz import MessageStatistics
from zstate.cli.stream_reader import TimedSample
from zstate.wire.messages import JointState, order_digest


def arrival(came_ms: int, seq: int, session: int = 1) -> TimedSample:
    return TimedSample(came_ms * 1_000_000, JointState(0, seq, session, order_digest(()), b""))


def test_rate_spread_and_gaps_follow_from_the_arrivals():
    statistics = MessageStatistics(10)
    assert statistics.facts() is None
    for tapped in (arrival(0, 5), arrival(100, 6), arrival(300, 9)):
        statistics.add(tapped)
    measured = statistics.facts()
    assert measured is not None
    assert measured["rate_hz"] == pytest.approx(2 / 0.3)
    assert (measured["min_s"], measured["max_s"]) == pytest.approx((0.1, 0.2))
    assert measured["std_dev_s"] == pytest.approx(0.05)  # 0.1 and 0.2 are each half of 0.1 off their mean
    assert (measured["window"], measured["missed"]) == (3, 2)  # 7 and 8 are missing


def test_restarted_writer_begins_a_new_window():
    statistics = MessageStatistics(10)
    statistics.add(arrival(0, 100))
    statistics.add(arrival(5000, 0, session=2))
    assert statistics.facts() is None
    statistics.add(arrival(5100, 1, session=2))
    measured = statistics.facts()
    assert measured is not None
    assert (measured["rate_hz"], measured["missed"]) == (pytest.approx(10.0), 0)


def test_all_writers_of_a_topic_are_measured_together():
    statistics = MessageStatistics(10, of_all=True)
    for tapped in (arrival(0, 7, session=1), arrival(40, 3, session=2), arrival(100, 8, session=1)):
        statistics.add(tapped)
    statistics.add(arrival(140, 5, session=2))  # its 4 is missing
    measured = statistics.facts()
    assert measured is not None
    assert measured["rate_hz"] == pytest.approx(3 / 0.14)
    assert (measured["window"], measured["missed"]) == (4, 1)


def test_several_samples_of_one_message_are_one_arrival():
    statistics = MessageStatistics(10, of_all=True)
    for came_ms, seq in ((0, 1), (0, 1), (100, 2), (100, 2)):
        statistics.add(arrival(came_ms, seq))
    measured = statistics.facts()
    assert measured is not None
    assert measured["rate_hz"] == pytest.approx(10.0)
