"""Texts of the tab View: unconnected trees, frames without a pose, and stale robots."""

from __future__ import annotations

import re
from datetime import datetime

import numpy as np
import pytest

from zstate.buffer.snapshot import FramePoses, FrameTable
from zstate.view.panels.display_panel import disconnected_html, stale_text, unplaced_html


def plain(text: str) -> str:
    """The text without its tags."""
    return re.sub(r"<[^>]*>", " ", text)


def snapshot(names: tuple[str, ...], reasons: dict[int, str]) -> FramePoses:
    count = len(names)
    tree = FrameTable(names, np.full(count, -1, dtype=np.intp), ("root",) * count, (None,) * count)
    known = np.array([row not in reasons for row in range(count)])
    return FramePoses(None, tree, np.tile([0.0, 0, 0, 0, 0, 0, 1], (count, 1)), known, reasons)


def test_frames_without_a_pose_are_grouped_by_reason():
    names = tuple(f"r/link{number}" for number in range(6))
    text = plain(unplaced_html(snapshot(names, dict.fromkeys(range(1, 6), "no joint sample"))))
    assert "5 frames have no pose" in text
    assert "r/link1, r/link2 and 3 more: no joint sample" in text


def test_single_frame_without_a_pose_is_in_the_singular():
    text = plain(unplaced_html(snapshot(("r/a", "r/b"), {1: "silent"})))
    assert "1 frame has no pose" in text
    assert "r/b: silent" in text


def test_unconnected_trees_are_listed_with_a_command_that_connects_them():
    parents = np.array([-1, 0, -1, 2, -1], dtype=np.intp)
    names = ("a/base", "a/tip", "b/base", "b/tip", "map")
    tree = FrameTable(names, parents, ("root", "joint", "root", "joint", "root"), (None,) * 5)
    text = plain(disconnected_html(tree, "a/tip"))
    assert "2 frames are not connected to the fixed frame" in text
    assert "b/base, and 1 below it\nmap" in text
    assert "zstate static a/base b/base --xyz 1 0 0" in text
    connected = FrameTable(names[:2], parents[:2], ("root", "joint"), (None,) * 2)
    assert not disconnected_html(connected, "a/base")


def test_no_text_if_every_frame_has_a_pose():
    assert not unplaced_html(snapshot(("r/a",), {}))


@pytest.mark.parametrize(
    ("silent_s", "lasting"),
    [(4.71, "4 s"), (75.0, "1 min 15 s"), (3 * 3600 + 25 * 60 + 7, "3 h 25 min")],
)
def test_stale_text_has_duration_and_start(silent_s: float, lasting: str):
    now = datetime(2026, 3, 4, 15, 6, 7).astimezone()
    since = datetime.fromtimestamp(now.timestamp() - silent_s).astimezone()
    assert stale_text(silent_s, now.timestamp()) == f"silent for {lasting}, since {since:%H:%M:%S}"
