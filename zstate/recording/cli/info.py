"""zstate info: contents of a recording."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import datetime
from typing import TYPE_CHECKING, Any

import click

from zstate.cli import options
from zstate.cli.output.console import (
    count_text,
    files_text,
    output_width,
    print_json,
    print_wrapped,
    rate_text,
    size_text,
)
from zstate.cli.output.text_layout import Table, in_columns

if TYPE_CHECKING:
    from zstate.recording.info import RecordedRobot, RecordedStream, RecordingInfo

_HEADINGS = ("stream", "topic", "type", "count", "rate", "writer")
_DAY_S = 86_400.0
_ADVICE = "  cut off or damaged; `zstate recover {0}` makes a complete file of what can be read"

_UNKNOWN = (
    "  the recorder did not end: the counts are of what it wrote until then; how many messages did not "
    "arrive, and what followed, is not known"
)


@click.command("info")
@click.argument("file")
@options.json_option("One JSON object.")
def info_command(file: str, as_json: bool) -> None:
    """Show the contents of the recording FILE: robots, streams, models, times and counts.

    FILE is an MCAP file, the first of several split files, or a ROS 2 bag. Rates are means over the whole
    recording. Latched messages (robot_description, tf_static) are written again every 10 s, and counted; a
    map only in each file. The size a second and a day is that of the files, compressed.
    """
    from zstate.recording.info import mean_rate, other_channels, read_info, recorded_robots

    info = read_info(file)
    robots = recorded_robots(info)
    if as_json:
        print_json(_facts(info, robots))
        return
    lines = [*_head(info), *(line for robot in robots for line in ("", *_robot_lines(robot)))]
    others = [
        ("  " + one.topic, one.type_name, str(one.count), rate_text(mean_rate(one, info.duration_s)))
        for one in other_channels(info)
    ]
    others += [
        ("  " + one.topic, f"{one.encoding}: not read here", str(one.count), "-") for one in info.skipped
    ]
    if others:
        lines += ["", "other topics", *in_columns(others)]
    print_wrapped("\n".join(lines))


def _head(info: RecordingInfo) -> Iterator[str]:
    libraries = f" by {', '.join(info.libraries)}" if info.libraries else ""
    storage = ", ".join((*info.formats, *info.compressions))
    yield f"{files_text(info.files)}: {size_text(info.size)} ({storage}){libraries}"
    if info.first is not None and info.last is not None:
        ends = (("start", info.first), ("end", info.last))
        yield from in_columns([(end, _time_text(stamp), str(stamp)) for end, stamp in ends])
    yield f"{count_text(info.message_count, 'message')} in {info.duration_s:.3f} s"
    if info.bytes_per_s is not None:
        yield f"{size_text(info.bytes_per_s)} a second, {size_text(info.bytes_per_s * _DAY_S)} a day"
    yield "complete" if info.complete else "not complete"
    yield from (f"  {loss}" for loss in info.losses)
    for source, count in sorted(info.missing.items()):
        robot, _, stream = source.partition("/")
        yield f"  {count_text(count, 'message')} of {robot} {stream} did not arrive, or were dropped"
    if not info.is_missing_known and any("zstate" in library for library in info.libraries):
        yield _UNKNOWN
    yield from (_ADVICE.format(name) for name in _recoverable(info))


def _recoverable(info: RecordingInfo) -> list[str]:
    """The files that ``zstate recover`` can complete."""
    from zstate.recording.reader import RecordingReader

    with RecordingReader(info.path) as reader:
        return [str(file.path) for file in reader.storages if not file.complete and file.format == "mcap"]


def _time_text(stamp: int) -> str:
    seconds, nanoseconds = divmod(stamp, 1_000_000_000)
    local = datetime.fromtimestamp(seconds).astimezone()
    return f"{local:%Y-%m-%d %H:%M:%S}.{nanoseconds:09d} {local:%z}"


def _robot_lines(robot: RecordedRobot) -> list[str]:
    model, described = robot.model, robot.fault or "no model"
    if model is not None:
        size = f"{count_text(len(model.links), 'link')}, {count_text(len(model.joints), 'joint')}"
        described = f"model {model.name!r}, {size} ({len(model.joint_names)} driven)"
    rows = [
        ("  " + one.stream, one.topic, one.type, str(one.count), rate_text(one.rate_hz), _writer_text(one))
        for one in robot.streams
    ]
    table = Table(_HEADINGS, rows, optional=("type", "topic"), headed=False)
    return [f"{robot.name}: {described}", *table.lines(output_width())]


def _writer_text(stream: RecordedStream) -> str:
    rays = None if stream.rays is None else count_text(stream.rays, "ray")
    return ", ".join(filter(None, (stream.writer, rays)))


def _facts(info: RecordingInfo, robots: Sequence[RecordedRobot]) -> dict[str, Any]:
    from zstate.recording.info import other_channels

    return {
        "path": str(info.path),
        "files": [str(file) for file in info.files],
        "formats": info.formats,
        "size": info.size,
        "libraries": info.libraries,
        "compressions": info.compressions,
        "complete": info.complete,
        "losses": info.losses,
        "missing": info.missing,
        "missing_known": info.is_missing_known,
        "recoverable": _recoverable(info),
        "start": info.first,
        "end": info.last,
        "duration_s": info.duration_s,
        "bytes_per_s": info.bytes_per_s,
        "messages": info.message_count,
        "robots": [robot.facts() for robot in robots],
        "others": [
            {"topic": one.topic, "type": one.type_name, "encoding": one.encoding, "count": one.count}
            for one in (*other_channels(info), *info.skipped)
        ],
    }
