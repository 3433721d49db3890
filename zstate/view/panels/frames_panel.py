"""Tab Frames: search for a frame, details of the selected one, and the transform between two frames."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches
from typing import Protocol

import numpy as np
import viser

from zstate.buffer.snapshot import FrameTable
from zstate.clock import SYSTEM
from zstate.errors import LookupFailed
from zstate.view.panels import html
from zstate.view.panels.html import Rows, format_number, pose_rows
from zstate.view.panels.panel import BoundWidget, FrameDropdown, PanelContext

_MAX_LISTED = 10


class TrailControls(Protocol):
    """Trail settings of a scene."""

    def set_trail(self, frame: str, on: bool) -> None: ...


class FramesPanel:
    """Search field for frames: the best match is selected, and the others are listed below."""

    def __init__(self, gui: viser.GuiApi, scene: TrailControls) -> None:
        self._scene = scene
        self._tree: FrameTable | None = None
        self._query = ""
        self._enabled_trails: set[str] = set()
        self._drawn_trails: set[str] = set()
        hint = "Parts of a frame's name: hand, left gripper, ..."
        self._search = gui.add_text("Search", "", hint=hint)
        self._selected = FrameDropdown(gui, "Frame", "(none found)")
        self._found = gui.add_html("")
        self._facts = gui.add_html("")
        hint = "Draw where this frame has been."
        self._trail = BoundWidget[bool](gui.add_checkbox("Trail", False, hint=hint))
        self._clear = gui.add_button("Clear all trails", visible=False, color="gray")
        self._clear.on_click(lambda _: self._enabled_trails.clear())

    def update(self, context: PanelContext) -> None:
        tree, query = context.snapshot.tree, self._search.value
        if tree is not self._tree or query != self._query:
            found, selected = search_frames(tree.names, query), self._selected.frame
            if selected not in found or query != self._query:
                selected = found[0] if found else None
            self._tree, self._query = tree, query
            self._selected.set_options(found, selected)
            text = _found_text(found, len(tree.names), query)
            self._found.content = html.paragraph(text, muted=True) if query else ""
        checked, is_other = self._trail.poll_change(), self._selected.poll_change() is not None
        frame = self._selected.frame
        if checked is not None and frame is not None and not is_other:
            (self._enabled_trails.add if checked else self._enabled_trails.discard)(frame)
        self._facts.content = html.pairs(_frame_rows(frame, context)) if frame else ""
        self._trail.show(frame in self._enabled_trails)
        for one in self._drawn_trails ^ self._enabled_trails:
            self._scene.set_trail(one, one in self._enabled_trails)
        self._drawn_trails = set(self._enabled_trails)
        self._clear.visible = bool(self._drawn_trails)


class TransformPanel:
    """The pose of one frame in another and its speed, as `zstate tf A B --twist` prints them."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._tree: FrameTable | None = None
        self._source = FrameDropdown(gui, "Pose of", "(choose)")
        self._target = FrameDropdown(gui, "in frame", "(choose)")
        self._text = gui.add_html("")

    def update(self, context: PanelContext) -> None:
        tree = context.snapshot.tree
        if tree is not self._tree:
            self._tree = tree
            for dropdown in (self._source, self._target):
                dropdown.set_options(tree.names, dropdown.frame if dropdown.frame in tree.index else None)
        target, source = self._target.frame, self._source.frame
        if target is None or source is None:
            self._text.content = ""
            return
        rows = _pose_rows(context, target, source)
        if rows[0][0] != _NO_POSE:
            try:
                twist = context.buffer.twist(source, target, context.at)
            except LookupFailed:
                pass
            else:
                linear, angular = (float(np.linalg.norm(vector)) for vector in (twist.linear, twist.angular))
                text = f"{format_number(linear, 3)} m/s, {format_number(np.degrees(angular), 1)} deg/s"
                rows.append(("speed", text))
        self._text.content = html.pairs(rows)


def search_frames(names: Sequence[str], query: str) -> tuple[str, ...]:
    """The ``names`` that contain every word of ``query``, the best first; all names for an empty query.

    Case is ignored; spaces, underscores and slashes separate words. Frames with exactly this name come
    first, then frames that start with it, then the rest, each in the given order. If nothing matches,
    frames with a similar name.
    """
    text = query.strip().lower()
    words = text.replace("_", " ").replace("/", " ").split()
    if not words:
        return tuple(names)
    found = [name for name in names if all(word in name.lower() for word in words)]
    if not found:
        full = {name.rpartition("/")[2].lower(): name for name in reversed(names)}
        return tuple(full[bare] for bare in get_close_matches(text, full, n=8))

    def rank(name: str) -> int:
        bare = name.lower().rpartition("/")[2]
        return 0 if text in (name.lower(), bare) else 1 if bare.startswith(text) else 2

    return tuple(sorted(found, key=rank))


def _found_text(found: Sequence[str], total: int, query: str) -> str:
    if not found:
        return f"none of {total} frames matches {query!r}"
    more = len(found) - 1 - _MAX_LISTED
    listed = ", ".join(found[1 : 1 + _MAX_LISTED]) + (f" and {more} more" if more > 0 else "")
    return f"{len(found)} of {total} frames" + (f"; also {listed}" if listed else "")


_NO_POSE = "no pose"


def _frame_rows(frame: str, context: PanelContext) -> Rows:
    """Pose, parent and writer of a frame."""
    info = next(iter(context.buffer.frames((frame,))), None)
    if info is None or frame not in context.snapshot.tree.index:
        return []
    rows: Rows = [("in", context.fixed), *_pose_rows(context, context.fixed, frame)]
    if info.parent is None:
        return [*rows, ("parent", "none: this is a root")]
    rows += [("parent", info.parent), ("kind", info.kind), ("writer", info.writer or "unknown")]
    if info.kind != "static":
        rate = "-" if info.rate_hz is None else f"{info.rate_hz:.1f} Hz"
        rows += [("age", context.age_text(info.newest_in(context.domain or SYSTEM))), ("rate", rate)]
    return rows


def _pose_rows(context: PanelContext, target: str, source: str) -> Rows:
    """The pose of one frame in another, or why there is none."""
    snapshot, tree = context.snapshot, context.snapshot.tree
    pose = snapshot.poses_in(target)[tree.index[source]]
    if not np.isnan(pose).any():
        return pose_rows(pose.tolist())
    for name in (source, target):
        row = tree.index[name]
        while row >= 0:
            if row in snapshot.reasons:
                return [(_NO_POSE, f"{tree.names[row]}: {snapshot.reasons[row]}")]
            row = int(tree.parents[row])
    reason = context.buffer.explain(target, source, context.at)
    return [(_NO_POSE, "the frames are in separate trees" if reason is None else str(reason))]
