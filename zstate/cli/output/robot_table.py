"""Table of the announced robots: each stream with its writer, its rate, and the age of the newest sample."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict
from datetime import datetime
from typing import TYPE_CHECKING, Any

from zstate.cli.output.console import rate_text
from zstate.cli.output.text_layout import Table, first_fitting
from zstate.cli.sampling import Sampler, Source
from zstate.errors import duration_text

if TYPE_CHECKING:
    from zstate.net.presence import RobotInfo
    from zstate.wire.keys import Stream
    from zstate.wire.writer import Writer

# A writer without a sample for this long is silent; its rate is not shown.
_SILENT_NS = 2_000_000_000

_HEADINGS = ("robot, stream", "rate", "age", "writer", "since")
_OPTIONAL = ("since", "age")


def sources(robots: Sequence[RobotInfo]) -> list[Source]:
    """The streams that can be measured without making a publisher send more: joint states."""
    return [
        Source(robot.name, stream, writer.session)
        for robot in robots
        for stream, writer in robot.writers
        if stream == "joint_states"
    ]


def robots_text(robots: Sequence[RobotInfo], sampler: Sampler, *, width: int | None = None) -> str:
    """Each robot, and below it each stream: rate, age of the newest sample, writer, since when.

    If that is wider than ``width``, first the date is left out, then the columns "since" and "age", then the
    headings; at last writers become letters. Without ``width`` there are no headings.
    """
    full: list[tuple[str, ...]] = []
    for robot in robots:
        full.append((robot.name, "", "", "", ""))
        full += [_row(robot, stream, writer, sampler) for stream, writer in robot.writers]
    undated = [(*row[:-1], row[-1].rpartition(", ")[2]) for row in full]
    headed = width is not None
    tables = (
        Table(_HEADINGS, full, headed=headed),
        Table(_HEADINGS, undated, _OPTIONAL, headed=headed),
        Table(_HEADINGS, undated, _OPTIONAL, headed=False),
        Table(_HEADINGS, undated, _OPTIONAL, abbreviate="writer", headed=False),
    )
    return "\n".join(first_fitting(tables, width))


def _row(robot: RobotInfo, stream: Stream, writer: Writer, sampler: Sampler) -> tuple[str, ...]:
    from zstate.wire.keys import MODEL_WRITER

    names = [name for name in robot.names_of(writer) if stream == "tf_static" and name != MODEL_WRITER]
    shown = f"  {stream}/{','.join(names)}" if names else f"  {stream}"
    pulse = sampler.pulse(Source(robot.name, stream, writer.session))
    if pulse is None:
        return shown, "", "", str(writer), _since(writer)
    rate = "silent" if pulse.silent_ns > _SILENT_NS else rate_text(pulse.rate_hz)
    return shown, rate, duration_text(pulse.silent_ns), str(writer), _since(writer)


def _since(writer: Writer) -> str:
    start = datetime.fromtimestamp(writer.since // 1_000_000_000).astimezone()
    nanoseconds = time.time_ns() - writer.since
    minutes, seconds = divmod(nanoseconds // 1_000_000_000, 60)
    hours, minutes = divmod(minutes, 60)
    lasting = f"{minutes} min {seconds:02d} s" if minutes else duration_text(nanoseconds)
    return f"since {start:%Y-%m-%d %H:%M:%S}, {f'{hours} h {minutes:02d} min' if hours else lasting}"


def robots_facts(robots: Sequence[RobotInfo], sampler: Sampler) -> list[dict[str, Any]]:
    """The same as JSON."""
    return [
        {"robot": robot.name, "writers": [_facts(robot, *pair, sampler) for pair in robot.writers]}
        for robot in robots
    ]


def _facts(robot: RobotInfo, stream: Stream, writer: Writer, sampler: Sampler) -> dict[str, Any]:
    pulse = sampler.pulse(Source(robot.name, stream, writer.session))
    return {
        "stream": stream,
        **asdict(writer),
        "names": robot.names_of(writer) if stream == "tf_static" else (),
        "rate_hz": None if pulse is None else pulse.rate_hz,
        "silent_s": None if pulse is None else pulse.silent_ns * 1e-9,
    }
