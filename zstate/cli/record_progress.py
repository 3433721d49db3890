"""Progress of `zstate record`: counts, missing robots, deleted files, and a disk that fills."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from zstate.cli.output.console import count_text, files_text, print_status, size_text
from zstate.cli.robot_directory import RobotDirectory

if TYPE_CHECKING:
    from zstate.recording.recorder import Recorder, RecorderStats
    from zstate.recording.retention import Retention

# Discovery takes less.
_DISCOVERY_S = 0.5
# The model and the static edges are written once in this time.
_DISK_WINDOW_S = 10.0
_DAY_S = 86_400.0


class RecordProgress:
    """Progress of a recorder: its streams, its rate, and the robots it waits for."""

    def __init__(
        self,
        recorder: Recorder,
        directory: RobotDirectory,
        robots: Sequence[str],
        retention: Retention | None = None,
    ) -> None:
        self._recorder, self._directory, self._robots = recorder, directory, robots
        self._retention, self._retained_at = retention, 0
        self._disk = DiskForecast(recorder, retention)
        self._listed: set[tuple[str, str]] = set()
        self._waiting = ""
        self._start = time.monotonic()
        self._before = (self._start, 0)

    def line(self) -> str:
        """Duration, messages, rate since the last call, size and robots."""
        stats, now = self._recorder.stats, time.monotonic()
        count, (before, count_before) = sum(stats.messages.values()), self._before
        self._before = (now, count)
        rate = (count - count_before) / max(now - before, 1e-9)
        robots, lost = ", ".join(_robots(stats)) or "no robot yet", _lost(stats)
        size, took = size_text(stats.bytes), f"{now - self._start:.0f} s"
        return f"{took}  {count} messages  {rate:.1f}/s  {size}  {robots}{f'  lost {lost}' if lost else ''}"

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

    def watch_disk(self) -> None:
        """Delete recordings beyond ``--keep`` if a file has started since, and warn of a disk that fills."""
        files = self._recorder.stats.files
        if self._retention is not None and len(files) != self._retained_at:
            self._retained_at = len(files)
            kept = self._retention.keep.text
            for file in self._retention.delete_excess(files[-1]):
                text = f"deleted {str(file.path)!r} ({size_text(file.size)}): --keep {kept}"
                print_status(text, event="deleted")
        warning = self._disk.warning()
        if warning:
            print_status(warning, event="disk", level="warning")

    @property
    def no_message_text(self) -> str:
        """The reason why nothing was recorded, as far as it can be determined here."""
        announced = self._directory.robots()
        return self._missing(set()) or f"{self._directory.messages.announced(announced)}, but no message came"

    def _missing(self, recorded: set[str]) -> str:
        announced, messages = self._directory.robots(), self._directory.messages
        if not self._robots:
            return "" if recorded or announced else messages.announced(announced)
        missing = set(self._robots) - recorded - {info.name for info in announced}
        return "; ".join(messages.unknown(robot, announced) for robot in sorted(missing))

    def summary(self) -> str:
        stats, took = self._recorder.stats, time.monotonic() - self._start
        messages = count_text(sum(stats.messages.values()), "message")
        robots = f" of {', '.join(_robots(stats))}" if _robots(stats) else ""
        where = f"{files_text(stats.files)} ({size_text(stats.bytes)})"
        lost = f"lost {_lost(stats)}" if _lost(stats) else "nothing lost"
        return f"recorded {messages}{robots} in {took:.1f} s into {where}; {lost}{self._deleted()}"

    def _deleted(self) -> str:
        if self._retention is None or not self._retention.deleted_files:
            return ""
        count, size = self._retention.deleted_files, self._retention.deleted_bytes
        return f"; deleted {count_text(count, 'file')} ({size_text(size)})"


class DiskForecast:
    """Warns once if the disk of a recording would be full within a day at the rate of the last 10 s."""

    def __init__(self, recorder: Recorder, retention: Retention | None) -> None:
        self._recorder, self._retention = recorder, retention
        self._start, self._bytes = time.monotonic(), 0
        self._has_warned = False

    def warning(self) -> str:
        """The warning, or an empty text; computed every 10 s, so it may be called at any rate."""
        now = time.monotonic()
        elapsed = now - self._start
        if self._has_warned or elapsed < _DISK_WINDOW_S:
            return ""
        stats = self._recorder.stats
        rate = (stats.bytes - self._bytes) / elapsed
        self._start, self._bytes = now, stats.bytes
        growth = rate * _DAY_S if self._retention is None else self._retention.growth(rate, _DAY_S)
        file = stats.files[-1]
        try:
            free = shutil.disk_usage(file.parent).free
        except OSError:  # the recorder reports a disk that is gone
            return ""
        if free >= growth:
            return ""
        self._has_warned = True
        return (
            f"the disk of {str(file)!r} is full in {free / rate / 3600.0:.2g} h: {size_text(free)} are free, "
            f"and the recording grows by {size_text(rate)} a second; free some space, or bound recordings "
            "with --keep and --split-size"
        )


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
