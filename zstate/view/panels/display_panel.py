"""What is drawn, and seen from where."""

from __future__ import annotations

from typing import Protocol

import viser

from zstate.buffer.snapshot import FrameTable
from zstate.view.data_source import FixedFrame
from zstate.view.panels import html
from zstate.view.panels.context import PanelContext
from zstate.view.panels.widgets import FrameChoice

_NO_FRAME = "(no frame yet)"


class DisplayOptions(Protocol):
    """What of a scene is shown."""

    visuals: bool
    collisions: bool
    axes: bool
    names: bool
    parent_lines: bool


class DisplayPanel:
    """The fixed frame, chosen from a list, and a box to tick for each thing that may be shown."""

    def __init__(self, gui: viser.GuiApi, scene: DisplayOptions, fixed: FixedFrame) -> None:
        self._scene = scene
        self._fixed = fixed
        self._tree: FrameTable | None = None
        hint = "Everything is seen from this frame. Click and type to search."
        self._frames = FrameChoice(gui, "Fixed frame", _NO_FRAME, hint)
        self._unknown = gui.add_html("")
        self._visuals = gui.add_checkbox("Visuals", scene.visuals)
        self._collisions = gui.add_checkbox("Collisions", scene.collisions)
        self._axes = gui.add_checkbox("Axes", scene.axes)
        self._names = gui.add_checkbox("Names", scene.names)
        self._parent_lines = gui.add_checkbox("Parent lines", scene.parent_lines)

    def update(self, look: PanelContext) -> None:
        tree = look.moment.tree
        chosen = self._frames.poll_change()
        if chosen is not None:
            self._fixed.chosen = chosen
        fixed = self._fixed.choose(tree)
        if tree is not self._tree:
            self._tree = tree
            self._frames.offer(tree.names, fixed or None)
        elif fixed:
            self._frames.show(fixed)
        wanted = self._fixed.chosen
        said = f"{wanted!r} is not a known frame; everything is seen from {fixed!r}"
        self._unknown.content = html.paragraph(said, color=html.WARNING) if wanted not in ("", fixed) else ""
        self._switch(self._scene)

    def _switch(self, scene: DisplayOptions) -> None:
        scene.visuals = self._visuals.value
        scene.collisions = self._collisions.value
        scene.axes = self._axes.value
        scene.names = self._names.value
        scene.parent_lines = self._parent_lines.value
