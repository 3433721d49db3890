from __future__ import annotations

from zstate.following.gaps import Gaps
from zstate.following.tally import Tally


def counted(tally: Tally) -> tuple[int, int]:
    stats = tally.stats()
    return stats.missed, stats.dropped


def test_what_is_missing_between_the_samples_of_each_writer_is_counted():
    gaps = Gaps(tally := Tally())
    for writer, seq in (("a", 5), ("b", 100), ("a", 6), ("b", 101), ("a", 9)):
        gaps.note(writer, seq)
    assert counted(tally) == (2, 0)


def test_the_first_sample_and_one_that_comes_late_or_twice_is_no_gap():
    gaps = Gaps(tally := Tally())
    for seq in (5, 6, 6, 4, 7):
        gaps.note("a", seq)
    assert counted(tally) == (0, 0)


def test_gaps_of_a_batch_that_overflowed_and_the_next_of_writers_that_are_not_in_it_are_our_own():
    gaps = Gaps(tally := Tally())
    for writer in ("a", "b", "c"):
        gaps.note(writer, 0)
    gaps.begin(overflowed=True)
    for writer, seq in (("a", 3), ("b", 1), ("a", 5)):
        gaps.note(writer, seq)
    assert counted(tally) == (0, 3)
    gaps.begin(overflowed=False)
    for writer, seq in (("a", 7), ("b", 3), ("c", 2), ("c", 4), ("d", 7), ("d", 9)):
        gaps.note(writer, seq)
    assert counted(tally) == (4, 4)
