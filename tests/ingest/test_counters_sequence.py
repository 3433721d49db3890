from __future__ import annotations

from zstate.ingest.counters import MissingSamples, SequenceNumbers


def test_every_sample_of_a_new_session_is_missing():
    missing = MissingSamples()
    assert missing
    assert all(seq in missing for seq in (0, 1, 10**12))


def test_samples_before_the_first_live_one_are_missing():
    missing = MissingSamples()
    missing.stop_at(5)
    assert [seq for seq in range(10) if seq in missing] == [0, 1, 2, 3, 4]


def test_gap_is_missing_until_later_samples_are_inserted():
    missing = MissingSamples()
    missing.stop_at(2)
    missing.add(7, 9)
    assert [seq for seq in range(12) if seq in missing] == [0, 1, 7, 8]
    missing.stop_at(8)
    assert [seq for seq in range(12) if seq in missing] == [0, 1, 7]
    missing.stop_at(7)
    assert [seq for seq in range(12) if seq in missing] == [0, 1]


def test_nothing_is_missing_after_the_first_sample_of_all():
    missing = MissingSamples()
    missing.stop_at(0)
    assert not missing
    assert 0 not in missing


def test_newest_64_of_many_gaps_are_kept():
    missing = MissingSamples()
    missing.stop_at(0)
    gaps = range(0, 1000, 10)
    for first in gaps:
        missing.add(first, first + 1)
    assert [seq for seq in range(1000) if seq in missing] == list(gaps[-64:])


def test_numbers_that_are_skipped_are_missing_until_they_are_received():
    numbers = SequenceNumbers()
    assert numbers.skip_to(10) == 0  # the first; what is before it may be in a cache
    assert [seq for seq in (8, 9, 10, 11) if numbers.is_missing(seq)] == [8, 9, 11]
    assert numbers.skip_to(14) == 3
    assert numbers.skip_to(12) == 0  # reordered
    assert (numbers.next, numbers.is_missing(13)) == (15, True)
