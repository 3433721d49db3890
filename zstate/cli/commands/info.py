"""zstate info: what is in a recording."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import datetime
from typing import TYPE_CHECKING, Any

import click

from zstate.cli.console import count_text, is_terminal, rate_text, say_fitted, say_json, terminal_width
from zstate.cli.layout import in_columns, narrowed
from zstate.cli.options import json_option

if TYPE_CHECKING:
    from zstate.cli.recording_facts import RecordedRobot
    from zstate.record.channel import Channel
    from zstate.record.info import RecordingInfo

_ADVICE = "  cut off or damaged; `zstate recover {0}` makes a complete file of what can be read"


@click.command("info")
@click.argument("file")
@json_option("One JSON object.")
def info_command(file: str, as_json: bool) -> None:
    """Say what is in the recording FILE: its robots, their streams and models, when, how much.

    FILE is an MCAP file, the first of several that belong together, or a bag of ROS 2. Rates are means
    over the whole recording. What holds until further notice (robot_description, tf_static) is written
    again every 10 s, which is counted.
    """
    from zstate.cli.recording_facts import recorded_robots
    from zstate.record.info import describe

    info = describe(file)
    robots = recorded_robots(info)
    if as_json:
        say_json(_facts(info, robots))
        return
    lines = [*_head(info), *(line for robot in robots for line in ("", *_robot_lines(robot)))]
    say_fitted("\n".join([*lines, *_other_lines(info)]))


def _head(info: RecordingInfo) -> Iterator[str]:
    from zstate.cli.output.recording_text import files_text, size_text

    libraries = f" by {', '.join(info.libraries)}" if info.libraries else ""
    storage = ", ".join((*info.formats, *info.compressions))
    yield f"{files_text(info.files)}: {size_text(info.size)} ({storage}){libraries}"
    if info.first is not None and info.last is not None:
        yield from in_columns(
            [
                ("start", _time_text(info.first), str(info.first)),
                ("end", _time_text(info.last), str(info.last)),
            ]
        )
    yield f"{count_text(info.message_count, 'message')} in {info.duration_s:.3f} s"
    yield "complete" if info.complete else "not complete"
    yield from (f"  {loss}" for loss in info.losses)
    yield from (_ADVICE.format(name) for name in _recoverable(info))


def _recoverable(info: RecordingInfo) -> list[str]:
    """The files that ``zstate recover`` mends."""
    from zstate.record.reader import RecordReader

    with RecordReader(info.path) as reader:
        return [str(file.path) for file in reader.storages if not file.complete and file.format == "mcap"]


def _time_text(stamp: int) -> str:
    seconds, nanoseconds = divmod(stamp, 1_000_000_000)
    local = datetime.fromtimestamp(seconds).astimezone()
    return f"{local:%Y-%m-%d %H:%M:%S}.{nanoseconds:09d} {local:%z}"


def _robot_lines(robot: RecordedRobot) -> list[str]:
    rows = [
        ("  " + said.stream, said.topic, said.type, str(said.count), rate_text(said.rate_hz), said.writer)
        for said in robot.streams
    ]
    width, of_topic, of_type = terminal_width() if is_terminal() else None, 1, 2
    return [f"{robot.name}: {_model_text(robot)}", *narrowed(rows, width, (of_type, of_topic))]


def _model_text(robot: RecordedRobot) -> str:
    model = robot.model
    if model is None:
        return robot.fault or "no model"
    size = f"{count_text(len(model.links), 'link')}, {count_text(len(model.joints), 'joint')}"
    return f"model {model.name!r}, {size} ({len(model.joint_names)} driven)"


def _other_lines(info: RecordingInfo) -> list[str]:
    from zstate.cli.recording_facts import mean_rate, other_channels

    rows = [
        ("  " + channel.topic, channel.type_name, str(channel.count), rate)
        for channel in other_channels(info)
        for rate in [rate_text(mean_rate(channel, info.duration_s))]
    ]
    rows += [
        ("  " + one.topic, f"{one.encoding}: not read here", str(one.count), "-") for one in info.skipped
    ]
    return ["", "other topics", *in_columns(rows)] if rows else []


def _facts(info: RecordingInfo, robots: Sequence[RecordedRobot]) -> dict[str, Any]:
    from zstate.cli.recording_facts import other_channels

    return {
        "path": str(info.path),
        "files": [str(file) for file in info.files],
        "formats": info.formats,
        "size": info.size,
        "libraries": info.libraries,
        "compressions": info.compressions,
        "complete": info.complete,
        "losses": info.losses,
        "recoverable": _recoverable(info),
        "start": info.first,
        "end": info.last,
        "duration_s": info.duration_s,
        "messages": info.message_count,
        "robots": [robot.facts() for robot in robots],
        "others": [_channel_facts(channel) for channel in (*other_channels(info), *info.skipped)],
    }


def _channel_facts(channel: Channel) -> dict[str, Any]:
    return {
        "topic": channel.topic,
        "type": channel.type_name,
        "encoding": channel.encoding,
        "count": channel.count,
    }
