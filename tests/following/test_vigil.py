"""Silence, by a clock that is given."""

from __future__ import annotations

import math

import pytest

from zstate.following.vigil import Vigil

WRITER = ("r1", 7)


def heard(*times_s: float) -> Vigil:
    vigil = Vigil()
    vigil.begin(WRITER)
    for now_s in times_s:
        assert vigil.hear(WRITER, now_s) is None
    return vigil


@pytest.mark.parametrize(("period_s", "silence_s"), [(0.01, 0.5), (0.05, 0.5), (0.2, 2.0)])
def test_stale_is_ten_periods_and_half_a_second_at_least(period_s: float, silence_s: float):
    vigil = heard(*(100.0 + period_s * number for number in range(50)))
    due_s = 100.0 + period_s * 49 + silence_s
    stale, next_s = vigil.look(due_s - 1e-3)
    assert not stale
    assert next_s == pytest.approx(due_s)
    stale, next_s = vigil.look(due_s + 1e-3)
    assert stale == {WRITER: pytest.approx(silence_s + 1e-3)}
    assert next_s == math.inf


def test_it_is_stale_once_until_a_sample_comes():
    vigil = heard(1.0, 1.1)
    assert vigil.look(9.0)[0]
    assert not vigil.look(10.0)[0]
    assert vigil.hear(WRITER, 11.1) == pytest.approx(10.0)
    assert vigil.hear(WRITER, 11.2) is None
    assert vigil.look(19.0)[0]


def test_who_has_not_said_two_things_yet_is_not_stale():
    assert heard().look(1e9) == ({}, math.inf)
    assert heard(1.0).look(1e9) == ({}, math.inf)


def test_samples_of_nobody_announced_are_nobodys():
    vigil = Vigil()
    for now_s in (1.0, 2.0):
        assert vigil.hear(WRITER, now_s) is None
    assert vigil.look(1e9) == ({}, math.inf)


def test_each_stream_that_ends_tells_whether_its_writer_was_stale():
    vigil = heard(1.0, 1.1)
    vigil.begin(WRITER)
    vigil.look(9.0)
    assert [vigil.end(WRITER) for _ in range(3)] == [True, True, False]
    assert not heard(1.0, 1.1).end(WRITER)
