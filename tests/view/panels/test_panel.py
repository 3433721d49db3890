"""BoundWidget and FrameDropdown: changes of the user and of the program."""

from __future__ import annotations

from zstate.view.panels.panel import BoundWidget, FrameDropdown


def test_user_change_is_returned_once(page):
    box = page.server.gui.add_checkbox("box", False)
    choice = BoundWidget[bool](box)
    assert choice.poll_change() is None
    box.value = True
    assert choice.poll_change() is True
    assert choice.poll_change() is None


def test_user_change_is_not_overwritten_by_an_older_value(page):
    number = page.server.gui.add_number("number", 1.0)
    choice = BoundWidget[float](number)
    number.value = 2.0
    choice.show(1.0)
    assert choice.poll_change() == 2.0
    choice.show(3.0)
    assert number.value == 3.0
    assert choice.poll_change() is None


def test_frame_stays_selected_while_options_change(page):
    choice = FrameDropdown(page.server.gui, "frame", "(none)")
    assert choice.frame is None
    choice.set_options(("a", "b"), "b")
    choice.set_options(("c", "a", "b"), "b")
    assert choice.frame == "b"
    choice.set_options(("c", "a"), None)
    assert choice.frame is None
    assert choice.poll_change() is None
