"""zstate record: robots into MCAP files."""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from zstate.cli import options
from zstate.cli.metrics import serve_metrics, writer_rows
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
from zstate.recording.cli.metrics import recorder_rows

if TYPE_CHECKING:
    from zstate.clock import Clock
    from zstate.metrics.endpoint import BindAddress
    from zstate.recording.background_store import BackgroundStore
    from zstate.recording.errors import RecordingError
    from zstate.recording.recorder import Recorder, RecorderStats
    from zstate.recording.retention import FilePattern, Keep, Retention

_LINE_S = 1.0
_REFRESH_S = 0.25
_INDEX_WITHIN_S = 10.0
# Discovery takes less.
_DISCOVERY_S = 0.5
# The model and the static edges are written once in this time.
_DISK_WINDOW_NS = 10_000_000_000
_DAY_S = 86_400.0
_DEFAULT_FILE = "rec-%Y%m%d-%H%M%S.mcap"


def _at_least(least: float, unit: str) -> Callable[[float], float]:
    def check(size: float) -> float:
        if not (math.isfinite(size) and size >= least):
            raise InvalidInput(f"a file has at least {least:g} {unit}; got {size}")
        return size

    return check


def _parse_keep(text: str) -> Keep:
    from zstate.recording.retention import Keep

    return Keep.parse(text)


@click.command("record")
@click.argument("file", default=_DEFAULT_FILE)
@click.argument("robots", metavar="[ROBOT]...", nargs=-1)
@options.wire_option
@options.seconds_option
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
@click.option(
    "--keep",
    type=options.Checked("SIZE|AGE", _parse_keep),
    help="Delete the oldest recordings that match FILE beyond this size, such as 50GB, or age, such as 7d, "
    "when a file starts.",
)
@click.option(
    "--archive",
    metavar="DIR|URL",
    help="Add each finished file to this archive, in the background, before --keep deletes it.",
)
@click.option("--overwrite", is_flag=True, help="Replace an existing FILE.")
@options.metrics_option
@options.session_options
def record_command(
    *,
    file: str,
    robots: tuple[str, ...],
    wire: str,
    seconds: float | None,
    split_size: float | None,
    split_seconds: float | None,
    keep: Keep | None,
    archive: str | None,
    overwrite: bool,
    metrics: BindAddress | None,
    network: SessionOptions,
) -> None:
    """Record ROBOTs, by default all, into the MCAP file FILE until Ctrl-C.

    Writes ROS 2 messages, which Foxglove, PlotJuggler, Rerun and rosbags read directly. Each file of a split
    recording is complete by itself: the model and the fixed edges are written at its start and every 10 s,
    a map at its start and when it changes. After a crash all but the last 0.5 s is in the file; `zstate
    recover` makes a complete file of it.

    It keeps the commands to drivers, as joint states on /joint_commands; the states of drivers, with motions
    and their outcomes, on /diagnostics, which Foxglove and rqt show; and the stops on /stops. A replay never
    publishes these.

    FILE may have the start time in its name: %Y %m %d %H %M %S are replaced by the local time (also %y and
    %j; %% is a percent sign). The default, rec-%Y%m%d-%H%M%S.mcap in the working directory, gives each start
    a file of its own. --keep deletes files with such a name that zstate recorded, a split recording file by
    file, and never one that is being written.

    --archive adds each finished file to an archive (`zstate archive`). A file that cannot be added is named
    and tried again after the next one; the recording goes on. --keep deletes a file once it was tried.

    \b
    zstate record
    zstate record run.mcap
    zstate record run.mcap panda --seconds 60
    zstate record run.mcap --wire ros2:domain=5 --split-size 500
    zstate record rec-%Y%m%d-%H%M%S.mcap --split-size 500 --keep 50GB
    zstate record rec-%Y%m%d-%H%M%S.mcap --split-seconds 600 --keep 7d --archive s3://plant/fleet
    """
    from zstate.recording.background_store import BackgroundStore
    from zstate.recording.errors import RecordingError
    from zstate.recording.recorder import Recorder

    pattern = _file_pattern(file)
    retention = None if keep is None else _retention(pattern, keep, split_size, split_seconds)
    store = None if archive is None else BackgroundStore(archive)
    path = pattern.path_at(datetime.now())
    if str(path) != file:
        print_status(f"recording into {str(path)!r}")
    with open_session(network, (wire,)) as session:
        try:
            recorder = Recorder(
                session,
                path,
                robots,
                wire=wire,
                max_bytes=None if split_size is None else round(split_size * 1e6),
                max_seconds=split_seconds,
                overwrite=overwrite,
            )
        except RecordingError as error:
            fail(_refusal_text(error, pattern))
        with (
            recorder,
            RobotDirectory(session, robots[0] if len(robots) == 1 else "*", wire) as directory,
            serve_metrics(metrics, recorder_rows(recorder), writer_rows(directory)),
        ):
            progress = RecordProgress(recorder, directory, robots, retention, store)
            try:
                _show(recorder, progress, seconds)
            finally:
                recorder.close()
                recorder.wait(_INDEX_WITHIN_S)  # the index of a large file takes its time on a busy machine
                progress.watch_files()
                progress.finish_store()
                print_wrapped(progress.summary())
            if recorder.failure is not None:
                raise recorder.failure
            if not recorder.stats.messages:
                fail(f"nothing was recorded: {progress.no_message_text}")
            if store is not None and store.failed:
                fail(_missing_text(store))


