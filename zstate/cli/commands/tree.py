"""zstate tree: the frames of the announced robots, as a tree."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

import click

from zstate.cli.options import form_options, session_options, wire_option
from zstate.cli.output.console import output_width, print_json, print_result
from zstate.cli.output.wire_text import is_ros, messages_for
from zstate.cli.session import SessionOptions, open_session

if TYPE_CHECKING:
    from zstate.buffer.frame_tree import FrameInfo
    from zstate.cli.output.wire_text import WireMessages


@click.command("tree")
@click.argument("robot", default="*", metavar="[ROBOT]")
@form_options("One JSON array of frames.", "A picture, from the top down.")
@wire_option
@session_options
def tree_command(network: SessionOptions, robot: str, form: str | None, wire: str) -> None:
    """Show the frames of ROBOT, or of all announced robots, as a tree.

    For each edge: its kind, the rate of its samples, the age of the newest one, and who writes it. In a
    terminal that is too narrow, writers are letters, and "↓" is before an only child. With nobody announced
    there is no tree, and the exit code is 0 as that of ls and graph; it is 1 for a ROBOT that is not there.

    \b
    zstate tree
    zstate tree panda --svg > panda.svg
    zstate tree --json | jq '.[] | select(.age_s > 1)'
    zstate tree --wire ros2                            # hears /tf and /tf_static
    """
    from zstate.cli.output.frames import collect_frames, collect_ros_frames

    with open_session(network, (wire,)) as session:
        is_native = not is_ros(wire)
        frames = collect_frames(session, robot) if is_native else collect_ros_frames(session, robot, wire)
        now = time.time_ns()
    if form == "json":
        print_json([_facts(frame, now) for frame in frames])
    elif frames:
        title = "Frames" if robot == "*" else f"Frames of {robot}"
        named = [_named(frame, messages_for(wire)) for frame in frames]
        print_result(_drawn(named, now, form, in_full=not is_native, title=title))


def _named(frame: FrameInfo, words: WireMessages) -> FrameInfo:
    """The frame with the names that its wire format uses."""
    parent = None if frame.parent is None else words.translate(frame.parent)
    return replace(frame, name=words.translate(frame.name), parent=parent)


def _drawn(frames: Sequence[FrameInfo], now: int, form: str | None, *, in_full: bool, title: str) -> str:
    from zstate.cli.output.frames import tree_drawing, tree_text

    if form is None:
        return tree_text(frames, now, in_full=in_full, width=output_width())
    from zstate.cli.output.drawing import draw

    return draw(tree_drawing(frames, now, in_full=in_full), form, title)


def _facts(frame: FrameInfo, now: int) -> dict[str, Any]:
    from zstate.clock import SYSTEM  # loads numpy

    newest = frame.newest_in(SYSTEM)
    return {**asdict(frame), "age_s": None if newest is None else (now - newest) * 1e-9}
