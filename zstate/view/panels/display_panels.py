"""Tabs View, Frames and Graph: what is drawn, the state of robots, frames and streams."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from difflib import get_close_matches

import numpy as np
import viser

from zstate.buffer.snapshot import FramePoses, FrameTable
from zstate.buffer.tracks import JointTrack, PoseTrack, Track
from zstate.clock import SYSTEM
from zstate.errors import LookupFailed, format_duration
from zstate.ingest.deadline import is_stale
from zstate.model.catalog import example_name
from zstate.net.graph import Graph, GraphMonitor
from zstate.net.status_monitor import WriterState
from zstate.view.data_source import FixedFrame, ViewSource
from zstate.view.panels import html
from zstate.view.panels.html import Rows, format_number, pose_rows
from zstate.view.panels.panel import BoundWidget, FrameDropdown, PanelContext
from zstate.view.scene.clouds import CLOUD_COLORS, Clouds
from zstate.view.scene.scene import Scene

_DISPLAYS = ("visuals", "collisions", "axes", "names", "parent_lines")
_MAX_SCANS = 50
_MAX_PATH_S = 30  # the buffer's history
_MAX_CLOUDS_S = 30.0
_POINTS_STEP, _MAX_POINTS = 20, 2000
_MAX_LINES = 12
_MAX_FRAMES = 10
_NO_POSE = "no pose"
_EXPIRED_S = 3.0
"""Publishers send a status once a second; an older one is not valid any more."""


class DisplayPanel:
    """The fixed frame, selected from a list, and a checkbox for each display option."""

    def __init__(self, gui: viser.GuiApi, scene: Scene, fixed: FixedFrame) -> None:
        self._scene = scene
        self._fixed = fixed
        hint = "Everything is seen from this frame. Click and type to search."
        self._frames = FrameDropdown(gui, "Fixed frame", "(no frame yet)", hint)
        self._unknown = gui.add_html("")
        self._boxes = {
            name: gui.add_checkbox(name.replace("_", " ").capitalize(), getattr(scene, name))
            for name in _DISPLAYS
        }
        world = scene.world
        self._scans = gui.add_checkbox("Scans", world.scans)
        hint = "How many scans of each sensor are drawn; older ones are paler."
        self._scan_count = gui.add_slider(
            "Last scans", min=1, max=_MAX_SCANS, step=1, initial_value=world.scan_count, hint=hint
        )
        self._clouds = CloudControls(gui, scene.clouds)
        self._maps = gui.add_checkbox("Maps", world.maps)
        odometry = scene.odometry
        hint = "The path of each base whose pose has a covariance, and the ellipse that it is in with 95 %."
        self._odometry = gui.add_checkbox("Odometry", odometry.is_on, hint=hint)
        self._path_s = gui.add_slider(
            "Path [s]", min=1, max=_MAX_PATH_S, step=1, initial_value=round(odometry.path_s)
        )

    def update(self, context: PanelContext) -> None:
        tree = context.snapshot.tree
        selected = self._frames.poll_change()
        if selected is not None:
            self._fixed.requested = selected
        requested, fixed = self._fixed.requested, self._fixed.resolve(tree)
        self._frames.set_options(tree.names, fixed or None)
        text = f"{requested!r} is not a known frame; everything is seen from {fixed!r}"
        is_unknown = requested not in ("", fixed)
        self._unknown.content = html.paragraph(text, color=html.WARNING) if is_unknown else ""
        for name, box in self._boxes.items():
            setattr(self._scene, name, box.value)
        world = self._scene.world
        world.scans, world.maps = self._scans.value, self._maps.value
        world.scan_count = int(self._scan_count.value)
        self._clouds.update()
        odometry = self._scene.odometry
        odometry.is_on, odometry.path_s = self._odometry.value, self._path_s.value


class CloudControls:
    """What is drawn of clouds; shown when there are clouds."""

    def __init__(self, gui: viser.GuiApi, clouds: Clouds) -> None:
        self._drawn = clouds
        self._folder = gui.add_folder("Clouds", visible=False)
        with self._folder:
            self._is_on = gui.add_checkbox("Draw clouds", clouds.is_on)
            hint = "Sensors without this value have one colour each."
            self._color = gui.add_dropdown("Coloured by", CLOUD_COLORS, initial_value=clouds.color, hint=hint)
            hint = "How long points remain in the fixed frame; 0: only the newest cloud of each sensor."
            self._window_s = gui.add_slider(
                "Last seconds", min=0.0, max=_MAX_CLOUDS_S, step=0.5, initial_value=clouds.window_s, hint=hint
            )
            hint = "The points of all clouds together are thinned out to so many, in thousands."
            self._points = gui.add_slider(
                "Points [1000]",
                min=_POINTS_STEP,
                max=_MAX_POINTS,
                step=_POINTS_STEP,
                initial_value=clouds.points // 1000,
                hint=hint,
            )

    def update(self) -> None:
        """Apply the user's input."""
        clouds = self._drawn
        self._folder.visible = clouds.has_any
        clouds.is_on, clouds.color = self._is_on.value, self._color.value
        clouds.window_s, clouds.points = self._window_s.value, 1000 * int(self._points.value)


