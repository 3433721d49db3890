"""Text of `zstate record` and `zstate replay`: progress lines and final reports."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from zstate.cli.output.console import count_text
from zstate.cli.robot_directory import RobotDirectory
from zstate.errors import format_duration

if TYPE_CHECKING:
    from zstate.net.session import Session
    from zstate.recording.player import Player, PlayerReport
    from zstate.recording.recorder import Recorder, RecorderStats

# Discovery takes less.
_DISCOVERY_S = 0.5


def size_text(size: int) -> str:
    """A number of bytes with a unit."""
    amount = float(size)
    for unit in ("B", "kB", "MB"):
        if amount < 1000.0:
            return f"{amount:.0f} {unit}" if unit == "B" else f"{amount:.3g} {unit}"
        amount /= 1000.0
    return f"{amount:,.2f} GB"


def files_text(files: Sequence[Path]) -> str:
    """The names of the files of a recording."""
    if len(files) < 3:
        return " and ".join(map(str, files))
    return f"{len(files)} files, {files[0]} to {files[-1].name}"


class RecordProgress:
    """Progress of a recorder: its streams, its rate, and the robots it waits for."""

    def __init__(self, recorder: Recorder, roster: RobotDirectory, robots: Sequence[str]) -> None:
        self._recorder = recorder
        self._roster = roster
        self._robots = robots
        self._listed: set[tuple[str, str]] = set()
        self._waiting = ""
        self._start = time.monotonic()
        self._before = (self._start, 0)

    def line(self) -> str:
        """Duration, messages, rate since the last call, size and robots."""
        stats, now = self._recorder.stats, time.monotonic()
        count = sum(stats.messages.values())
        before, count_before = self._before
        self._before = (now, count)
        rate = (count - count_before) / max(now - before, 1e-9)
        robots = ", ".join(_robots(stats)) or "no robot yet"
        lost = f"  lost {_lost(stats)}" if _lost(stats) else ""
        took = f"{now - self._start:.0f} s"
        return f"{took}  {count} messages  {rate:.1f}/s  {size_text(stats.bytes)}  {robots}{lost}"

    def changes(self) -> Iterator[str]:
        """Streams recorded since the last call, and robots that are missing."""
        streams = set(self._recorder.stats.messages)
        for robot in sorted({robot for robot, _ in streams - self._listed}):
            new = sorted(stream for name, stream in streams - self._listed if name == robot)
            yield "recording the clock" if new == ["clock"] else f"recording {robot}: {', '.join(new)}"
        self._listed |= streams
        waiting = self._missing({robot for robot, stream in streams if stream != "clock"})
        if waiting and waiting != self._waiting and time.monotonic() - self._start > _DISCOVERY_S:
            yield f"waiting: {waiting}"
            self._waiting = waiting

    @property
    def no_message_text(self) -> str:
        """The reason why nothing was recorded, as far as it can be determined here."""
        announced = self._roster.robots()
        return self._missing(set()) or f"{self._roster.messages.announced(announced)}, but no message came"

    def _missing(self, recorded: set[str]) -> str:
        announced, words = self._roster.robots(), self._roster.messages
        if not self._robots:
            return "" if recorded or announced else words.announced(announced)
        missing = set(self._robots) - recorded - {info.name for info in announced}
        return "; ".join(words.unknown(robot, announced) for robot in sorted(missing))

    def summary(self) -> str:
        """Messages, robots, files and losses at the end."""
        stats, took = self._recorder.stats, time.monotonic() - self._start
        messages = count_text(sum(stats.messages.values()), "message")
        of = f" of {', '.join(_robots(stats))}" if _robots(stats) else ""
        lost = f"lost {_lost(stats)}" if _lost(stats) else "nothing lost"
        where = f"{files_text(stats.files)} ({size_text(stats.bytes)})"
        return f"recorded {messages}{of} in {took:.1f} s into {where}; {lost}"


def _robots(stats: RecorderStats) -> list[str]:
    return sorted({robot for robot, stream in stats.messages if stream != "clock"})


def _lost(stats: RecorderStats) -> str:
    reasons = ", ".join(f"{reason} {count}" for reason, count in stats.refused.items())
    parts = (
        (stats.dropped, "dropped here"),
        (stats.missed, "missed on the way"),
        (stats.unwritten, "without a description that fits"),
        (sum(stats.refused.values()), f"refused ({reasons})"),
    )
    return ", ".join(f"{count} {what}" for count, what in parts if count)


def conflicting_writers(session: Session, robots: Sequence[str], wires: Sequence[str]) -> list[str]:
    """Writers on the network of streams that a replay of ``robots`` would publish."""
    from zstate.net.presence import discover
    from zstate.wire.registry import get_wire

    conflicts: list[str] = []
    for name in wires:
        wire = get_wire(name)
        # The name of a replayed robot on this wire: ROS has only namespaces.
        names = {wire.robot_of(wire.expression(robot, "joint_states")): robot for robot in robots}
        replayed = {"joint_states", "robot_description", "tf"} - wire.shared
        for info in discover(session, wire=name):
            writers = {str(writer) for stream, writer in info.writers if stream in replayed}
            if info.name in names and writers:
                conflicts.append(f"{names[info.name]!r} by {', '.join(sorted(writers))}")
    return conflicts


def replay_heading(replayer: Player, file: str) -> str:
    """Robots, time span and rate of a replay."""
    from zstate.clock import format_stamp

    first, last = replayer.span
    robots = ", ".join(map(repr, replayer.robots))
    rate = "as fast as it can" if replayer.rate == float("inf") else f"at {replayer.rate:g} times its speed"
    duration = f"{(last - first) / 1e9:.1f} s"
    return (
        f"replaying {robots} from {file}: {duration}, {format_stamp(first)} to {format_stamp(last)}, {rate}"
    )


def replay_line(replayer: Player) -> str:
    """Position, rate and lateness of a running replay."""
    from zstate.clock import format_stamp

    first, last = replayer.span
    now, report = replayer.position, replayer.report()
    position = f"{(now - first) / 1e9:.1f} of {(last - first) / 1e9:.1f} s"
    late = format_duration(report.lateness_p99)
    return f"{position}  {format_stamp(now)}  {report.samples} samples  {report.rate:.2f}x  late {late}"


def replay_summary(report: PlayerReport) -> str:
    """Samples, rate, lateness and refusals at the end of a replay."""
    late = (
        f"late by {format_duration(report.lateness_p50)} (median), {format_duration(report.lateness_p99)} "
        f"(99 of 100), {format_duration(report.lateness_max)} (at most)"
    )
    passes = f" in {report.passes} passes" if report.passes > 1 else ""
    delays = f"; fell {count_text(report.delays, 'time')} more than a second behind" if report.delays else ""
    reasons = ", ".join(f"{reason} {count}" for reason, count in report.refused.items())
    refused = f"; not published: {reasons}" if reasons else ""
    return (
        f"replayed {count_text(report.samples, 'sample')}{passes} at {report.rate:.3f} times the speed, "
        f"{late}{delays}{refused}"
    )
