"""zstate record: robots into MCAP files."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

import click

from zstate.cli import options
from zstate.cli.metrics import recorder_collector, serve_metrics, writer_collector
from zstate.cli.output.console import (
    count_text,
    fail,
    files_text,
    is_terminal,
    print_status,
    print_wrapped,
    size_text,
)
from zstate.cli.robot_directory import RobotDirectory
from zstate.cli.session import SessionOptions, open_session
from zstate.errors import InvalidInput

if TYPE_CHECKING:
    from zstate.metrics.endpoint import BindAddress
    from zstate.recording.recorder import Recorder, RecorderStats

_LINE_S = 1.0
_REFRESH_S = 0.25
_INDEX_WITHIN_S = 10.0
# Discovery takes less.
_DISCOVERY_S = 0.5


def _at_least(least: float, unit: str) -> Callable[[float], float]:
    def check(size: float) -> float:
        if not (math.isfinite(size) and size >= least):
            raise InvalidInput(f"a file has at least {least:g} {unit}; got {size}")
        return size

    return check


@click.command("record")
@click.argument("file")
@click.argument("robots", metavar="[ROBOT]...", nargs=-1)
@options.wire_option
@click.option("--duration", type=options.SECONDS, help="Stop after S seconds.")
@click.option(
    "--split-size",
    type=options.number("MB", _at_least(0.1, "MB")),
    help="Start a new file (FILE_1, FILE_2 ...) when one reaches this size.",
)
@click.option(
    "--split-seconds",
    type=options.number("S", _at_least(1.0, "s")),
    help="Start a new file every S seconds, at least 1.",
)
@click.option("--overwrite", is_flag=True, help="Replace an existing FILE.")
@options.metrics_option
@options.session_options
def record_command(
    *,
    file: str,
    robots: tuple[str, ...],
    wire: str,
    duration: float | None,
    split_size: float | None,
    split_seconds: float | None,
    overwrite: bool,
    metrics: BindAddress | None,
    network: SessionOptions,
) -> None:
    """Record ROBOTs, by default all, into the MCAP file FILE until Ctrl-C.

    Writes ROS 2 messages, which Foxglove, PlotJuggler, Rerun and rosbags read directly. Each file of a split
    recording is complete by itself: the model and the fixed edges are written at its start and every 10 s.
    After a crash all but the last 0.5 s is in the file; `zstate recover` makes a complete file of it.

    \b
    zstate record run.mcap
    zstate record run.mcap panda --duration 60
    zstate record run.mcap --wire ros2:domain=5 --split-size 500
    """
    from zstate.errors import RecordingError
    from zstate.recording.recorder import Recorder

    if not file.endswith(".mcap"):
        file = f"{file}.mcap"
        print_status(f"recording into {file!r}")
    with open_session(network, (wire,)) as session:
        try:
            recorder = Recorder(
                session,
                file,
                robots,
                wire=wire,
                max_bytes=None if split_size is None else round(split_size * 1e6),
                max_seconds=split_seconds,
                overwrite=overwrite,
            )
        except RecordingError as error:
            fail(str(error).replace("overwrite=True", "--overwrite"))
        with (
            recorder,
            RobotDirectory(session, robots[0] if len(robots) == 1 else "*", wire) as directory,
            serve_metrics(metrics, recorder_collector(recorder), writer_collector(directory)),
        ):
            progress = RecordProgress(recorder, directory, robots)
            try:
                _show(recorder, progress, duration)
            finally:
                recorder.close()
                recorder.wait(_INDEX_WITHIN_S)  # the index of a large file takes its time on a busy machine
                print_wrapped(progress.summary())
            if recorder.failure is not None:
                raise recorder.failure
            if not recorder.stats.messages:
                fail(f"nothing was recorded: {progress.no_message_text}")


def _show(recorder: Recorder, progress: RecordProgress, duration: float | None) -> None:
    """Show progress until the recording has ended, or for ``duration`` seconds."""
    until = math.inf if duration is None else time.monotonic() + duration

    def is_over(pause_s: float) -> bool:
        return recorder.wait(min(pause_s, max(0.0, until - time.monotonic()))) or time.monotonic() >= until

    if not is_terminal():
        while not is_over(_LINE_S):
            for change in progress.changes():
                print_status(change)
            print_wrapped(progress.line())
        return
    from rich.live import Live
    from rich.text import Text

    with Live(auto_refresh=False, transient=True) as live:
        while not is_over(_REFRESH_S):
            for change in progress.changes():
                live.console.print(change, markup=False, highlight=False, soft_wrap=True)
            live.update(Text(progress.line()), refresh=True)


class RecordProgress:
    """Progress of a recorder: its streams, its rate, and the robots it waits for."""

    def __init__(self, recorder: Recorder, directory: RobotDirectory, robots: Sequence[str]) -> None:
        self._recorder, self._directory, self._robots = recorder, directory, robots
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
        return f"recorded {messages}{robots} in {took:.1f} s into {where}; {lost}"


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
