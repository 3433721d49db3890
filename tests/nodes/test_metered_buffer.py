from __future__ import annotations

import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from helpers.robots import RRBOT, SECOND, STAMP, UPRIGHT

from zstate.clock import ManualClock
from zstate.errors import Disconnected, InFuture, UnknownFrame
from zstate.nodes.metered_buffer import Histogram, InstrumentedBuffer, MeteredBuffer
from zstate.transform import Transform

NOW = 1_789_000_000 * SECOND


def moving(stamp: int, x: float = 0.0) -> Transform:
    return Transform("base", "hand", (x, 0.0, 0.0), UPRIGHT, stamp)


def test_lookups_are_counted_and_their_failures_by_kind():
    buffer = InstrumentedBuffer()
    buffer.insert(moving(STAMP))
    buffer.insert_static(Transform("cell", "table", (0.0, 0.0, 0.0), UPRIGHT))
    assert buffer.lookup("base", "hand") == buffer.lookup("base", "hand", STAMP)
    for _ in range(2):
        with pytest.raises(InFuture):
            buffer.lookup("base", "hand", STAMP + 1)
    with pytest.raises(UnknownFrame):
        buffer.lookup("base", "nowhere")
    with pytest.raises(Disconnected):
        buffer.lookup("base", "table", timeout_s=0.01)
    assert buffer.lookups == 6
    assert buffer.failures == {"InFuture": 2, "UnknownFrame": 1, "Disconnected": 1}


def test_lookup_options_are_passed_on():
    buffer = InstrumentedBuffer()
    track = buffer.add_robot(RRBOT, "r1")
    buffer.insert_joints(track, STAMP, [0.0, 0.0], [1.0, 1.0])
    answer = buffer.lookup("base", "lower", STAMP + SECOND // 100, predict_s=0.02)
    assert answer.kind == "predicted"


def test_latency_is_from_the_stamp_until_a_sample_can_be_looked_up():
    buffer = InstrumentedBuffer()
    track = buffer.add_robot(RRBOT, "r1")
    buffer.insert_joints(track, time.time_ns() - 2 * SECOND, [0.0, 0.0])
    buffer.insert_many([("base", "cup")], time.time_ns() - SECOND // 5, [[0.0, 0.0, 0.0, *UPRIGHT]])
    buckets, total = buffer.latency.read()
    counts = dict(buckets)
    assert (counts["0.1"], counts["1"], counts["+Inf"]) == (0.0, 1.0, 2.0)
    assert total == pytest.approx(2.2, abs=1.0)


def test_each_histogram_bucket_counts_values_up_to_its_bound():
    histogram = Histogram((0.001, 0.01, 1.0))
    for value in (-0.5, 0.001, 0.002, 0.5, 7.0):
        histogram.add(value)
    buckets, total = histogram.read()
    assert buckets == [("0.001", 2.0), ("0.01", 3.0), ("1", 4.0), ("+Inf", 5.0)]
    assert total == -0.5 + 0.001 + 0.002 + 0.5 + 7.0


def test_histogram_counts_values_of_all_threads():
    histogram = Histogram((1.0,))

    def add() -> None:
        for _ in range(5000):
            histogram.add(0.5)

    threads = [threading.Thread(target=add) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert histogram.read() == ([("1", 20_000.0), ("+Inf", 20_000.0)], 10_000.0)


def metered(*ages_s: float) -> MeteredBuffer:
    """A buffer with a sample of each age, in this order."""
    buffer = MeteredBuffer(ManualClock(NOW))
    for age_s in ages_s:
        stamp = NOW - round(age_s * SECOND)
        buffer.insert_many([("r1/base", "r1/tool")], stamp, [[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
    return buffer


def test_latency_is_the_median_and_age_that_of_the_newest():
    buffer = metered(0.3, 0.1, 0.02)
    measure = buffer.measure("r1")
    assert measure.latency_s == pytest.approx(0.1)
    assert measure.age_s == pytest.approx(0.02)
    assert measure.rate_hz > 0.0
    assert buffer.statistics_of("r1").count == 3
    assert measure.transforms_hz is None


def test_transforms_besides_joint_states_have_their_own_rate():
    buffer = metered()
    for _ in range(5):
        buffer.insert_many([("r1/odom", "r1/world")], NOW, [[0.0, 0.0, 0.0, *UPRIGHT]])
    track = buffer.add_robot(RRBOT, "r1")
    for age_s in (0.3, 0.2):
        buffer.insert_joints(track, NOW - round(age_s * SECOND), [0.0, 0.0])
    measure = buffer.measure("r1")
    assert (buffer.statistics_of("r1").count, buffer.statistics_of("r1", "transforms").count) == (2, 5)
    assert measure.age_s == pytest.approx(0.2)
    assert measure.transforms_hz is not None
    assert measure.transforms_hz > 0.0


def test_samples_of_another_robot_do_not_count():
    assert metered(0.1).measure("r2") == MeteredBuffer().measure("r2")


def test_without_samples_nothing_is_measured():
    buffer = metered()
    measure = buffer.measure("r1")
    assert (measure.rate_hz, measure.latency_s, measure.age_s) == (0.0, None, None)


def test_samples_that_several_streams_insert_at_the_same_time_are_all_counted():
    """Each stream has a thread, and the first samples of a robot come from several."""
    buffer, threads, robots = MeteredBuffer(ManualClock(NOW)), 4, 300
    start = threading.Barrier(threads)

    def insert(thread: int) -> None:
        for number in range(robots):
            edge = (f"r{number}/base", f"r{number}/tool{thread}")
            start.wait()
            for _ in range(3):
                buffer.insert_many([edge], NOW, [[0.0, 0.0, 0.0, *UPRIGHT]])

    usual = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(insert, range(threads)))
    finally:
        sys.setswitchinterval(usual)
    for number in range(robots):
        robot = f"r{number}"
        assert buffer.statistics_of(robot).count == 3 * threads
        assert buffer.latency_of(robot).read()[0][-1] == ("+Inf", 3.0 * threads)