class RobotsPanel:
    """A line for each robot, and everything that cannot be drawn. Stale robots are drawn in grey.

    A robot is stale if one of the writers that place it is: of its joint states, or of an edge above it, such
    as its odometry. A robot without a model consists of frames; it is stale if the writers of all are.
    """

    def __init__(self, gui: viser.GuiApi, source: ViewSource, scene: Scene) -> None:
        self._source = source
        self._scene = scene
        self._robots = gui.add_html("")
        self._missing = gui.add_html("")

    def update(self, context: PanelContext) -> None:
        robots, tree = self._source.robots(), context.snapshot.tree
        # A writer that is stale now was not when a snapshot of the past was taken.
        silent = self._silent_tracks(tree) if context.is_live else {}
        states: list[tuple[str, str]] = []
        colors: list[str] = []
        for robot in robots:
            stale = stale_reason(robot, tree, silent)
            self._scene.set_stale(robot, stale)
            states.append((robot, stale or state_text(robot, tree, is_live=context.is_live)))
            colors.append(html.ALARM if stale else "")
        if robots:
            self._robots.content = html.table(("Robot", "State"), states, colors)
        else:
            command = f"zstate publish {example_name()} --source sine"
            text = f"No robot is announced. Start one, for instance with: {command}"
            self._robots.content = html.paragraph(text, muted=True)
        poses = [track for track in silent if isinstance(track, PoseTrack)]
        edges = [f"{track.name}: {silent[track]}" for track in poses]
        meshes = [f"{uri}\n    {why}" for robot in robots for uri, why in self._scene.missing_meshes(robot)]
        scene = self._scene
        missing = *scene.world.missing, *scene.clouds.missing, *scene.cameras.missing
        around = [f"{name}: {why}" for name, why in missing]
        self._missing.content = (
            disconnected_html(tree, context.fixed)
            + unplaced_html(context.snapshot)
            + _listing("edge is stale", "edges are stale", edges, sum(len(track.edges) for track in poses))
            + _listing("mesh is missing", "meshes are missing", meshes)
            + _listing("display is incomplete", "displays are incomplete", around)
        )

    def _silent_tracks(self, tree: FrameTable) -> dict[Track, str]:
        """The tracks whose writers have missed their deadlines, and since when."""
        ages = ((track, self._source.silent_s(track)) for track in tree.moving)
        return {
            track: stale_text(silent_s)
            for track, silent_s in ages
            if silent_s is not None and is_stale(silent_s, track.rate_hz)
        }


def stale_reason(robot: str, tree: FrameTable, silent: Mapping[Track, str]) -> str | None:
    """The reason why a robot is stale; None if it is not. ``silent`` are the stale tracks."""
    tracks = tree.tracks_of.get(robot, ())
    stale = [track for track in tracks if track in silent]
    if not stale or (robot not in tree.robots and len(stale) < len(tracks)):
        return None
    first = stale[0]
    is_above = robot in tree.robots and first not in _joint_tracks(tree.robots[robot])
    return f"its place: {silent[first]}" if is_above else silent[first]


