"""Tab Cameras: the newest picture of each camera."""

from __future__ import annotations

import numpy as np
import viser

from zstate.errors import format_duration
from zstate.view.panels import html
from zstate.view.panels.panel import PanelContext
from zstate.view.pictures import StillPicture
from zstate.view.scene.cameras import Cameras, ShownPicture
from zstate.view.world_source import WriterName

_NO_PIXELS = np.zeros((1, 1, 3), np.uint8)


class CamerasPanel:
    """The newest picture of each camera, its age and its size; the tab appears with the first picture."""

    def __init__(self, gui: viser.GuiApi, tabs: viser.GuiTabGroupHandle, cameras: Cameras) -> None:
        self._gui = gui
        self._tabs = tabs
        self._cameras = cameras
        self._tab: viser.GuiTabHandle | None = None
        self._boxes: tuple[viser.GuiCheckboxHandle, viser.GuiCheckboxHandle] | None = None
        self._panels: dict[WriterName, _CameraPanel] = {}

    def update(self, context: PanelContext) -> None:
        shown = self._cameras.shown
        for name in self._panels.keys() - shown.keys():
            self._panels.pop(name).remove()
        if shown and self._tab is None:
            self._tab = self._tabs.add_tab("Cameras")
            with self._tab:
                hint = "Draw each picture on the frustum of its camera, too."
                frustums = self._gui.add_checkbox("Frustums", self._cameras.frustums, hint=hint)
                hint = "Lines of the robots where they were at the stamp of the picture, by the calibration."
                models = self._gui.add_checkbox("Model over picture", self._cameras.models, hint=hint)
                self._boxes = frustums, models
        if self._tab is None or self._boxes is None:
            return
        self._cameras.frustums, self._cameras.models = (box.value for box in self._boxes)
        for name, picture in shown.items():
            if name not in self._panels:
                with self._tab:
                    self._panels[name] = _CameraPanel(self._gui, name)
            self._panels[name].update(picture, context)


class _CameraPanel:
    """The picture of one camera."""

    def __init__(self, gui: viser.GuiApi, name: WriterName) -> None:
        self._folder = gui.add_folder(str(name))
        with self._folder:
            self._text = gui.add_html("")
            self._image = gui.add_image(_NO_PIXELS, format="jpeg")
        self._drawn: StillPicture | None = None

    def update(self, shown: ShownPicture, context: PanelContext) -> None:
        picture = shown.picture
        if picture is not self._drawn:
            # viser takes arrays, which it encodes; these are the properties behind.
            self._image._format = picture.format  # pyright: ignore[reportPrivateUsage]
            self._image._data = picture.data  # pyright: ignore[reportPrivateUsage]
            self._drawn = picture
        text = picture_text(shown, context)
        self._text.content = html.paragraph(text, color=html.ALARM if shown.is_old else "")

    def remove(self) -> None:
        """Remove it from the page."""
        self._folder.remove()


def picture_text(shown: ShownPicture, context: PanelContext) -> str:
    """The size, the format and the age of a picture, and why there is no newer one."""
    packet = shown.picture.packet
    width, height = shown.picture.size
    parts = [f"{width} x {height} {packet.format}"]
    now = context.now if context.is_live else context.snapshot.stamp
    if now is not None:
        age = format_duration(now - packet.stamp)
        parts.append(f"{age} old" if context.is_live else f"{age} before the instant on display")
    if shown.is_old:
        parts.append(shown.problem or "no newer one arrives")
    if shown.model_problem is not None:
        parts.append(f"without the model: {shown.model_problem}")
    return ", ".join(parts)
