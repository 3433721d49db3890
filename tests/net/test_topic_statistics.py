from __future__ import annotations

import numpy as np
import pytest
from helpers.processes import until

from zstate import connect, discover
from zstate.clouds import CloudPublisher
from zstate.net.sites import Thinning
from zstate.net.topic_statistics import (
    Arrival,
    IntervalStatistics,
    SequenceGaps,
    TopicStatistics,
    WriterKey,
)
from zstate.wire.messages import JointState, order_digest
from zstate.wire.registry import get_wire

MS = 1_000_000


def added(*received: tuple[int, int, int, int]) -> IntervalStatistics:
    """Samples as (arrival, stamp, number, delay), times in milliseconds."""
    statistics = IntervalStatistics()
    for at, stamp, seq, delay in received:
        statistics.add(Arrival(at * MS, stamp * MS, seq, delay * MS))
    return statistics


def test_burst_changes_the_arrival_rate_but_not_the_stamp_rate():
    # Stamped every 20 ms, one of them lost, all but the first delayed until 100 ms.
    window = added((20, 0, 1, 20), (100, 20, 2, 80), (100, 60, 4, 40)).window()
    assert window is not None
    assert window.rate_hz == pytest.approx(2 / 0.08)
    assert window.stamp_rate_hz == pytest.approx(50.0)


def test_a_thinned_stream_that_comes_in_a_burst_is_still_thinned():
    """A stalled link passes samples of 5 Hz on together; a busy one passes those of 50 Hz on slowly."""
    thinning = Thinning("plant1", 5.0)
    assert thinning.explains(
        added((0, 0, 1, 0), (600, 200, 11, 400), (601, 400, 21, 201), (602, 600, 31, 2)).window()
    )
    assert not thinning.explains(added((0, 0, 1, 0), (200, 20, 2, 180), (400, 40, 4, 360)).window())
    assert not thinning.explains(added((0, 0, 1, 0)).window())
    assert not thinning.explains(None)


def test_delays_are_from_stamp_to_arrival():
    window = added((0, 0, 1, 7), (10, 0, 2, 3), (20, 0, 3, 4)).window()
    assert window is not None
    assert window.delay_s == pytest.approx(0.004)
    assert window.delays == (3 * MS, 7 * MS)


def test_window_has_the_samples_after_its_start():
    statistics = added(*((10 * number, 0, number, 0) for number in range(10)))
    window = statistics.window(60 * MS)
    assert window is not None
    assert [one.seq for one in window.received] == [7, 8, 9]
    assert statistics.recent(20 * MS, now=200 * MS) is None
    assert statistics.silent_s(now=200 * MS) == pytest.approx(0.11)


def test_one_sample_has_no_rate():
    statistics = added((0, 0, 1, 0))
    window = statistics.window()
    assert window is not None
    assert (window.rate_hz, window.stamp_rate_hz, window.jitter_s) == (None, None, None)
    assert not statistics.is_stale(now=10**18)
    assert IntervalStatistics().window() is None


def test_gaps_are_counted_per_session_and_late_samples_change_nothing():
    gaps = SequenceGaps()
    for session, seq in ((1, 5), (2, 9), (1, 6), (1, 9), (1, 8), (1, 10), (2, 10)):
        assert gaps.add(session, seq)
    assert not gaps.add(1, 10)
    assert (gaps.missed(1), gaps.missed(2), gaps.missed(), gaps.missed(3)) == (2, 0, 2, 0)


def test_samples_of_one_message_count_once_per_source():
    with connect() as session, TopicStatistics(session, get_wire("native")) as topic:
        for seq in (1, 1, 2):
            topic.add("r1", "joint_states", JointState(0, seq, 7, order_digest(()), b""), seq, 0)
        statistics = topic.get(WriterKey("r1", "joint_states", 7))
    assert statistics is not None
    assert statistics.count == 2


def test_bulk_data_has_the_rate_that_its_writer_states_and_is_not_received(sessions):
    points = np.zeros((2, 3), np.float32)
    with CloudPublisher(sessions[0], "r1", "lidar") as lidar:
        (writer,) = {writer for _, writer in discover(sessions[0])[0].writers}
        key = WriterKey("r1", "cloud", writer.session)
        with TopicStatistics(sessions[1], get_wire("native")) as statistics:
            statistics.watch(("imu", "cloud"))
            until(lambda: lidar.publish(points) or statistics.published_hz(key))
            statistics.wait([key], 0.0)
            assert statistics.get(key) is None