def _joint_tracks(robot: JointTrack) -> tuple[JointTrack, ...]:
    """The robot's own track, and those of its parts, which other writers move."""
    return robot, *robot.parts.values()


def state_text(robot: str, tree: FrameTable, *, is_live: bool) -> str:
    """What is known of a robot, and the rate of its joint states; without joints that of its transforms."""
    joints, tracks = tree.robots.get(robot), tree.tracks_of.get(robot, ())
    if not tracks:
        return "no model yet"
    expected = tracks if joints is None or not joints.model.joint_names else _joint_tracks(joints)
    rates = [track.rate_hz for track in expected if track.rate_hz is not None]
    text = f"{'live' if is_live else 'in the past'}, {rates[0]:.1f} Hz" if rates else "no sample yet"
    return text if joints is not None else f"{text}, transforms only"


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
    text = "They are drawn next to it: their position is not known. Connect them, for instance with:"
    end = "not connected to the fixed frame"
    listing = _listing(f"frame is {end}", f"frames are {end}", lines)
    return listing + html.paragraph(f"{text} {command}", muted=True)


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


class FramesPanel:
    """Search field for frames: the best match is selected, and the others are listed below."""

    def __init__(self, gui: viser.GuiApi, scene: Scene) -> None:
        self._scene = scene
        self._tree: FrameTable | None = None
        self._query = ""
        self._enabled_trails: set[str] = set()
        self._drawn_trails: set[str] = set()
        self._search = gui.add_text("Search", "", hint="Parts of a frame's name: hand, left gripper, ...")
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
            text = f"none of {len(tree.names)} frames matches {query!r}"
            if found:
                more = len(found) - 1 - _MAX_FRAMES
                listed = ", ".join(found[1 : 1 + _MAX_FRAMES]) + (f" and {more} more" if more > 0 else "")
                text = f"{len(found)} of {len(tree.names)} frames" + (f"; also {listed}" if listed else "")
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
        newest = info.newest_in(context.domain or SYSTEM)
        age = "-" if newest is None or context.now is None else format_duration(context.now - newest)
        rows += [("age", age), ("rate", rate)]
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
        rows: Rows = []
        if target is not None and source is not None:
            rows = _pose_rows(context, target, source)
            if rows[0][0] != _NO_POSE:
                with suppress(LookupFailed):
                    twist = context.buffer.twist(source, target, context.at)
                    linear, angular = (float(np.linalg.norm(one)) for one in (twist.linear, twist.angular))
                    text = f"{format_number(linear, 3)} m/s, {format_number(np.degrees(angular), 1)} deg/s"
                    rows.append(("speed", text))
        self._text.content = html.pairs(rows) if rows else ""


class GraphPanel:
    """The status of every publisher, then the streams, grouped by writers and readers."""

    def __init__(self, gui: viser.GuiApi, monitor: GraphMonitor) -> None:
        self._monitor = monitor
        self._text = gui.add_html("")

    def update(self, context: PanelContext) -> None:
        self._text.content = graph_html(self._monitor.states(), self._monitor.graph())


def graph_html(states: Sequence[WriterState], graph: Graph) -> str:
    """Publishers and streams as HTML."""
    parts: list[str] = []
    for state in states:
        status = state.status
        color = {"ok": "", "warn": html.WARNING}.get(status.level, html.ALARM)
        text = status.text or status.level
        if state.age_s >= _EXPIRED_S:
            color, text = html.ALARM, f"no status for {format_duration(round(state.age_s * 1e9))}"
        parts.append(html.heading(f"{state.robot} at {status.rate_hz:.1f} Hz", color=color))
        parts.append(html.paragraph(f"{status.program} pid {status.pid}: {text}"))
    for group in graph.groups:
        names = ", ".join(stream.name for stream in group.streams)
        parts.append(html.heading(f"{group.robot}: {names}", color="" if group.writers else html.ALARM))
        ends = (("written by", group.writers), ("read by", group.readers))
        parts.append(html.pairs((label, "\n".join(programs) or "none") for label, programs in ends))
    return "".join(parts) or html.paragraph("No robot stream has a writer or a reader.", muted=True)
