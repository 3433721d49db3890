"""Tab View: the fixed frame, the display options, and the state of each robot."""

from __future__ import annotations

import time
from collections.abc import Sequence
from datetime import datetime
from typing import Protocol

import numpy as np
import viser

from zstate.buffer.snapshot import FramePoses, FrameTable
from zstate.ingest.deadline import is_stale
from zstate.model.catalog import example_name
from zstate.view.data_source import FixedFrame, ViewSource
from zstate.view.panels import html
from zstate.view.panels.panel import FrameDropdown, PanelContext

_DISPLAYS = {
    "visuals": "Visuals",
    "collisions": "Collisions",
    "axes": "Axes",
    "names": "Names",
    "parent_lines": "Parent lines",
}
_MAX_LINES = 12


class DisplayOptions(Protocol):
    """Display options of a scene."""

    visuals: bool
    collisions: bool
    axes: bool
    names: bool
    parent_lines: bool


class DisplayPanel:
    """The fixed frame, selected from a list, and a checkbox for each display option."""

    def __init__(self, gui: viser.GuiApi, scene: DisplayOptions, fixed: FixedFrame) -> None:
        self._scene = scene
        self._fixed = fixed
        self._tree: FrameTable | None = None
        hint = "Everything is seen from this frame. Click and type to search."
        self._frames = FrameDropdown(gui, "Fixed frame", "(no frame yet)", hint)
        self._unknown = gui.add_html("")
        self._boxes = {
            name: gui.add_checkbox(label, getattr(scene, name)) for name, label in _DISPLAYS.items()
        }

    def update(self, context: PanelContext) -> None:
        tree = context.snapshot.tree
        selected = self._frames.poll_change()
        if selected is not None:
            self._fixed.requested = selected
        fixed = self._fixed.resolve(tree)
        if tree is not self._tree:
            self._tree = tree
            self._frames.set_options(tree.names, fixed or None)
        elif fixed:
            self._frames.show(fixed)
        requested = self._fixed.requested
        text = f"{requested!r} is not a known frame; everything is seen from {fixed!r}"
        is_unknown = requested not in ("", fixed)
        self._unknown.content = html.paragraph(text, color=html.WARNING) if is_unknown else ""
        for name, box in self._boxes.items():
            setattr(self._scene, name, box.value)


class RobotStyler(Protocol):
    """Settings and results of a scene for each robot."""

    def set_stale(self, robot: str, text: str | None) -> None: ...
    def missing_meshes(self, robot: str) -> Sequence[tuple[str, str]]: ...


class RobotsPanel:
    """A line for each robot, and everything that cannot be drawn. Stale robots are drawn in grey."""

    def __init__(self, gui: viser.GuiApi, source: ViewSource, scene: RobotStyler) -> None:
        self._source = source
        self._scene = scene
        self._robots = gui.add_html("")
        self._missing = gui.add_html("")

    def update(self, context: PanelContext) -> None:
        robots = self._source.robots()
        states: list[tuple[str, str]] = []
        colors: list[str] = []
        for robot in robots:
            track = context.snapshot.tree.robots.get(robot)
            rate_hz = None if track is None else track.rate_hz
            # A robot that is stale now was not when a snapshot of the past was taken.
            silent_s = self._source.silent_s(robot) if context.is_live else None
            stale = stale_text(silent_s) if silent_s is not None and is_stale(silent_s, rate_hz) else None
            self._scene.set_stale(robot, stale)
            if stale is not None:
                state = stale
            elif rate_hz is not None:
                state = f"{'live' if context.is_live else 'in the past'}, {rate_hz:.1f} Hz"
            else:
                state = "no model yet" if track is None else "no sample yet"
            states.append((robot, state))
            colors.append(html.ALARM if stale else "")
        if robots:
            self._robots.content = html.table(("Robot", "State"), states, colors)
        else:
            command = f"zstate publish {example_name()} --source sine"
            text = f"No robot is announced. Start one, for instance with: {command}"
            self._robots.content = html.paragraph(text, muted=True)
        meshes = [f"{uri}\n    {why}" for robot in robots for uri, why in self._scene.missing_meshes(robot)]
        self._missing.content = (
            disconnected_html(context.snapshot.tree, context.fixed)
            + unplaced_html(context.snapshot)
            + _listing("mesh is missing", "meshes are missing", meshes)
        )


def stale_text(silent_s: float, now_s: float | None = None) -> str:
    """ "silent for 4 s, since 14:03:22"; ``now_s`` is the present time, seconds since 1970."""
    since = datetime.fromtimestamp((time.time() if now_s is None else now_s) - silent_s).astimezone()
    minutes, seconds = divmod(int(silent_s), 60)
    hours, minutes = divmod(minutes, 60)
    duration = f"{minutes} min {seconds} s" if minutes else f"{seconds} s"
    if hours:
        duration = f"{hours} h {minutes} min"
    return f"silent for {duration}, since {since:%H:%M:%S}"


def disconnected_html(tree: FrameTable, fixed: str) -> str:
    """The roots of trees that are not connected to the fixed frame, and how to connect them."""
    if fixed not in tree.index:
        return ""
    root = int(tree.roots[tree.index[fixed]])
    counts = np.bincount(tree.roots, minlength=len(tree.names)).tolist()
    others = [(tree.names[row], count - 1) for row, count in enumerate(counts) if count and row != root]
    if not others:
        return ""
    lines = [f"{name}{f', and {below} below it' * bool(below)}" for name, below in others]
    command = f"zstate static {tree.names[root]} {others[0][0]} --xyz 1 0 0"
    text = (
        f"They are drawn next to it: their position is not known. Connect them, for instance with: {command}"
    )
    end = "not connected to the fixed frame"
    return _listing(f"frame is {end}", f"frames are {end}", lines) + html.paragraph(text, muted=True)


def unplaced_html(snapshot: FramePoses) -> str:
    """The frames without a pose, grouped by reason."""
    frames: dict[str, list[str]] = {}
    for row, reason in snapshot.reasons.items():
        frames.setdefault(reason, []).append(snapshot.tree.names[row])
    lines: list[str] = []
    for reason, names in frames.items():
        few = names if len(names) <= 3 else [names[0], f"{names[1]} and {len(names) - 2} more"]
        lines.append(f"{', '.join(few)}: {reason}")
    return _listing("frame has no pose", "frames have no pose", lines, len(snapshot.reasons))


def _listing(one: str, several: str, lines: Sequence[str], count: int | None = None) -> str:
    if not lines:
        return ""
    count = len(lines) if count is None else count
    more = len(lines) - _MAX_LINES
    shown = [*lines[:_MAX_LINES], *([f"... and {more} more"] if more > 0 else [])]
    head = f"{count} {one if count == 1 else several}"
    return html.paragraph(head, color=html.ALARM) + html.paragraph("\n".join(shown))
