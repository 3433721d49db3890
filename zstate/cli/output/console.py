"""Output of commands: results on standard output, status on standard error."""

from __future__ import annotations

import json
import math
import os
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from zstate.cli.output import logs
from zstate.errors import format_duration

if TYPE_CHECKING:
    from zstate.buffer.frame_tree import FrameInfo
    from zstate.rate import RateReport

GRACE_S = 0.5
"""A wait that takes longer than this is reported [s]; most end sooner."""


def print_result(text: str = "") -> None:
    """Print a line of the result; flushed."""
    click.echo(logs.without_controls(text, colors=True))  # click removes colours if it is no terminal


def print_wrapped(text: str) -> None:
    """Print sentences of the result, wrapped for a narrow terminal; with --log-format json an object.

    A log collector of a service reads standard output and standard error together, and parses both.
    """
    if logs.is_json():
        click.echo(logs.as_json(text, event="result"))
        return
    from zstate.cli.output.text_layout import wrap

    print_result(wrap(text, terminal_width()) if is_terminal() else text)


def print_json(value: Any) -> None:
    """Print a JSON document on one line."""
    click.echo(json.dumps(value))


def print_status(text: str, *, event: str = "note", robot: str | None = None, level: str = "info") -> None:
    """Print a status line, for instance that the command waits. Not part of the result.

    ``event`` and ``robot`` are for programs that read ``--log-format json``. As text, a ``level`` of
    "warning" begins with the name of the program.
    """
    logs.write(text, level=level, event=event, robot=robot)


def fail(text: str) -> NoReturn:
    """End the command with exit code 1 and this error message."""
    raise click.ClickException(text)


def colored(text: str, color: str | None) -> str:
    """``text`` in a colour, if standard output is a terminal and NO_COLOR is not set."""
    if color is None or not is_terminal() or os.environ.get("NO_COLOR"):
        return text
    return click.style(text, fg=color)


def is_terminal() -> bool:
    """Whether standard output is a terminal."""
    return sys.stdout.isatty()


def terminal_width() -> int:
    """The width of the terminal, or COLUMNS if that is set."""
    return shutil.get_terminal_size().columns


def output_width() -> int | None:
    """The width of the terminal; None if standard output is not a terminal."""
    return terminal_width() if is_terminal() else None


def duration_or_dash(nanoseconds: int | None) -> str:
    """A duration as text; "-" for None."""
    return "-" if nanoseconds is None else format_duration(nanoseconds)


def sample_age_text(frame: FrameInfo, now: int) -> str:
    """The age of the newest sample of a frame by the system clock; if another clock stamps it, its name."""
    from zstate.clock import SYSTEM  # loads numpy, which help texts do not need

    if frame.newest is None:
        return "no sample"
    newest = frame.newest_in(SYSTEM)
    return f"{frame.domain} time" if newest is None else format_duration(now - newest)


def rate_text(rate_hz: float | None) -> str:
    """A rate with one decimal; "-" for None."""
    return "-" if rate_hz is None else f"{rate_hz:.1f} Hz"


def count_text(count: int, what: str) -> str:
    """``count`` of ``what``: "1 joint", "7 joints"."""
    return f"{count} {what}{'' if count == 1 else 's'}"


def size_text(size: float) -> str:
    """A number of bytes with a unit."""
    amount = float(size)
    for unit in ("B", "kB", "MB"):
        if amount < 999.5:  # beyond it is rounded to 1000
            return f"{amount:.0f} {unit}" if unit == "B" else f"{amount:.3g} {unit}"
        amount /= 1000.0
    return f"{amount:,.2f} GB"


def files_text(files: Sequence[Path]) -> str:
    """The names of the files of a recording."""
    if len(files) < 3:
        return " and ".join(map(str, files))
    return f"{len(files)} files, {files[0]} to {files[-1].name}"


def report_text(report: RateReport) -> str:
    """The commanded and the achieved rate."""
    samples = count_text(report.ticks, "sample")
    if not report.commanded_hz:
        return f"{samples} at the pace of the device, {report.rate_hz:.2f} Hz"
    rates = f"commanded {report.commanded_hz:g} Hz, achieved {report.rate_hz:.2f} Hz"
    return f"{samples}; {rates}, skipped {report.skipped}"


def keep_showing(text: Callable[[], str], seconds: float | None = None, *, every_s: float = 0.5) -> None:
    """Show ``text()`` in its place on the terminal, again and again, as much of it as fits.

    Returns after ``seconds``; None: never.
    """
    from rich.live import Live  # few commands need rich
    from rich.text import Text

    end = math.inf if seconds is None else time.monotonic() + seconds
    with Live(auto_refresh=False) as live:
        while time.monotonic() < end:
            live.update(Text(text(), no_wrap=True, overflow="crop"), refresh=True)
            time.sleep(every_s)
