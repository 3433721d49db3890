"""The loop check of edges that the buffer, listeners and publishers share."""

from __future__ import annotations

from typing import NamedTuple

import pytest

from zstate.buffer.edge_rules import loop_refusal


class Placed(NamedTuple):
    parent: str
    writer: str | None = None


CHAIN = {"b": Placed("a", "one"), "c": Placed("b"), "d": Placed("c", "two")}


@pytest.mark.parametrize(
    ("parent", "child", "path"),
    [
        ("d", "a", "'a' -> 'b' -> 'c' -> 'd' -> 'a'; 'a' -> 'b' is written by one"),
        ("c", "b", "'b' -> 'c' -> 'b'; 'b' -> 'c' is written by hand"),
    ],
)
def test_loop_names_its_frames_downwards_and_the_writer_of_the_first_edge(parent, child, path):
    refusal = loop_refusal(parent, child, "me", CHAIN.get)
    assert refusal is not None
    assert (refusal.reason, refusal.edge) == ("loop", (parent, child))
    assert str(refusal) == f"{parent!r} -> {child!r} by me would close the loop {path}"


def test_self_edge_is_refused_and_edges_between_branches_are_not():
    refusal = loop_refusal("a", "a", None, CHAIN.get)
    assert refusal is not None
    assert refusal.reason == "self edge"
    assert loop_refusal("b", "e", None, CHAIN.get) is None
    assert loop_refusal("e", "a", None, CHAIN.get) is None


def test_search_ends_in_a_loop_of_other_writers():
    assert loop_refusal("x", "a", None, {"x": Placed("y"), "y": Placed("x")}.get) is None
