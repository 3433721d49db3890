"""Which robots there are, whether they say anything, and what cannot be drawn of them."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Protocol

import numpy as np
import viser

from zstate.buffer.snapshot import FramePoses, FrameTable
from zstate.ingest.deadline import is_stale
from zstate.model.catalog import example_name
from zstate.view.data_source import ViewSource
from zstate.view.panels import html
from zstate.view.panels.context import PanelContext

_MOST_LINES = 12


class RobotStyler(Protocol):
    """What a scene does with robots."""

    def grey(self, robot: str, since: str | None) -> None: ...
    def missing_meshes(self, robot: str) -> Sequence[tuple[str, str]]: ...


class RobotsPanel:
    """A line for each robot. One that is silent is drawn grey, with the time since when."""

    def __init__(self, gui: viser.GuiApi, world: ViewSource, scene: RobotStyler) -> None:
        self._world = world
        self._scene = scene
        self._robots = gui.add_html("")
        self._missing = gui.add_html("")

    def update(self, look: PanelContext) -> None:
        robots = self._world.robots()
        silences = {robot: self._silence(robot, look) for robot in robots}
        for robot, silence in silences.items():
            self._scene.grey(robot, silence)
        self._robots.content = self._table(look, silences)
        apart = disconnected_html(look.moment.tree, look.fixed)
        self._missing.content = apart + unplaced_html(look.moment) + self._meshes(robots)

    def _silence(self, robot: str, look: PanelContext) -> str | None:
        # Who is silent now was not when what is shown happened.
        silent_s = self._world.silent_s(robot) if look.is_present else None
        if silent_s is None or not is_stale(silent_s, _rate_hz(robot, look)):
            return None
        return silence_text(silent_s)

    def _table(self, look: PanelContext, silences: Mapping[str, str | None]) -> str:
        if not silences:
            start = f"zstate publish {example_name()} --source sine"
            text = f"No robot is announced. Start one, for instance with: {start}"
            return html.paragraph(text, muted=True)
        rows = [(robot, silence or self._state(robot, look)) for robot, silence in silences.items()]
        colors = [html.ALARM if silence else "" for silence in silences.values()]
        return html.table(("Robot", "State"), rows, colors)

    def _state(self, robot: str, look: PanelContext) -> str:
        rate_hz = _rate_hz(robot, look)
        if rate_hz is None:
            return "no sample yet" if robot in look.moment.tree.robots else "no model yet"
        return f"{'live' if look.is_present else 'in the past'}, {rate_hz:.1f} Hz"

    def _meshes(self, robots: Sequence[str]) -> str:
        lines = [
            f"{uri}\n    {where}" for robot in robots for uri, where in self._scene.missing_meshes(robot)
        ]
        return _listing("meshes are missing", "mesh is missing", lines)


def silence_text(silent_s: float, now_s: float | None = None) -> str:
    """ "silent for 4 s, since 14:03:22"; ``now_s`` is the present time, seconds since 1970."""
    since = datetime.fromtimestamp((time.time() if now_s is None else now_s) - silent_s).astimezone()
    minutes, seconds = divmod(int(silent_s), 60)
    hours, minutes = divmod(minutes, 60)
    duration = f"{minutes} min {seconds} s" if minutes else f"{seconds} s"
    if hours:
        duration = f"{hours} h {minutes} min"
    return f"silent for {duration}, since {since:%H:%M:%S}"


def _rate_hz(robot: str, look: PanelContext) -> float | None:
    track = look.moment.tree.robots.get(robot)
    return None if track is None else track.rate_hz


def disconnected_html(tree: FrameTable, fixed: str) -> str:
    """The roots that nothing joins to the fixed frame, so that they are drawn beside it, anywhere."""
    if fixed not in tree.index:
        return ""
    root = int(tree.roots[tree.index[fixed]])
    counts = np.bincount(tree.roots, minlength=len(tree.names)).tolist()
    apart = [(tree.names[row], count - 1) for row, count in enumerate(counts) if count and row != root]
    if not apart:
        return ""
    lines = [f"{name}{f', and {below} below it' * bool(below)}" for name, below in apart]
    advice = f"zstate static {tree.names[root]} {apart[0][0]} --xyz 1 0 0"
    listing = _listing(
        "frames are not joined to the fixed frame", "frame is not joined to the fixed frame", lines
    )
    said = f"They are drawn beside it: their place is not known. Join them, for instance with: {advice}"
    return listing + html.paragraph(said, muted=True)


def unplaced_html(moment: FramePoses) -> str:
    """The frames that have no pose, with the reason; those together that have the same."""
    frames: dict[str, list[str]] = {}
    for row, reason in moment.reasons.items():
        frames.setdefault(reason, []).append(moment.tree.names[row])
    lines = [f"{_enumerated(names)}: {reason}" for reason, names in frames.items()]
    count = len(moment.reasons)
    return _listing("frames have no pose", "frame has no pose", lines, count)


def _enumerated(names: Sequence[str]) -> str:
    if len(names) <= 3:
        return ", ".join(names)
    return f"{names[0]}, {names[1]} and {len(names) - 2} more"


def _listing(several: str, one: str, lines: Sequence[str], count: int | None = None) -> str:
    if not lines:
        return ""
    count = len(lines) if count is None else count
    more = len(lines) - _MOST_LINES
    shown = [*lines[:_MOST_LINES], *([f"... and {more} more"] if more > 0 else [])]
    head = f"{count} {one if count == 1 else several}"
    return html.paragraph(head, color=html.ALARM) + html.paragraph("\n".join(shown))