def _file_pattern(file: str) -> FilePattern:
    from zstate.recording.retention import FilePattern

    try:
        return FilePattern(file if file.endswith(".mcap") else f"{file}.mcap")
    except InvalidInput as error:
        raise click.BadParameter(str(error), param_hint="FILE") from None


def _retention(
    pattern: FilePattern, keep: Keep, split_size: float | None, split_seconds: float | None
) -> Retention:
    """What ``--keep`` asks for. Raises UsageError if it cannot work with the other options."""
    from zstate.recording.retention import Retention

    if not pattern.has_time:
        raise click.UsageError(
            f"--keep deletes older recordings that match FILE, and {str(pattern)!r} is the name of one; put "
            f"the time into it, such as {_DEFAULT_FILE}"
        )
    if split_size is not None and split_size * 1e6 > keep.max_bytes:
        raise click.UsageError(
            f"--keep {keep.text} is less than one file of --split-size {split_size:g} MB; raise --keep, or "
            "split into smaller files"
        )
    if split_seconds is not None and split_seconds > keep.max_age_s:
        raise click.UsageError(
            f"--keep {keep.text} is less than one file of --split-seconds {split_seconds:g}; raise --keep, "
            "or split into shorter files"
        )
    if split_size is None and split_seconds is None:
        print_status(
            "--keep deletes recordings at this start only, since this recording is one file; --split-size or "
            "--split-seconds bounds it, too"
        )
    return Retention(pattern, keep, is_split=split_size is not None or split_seconds is not None)


def _missing_text(store: BackgroundStore) -> str:
    """What is missing in the archive, and how to add it."""
    there = [str(file) for file in store.failed if file.exists()]
    text = f"{count_text(len(store.failed), 'file')} of the recording not in {store.name}"
    return f"{text}; add them by `zstate archive {store.name} --from {' '.join(there)}`" if there else text


def _refusal_text(error: RecordingError, pattern: FilePattern) -> str:
    """Why the recording cannot start, in terms of the command line."""
    text = str(error).replace("overwrite=True", "--overwrite")
    if isinstance(error.__cause__, FileExistsError) and pattern.has_time:
        text += f"; each start has a file of its own if FILE has the seconds, as in {_DEFAULT_FILE}"
    return text


def _show(recorder: Recorder, progress: RecordProgress, seconds: float | None) -> None:
    """Show progress until the recording has ended, or for ``seconds``."""
    progress.watch_files()
    until = math.inf if seconds is None else time.monotonic() + seconds

    def is_over(pause_s: float) -> bool:
        return recorder.wait(min(pause_s, max(0.0, until - time.monotonic()))) or time.monotonic() >= until

    if not is_terminal():
        while not is_over(_LINE_S):
            progress.watch_files()
            for change in progress.changes():
                print_status(change)
            print_wrapped(progress.line())
        return
    from rich.live import Live
    from rich.text import Text

    with Live(auto_refresh=False, transient=True) as live:
        while not is_over(_REFRESH_S):
            progress.watch_files()
            for change in progress.changes():
                live.console.print(change, markup=False, highlight=False, soft_wrap=True)
            live.update(Text(progress.line()), refresh=True)


