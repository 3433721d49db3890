"""What the panels say, and that a browser runs none of it."""

from __future__ import annotations

import re
from datetime import datetime

import numpy as np
import pytest

from zstate.buffer.snapshot import FramePoses, FrameTable
from zstate.net.graph import Graph, StreamUse, WriterState
from zstate.view.panels import html
from zstate.view.panels.display_panel import disconnected_html, stale_text, unplaced_html
from zstate.view.panels.graph_panel import graph_html
from zstate.wire.messages import Level, Status

SCRIPT = "<img src=x onerror=alert(1)>\"'&"


def plain(text: str) -> str:
    """What a browser shows of it, more or less."""
    return re.sub(r"<[^>]*>", " ", text)


def test_names_out_of_the_network_are_text_and_nothing_else():
    for made in (
        html.paragraph(SCRIPT),
        html.heading(SCRIPT),
        html.pairs([(SCRIPT, SCRIPT)]),
        html.table((SCRIPT,), [(SCRIPT,)]),
    ):
        assert "<img" not in made
        assert "&lt;img" in made


def snapshot(names: tuple[str, ...], reasons: dict[int, str]) -> FramePoses:
    count = len(names)
    tree = FrameTable(names, np.full(count, -1, dtype=np.intp), ("root",) * count, (None,) * count)
    known = np.array([row not in reasons for row in range(count)])
    return FramePoses(None, tree, np.tile([0.0, 0, 0, 0, 0, 0, 1], (count, 1)), known, reasons)


def test_frames_that_have_no_pose_for_one_reason_are_told_of_together():
    names = tuple(f"r/link{number}" for number in range(6))
    text = plain(unplaced_html(snapshot(names, dict.fromkeys(range(1, 6), "no joint sample"))))
    assert "5 frames have no pose" in text
    assert "r/link1, r/link2 and 3 more: no joint sample" in text


def test_one_frame_without_a_pose_is_told_of_in_the_singular():
    text = plain(unplaced_html(snapshot(("r/a", "r/b"), {1: "silent"})))
    assert "1 frame has no pose" in text
    assert "r/b: silent" in text


def test_robots_that_stand_on_nothing_in_common_are_told_of_with_what_joins_them():
    parents = np.array([-1, 0, -1, 2, -1], dtype=np.intp)
    names = ("a/base", "a/tip", "b/base", "b/tip", "map")
    tree = FrameTable(names, parents, ("root", "joint", "root", "joint", "root"), (None,) * 5)
    text = plain(disconnected_html(tree, "a/tip"))
    assert "2 frames are not joined to the fixed frame" in text
    assert "b/base, and 1 below it\nmap" in text
    assert "zstate static a/base b/base --xyz 1 0 0" in text
    joined = FrameTable(names[:2], parents[:2], ("root", "joint"), (None,) * 2)
    assert not disconnected_html(joined, "a/base")


def test_nothing_is_said_where_every_frame_has_its_pose():
    assert not unplaced_html(snapshot(("r/a",), {}))


def status(level: Level, text: str = "") -> Status:
    return Status(1, 2, level, "driver", "host", 42, 99.94, 1000, 0, text)


def test_a_publisher_is_told_of_with_its_rate_and_its_own_words():
    text = plain(graph_html([WriterState("r1", status("warn", "3 ticks late"), 0.5)], Graph()))
    assert "r1 at 99.9 Hz" in text
    assert "driver pid 42: 3 ticks late" in text


def test_what_a_publisher_said_long_ago_does_not_hold_any_more():
    made = graph_html([WriterState("r1", status("ok"), 12.0)], Graph())
    assert "has said nothing for 12.0 s" in plain(made)
    assert html.ALARM in made


def test_streams_with_the_same_ends_stand_together_and_what_nobody_writes_stands_out():
    uses = (
        StreamUse("r1", "joint_states", ("a",), ("b", "c")),
        StreamUse("r1", "tf", ("a",), ("b", "c")),
        StreamUse("r2", "tf", (), ("b",)),
    )
    made = graph_html((), Graph(uses))
    assert "r1: joint_states, tf" in plain(made)
    assert re.search(r"written by\s+nobody", plain(made))
    assert made.count(html.ALARM) == 1


@pytest.mark.parametrize(
    ("silent_s", "lasting"),
    [(4.71, "4 s"), (75.0, "1 min 15 s"), (3 * 3600 + 25 * 60 + 7, "3 h 25 min")],
)
def test_a_silence_is_said_with_how_long_and_since_when(silent_s: float, lasting: str):
    now = datetime(2026, 3, 4, 15, 6, 7).astimezone()
    since = datetime.fromtimestamp(now.timestamp() - silent_s).astimezone()
    assert stale_text(silent_s, now.timestamp()) == f"silent for {lasting}, since {since:%H:%M:%S}"
