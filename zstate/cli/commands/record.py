"""zstate record: what robots say, into MCAP files."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING

import click

from zstate.cli.metrics import recorder_collector, serve_metrics, writer_collector
from zstate.cli.options import checked_seconds, metrics_option, session_options, wire_option
from zstate.cli.output.console import fail, is_terminal, print_status, print_wrapped
from zstate.cli.robot_directory import RobotDirectory
from zstate.cli.session import SessionOptions, open_session

if TYPE_CHECKING:
    from zstate.cli.output.recording_text import RecordProgress
    from zstate.metrics.endpoint import BindAddress
    from zstate.recording.recorder import Recorder

_LINE_S = 1.0
_REFRESH_S = 0.25
_INDEX_WITHIN_S = 10.0


def _checked_megabytes(_: click.Context, __: click.Parameter, size: float | None) -> float | None:
    if size is not None and not (math.isfinite(size) and size >= 0.1):
        raise click.BadParameter(f"a file has 0.1 MB or more; got {size}")
    return size


@click.command("record")
@click.argument("file")
@click.argument("robots", metavar="[ROBOT]...", nargs=-1)
@wire_option
@click.option("--duration", type=float, callback=checked_seconds, metavar="S", help="End after so long [s].")
@click.option(
    "--split-size",
    type=float,
    callback=_checked_megabytes,
    metavar="MB",
    help="Begin another file (FILE_1, FILE_2 ...) when one has grown so large.",
)
@click.option(
    "--split-seconds",
    type=click.FloatRange(min=1.0),
    callback=checked_seconds,
    metavar="S",
    help="Begin another file after so long.",
)
@click.option("--overwrite", is_flag=True, help="Replace a FILE that exists.")
@metrics_option
@session_options
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
    """Record ROBOTs, or all there are, into the MCAP file FILE, until Ctrl-C.

    ROS 2's messages, which Foxglove, PlotJuggler, Rerun and rosbags read as they are. Each file can be
    understood by itself: it holds the model and the fixed edges, and again every 10 s. After a crash
    what is older than half a second is there; `zstate recover` makes a complete file of it.

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
            RobotDirectory(session, robots[0] if len(robots) == 1 else "*", wire) as roster,
            serve_metrics(metrics, recorder_collector(recorder), writer_collector(roster)),
        ):
            _run(recorder, roster, robots, duration)


def _run(recorder: Recorder, roster: RobotDirectory, robots: tuple[str, ...], duration: float | None) -> None:
    from zstate.cli.output.recording_text import RecordProgress

    progress = RecordProgress(recorder, roster, robots)
    try:
        _show(recorder, progress, duration)
    finally:
        recorder.close()
        recorder.wait(_INDEX_WITHIN_S)  # on a busy machine, the index of a large file takes its time
        print_wrapped(progress.summary())
    if recorder.failure is not None:
        raise recorder.failure
    if not recorder.stats.messages:
        fail(f"nothing was recorded: {progress.no_message_text}")


def _show(recorder: Recorder, progress: RecordProgress, duration: float | None) -> None:
    """Until the recording has ended, or for ``duration`` seconds."""
    until = math.inf if duration is None else time.monotonic() + duration
    if not is_terminal():
        while not _is_over(recorder, until, _LINE_S):
            for change in progress.changes():
                print_status(change)
            print_wrapped(progress.line())
        return
    from rich.live import Live
    from rich.text import Text

    with Live(auto_refresh=False, transient=True) as live:
        while not _is_over(recorder, until, _REFRESH_S):
            for change in progress.changes():
                live.console.print(change, markup=False, highlight=False, soft_wrap=True)
            live.update(Text(progress.line()), refresh=True)


def _is_over(recorder: Recorder, until: float, pause_s: float) -> bool:
    """Wait ``pause_s``, then return whether the recording has ended."""
    return recorder.wait(min(pause_s, max(0.0, until - time.monotonic()))) or time.monotonic() >= until