class RecordProgress:
    """Progress of a recorder: its streams, its rate, and the robots it waits for."""

    def __init__(
        self,
        recorder: Recorder,
        directory: RobotDirectory,
        robots: Sequence[str],
        retention: Retention | None = None,
        store: BackgroundStore | None = None,
    ) -> None:
        from zstate.clock import MonotonicClock

        self._recorder, self._directory, self._robots = recorder, directory, robots
        self._retention, self._retained_at = retention, 0
        self._store, self._stored = store, 0
        self._reported: dict[Path, str] = {}
        self._disk = DiskForecast(lambda: recorder.stats, retention, MonotonicClock())
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

    def watch_files(self) -> None:
        """Add finished files to ``--archive``, delete those beyond ``--keep``, warn of a disk that fills."""
        files = self._recorder.stats.files
        self._watch_store(files[: len(files) if self._recorder.wait(0.0) else -1])
        if self._retention is not None and len(files) != self._retained_at:
            self._retained_at = len(files)
            kept = self._retention.keep.text
            waiting = () if self._store is None else self._store.waiting
            for file in self._retention.delete_excess({files[-1], *waiting}):
                text = f"deleted {str(file.path)!r} ({size_text(file.size)}): --keep {kept}"
                print_status(text, event="deleted")
        warning = self._disk.warning()
        if warning:
            print_status(warning, event="disk", level="warning")

    def _watch_store(self, finished: Sequence[Path]) -> None:
        store = self._store
        if store is None:
            return
        for file in finished[self._stored :]:
            store.add(file)
        self._stored = len(finished)
        self._report_store(store)

    def _report_store(self, store: BackgroundStore) -> None:
        """Print why the store cannot be used, and what it does not have."""
        if store.problem:
            print_status(f"--archive {store.name}: {store.problem}", event="archive", level="warning")
            store.problem = ""
        for file, reason in list(store.failed.items()):
            if self._reported.get(file) != reason:
                text = f"{str(file)!r} is not in {store.name}: {reason}"
                print_status(text, event="archive", level="warning")
                self._reported[file] = reason

    def finish_store(self) -> None:
        """Wait until ``--archive`` has the last files. Ctrl-C ends the wait."""
        store = self._store
        if store is None:
            return
        if not store.finish(_LINE_S):
            print_status(f"adding the last files to {store.name}; Ctrl-C leaves them out")
            while not store.finish(_LINE_S):
                pass
        self._report_store(store)

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
        messages = count_text(sum(stats.messages.values()) - stats.lost, "message")
        robots = f" of {', '.join(_robots(stats))}" if _robots(stats) else ""
        where = f"{files_text(stats.files)} ({size_text(stats.bytes)})"
        lost = f"lost {_lost(stats)}" if _lost(stats) else "nothing lost"
        text = f"recorded {messages}{robots} in {took:.1f} s into {where}; {lost}"
        return f"{text}{self._deleted()}{self._archived()}"

    def _archived(self) -> str:
        store = self._store
        if store is None:
            return ""
        failed = f", {len(store.failed)} not" if store.failed else ""
        return f"; added {count_text(len(store.added), 'file')} to {store.name}{failed}"

    def _deleted(self) -> str:
        if self._retention is None or not self._retention.deleted_files:
            return ""
        count, size = self._retention.deleted_files, self._retention.deleted_bytes
        return f"; deleted {count_text(count, 'file')} ({size_text(size)})"


class DiskForecast:
    """Warns once if the disk of a recording would be full within a day at the rate of the last 10 s."""

    def __init__(self, stats: Callable[[], RecorderStats], retention: Retention | None, clock: Clock) -> None:
        self._stats, self._retention, self._clock = stats, retention, clock
        self._start, self._bytes = clock.now(), 0
        self._has_warned = False

    def warning(self) -> str:
        """The warning, or an empty text; computed every 10 s, so it may be called at any rate."""
        now = self._clock.now()
        elapsed_ns = now - self._start
        if self._has_warned or elapsed_ns < _DISK_WINDOW_NS:
            return ""
        stats = self._stats()
        rate = (stats.bytes - self._bytes) / (elapsed_ns * 1e-9)
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
        (stats.lost, "that the disk had no space for"),
        (stats.dropped, "dropped here"),
        (stats.missed, "missed on the way"),
        (stats.unwritten, "without a description that fits"),
        (sum(stats.refused.values()), f"refused ({reasons})"),
    )
    lost = ", ".join(f"{count} {what}" for count, what in parts if count)
    of = ", ".join(f"{count} of {robot} {stream}" for (robot, stream), count in sorted(stats.missing.items()))
    return f"{lost} ({of})" if of else lost
