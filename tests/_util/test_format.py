from __future__ import annotations

from zstate._util.format import did_you_mean, suggestion_text


def test_similar_names_are_suggested_and_others_are_not():
    assert did_you_mean("elbov", ["shoulder", "elbow"]) == "; did you mean 'elbow'?"
    assert not did_you_mean("wrist", ["shoulder", "elbow"])
    assert did_you_mean("arm_1", ["arm_2", "arm_3", "hand"], count=2) == "; did you mean 'arm_3' or 'arm_2'?"


def test_nothing_is_suggested_without_known_names():
    assert not suggestion_text()
    assert not suggestion_text(None)
