"""zstate archive: recordings of months as Parquet."""

from __future__ import annotations

import re
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

import click

from zstate.cli import options
from zstate.cli.output.console import count_text, fail, print_result, print_status, print_wrapped, size_text
from zstate.errors import InvalidInput

if TYPE_CHECKING:
    from zstate.archive.importer import ImportReport

_LINE_S = 2.0
_DAYS = {"d": 1, "w": 7}


def _date_before(text: str) -> str:
    """The UTC date of ``text``: itself, or so many days or weeks before today."""
    if found := re.fullmatch(r"(\d{1,6})([dw])", text, re.ASCII):
        days = int(found[1]) * _DAYS[found[2]]
        return str((datetime.now(UTC) - timedelta(days=days)).date())
    try:
        return str(datetime.strptime(text, "%Y-%m-%d").date())
    except ValueError:
        raise InvalidInput(f"{text!r} is no date like 2026-08-01, and no time like 90d or 12w") from None


class _ArchiveGroup(click.Group):
    """A group whose option --from has one or more values, as a shell makes of ``*.mcap``."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        recordings: list[str] = []
        rest: list[str] = []
        is_from = False
        for word in args:
            is_of_command = len(rest) > 1  # behind the archive and the command
            if word.startswith("-"):
                is_from = word == "--from" and not is_of_command
            if word != "--from" or is_of_command:
                (recordings if is_from else rest).append(word)
        if "--from" in args and "--from" not in rest and not recordings:
            raise click.UsageError("Option '--from' requires at least one RECORDING.", ctx)
        # A group takes its options before its arguments.
        return super().parse_args(ctx, [*(one for name in recordings for one in ("--from", name)), *rest])


@click.group("archive", cls=_ArchiveGroup, invoke_without_command=True)
@click.argument("url", metavar="DIR|URL")
@click.option("--from", "recordings", multiple=True, metavar="RECORDING...", help="Add these recordings.")
@click.pass_context
def archive_command(context: click.Context, *, url: str, recordings: tuple[str, ...]) -> None:
    """Add recordings to an archive of Parquet files, or show what it has.

    An archive is a folder, or s3://BUCKET/PREFIX, gs://... or abfs://...; the credentials are those of the
    environment. It is made by the first recording. One that was added before adds nothing, and one whose
    import was interrupted is completed. DuckDB, Polars, pandas and Spark read the files without zstate.

    Needs pyarrow and duckdb: pip install 'zstate[archive]'.

    \b
    zstate archive fleet --from monday/*.mcap           # add recordings
    zstate archive fleet                                # robots, and since when
    zstate archive s3://plant/fleet --from run.mcap
    zstate view fleet --robot robot17 --at 2026-11-20T14:03
    zstate archive fleet cut minute.mcap robot17 --at 2026-11-20T14:03   # for replay, info, foxglove
    zstate archive fleet check                          # checksums of all files
    zstate archive fleet compact --before 1d            # fewer files, as each costs every query
    zstate archive fleet expire --before 90d
    zstate archive fleet forget robot17
    """
    if context.invoked_subcommand is not None:
        if recordings:
            raise click.UsageError("--from adds recordings, without another command")
        context.obj = url
        return
    if recordings:
        _add(url, recordings)
    else:
        _show(url)


def _add(url: str, recordings: tuple[str, ...]) -> None:
    from zstate.archive.importer import import_recording
    from zstate.recording.errors import RecordingError

    failed: list[str] = []
    for recording in recordings:
        start = time.monotonic()
        try:
            report = import_recording(url, recording, _Progress())
        except (RecordingError, InvalidInput) as error:
            failed.append(recording)
            print_status(f"{recording} was not added: {error}")
            continue
        print_wrapped(_summary(report, time.monotonic() - start))
    if failed:
        others = f"; the others are in {url}" if len(failed) < len(recordings) else ""
        fail(f"{count_text(len(failed), 'recording')} not added: {', '.join(failed)}{others}")


class _Progress:
    """Prints a status line every two seconds."""

    def __init__(self) -> None:
        self._due = time.monotonic() + _LINE_S

    def __call__(self, text: str) -> None:
        if time.monotonic() >= self._due:
            print_status(text)
            self._due = time.monotonic() + _LINE_S


def _summary(report: ImportReport, took_s: float) -> str:
    if report.is_known:
        return f"{report.path} is in the archive already"
    rows = ", ".join(f"{number} {stream}" for stream, number in sorted(report.rows.items()))
    losses = [f"{count_text(number, 'message')} left out ({why})" for why, number in report.refused.items()]
    robots = ", ".join(report.robots) or "no robot"
    where = f"{count_text(report.files, 'file')} ({size_text(report.size)})"
    text = f"added {report.path} in {took_s:.1f} s: {rows or 'no samples'} of {robots} in {where}"
    return f"{text}; {', '.join(losses) or 'nothing missing'}"


def _show(url: str) -> None:
    from zstate.archive.archive import Archive
    from zstate.cli.output.console import output_width
    from zstate.cli.output.text_layout import Table

    archive = Archive(url)
    rows: list[tuple[str, ...]] = []
    for robot in archive.robots():
        covered = archive.coverage(robot)
        samples = sum(number for one in covered for number in one.rows.values())
        span = _date_text(covered[0].start), _date_text(max(one.end for one in covered))
        rows.append((robot, str(len(covered)), *span, str(samples)))
    if not rows:
        fail(f"{url!r} has no recording; add one: zstate archive {url} --from RECORDING")
    table = Table(("ROBOT", "RECORDINGS", "FROM", "TO", "SAMPLES"), rows)
    for line in table.lines(output_width()):
        print_result(line)


def _date_text(stamp: int) -> str:
    return f"{datetime.fromtimestamp(stamp // 10**9, UTC):%Y-%m-%d %H:%M:%S}"


@archive_command.command("cut")
@click.argument("file", metavar="FILE")
@click.argument("robot")
@options.window_options
@click.pass_obj
def cut_command(url: str, *, file: str, robot: str, window: tuple[int, int] | None) -> None:
    """Write a window of ROBOT as a recording, which replay, info and foxglove open.

    `zstate view`, `plot` and `export` take the archive itself.

    A TIME is UTC as 2026-11-20T14:03, 2026-11-20T14:03:05.25, or a stamp in nanoseconds.

    \b
    zstate archive fleet cut minute.mcap robot17 --at 2026-11-20T14:03
    zstate archive fleet cut run.mcap robot17 --from 2026-11-20T14:00 --to 2026-11-20T14:10
    zstate view minute.mcap
    """
    from zstate.archive.cut import cut
    from zstate.recording.errors import RecordingError

    if window is None:
        raise click.UsageError("name the window by --at TIME, or by --from TIME --to TIME")
    try:
        written = cut(url, Path(file), robot, *window)
    except RecordingError as error:
        fail(str(error))
    counts = ", ".join(f"{count} {stream}" for stream, count in sorted(written.items()))
    print_wrapped(f"wrote {file}: {counts}")


@archive_command.command("check")
@click.pass_obj
def check_command(url: str) -> None:
    """Read all files, and name those that are damaged, missing, of an interrupted import, or of others.

    The rest of the archive is used as before. Ends with 1 if there is any.

    \b
    zstate archive fleet check
    """
    from zstate.archive.upkeep import check

    count = 0
    for path, problem in check(url):
        print_wrapped(f"{path}: {problem}")
        count += 1
    if count:
        fail(f"{count_text(count, 'file')} of {url} cannot be used")
    print_wrapped(f"all files of {url} are as they were written")


@archive_command.command("compact")
@click.option(
    "--before",
    type=options.Checked("DATE", _date_before),
    help="Samples of dates before a UTC date, or a time before today: 1d, 2w. Default: of all dates.",
)
@click.pass_obj
def compact_command(url: str, *, before: str | None) -> None:
    """Merge the files of each stream, robot and date, and what is listed of each recording.

    Lookups and queries answer as before, and need less time: each file costs all of them. Recordings may be
    added and read while it runs; run it once a day, for the days that are over. If it is interrupted, run it
    again. Files of recordings that overlap in time are not merged.

    \b
    zstate archive fleet compact --before 1d
    """
    from zstate.archive.compaction import compact

    report = compact(url, before, _Progress())
    for path, problem in report.problems.items():
        print_wrapped(f"{path} stays as it is: {problem}")
    written = count_text(report.written, "file")
    print_wrapped(f"{written} in place of {report.files}" if report.written else "nothing to merge")


@archive_command.command("expire")
@click.option(
    "--before",
    required=True,
    type=options.Checked("DATE", _date_before),
    help="A UTC date, or a time before today: 90d, 12w.",
)
@click.pass_obj
def expire_command(url: str, before: str) -> None:
    """Remove what was recorded before a date.

    \b
    zstate archive fleet expire --before 90d
    zstate archive fleet expire --before 2026-08-01
    """
    from zstate.archive.upkeep import expire

    removed = expire(url, before)
    print_wrapped(f"removed {count_text(removed.files, 'file')} ({size_text(removed.size)}) before {before}")


@archive_command.command("forget")
@click.argument("robot")
@click.pass_obj
def forget_command(url: str, robot: str) -> None:
    """Remove all of ROBOT.

    \b
    zstate archive fleet forget robot17
    """
    from zstate.archive.upkeep import forget

    removed = forget(url, robot)
    print_wrapped(f"removed {count_text(removed.files, 'file')} ({size_text(removed.size)}) of {robot}")
