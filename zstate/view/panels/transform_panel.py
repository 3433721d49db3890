"""The transform between any two frames."""

from __future__ import annotations

import numpy as np
import viser

from zstate.buffer.snapshot import FrameTable
from zstate.errors import LookupFailed
from zstate.view.data_source import ViewSource
from zstate.view.panels import html
from zstate.view.panels.context import PanelContext
from zstate.view.panels.frames_panel import explain_no_pose
from zstate.view.panels.html import Rows, digits, pose_rows
from zstate.view.panels.widgets import FrameChoice

_NONE = "(choose)"


class TransformPanel:
    """The pose of one frame in another, with how fast it moves: what `zstate tf A B --twist` prints."""

    def __init__(self, gui: viser.GuiApi, world: ViewSource) -> None:
        self._world = world
        self._tree: FrameTable | None = None
        self._source = FrameChoice(gui, "Pose of", _NONE)
        self._target = FrameChoice(gui, "in frame", _NONE)
        self._text = gui.add_html("")

    def update(self, look: PanelContext) -> None:
        tree = look.moment.tree
        if tree is not self._tree:
            self._tree = tree
            for choice in (self._source, self._target):
                choice.offer(tree.names, choice.frame if choice.frame in tree.index else None)
        target, source = self._target.frame, self._source.frame
        rows = [] if target is None or source is None else self._rows(look, target, source)
        self._text.content = html.pairs(rows) if rows else ""

    def _rows(self, look: PanelContext, target: str, source: str) -> Rows:
        tree = look.moment.tree
        pose = look.moment.poses_in(target)[tree.index[source]]
        if np.isnan(pose).any():
            return [("no answer", explain_no_pose(self._world, look, target, source))]
        return [*pose_rows(pose.tolist()), *self._motion(look, target, source)]

    def _motion(self, look: PanelContext, target: str, source: str) -> Rows:
        try:
            speed = self._world.buffer.twist(source, target, look.at)
        except LookupFailed:
            return []
        moves, turns = (float(np.linalg.norm(vector)) for vector in (speed.linear, speed.angular))
        return [("speed", f"{digits(moves, 3)} m/s, {digits(np.degrees(turns), 1)} deg/s")]
