"""zstate tree: the frames of the announced robots, as a tree."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import click

from zstate.cli.console import age_text, note, rate_text, say, say_json
from zstate.cli.layout import in_columns, tree_lines
from zstate.cli.network import Network, open_session
from zstate.cli.options import session_options, wire_option
from zstate.cli.words import is_ros, words_of

if TYPE_CHECKING:
    from zstate.buffer.frames import FrameInfo

_NO_FRAMES = "announced, but without any frame: who publishes the model? `zstate publish ROBOT` does"
_HEADINGS = ("frame", "edge", "rate", "age", "writer")


@click.command("tree")
@click.argument("robot", default="*", metavar="[ROBOT]")
@click.option("--json", "form", flag_value="json", help="One JSON array of frames.")
@click.option("--dot", "form", flag_value="dot", help="For Graphviz.")
@click.option("--mermaid", "form", flag_value="mermaid", help="For Markdown.")
@wire_option
@session_options
def tree_command(network: Network, robot: str, form: str | None, wire: str) -> None:
    """Show the frames of ROBOT, or of all announced robots, as a tree.

    For each edge: its kind, the rate of its samples, the age of the newest one, and who writes it.

    \b
    zstate tree
    zstate tree panda --dot | dot -Tsvg > tree.svg
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
    if not frames and not is_ros(wire):
        note(_NO_FRAMES)
    if form == "json":
        say_json([_facts(frame, now) for frame in frames])
    elif frames:
        drawing = {"dot": _dot, "mermaid": _mermaid}.get(form or "")
        text = drawing(frames) if drawing else _text(frames, now, in_full=is_ros(wire))
        say(words_of(wire).explained(text))


def _text(frames: Sequence[FrameInfo], now: int, *, in_full: bool) -> str:
    by_name = {frame.name: frame for frame in frames}
    children: dict[str, list[str]] = {}
    for frame in frames:
        if frame.parent is not None:
            children.setdefault(frame.parent, []).append(frame.name)
    rows: list[tuple[str, ...]] = [_HEADINGS]
    for root in (frame.name for frame in frames if frame.parent is None):
        for guide, name in tree_lines(root, children):
            shown = name if in_full else _short(by_name[name])
            rows.append((guide + shown, *_cells(by_name[name], now)))
    return "\n".join(in_columns(rows))


def _short(frame: FrameInfo) -> str:
    """The name without the robot's, where the parent belongs to the same robot."""
    robot, slash, bare = frame.name.partition("/")
    return bare if slash and (frame.parent or "").startswith(f"{robot}/") else frame.name


def _cells(frame: FrameInfo, now: int) -> tuple[str, str, str, str]:
    if frame.kind not in ("joint", "pose"):
        return frame.kind, "", "", frame.writer or ""
    age = "no sample" if frame.newest is None else age_text(frame.newest, now)
    return frame.kind, rate_text(frame.rate_hz), age, frame.writer or ""


def _facts(frame: FrameInfo, now: int) -> dict[str, Any]:
    return {**asdict(frame), "age_s": None if frame.newest is None else (now - frame.newest) * 1e-9}


def _edge_label(frame: FrameInfo) -> str:
    return frame.kind if frame.rate_hz is None else f"{frame.kind} {rate_text(frame.rate_hz)}"


def _dot(frames: Sequence[FrameInfo]) -> str:
    lines = ["digraph frames {", "  node [shape=box];"]
    for frame in frames:
        name = json.dumps(frame.name, ensure_ascii=False)
        if frame.parent is None:
            lines.append(f"  {name};")
        else:
            parent = json.dumps(frame.parent, ensure_ascii=False)
            lines.append(f'  {parent} -> {name} [label="{_edge_label(frame)}"];')
    return "\n".join([*lines, "}"])


def _mermaid(frames: Sequence[FrameInfo]) -> str:
    numbers = {frame.name: f"f{number}" for number, frame in enumerate(frames)}
    lines = ["graph TD"]
    lines += [f'  {numbers[frame.name]}["{_mermaid_text(frame.name)}"]' for frame in frames]
    lines += [
        f"  {numbers[frame.parent]} -->|{_edge_label(frame)}| {numbers[frame.name]}"
        for frame in frames
        if frame.parent is not None
    ]
    return "\n".join(lines)


def _mermaid_text(name: str) -> str:
    return name.replace("#", "#35;").replace('"', "#quot;")
