from __future__ import annotations

from zstate.following.absent import Absent


def test_of_a_new_session_everything_is_missing():
    absent = Absent()
    assert absent
    assert all(seq in absent for seq in (0, 1, 10**12))


def test_what_was_heard_live_is_not_missing_and_what_was_before_is():
    absent = Absent()
    absent.stop_at(5)
    assert [seq for seq in range(10) if seq in absent] == [0, 1, 2, 3, 4]


def test_a_gap_is_missing_until_what_comes_after_it_was_learned():
    absent = Absent()
    absent.stop_at(2)
    absent.add(7, 9)
    assert [seq for seq in range(12) if seq in absent] == [0, 1, 7, 8]
    absent.stop_at(8)
    assert [seq for seq in range(12) if seq in absent] == [0, 1, 7]
    absent.stop_at(7)
    assert [seq for seq in range(12) if seq in absent] == [0, 1]


def test_nothing_is_missing_once_the_first_sample_of_all_was_learned():
    absent = Absent()
    absent.stop_at(0)
    assert not absent
    assert 0 not in absent


def test_of_many_gaps_the_newest_are_remembered():
    absent = Absent()
    absent.stop_at(0)
    for first in range(0, 1000, 10):
        absent.add(first, first + 1)
    assert 990 in absent
    assert 0 not in absent
