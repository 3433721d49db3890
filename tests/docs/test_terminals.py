"""The comparison of terminals in pages with what commands print: numbers count, and the order of lines."""

from __future__ import annotations

import re

import pytest
from helpers.tutorial_terminal import TutorialPage, is_same, masked, shows


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("- Translation: [-0.199, 0.170]", "- Translation: [-0.198, 0.170]", True),
        ("- Translation: [-0.199, 0.170]", "- Translation: [-0.197, 0.170]", False),
        ("- Translation: [-0.199, 0.170]", "- Translation: [0.199, 0.170]", False),
        ("[-0.000, 1.000]", "[0.000, 1.000]", True),
        ("[1.3  0.17 1.05]", "[1.3  0.18 1.05]", True),
        ("(20, 7)", "(20, 8)", False),
        ("[1. 0. 0.]", "[0. 0. 0.]", False),
        ("after 250.0 ms", "after 251.0 ms", False),
        ("100 Hz", "101 Hz", False),
        ("upper -2 to 2 rad", "upper -2 to 3 rad", False),
        ("frame r1", "frame r2", False),
        ("tcp/x:7447", "tcp/x:7448", False),
    ],
)
def test_numbers_may_differ_by_one_in_their_last_decimal(one: str, other: str, same: bool) -> None:
    assert is_same(one, other) == same


def test_numbers_that_a_page_marks_as_varying_are_not_compared() -> None:
    page, output = "newest 7.8 ms ago, 48.1 Hz, 2 joints", "newest 1.2 s ago, 50 Hz, 2 joints"
    marks = ("newest # ago", "# Hz")
    assert masked([page], marks) == masked([output], marks) == ["newest # ago, # Hz, 2 joints"]
    assert masked([page], marks[:1]) != masked([output], marks[:1])


def test_lines_are_compared_in_their_order() -> None:
    assert shows(["one", "two"], ["one", "two"])
    assert not shows(["two", "one"], ["one", "two"])
    assert shows(["one", "two", "three"], ["one", "..."])


def test_a_mark_belongs_to_the_block_below_it_and_must_be_in_it() -> None:
    page = TutorialPage(
        "<!-- varies: # Hz -->\n```console\n$ one\n48.1 Hz\n```\n\n```console\n$ two\n48.1 Hz\n```\n"
    )
    assert [step.varies for step in page.steps()] == [("# Hz",), ()]
    assert page.unused_marks() == []
    assert TutorialPage("<!-- varies: # us -->\n```console\n$ one\n48.1 Hz\n```\n").unused_marks() == ["# us"]


def test_a_number_alone_marks_lines_that_are_numbers_and_nothing_else() -> None:
    assert masked(["36482296232140", "3 joints"], ["#"]) == ["#", "3 joints"]


@pytest.mark.parametrize(
    "text", ["at 1795275562.823598091", "1795279181040127414", "swing@desk pid 10835", "at 127.0.0.1:7450"]
)
def test_only_names_of_this_run_are_masked_without_a_mark(text: str) -> None:
    assert masked([text]) != [text]
    assert masked([re.sub(r"\d{4}$", "7777", text)]) == masked([text])


@pytest.mark.parametrize("text", ["4.995000000", "0.123", "-2.5", "12.5 ms", "27.2 kB", "304 messages"])
def test_figures_are_not_masked_without_a_mark(text: str) -> None:
    assert masked([text]) == [text]
