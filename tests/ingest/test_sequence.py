from __future__ import annotations

from zstate.ingest.counters import Counters, GapCounter, MissingSamples


def test_of_a_new_session_everything_is_missing():
    missing = MissingSamples()
    assert missing
    assert all(seq in missing for seq in (0, 1, 10**12))


def test_what_was_heard_live_is_not_missing_and_what_was_before_is():
    missing = MissingSamples()
    missing.stop_at(5)
    assert [seq for seq in range(10) if seq in missing] == [0, 1, 2, 3, 4]


def test_a_gap_is_missing_until_what_comes_after_it_was_learned():
    missing = MissingSamples()
    missing.stop_at(2)
    missing.add(7, 9)
    assert [seq for seq in range(12) if seq in missing] == [0, 1, 7, 8]
    missing.stop_at(8)
    assert [seq for seq in range(12) if seq in missing] == [0, 1, 7]
    missing.stop_at(7)
    assert [seq for seq in range(12) if seq in missing] == [0, 1]


def test_nothing_is_missing_once_the_first_sample_of_all_was_learned():
    missing = MissingSamples()
    missing.stop_at(0)
    assert not missing
    assert 0 not in missing


def test_of_many_gaps_the_newest_are_remembered():
    missing = MissingSamples()
    missing.stop_at(0)
    for first in range(0, 1000, 10):
        missing.add(first, first + 1)
    assert 990 in missing
    assert 0 not in missing


def counted(counters: Counters) -> tuple[int, int]:
    stats = counters.stats()
    return stats.missed, stats.dropped


def test_what_is_missing_between_the_samples_of_each_writer_is_counted():
    gap_counter = GapCounter(counters := Counters())
    for writer, seq in (("a", 5), ("b", 100), ("a", 6), ("b", 101), ("a", 9)):
        gap_counter.add(writer, seq)
    assert counted(counters) == (2, 0)


def test_the_first_sample_and_one_that_comes_late_or_twice_is_no_gap():
    gap_counter = GapCounter(counters := Counters())
    for seq in (5, 6, 6, 4, 7):
        gap_counter.add("a", seq)
    assert counted(counters) == (0, 0)


def test_gaps_of_a_batch_that_overflowed_and_the_next_of_writers_that_are_not_in_it_are_our_own():
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
