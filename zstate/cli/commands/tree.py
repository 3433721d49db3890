"""zstate tree: the frames of the announced robots, as text, JSON or a drawing."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from typing import TYPE_CHECKING

import click

from zstate.cli import options
from zstate.cli.output.console import (
    count_text,
    fail,
    output_width,
    print_json,
    print_result,
    print_status,
    rate_text,
    sample_age_text,
)
from zstate.cli.output.text_layout import Guides, Table, chain_lines, first_fitting, tree_lines
from zstate.cli.output.wire_text import is_ros, messages_for
from zstate.cli.session import SessionOptions, open_session

if TYPE_CHECKING:
    from zstate.buffer.frame_tree import FrameInfo
    from zstate.cli.output.drawing import Drawing
    from zstate.net.discovery import RobotInfo
    from zstate.net.session import Session
    from zstate.nodes.listener import TransformListener

_MODELS_WITHIN_S = 3.0
_SAMPLES_WITHIN_S = 1.0
# The rate of two samples may be far off.
_RATE_OVER_NS = 100_000_000
# ROS nodes publish transforms at 1 Hz at least; nodes without a message in this time are named.
_MESSAGES_WITHIN_S = 2.0
_NODES_WITHIN_S = 1.0
_QUIET_S = 0.15

_HEADINGS = ("frame", "edge", "rate", "age", "writer")
_NARROW_HEADINGS = ("frame", "rate and age", "writer")


@click.command("tree")
@click.argument("robot", default="*", metavar="[ROBOT]")
@options.form_options("One JSON array of frames.", "A picture, from the top down.")
@options.placer_option
@options.wire_option
@options.session_options
def tree_command(
    network: SessionOptions, robot: str, form: str | None, placers: tuple[str, ...] | None, wire: str
) -> None:
    """Show the frames of ROBOT, or of all announced robots, as a tree.

    Each edge has its kind, the rate of its samples, the age of the newest one, and its writer. In a narrow
    terminal writers are abbreviated to letters, and "↓" marks an only child. Exit code 1 if ROBOT is not
    announced; without ROBOT the tree may be empty, as with ls and graph.

    \b
    zstate tree
    zstate tree panda --svg > panda.svg
    zstate tree --json | jq '.[] | select(.age_s > 1)'
    zstate tree --wire ros2                            # reads /tf and /tf_static
    """
    is_native, messages = not is_ros(wire), messages_for(wire)
    with open_session(network, (wire,)) as session:
        frames = (
            _collect_frames(session, robot, placers)
            if is_native
            else _collect_ros_frames(session, robot, wire)
        )
        now = time.time_ns()
    if form == "json":
        from zstate.clock import SYSTEM  # loads numpy

        newest = [frame.newest_in(SYSTEM) for frame in frames]
        ages_s = [None if stamp is None else (now - stamp) * 1e-9 for stamp in newest]
        print_json([{**asdict(one), "age_s": age_s} for one, age_s in zip(frames, ages_s, strict=True)])
        return
    if not frames:
        return
    translate = messages.translate
    frames = [
        replace(one, name=translate(one.name), parent=one.parent and translate(one.parent)) for one in frames
    ]
    if form is None:
        print_result(tree_text(frames, now, in_full=not is_native, width=output_width()))
        return
    from zstate.cli.output.drawing import draw

    title = "Frames" if robot == "*" else f"Frames of {robot}"
    print_result(draw(tree_drawing(frames, now, in_full=not is_native), form, title))


def _collect_frames(
    session: Session, robot: str, placers: Sequence[str] | None = None
) -> tuple[FrameInfo, ...]:
    """Every frame of ``robot``, or of all robots for "*", with rates and stamps of received samples.

    Prints on standard error which announced models and static edges did not arrive, or that no robot is
    announced. Fails if ``robot`` is not announced.
    """
    from zstate.cli.processes import BackgroundCall
    from zstate.cli.robot_directory import announced_robots
    from zstate.cli.waiting import ConditionWaiter
    from zstate.net.discovery import discover
    from zstate.streams import JOINT_STREAMS
    from zstate.wire.keys import ANY, MODEL_WRITER

    # Models and static edges arrive during discovery, which is mostly waiting.
    find = partial(discover, session) if robot == ANY else partial(announced_robots, session, robot)
    discovery = BackgroundCall("zstate announced", find)
    from zstate.nodes.listener import TransformListener

    waiter = ConditionWaiter()
    with TransformListener(session, robot, placers=placers) as listener:
        listener.add_observer(waiter.notify)
        robots = discovery.result()
        if not robots:
            print_status(messages_for("native").announced(()))
            return ()
        static_writers = [
            name for one in robots for name, _ in one.named("tf_static") if name != MODEL_WRITER
        ]

        def has_models(stable: bool) -> bool:
            if not stable:
                arrived = {frame.writer for frame in listener.buffer.frames() if frame.kind == "static"}
                # Never equal if two robots have a writer of the same name.
                if len(static_writers) != len(arrived.intersection(static_writers)):
                    return False
            return not _missing(listener, robots)

        waiter.wait_until_stable(
            lambda: len(listener.buffer.frames()), has_models, quiet_s=_QUIET_S, timeout_s=_MODELS_WITHIN_S
        )
        for text in _missing(listener, robots):
            print_status(text)
        moving = {robot.name for robot in robots if not JOINT_STREAMS.isdisjoint(_streams(robot))}

        def has_rate(frame: FrameInfo) -> bool:
            if frame.kind != "joint" or frame.name.partition("/")[0] not in moving:
                return True  # no samples are expected
            return frame.count > 1 and (frame.newest or 0) - (frame.oldest or 0) >= _RATE_OVER_NS

        waiter.wait_for(lambda: all(map(has_rate, listener.buffer.frames())), _SAMPLES_WITHIN_S)
        frames = listener.buffer.frames()
    if not frames:
        print_status("announced, but without any frame: no model is published; `zstate publish ROBOT` does")
    return frames


def _missing(listener: TransformListener, robots: tuple[RobotInfo, ...]) -> list[str]:
    owners = {frame.name.partition("/")[0] for frame in listener.buffer.frames()}
    known = {*owners, *listener.robots()}
    missing: list[str] = []
    for robot in robots:
        streams = _streams(robot)
        if "robot_description" in streams and robot.name not in owners:
            missing.append(f"{robot.name}: its model has not arrived within {_MODELS_WITHIN_S:g} s")
        elif "tf_static" in streams and robot.name not in known:
            missing.append(f"{robot.name}: its static edges have not arrived within {_MODELS_WITHIN_S:g} s")
    return missing


def _streams(robot: RobotInfo) -> set[str]:
    return {stream for stream, _ in robot.writers}


def _collect_ros_frames(session: Session, robot: str, wire: str) -> tuple[FrameInfo, ...]:
    """Every frame on /tf and /tf_static, with rates and stamps.

    Prints on standard error which nodes announce transforms but have sent none. Fails if there is no node.
    """
    from zstate.cli.robot_directory import RobotDirectory
    from zstate.cli.waiting import ConditionWaiter
    from zstate.nodes.listener import TransformListener

    waiter = ConditionWaiter()
    with (
        RobotDirectory(session, robot, wire, waiter.notify) as directory,
        TransformListener(session, robot, wire=wire, follow="tf") as listener,
    ):
        listener.add_observer(waiter.notify)

        def nodes() -> set[str]:
            writers = (pair for info in directory.robots() for pair in info.writers)
            return {str(writer) for stream, writer in writers if stream == "tf"}

        def without_samples(frames: tuple[FrameInfo, ...], least: int) -> set[str]:
            return nodes() - {one.writer for one in frames if one.kind == "pose" and one.count >= least}

        if not waiter.wait_for(lambda: listener.buffer.frames() or nodes(), _NODES_WITHIN_S):
            fail(directory.messages.no_sample_text(robot, "tf", directory.robots(), ended=False))
        waiter.wait_until_stable(
            lambda: len(listener.buffer.frames()),
            lambda stable: stable and not without_samples(listener.buffer.frames(), 2),
            quiet_s=_QUIET_S,
            timeout_s=_MESSAGES_WITHIN_S,
        )
        frames = listener.buffer.frames()
        for node in sorted(without_samples(frames, 1)):
            topic = directory.messages.topics(robot, ("tf",))
            print_status(f"{node} announces {topic}, but has sent nothing for {_MESSAGES_WITHIN_S:g} s")
        return frames


def tree_text(frames: Sequence[FrameInfo], now: int, *, in_full: bool, width: int | None = None) -> str:
    """The tree with a line for each frame: kind, rate, age and writer of its edge; ``now`` [ns] is for ages.

    If that is wider than ``width``, writers become letters that are explained below, then a frame that is its
    parent's only child is not indented, and at last moving edges have no kind.
    """

    def rows(guides: Guides, *, with_kind: bool = True) -> list[tuple[str, ...]]:
        found: list[tuple[str, ...]] = []
        for guide, frame in _walk(frames, guides):
            rate, age = _rate_and_age(frame, now)
            cells = (frame.kind, rate, age) if with_kind else (f"{rate} {age}" if rate else frame.kind,)
            found.append((guide + _shown_name(frame, in_full), *cells, frame.writer or ""))
        return found

    tables = (
        Table(_HEADINGS, rows(tree_lines), abbreviate="writer"),
        Table(_HEADINGS, rows(chain_lines), abbreviate="writer"),
        Table(_NARROW_HEADINGS, rows(chain_lines, with_kind=False), abbreviate="writer", headed=False),
    )
    return "\n".join(first_fitting(tables, width))


def _walk(frames: Sequence[FrameInfo], guides: Guides = tree_lines) -> list[tuple[str, FrameInfo]]:
    """(guide, frame) of all frames, parents first; roots and siblings in alphabetical order."""
    by_name = {frame.name: frame for frame in sorted(frames, key=lambda frame: frame.name)}
    children: dict[str, list[str]] = {}
    for frame in by_name.values():
        if frame.parent is not None:
            children.setdefault(frame.parent, []).append(frame.name)
    roots = [frame.name for frame in by_name.values() if frame.parent is None]
    return [(guide, by_name[name]) for root in roots for guide, name in guides(root, children)]


def _shown_name(frame: FrameInfo, in_full: bool) -> str:
    """The name, without the robot's if the parent belongs to the same robot and not ``in_full``."""
    robot, slash, bare = frame.name.partition("/")
    is_short = not in_full and slash and (frame.parent or "").startswith(f"{robot}/")
    return bare if is_short else frame.name


