"""zstate tree: the frames of the announced robots, as a tree."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

import click

from zstate.cli.console import is_terminal, say, say_json, terminal_width
from zstate.cli.network import Network, open_session
from zstate.cli.options import form_options, session_options, wire_option
from zstate.cli.words import is_ros, words_of

if TYPE_CHECKING:
    from zstate.buffer.frame_tree import FrameInfo
    from zstate.cli.words import Words


@click.command("tree")
@click.argument("robot", default="*", metavar="[ROBOT]")
@form_options("One JSON array of frames.", "A picture, from the top down.")
@wire_option
@session_options
def tree_command(network: Network, robot: str, form: str | None, wire: str) -> None:
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
    from zstate.cli.frames import gathered_frames
    from zstate.cli.ros_frames import gathered_ros_frames

    with open_session(network, (wire,)) as session:
        if is_ros(wire):
            frames = gathered_ros_frames(session, robot, wire)
        else:
            frames = gathered_frames(session, robot)
        now = time.time_ns()
    if form == "json":
        say_json([_facts(frame, now) for frame in frames])
    elif frames:
        title = "Frames" if robot == "*" else f"Frames of {robot}"
        named = [_named(frame, words_of(wire)) for frame in frames]
        say(_drawn(named, now, form, in_full=is_ros(wire), title=title))


def _named(frame: FrameInfo, words: Words) -> FrameInfo:
    """The same with the names by which its wire calls frames."""
    parent = None if frame.parent is None else words.explained(frame.parent)
    return replace(frame, name=words.explained(frame.name), parent=parent)


def _drawn(frames: Sequence[FrameInfo], now: int, form: str | None, *, in_full: bool, title: str) -> str:
    from zstate.cli.pictures.frames import dot, mermaid, svg
    from zstate.cli.tree_text import tree_text

    if form == "svg":
        return svg(frames, now, in_full=in_full, title=title)
    if form is not None:
        return dot(frames) if form == "dot" else mermaid(frames)
    return tree_text(frames, now, in_full=in_full, width=terminal_width() if is_terminal() else None)


def _facts(frame: FrameInfo, now: int) -> dict[str, Any]:
    from zstate.clock import SYSTEM  # loads numpy

    newest = frame.newest_in(SYSTEM)
    return {**asdict(frame), "age_s": None if newest is None else (now - newest) * 1e-9}
