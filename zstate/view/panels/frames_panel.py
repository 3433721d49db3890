"""The list of frames, with a search, and what is known of the one that is selected.

Search: the frames that somebody means who types a part of a name.
"""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches
from typing import Protocol

import numpy as np
import viser

from zstate.buffer.snapshot import FrameTable
from zstate.clock import SYSTEM
from zstate.view.data_source import ViewSource
from zstate.view.panels import html
from zstate.view.panels.context import PanelContext
from zstate.view.panels.html import Rows, pose_rows
from zstate.view.panels.widgets import BoundWidget, FrameChoice


def found_frames(names: Sequence[str], query: str) -> tuple[str, ...]:
    """The ``names`` in which every word of ``query`` occurs, the best first; all of them for no word.

    Case does not count, nor whether words are parted by spaces, underlines or slashes. A frame that is
    called so comes before those that begin so, and these before the rest, each in the given order. Where
    nothing fits, what is spelt nearly so.
    """
    words = query.lower().replace("_", " ").replace("/", " ").split()
    if not words:
        return tuple(names)
    found = [name for name in names if all(word in name.lower() for word in words)]
    if not found:
        return _nearly(names, query.strip().lower())
    wanted = query.strip().lower()
    return tuple(sorted(found, key=lambda name: _rank(name.lower(), wanted)))


def _rank(name: str, wanted: str) -> int:
    bare = name.rpartition("/")[2]
    if wanted in (name, bare):
        return 0
    return 1 if bare.startswith(wanted) else 2


def _nearly(names: Sequence[str], wanted: str) -> tuple[str, ...]:
    full = {name.rpartition("/")[2].lower(): name for name in reversed(names)}
    return tuple(full[bare] for bare in get_close_matches(wanted, full, n=8))


_NO_FRAME = "(none found)"
_MOST_LISTED = 10


class TrailControls(Protocol):
    """What a scene does with trails."""

    def trail(self, frame: str, on: bool) -> None: ...


class FramesPanel:
    """Type a part of a name: the best match is selected, and the others stand below it."""

    def __init__(self, gui: viser.GuiApi, world: ViewSource, scene: TrailControls) -> None:
        self._world = world
        self._scene = scene
        self._tree: FrameTable | None = None
        self._query = ""
        self._trailing: set[str] = set()
        hint = "Parts of a frame's name: hand, left gripper, ..."
        self._search = gui.add_text("Search", "", hint=hint)
        self._selected = FrameChoice(gui, "Frame", _NO_FRAME)
        self._found = gui.add_html("")
        self._facts = gui.add_html("")
        hint = "Draw where this frame has been."
        self._trail = BoundWidget[bool](gui.add_checkbox("Trail", False, hint=hint))
        self._clear = gui.add_button("Clear all trails", visible=False, color="gray")
        self._clear.on_click(lambda _: self._trailing.clear())
        self._drawn: set[str] = set()

    def update(self, look: PanelContext) -> None:
        query = self._search.value
        if look.moment.tree is not self._tree or query != self._query:
            self._find(look.moment.tree, query)
        wanted, is_other = self._trail.poll_change(), self._selected.poll_change() is not None
        frame = self._selected.frame
        if wanted is not None and frame is not None and not is_other:
            (self._trailing.add if wanted else self._trailing.discard)(frame)
        self._facts.content = html.pairs(self._rows(frame, look)) if frame else ""
        self._trail.show(frame in self._trailing)
        self._draw_trails()

    def _draw_trails(self) -> None:
        for frame in self._drawn ^ self._trailing:
            self._scene.trail(frame, frame in self._trailing)
        self._drawn = set(self._trailing)
        self._clear.visible = bool(self._drawn)

    def _find(self, tree: FrameTable, query: str) -> None:
        found, selected = found_frames(tree.names, query), self._selected.frame
        if selected not in found or query != self._query:
            selected = found[0] if found else None
        self._tree, self._query = tree, query
        self._selected.offer(found, selected)
        self._found.content = html.paragraph(_found_text(found, tree, query), muted=True) if query else ""

    def _rows(self, frame: str, look: PanelContext) -> Rows:
        info = next(iter(look.buffer.frames((frame,))), None)
        if info is None or frame not in look.moment.tree.index:
            return []
        rows: Rows = [("in", look.fixed), *self._pose(frame, look)]
        if info.parent is None:
            return [*rows, ("parent", "none: this is a root")]
        rows += [("parent", info.parent), ("kind", info.kind), ("writer", info.writer or "unknown")]
        if info.kind != "static":
            rate = "-" if info.rate_hz is None else f"{info.rate_hz:.1f} Hz"
            rows += [("age", look.age_text(info.newest_in(look.domain or SYSTEM))), ("rate", rate)]
        return rows

    def _pose(self, frame: str, look: PanelContext) -> Rows:
        moment = look.moment
        pose = moment.poses_in(look.fixed)[moment.tree.index[frame]]
        if not np.isnan(pose).any():
            return pose_rows(pose.tolist())
        return [("no pose", self._reason(frame, look))]

    def _reason(self, frame: str, look: PanelContext) -> str:
        return explain_no_pose(self._world, look, look.fixed, frame)


def explain_no_pose(world: ViewSource, look: PanelContext, target: str, source: str) -> str:
    """Why there is no pose of one frame in another at this moment."""
    tree = look.moment.tree
    for name in (source, target):
        row = tree.index[name]
        while row >= 0:
            if row in look.moment.reasons:
                return f"{tree.names[row]}: {look.moment.reasons[row]}"
            row = int(tree.parents[row])
    reason = world.buffer.explain(target, source, look.at)
    return "no known edges join the two" if reason is None else str(reason)


def _found_text(found: Sequence[str], tree: FrameTable, query: str) -> str:
    if not found:
        return f"none of {len(tree.names)} frames is called anything like {query!r}"
    more = len(found) - 1 - _MOST_LISTED
    listed = ", ".join(found[1 : 1 + _MOST_LISTED]) + (f" and {more} more" if more > 0 else "")
    return f"{len(found)} of {len(tree.names)} frames" + (f"; also {listed}" if listed else "")
