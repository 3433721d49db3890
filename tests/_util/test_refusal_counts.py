"""Refusals: counted by reason, logged once for each."""

from __future__ import annotations

import logging

import pytest

from zstate._util.refusals import Refusals


def test_each_reason_is_logged_once_with_its_subject(caplog: pytest.LogCaptureFixture):
    refusals = Refusals("joint_states")
    with caplog.at_level(logging.WARNING, "zstate"):
        for number in range(3):
            refusals.count("loop", f"text {number}")
        refusals.count("foreign", ValueError("other"))
    assert refusals.counts == {"loop": 3, "foreign": 1}
    assert refusals.first == {"loop": "text 0", "foreign": "other"}
    assert [record.getMessage() for record in caplog.records] == [
        "joint_states refused (loop): text 0; further ones are only counted",
        "joint_states refused (foreign): other; further ones are only counted",
    ]


def test_a_reason_is_logged_once_for_all_that_share_a_parent(caplog: pytest.LogCaptureFixture):
    parent = Refusals()
    one, other = Refusals(parent=parent), Refusals(parent=parent)
    with caplog.at_level(logging.WARNING, "zstate"):
        for refusals in (one, other, parent):
            refusals.count("loop", "text")
    assert len(caplog.records) == 1
    assert (one.counts["loop"], other.counts["loop"], parent.counts["loop"]) == (1, 1, 1)
    assert parent.first == {"loop": "text"}


def test_a_refusal_is_explained_before_it_is_counted():
    refusals, counted = Refusals(), []

    class Text:
        def __str__(self) -> str:
            counted.append(refusals.counts["late"])
            return "too late"

    refusals.count("late", Text())
    assert counted[0] == 0
    assert (refusals.counts, refusals.first) == ({"late": 1}, {"late": "too late"})
