"""PanelLayout without a browser: user input is applied once, and only changes are sent."""

from __future__ import annotations

import pytest
import viser
from helpers.robots import RRBOT, SECOND

from zstate.buffer.buffer import TransformBuffer
from zstate.clock import ManualClock
from zstate.transform import Transform
from zstate.view.data_source import ViewSource
from zstate.view.scene.scene import Scene
from zstate.view.view import PanelLayout


@pytest.fixture
def buffer() -> TransformBuffer:
    """Ten seconds of rrbot, ten samples a second."""
    buffer = TransformBuffer(60.0, ManualClock(10 * SECOND))
    track = buffer.add_robot(RRBOT, "r1")
    for tick in range(101):
        buffer.insert_joints(track, tick * SECOND // 10, [tick / 10, 0.0])
    return buffer


def test_empty_layout_gets_its_first_frame(page):
    buffer = TransformBuffer()
    with (
        ViewSource(None, buffer=buffer) as source,
        PanelLayout(page, source, Scene(page.server)) as layout,
    ):
        snapshot = source.snapshot(layout.stamp)
        layout.update(snapshot)
        assert layout.fixed.resolve(snapshot.tree) == ""
        buffer.insert_static(Transform("map", "camera", [1, 0, 0], [0, 0, 0, 1]))
        snapshot = source.snapshot(layout.stamp)
        layout.update(snapshot)
        assert layout.fixed.resolve(snapshot.tree) == "map"


def test_paused_recording_is_shown_at_the_cursor_and_not_at_its_end(page, buffer):
    with (
        ViewSource(None, buffer=buffer) as source,
        PanelLayout(page, source, Scene(page.server)) as layout,
    ):
        layout.cursor.pause()
        assert layout.stamp == 0
        layout.cursor.seek(4 * SECOND)
        stamp = layout.stamp
        assert stamp == 4 * SECOND
        snapshot = source.snapshot(stamp)
        layout.update(snapshot)
        assert layout.stamp == 4 * SECOND


def test_update_without_changes_sends_nothing(page, buffer, monkeypatch):
    sent: list[object] = []
    with (
        ViewSource(None, buffer=buffer) as source,
        PanelLayout(page, source, Scene(page.server)) as layout,
    ):
        layout.cursor.pause()
        layout.update(source.snapshot(layout.stamp))
        pipe = page.server.gui._websock_interface
        queue = pipe.queue_message
        monkeypatch.setattr(pipe, "queue_message", lambda message: (sent.append(message), queue(message)))
        layout.update(source.snapshot(layout.stamp))
        layout.update(source.snapshot(layout.stamp))
        assert sent == []
        layout.cursor.seek(2 * SECOND)
        layout.update(source.snapshot(layout.stamp))
        assert sent


@pytest.mark.parametrize("can_command, first", [(True, "Joints"), (False, "View")])
def test_page_opens_on_the_joints_if_sliders_are_asked_for(page, buffer, monkeypatch, can_command, first):
    groups: list[viser.GuiTabGroupHandle] = []
    add = page.server.gui.add_tab_group
    monkeypatch.setattr(page.server.gui, "add_tab_group", lambda: groups.append(add()) or groups[-1])
    with (
        ViewSource(None, buffer=buffer) as source,
        PanelLayout(page, source, Scene(page.server), can_command=can_command),
    ):
        labels = groups[0]._tab_labels
        assert labels[0] == first
        assert sorted(labels) == ["Frames", "Joints", "Time", "View"]
