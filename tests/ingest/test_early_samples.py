"""Samples that wait for a description: live ones in their order, old ones newest first, in bounded memory."""

from __future__ import annotations

from zstate.ingest.early_samples import EARLY_BYTES, EarlySamples
from zstate.wire.messages import JointState


def sample(seq: int, size: int = 8) -> JointState:
    return JointState(seq, seq, 1, b"12345678", bytes(size))


def test_both_kinds_are_taken_once_and_in_the_order_of_their_arrival():
    early = EarlySamples()
    for seq in (5, 6):
        assert early.add(sample(seq)) == 0
    for seq in (4, 3):
        assert early.add_old(sample(seq))
    assert [one.seq for one in early.take_live()] == [5, 6]
    assert [one.seq for one in early.take_history()] == [4, 3]
    assert [*early.take_live(), *early.take_history()] == []


def test_oldest_live_samples_are_dropped_beyond_four_megabytes():
    early = EarlySamples()
    dropped = [early.add(sample(seq, EARLY_BYTES // 4)) for seq in range(5)]
    assert dropped == [0, 0, 0, 1, 1]  # each has a little more than its numbers
    assert [one.seq for one in early.take_live()] == [2, 3, 4]


def test_history_ends_where_no_more_of_it_is_kept():
    early = EarlySamples()
    kept = next(count for count in range(100_000) if not early.add_old(sample(count)))
    assert kept + 1 == 20_000


def test_samples_of_a_replaced_writer_are_dropped():
    early = EarlySamples()
    early.add(sample(1))
    early.add_old(sample(0))
    early.clear()
    assert [*early.take_live(), *early.take_history()] == []
