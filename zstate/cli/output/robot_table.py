"""Table of the announced robots: each stream with its writer, its rate, and the age of the newest sample."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict
from datetime import datetime
from typing import TYPE_CHECKING, Any

from zstate.cli.output.console import rate_text
from zstate.cli.output.text_layout import Table, first_fitting
from zstate.errors import format_duration
from zstate.net.topic_statistics import TopicStatistics, WriterKey

if TYPE_CHECKING:
    from zstate.net.presence import RobotInfo
    from zstate.wire.identity import WriterId
    from zstate.wire.keys import Stream

_HEADINGS = ("robot, stream", "rate", "age", "writer", "since")
_OPTIONAL = ("since", "age")


def sources(robots: Sequence[RobotInfo]) -> list[WriterKey]:
    """The streams that can be measured without making a publisher send more: joint states."""
    return [
        WriterKey(robot.name, stream, writer.session)
        for robot in robots
        for stream, writer in robot.writers
        if stream == "joint_states"
    ]


def robots_text(robots: Sequence[RobotInfo], statistics: TopicStatistics, *, width: int | None = None) -> str:
    """Each robot, and below it each stream: rate, age of the newest sample, writer, since when.

    If that is wider than ``width``, first the date is left out, then the columns "since" and "age", then the
    headings; at last writers become letters. Without ``width`` there are no headings.
    """
    full: list[tuple[str, ...]] = []
    for robot in robots:
        full.append((robot.name, "", "", "", ""))
        full += [_row(robot, stream, writer, statistics) for stream, writer in robot.writers]
    undated = [(*row[:-1], row[-1].rpartition(", ")[2]) for row in full]
    headed = width is not None
    tables = (
        Table(_HEADINGS, full, headed=headed),
        Table(_HEADINGS, undated, _OPTIONAL, headed=headed),
        Table(_HEADINGS, undated, _OPTIONAL, headed=False),
        Table(_HEADINGS, undated, _OPTIONAL, abbreviate="writer", headed=False),
    )
    return "\n".join(first_fitting(tables, width))


def _row(robot: RobotInfo, stream: Stream, writer: WriterId, statistics: TopicStatistics) -> tuple[str, ...]:
    from zstate.wire.keys import MODEL_WRITER

    names = [name for name in robot.names_of(writer) if stream == "tf_static" and name != MODEL_WRITER]
    shown = f"  {stream}/{','.join(names)}" if names else f"  {stream}"
    source = statistics.get(WriterKey(robot.name, stream, writer.session))
    if source is None:
        return shown, "", "", str(writer), _since(writer)
    rate = "silent" if source.is_stale() else rate_text(source.published_hz())
    return shown, rate, format_duration(round(source.silent_s() * 1e9)), str(writer), _since(writer)


def _since(writer: WriterId) -> str:
    start = datetime.fromtimestamp(writer.since // 1_000_000_000).astimezone()
    nanoseconds = time.time_ns() - writer.since
    minutes, seconds = divmod(nanoseconds // 1_000_000_000, 60)
    hours, minutes = divmod(minutes, 60)
    lasting = f"{minutes} min {seconds:02d} s" if minutes else format_duration(nanoseconds)
    return f"since {start:%Y-%m-%d %H:%M:%S}, {f'{hours} h {minutes:02d} min' if hours else lasting}"


def robots_facts(robots: Sequence[RobotInfo], statistics: TopicStatistics) -> list[dict[str, Any]]:
    """The same as JSON."""
    return [
        {"robot": robot.name, "writers": [_facts(robot, *pair, statistics) for pair in robot.writers]}
        for robot in robots
    ]


def _facts(robot: RobotInfo, stream: Stream, writer: WriterId, statistics: TopicStatistics) -> dict[str, Any]:
    source = statistics.get(WriterKey(robot.name, stream, writer.session))
    return {
        "stream": stream,
        **asdict(writer),
        "names": robot.names_of(writer) if stream == "tf_static" else (),
        "rate_hz": None if source is None else source.published_hz(),
        "silent_s": None if source is None else source.silent_s(),
    }
