"""Texts of the tab Graph: publishers with their status, and grouped streams."""

from __future__ import annotations

import re

from zstate.net.graph import Graph, StreamUse, WriterState
from zstate.view.panels import html
from zstate.view.panels.graph_panel import graph_html
from zstate.wire.messages import Level, Status


def plain(text: str) -> str:
    """The text without its tags."""
    return re.sub(r"<[^>]*>", " ", text)


def status(level: Level, text: str = "") -> Status:
    return Status(1, 2, level, "driver", "host", 42, 99.94, 1000, 0, text)


def test_publisher_is_listed_with_its_rate_and_status():
    text = plain(graph_html([WriterState("r1", status("warn", "3 ticks late"), 0.5)], Graph()))
    assert "r1 at 99.9 Hz" in text
    assert "driver pid 42: 3 ticks late" in text


def test_expired_status_is_an_alarm():
    made = graph_html([WriterState("r1", status("ok"), 12.0)], Graph())
    assert "no status for 12.0 s" in plain(made)
    assert html.ALARM in made


def test_streams_with_the_same_writers_are_grouped_and_no_writer_is_an_alarm():
    uses = (
        StreamUse("r1", "joint_states", ("a",), ("b", "c")),
        StreamUse("r1", "tf", ("a",), ("b", "c")),
        StreamUse("r2", "tf", (), ("b",)),
    )
    made = graph_html((), Graph(uses))
    assert "r1: joint_states, tf" in plain(made)
    assert re.search(r"written by\s+none", plain(made))
    assert made.count(html.ALARM) == 1
