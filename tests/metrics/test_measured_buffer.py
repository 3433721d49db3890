from __future__ import annotations

import time

import pytest
from helpers.robots import RRBOT, SECOND, STAMP, UPRIGHT

from zstate.errors import Disconnected, InFuture, UnknownFrame
from zstate.metrics.buffer import InstrumentedBuffer
from zstate.transform import Transform


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


def test_options_of_a_lookup_are_handed_on():
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
