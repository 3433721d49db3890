"""What a person is told of a recording: while it is made, and when it has ended."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from zstate.cli.output.console import count_text
from zstate.cli.robot_directory import RobotDirectory

if TYPE_CHECKING:
    from zstate.recording.recorder import Recorder, RecorderStats

# Meeting everybody takes less.
_MEETING_S = 0.5


def size_text(size: int) -> str:
    """A number of bytes in the unit that suits it."""
    amount = float(size)
    for unit in ("B", "kB", "MB"):
        if amount < 1000.0:
            return f"{amount:.0f} {unit}" if unit == "B" else f"{amount:.3g} {unit}"
        amount /= 1000.0
    return f"{amount:,.2f} GB"


def files_text(files: Sequence[Path]) -> str:
    """The files of a recording by name."""
    if len(files) < 3:
        return " and ".join(map(str, files))
    return f"{len(files)} files, {files[0]} to {files[-1].name}"


class Progress:
    """A recording under way: what is recorded, how fast, and what it waits for."""

    def __init__(self, recorder: Recorder, roster: RobotDirectory, robots: Sequence[str]) -> None:
        self._recorder = recorder
        self._roster = roster
        self._robots = robots
        self._noted: set[tuple[str, str]] = set()
        self._waiting = ""
        self._began = time.monotonic()
        self._before = (self._began, 0)

    def line(self) -> str:
        """Time, messages, rate since the last line, size and robots."""
        stats, now = self._recorder.stats, time.monotonic()
        count = sum(stats.messages.values())
        before, count_before = self._before
        self._before = (now, count)
        rate = (count - count_before) / max(now - before, 1e-9)
        robots = ", ".join(_robots(stats)) or "nobody yet"
        lost = f"  lost {_lost(stats)}" if _lost(stats) else ""
        took = f"{now - self._began:.0f} s"
        return f"{took}  {count} messages  {rate:.1f}/s  {size_text(stats.bytes)}  {robots}{lost}"

    def news(self) -> Iterator[str]:
        """What has begun to be recorded since the last call, and what is waited for."""
        streams = set(self._recorder.stats.messages)
        for robot in sorted({robot for robot, _ in streams - self._noted}):
            new = sorted(stream for name, stream in streams - self._noted if name == robot)
            yield "recording the clock" if new == ["clock"] else f"recording {robot}: {', '.join(new)}"
        self._noted |= streams
        waiting = self._awaited({robot for robot, stream in streams if stream != "clock"})
        if waiting and waiting != self._waiting and time.monotonic() - self._began > _MEETING_S:
            yield f"waiting: {waiting}"
            self._waiting = waiting

    @property
    def silence(self) -> str:
        """Why nothing is heard, as far as one can tell from here."""
        announced = self._roster.robots()
        return self._awaited(set()) or f"{self._roster.words.announced(announced)}, but no message came"

    def _awaited(self, heard: set[str]) -> str:
        announced, words = self._roster.robots(), self._roster.words
        if not self._robots:
            return "" if heard or announced else words.announced(announced)
        absent = set(self._robots) - heard - {info.name for info in announced}
        return "; ".join(words.unknown(robot, announced) for robot in sorted(absent))

    def summary(self) -> str:
        """What was recorded, into which files, and what was lost."""
        stats, took = self._recorder.stats, time.monotonic() - self._began
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