def _rate_and_age(frame: FrameInfo, now: int) -> tuple[str, str]:
    if frame.kind not in ("joint", "pose"):
        return "", ""
    return rate_text(frame.rate_hz), sample_age_text(frame, now)


def tree_drawing(frames: Sequence[FrameInfo], now: int, *, in_full: bool) -> Drawing:
    """The tree; each edge has its kind, rate, age, and the colour of its writer. ``now`` [ns] is for ages."""
    from zstate.cli.output.drawing import ALARM, LINE, MUTED, PALETTE, Drawing, DrawnEdge, DrawnNode
    from zstate.clock import SYSTEM
    from zstate.ingest.deadline import is_stale

    writers = [frame.writer for frame in frames if frame.writer]
    colors = {writer: PALETTE[n % len(PALETTE)] for n, writer in enumerate(dict.fromkeys(writers))}
    nodes: list[DrawnNode] = []
    edges: list[DrawnEdge] = []
    for _, frame in _walk(frames):
        is_static, newest = frame.kind == "static", frame.newest_in(SYSTEM)
        lines, text_color = [_shown_name(frame, in_full)], MUTED
        if frame.kind in ("joint", "pose"):
            rate, age = _rate_and_age(frame, now)
            lines.append(f"{frame.kind}, {age}" if frame.newest is None else f"{frame.kind} · {rate} · {age}")
            is_old = newest is not None and is_stale((now - newest) * 1e-9, frame.rate_hz)
            text_color = ALARM if is_old or frame.newest is None else MUTED
        elif not is_static:
            lines.append(frame.kind)
        nodes.append(
            DrawnNode(
                frame.name,
                lines,
                label=frame.name,
                stroke=colors.get(frame.writer or "", LINE),
                dashed=is_static,
                bar=not is_static,
                text_color=text_color,
            )
        )
        if frame.parent is not None:
            label = frame.kind if frame.rate_hz is None else f"{frame.kind} {rate_text(frame.rate_hz)}"
            edges.append(DrawnEdge(frame.parent, frame.name, label, dashed=is_static))
    legend = [
        (color, f"{writer}: {count_text(writers.count(writer), 'edge')}") for writer, color in colors.items()
    ]
    return Drawing("frames", "tree", nodes, edges, legend)
