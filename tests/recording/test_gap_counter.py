from __future__ import annotations

from zstate.ingest.counters import Counters
from zstate.recording.gap_counter import GapCounter


def counted(counters: Counters) -> tuple[int, int]:
    stats = counters.stats()
    return stats.missed, stats.dropped


def test_gaps_between_the_samples_of_each_writer_are_counted():
    gap_counter = GapCounter(counters := Counters())
    for writer, seq in (("a", 5), ("b", 100), ("a", 6), ("b", 101), ("a", 9)):
        gap_counter.add(writer, seq)
    assert counted(counters) == (2, 0)


def test_first_late_and_repeated_samples_are_no_gap():
    gap_counter = GapCounter(counters := Counters())
    for seq in (5, 6, 6, 4, 7):
        gap_counter.add("a", seq)
    assert counted(counters) == (0, 0)


def test_gaps_of_an_overflowed_batch_count_as_dropped_for_all_writers():
    gap_counter = GapCounter(counters := Counters())
    for writer in ("a", "b", "c"):
        gap_counter.add(writer, 0)
    gap_counter.start_batch(overflowed=True)
    for writer, seq in (("a", 3), ("b", 1), ("a", 5)):
        gap_counter.add(writer, seq)
    assert counted(counters) == (0, 3)
    gap_counter.start_batch(overflowed=False)
    for writer, seq in (("a", 7), ("b", 3), ("c", 2), ("c", 4), ("d", 7), ("d", 9)):
        gap_counter.add(writer, seq)
    assert counted(counters) == (4, 4)
