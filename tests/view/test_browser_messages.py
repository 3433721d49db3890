"""accept_message: viser receives what the page sends, and nothing else that a browser may send."""

from __future__ import annotations

import logging
import math
from typing import Any

import pytest

pytest.importorskip("viser")

import msgspec
from helpers.browser_client import CAMERA, browser
from helpers.processes import until

from zstate.view.browser_messages import accept_message


def test_no_browser_switches_off_a_button_of_the_others(page, caplog):
    clicks: list[int] = []
    button = page.server.gui.add_button("STOP")
    button.on_click(lambda event: clicks.append(event.client_id))
    with browser(page) as hostile, browser(page) as other:
        until(lambda: len(page.server.get_clients()) == 2)
        with caplog.at_level(logging.WARNING, "zstate"):
            hostile.update(button, update_cb=[])
            hostile.update(button, removed=True)
            hostile.update(button, is_button=False, value=True)
            hostile.update(button, value=True)
            until(lambda: len(clicks) == 1)
            other.update(button, value=True)
            until(lambda: len(clicks) == 2)
    assert len(set(clicks)) == 2
    assert caplog.text.count("a browser at 127.0.0.1 sent a message that this page does not send") == 1


@pytest.fixture(scope="module")
def widgets(page) -> dict[str, Any]:
    gui = page.server.gui
    return {
        "button": gui.add_button("button"),
        "box": gui.add_checkbox("box", False),
        "text": gui.add_text("text", ""),
        "list": gui.add_dropdown("list", ("a", "b")),
        "buttons": gui.add_button_group("buttons", ("go", "halt")),
        "slider": gui.add_slider("slider", -1.0, 1.0, 0.1, 0.0),
        "count": gui.add_slider("count", 1, 5, 1, 2),
        "number": gui.add_number("number", 1.0, min=0.1, max=1000.0),
    }


def accepted(widgets: dict[str, Any], message: dict[str, Any]) -> Any:
    """What viser receives of a message; None if it is ignored."""
    raw = accept_message(msgspec.msgpack.encode(message), widgets.get)
    return None if raw is None else msgspec.msgpack.decode(raw)


def accepted_value(widgets: dict[str, Any], name: str, value: object) -> Any:
    message = {"type": "GuiUpdateMessage", "uuid": name, "updates": {"value": value}}
    received = accepted(widgets, message)
    return None if received is None else received["updates"]["value"]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("button", True),
        ("box", True),
        ("text", "left hand"),
        ("list", "b"),
        ("buttons", "halt"),
        ("slider", 0.5),
        ("slider", 1),
        ("count", 3),
        ("number", 50),
    ],
)
def test_values_that_a_user_can_select_are_accepted(widgets, name, value):
    assert accepted_value(widgets, name, value) == value


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("button", "x"),
        ("box", 1),
        ("text", 1.0),
        ("text", "x" * 1001),
        ("list", "c"),
        ("buttons", "__class__"),
        ("slider", math.nan),
        ("slider", math.inf),
        ("slider", True),
        ("slider", "0.5"),
        ("count", math.nan),
        ("number", [1.0]),
        ("number", None),
        ("unknown", 1.0),
    ],
)
def test_values_that_no_user_can_select_are_ignored(widgets, name, value):
    assert accepted_value(widgets, name, value) is None


def test_numbers_outside_a_range_become_its_ends(widgets):
    assert accepted_value(widgets, "slider", 7.0) == 1.0
    assert accepted_value(widgets, "count", -(2**62)) == 1
    assert accepted_value(widgets, "number", 0) == 0.1


@pytest.mark.parametrize(
    "message",
    [
        {"type": "GuiUpdateMessage", "uuid": "box", "updates": {}},
        {"type": "GuiUpdateMessage", "uuid": "box", "updates": {"value": True, "removed": True}},
        {"type": "GuiFormDirtyMessage", "uuid": "box"},
        {"type": "GuiFormSubmitMessage", "uuid": "box"},
        {"type": "FileTransferStartUpload", "source_component_uuid": "box", "transfer_uuid": "1"},
        {"type": "ShareUrlRequest"},
        {"type": "RunJavascriptMessage", "source": "alert(1)"},
        {"type": "SceneNodeClickMessage", "name": "/floor"},
        {"type": ["ViewerCameraMessage"]},
        {},
    ],
)
def test_messages_that_the_page_does_not_send_are_ignored(widgets, message):
    assert accepted(widgets, message) is None


@pytest.mark.parametrize("raw", ["text", b"", b"\xc1", b"\x01", b"\x91" * 100_000])
def test_malformed_messages_are_ignored(widgets, raw):
    assert accept_message(raw, widgets.get) is None


def test_camera_and_requested_pictures_are_passed_unchanged(widgets):
    for message in (CAMERA, {"type": "GetRenderResponseMessage", "payload": b"png", "render_uuid": "1"}):
        raw = msgspec.msgpack.encode(message)
        assert accept_message(raw, widgets.get) == raw
