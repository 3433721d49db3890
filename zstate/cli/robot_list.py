"""The announced robots as a list: each stream with its writer, its rate, and how fresh it is."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict
from datetime import datetime
from typing import TYPE_CHECKING, Any

from zstate.cli.console import rate_text
from zstate.cli.layout import letters_for, narrowed
from zstate.errors import duration_text, printable
from zstate.net.topic_statistics import TopicStatistics, WriterKey

if TYPE_CHECKING:
    from zstate.net.presence import RobotInfo
    from zstate.wire.keys import Stream
    from zstate.wire.writer import Writer

_AGE, _WRITER, _SINCE = 2, 3, 4
_HEADINGS = ("robot, stream", "rate", "age", "writer", "since")


def sources(robots: Sequence[RobotInfo]) -> list[WriterKey]:
    """What can be measured without making anybody say more: joint states."""
    return [
        WriterKey(robot.name, stream, writer.session)
        for robot in robots
        for stream, writer in robot.writers
        if stream == "joint_states"
    ]


def robots_text(robots: Sequence[RobotInfo], statistics: TopicStatistics, *, width: int | None = None) -> str:
    """Each robot, and below it each stream: rate, age of the newest sample, writer, since when.

    Where that is wider than ``width``, the date is left out, then all of since when, then the age; at last
    writers become letters that are explained below. Headings are above where there is room for them.
    """
    rows = [_row(robot, stream, writer, statistics) for robot in robots for stream, writer in robot.writers]
    lines, legend = _fitted_lines(rows, width)
    text: list[str] = []
    if width is not None:
        headed, letters = _fitted_lines([_HEADINGS, *rows], width)
        if not letters and max(map(len, headed)) <= width:
            text, lines = headed[:1], headed[1:]
    for robot in robots:
        count = len(robot.writers)
        text += [robot.name, *lines[:count]]
        lines = lines[count:]
    return "\n".join([*text, *legend])


def _fitted_lines(rows: Sequence[tuple[str, ...]], width: int | None) -> tuple[list[str], list[str]]:
    """Rows as lines, as wide as ``width`` if that can be, and what explains their letters."""
    lines = narrowed(rows, None)
    if width is None or max(map(len, lines), default=0) <= width:
        return lines, []
    short = [(*row[:_SINCE], row[_SINCE].rpartition(", ")[2]) for row in rows]
    lines = narrowed(short, width, (_SINCE, _AGE))
    if max(map(len, lines)) <= width:
        return lines, []
    letters = letters_for(row[_WRITER] for row in rows)
    named = [(*row[:_WRITER], letters[row[_WRITER]], *row[_SINCE:]) for row in short]
    legend = [f"{letter}: {printable(writer)}" for writer, letter in letters.items()]
    return narrowed(named, width, (_SINCE, _AGE)), legend


def _row(robot: RobotInfo, stream: Stream, writer: Writer, statistics: TopicStatistics) -> tuple[str, ...]:
    source = statistics.get(WriterKey(robot.name, stream, writer.session))
    if source is None:
        rate, age = "", ""
    else:
        rate = "silent" if source.is_stale() else rate_text(source.published_hz())
        age = duration_text(round(source.silent_s() * 1e9))
    return f"  {_said(robot, stream, writer)}", rate, age, str(writer), _since(writer)


def _said(robot: RobotInfo, stream: Stream, writer: Writer) -> str:
    names = _static_names(robot, stream, writer)
    return f"{stream}/{','.join(names)}" if names else stream


def _static_names(robot: RobotInfo, stream: Stream, writer: Writer) -> list[str]:
    from zstate.wire.keys import MODEL_WRITER

    return [name for name in robot.names_of(writer) if stream == "tf_static" and name != MODEL_WRITER]


def _since(writer: Writer) -> str:
    began = datetime.fromtimestamp(writer.since // 1_000_000_000).astimezone()
    return f"since {began:%Y-%m-%d %H:%M:%S}, {_lasting(time.time_ns() - writer.since)}"


def _lasting(nanoseconds: int) -> str:
    minutes, seconds = divmod(nanoseconds // 1_000_000_000, 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {seconds:02d} s" if minutes else duration_text(nanoseconds)


def robots_facts(robots: Sequence[RobotInfo], statistics: TopicStatistics) -> list[dict[str, Any]]:
    """The same for a program."""
    return [
        {"robot": robot.name, "writers": [_facts(robot, *pair, statistics) for pair in robot.writers]}
        for robot in robots
    ]


def _facts(robot: RobotInfo, stream: Stream, writer: Writer, statistics: TopicStatistics) -> dict[str, Any]:
    source = statistics.get(WriterKey(robot.name, stream, writer.session))
    return {
        "stream": stream,
        **asdict(writer),
        "names": robot.names_of(writer) if stream == "tf_static" else (),
        "rate_hz": None if source is None else source.published_hz(),
        "silent_s": None if source is None else source.silent_s(),
    }
