"""The layout without a browser: what a person chose is done once, and what is drawn follows."""

from __future__ import annotations

import pytest
from helpers.robots import RRBOT, SECOND

from zstate.buffer.buffer import TransformBuffer
from zstate.clock import ManualClock
from zstate.transform import Transform
from zstate.view.data_source import ViewSource
from zstate.view.panels.layout import PanelLayout
from zstate.view.panels.panel import BoundWidget, FrameDropdown
from zstate.view.scene.scene import Scene


@pytest.fixture
def buffer() -> TransformBuffer:
    """rrbot for ten seconds, ten samples in each."""
    buffer = TransformBuffer(60.0, ManualClock(10 * SECOND))
    track = buffer.add_robot(RRBOT, "r1")
    for tick in range(101):
        buffer.insert_joints(track, tick * SECOND // 10, [tick / 10, 0.0])
    return buffer


def test_what_a_person_chose_is_taken_once(page):
    box = page.server.gui.add_checkbox("box", False)
    choice = BoundWidget[bool](box)
    assert choice.poll_change() is None
    box.value = True
    assert choice.poll_change() is True
    assert choice.poll_change() is None


def test_what_a_person_chose_is_not_overwritten_by_what_was_shown_before(page):
    number = page.server.gui.add_number("number", 1.0)
    choice = BoundWidget[float](number)
    number.value = 2.0
    choice.show(1.0)
    assert choice.poll_change() == 2.0
    choice.show(3.0)
    assert number.value == 3.0
    assert choice.poll_change() is None


def test_a_frame_stays_chosen_while_others_come(page):
    choice = FrameDropdown(page.server.gui, "frame", "(none)")
    assert choice.frame is None
    choice.set_options(("a", "b"), "b")
    choice.set_options(("c", "a", "b"), "b")
    assert choice.frame == "b"
    choice.set_options(("c", "a"), None)
    assert choice.frame is None
    assert choice.poll_change() is None


def test_a_board_of_nothing_waits_for_the_first_robot(page):
    buffer = TransformBuffer()
    with (
        ViewSource(None, buffer=buffer) as world,
        PanelLayout(page.server, world, Scene(page.server)) as layout,
    ):
        snapshot = world.snapshot(layout.stamp)
        layout.update(snapshot)
        assert layout.fixed_frame(snapshot) == ""
        buffer.insert_static(Transform("map", "camera", [1, 0, 0], [0, 0, 0, 1]))
        snapshot = world.snapshot(layout.stamp)
        layout.update(snapshot)
        assert layout.fixed_frame(snapshot) == "map"


def test_a_recording_is_shown_at_an_instant_of_its_own_and_not_at_its_end(page, buffer):
    with (
        ViewSource(None, buffer=buffer) as world,
        PanelLayout(page.server, world, Scene(page.server)) as layout,
    ):
        layout.cursor.pause()
        assert layout.stamp == 0
        layout.cursor.seek(4 * SECOND)
        stamp = layout.stamp
        assert stamp == 4 * SECOND
        snapshot = world.snapshot(stamp)
        layout.update(snapshot)
        assert layout.stamp == 4 * SECOND


def test_where_nothing_is_new_nothing_is_sent(page, buffer, monkeypatch):
    sent: list[object] = []
    with (
        ViewSource(None, buffer=buffer) as world,
        PanelLayout(page.server, world, Scene(page.server)) as layout,
    ):
        layout.cursor.pause()
        layout.update(world.snapshot(layout.stamp))
        pipe = page.server.gui._websock_interface
        queue = pipe.queue_message
        monkeypatch.setattr(pipe, "queue_message", lambda message: (sent.append(message), queue(message)))
        layout.update(world.snapshot(layout.stamp))
        layout.update(world.snapshot(layout.stamp))
        assert sent == []
        layout.cursor.seek(2 * SECOND)
        layout.update(world.snapshot(layout.stamp))
        assert sent
