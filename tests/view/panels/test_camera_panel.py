"""CamerasPanel: the tab appears with the first picture, and shows its bytes and its age."""

from __future__ import annotations

import pytest

viser = pytest.importorskip("viser")

from helpers.pictures import jpeg  # noqa: E402

from zstate.buffer.buffer import TransformBuffer  # noqa: E402
from zstate.clock import ManualClock  # noqa: E402
from zstate.transform import Transform  # noqa: E402
from zstate.view.data_source import ViewSource  # noqa: E402
from zstate.view.panels.camera_panel import picture_text  # noqa: E402
from zstate.view.panels.panel import PanelContext  # noqa: E402
from zstate.view.pictures import Packet, StillPicture  # noqa: E402
from zstate.view.scene.cameras import ShownPicture  # noqa: E402
from zstate.view.scene.scene import Scene  # noqa: E402
from zstate.view.view import PanelLayout  # noqa: E402
from zstate.view.world_source import WriterName  # noqa: E402

MS = 1_000_000
DATA = jpeg()
PICTURE = StillPicture(Packet(900 * MS, "r1/lens", "jpeg", DATA, (1, 0)), "jpeg", DATA, (64, 48))


@pytest.fixture
def buffer() -> TransformBuffer:
    buffer = TransformBuffer(60.0, ManualClock(1000 * MS))
    buffer.insert(Transform("odom", "r1/lens", (0, 0, 0), (0, 0, 0, 1), stamp=950 * MS))
    return buffer


def test_tab_appears_with_the_first_picture_whose_bytes_are_sent(page, buffer, monkeypatch):
    scene, images = Scene(page.server), []
    add = page.server.gui.add_image

    def added(*args, **options):
        images.append(add(*args, **options))
        return images[-1]

    monkeypatch.setattr(page.server.gui, "add_image", added)
    with ViewSource(None, buffer=buffer) as source, PanelLayout(page, source, scene) as layout:
        layout.update(source.snapshot())
        assert images == []
        scene.cameras.shown = {WriterName("r1", "wrist"): ShownPicture(PICTURE, None, False, None)}
        layout.update(source.snapshot())
        (image,) = images
        assert image._data is DATA
        scene.cameras.shown = {}
        layout.update(source.snapshot())
        assert image._impl.removed


def context(buffer: TransformBuffer, *, is_live: bool) -> PanelContext:
    snapshot = buffer.snapshot(950 * MS)
    now = buffer.clock.now() if is_live else None
    return PanelContext(snapshot, "odom", buffer, is_live, now, "system", None)


def test_age_of_a_picture_is_live_that_to_the_present_and_else_to_the_instant_on_display(buffer):
    shown = ShownPicture(PICTURE, None, False, None)
    assert picture_text(shown, context(buffer, is_live=True)) == "64 x 48 jpeg, 100.0 ms old"
    text = picture_text(shown, context(buffer, is_live=False))
    assert text == "64 x 48 jpeg, 50.0 ms before the instant on display"


def test_old_picture_says_why_there_is_no_newer_one(buffer):
    silent = ShownPicture(PICTURE, None, True, None)
    broken = ShownPicture(PICTURE, None, True, "a broken h264")
    assert picture_text(silent, context(buffer, is_live=True)).endswith("old, no newer one arrives")
    assert picture_text(broken, context(buffer, is_live=True)).endswith("old, a broken h264")
