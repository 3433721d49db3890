from __future__ import annotations

import threading

from zstate.metrics.buffer import Histogram


def test_each_bucket_counts_what_is_not_above_its_bound():
    histogram = Histogram((0.001, 0.01, 1.0))
    for value in (-0.5, 0.001, 0.002, 0.5, 7.0):
        histogram.add(value)
    buckets, total = histogram.read()
    assert buckets == [("0.001", 2.0), ("0.01", 3.0), ("1", 4.0), ("+Inf", 5.0)]
    assert total == -0.5 + 0.001 + 0.002 + 0.5 + 7.0


def test_nothing_is_lost_between_threads():
    histogram = Histogram((1.0,))

    def note() -> None:
        for _ in range(5000):
            histogram.add(0.5)

    threads = [threading.Thread(target=note) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert histogram.read() == ([("1", 20_000.0), ("+Inf", 20_000.0)], 10_000.0)
