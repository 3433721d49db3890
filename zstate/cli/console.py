"""How commands speak: lines on standard output for results, on standard error for what goes on."""

from __future__ import annotations

import json
import os
import shutil
import sys
from typing import TYPE_CHECKING, Any, NoReturn

import click

from zstate.cli import logs
from zstate.errors import duration_text

if TYPE_CHECKING:
    from zstate.buffer.frame_tree import FrameInfo
    from zstate.rate import RateReport


def say(text: str = "") -> None:
    """One line of the result, there at once."""
    click.echo(logs.without_controls(text, colors=True))  # which click takes out where nobody sees them


def say_fitted(text: str) -> None:
    """Sentences of the result, folded between words for a narrow terminal; with --log-format json an object.

    A service's log collector gets standard output and standard error together, and parses both.
    """
    if logs.is_json():
        click.echo(logs.as_json(text, event="result"))
        return
    from zstate.cli.layout import fitted

    say(fitted(text, terminal_width()) if is_terminal() else text)


def say_json(value: Any) -> None:
    """One JSON document on one line."""
    click.echo(json.dumps(value))


def note(text: str, *, event: str = "note", robot: str | None = None, level: str = "info") -> None:
    """What goes on: waiting, and the end of waiting. Not part of the result.

    ``event`` and ``robot`` are for programs that read ``--log-format json``. In words, a ``level`` of
    "warning" begins with the program's name.
    """
    logs.write(text, level=level, event=event, robot=robot)


def fail(text: str) -> NoReturn:
    """End the command with exit code 1 and this cause."""
    raise click.ClickException(text)


def colored(text: str, color: str | None) -> str:
    """``text`` in a colour where a person sees it who has not asked for none (NO_COLOR)."""
    if color is None or not is_terminal() or os.environ.get("NO_COLOR"):
        return text
    return click.style(text, fg=color)


def is_terminal() -> bool:
    """Whether a person looks at standard output."""
    return sys.stdout.isatty()


def terminal_width() -> int:
    """How many letters fit on a line of the terminal; COLUMNS says otherwise."""
    return shutil.get_terminal_size().columns


def duration_or_dash(nanoseconds: int | None) -> str:
    """A duration in words; "-" for none."""
    return "-" if nanoseconds is None else duration_text(nanoseconds)


def age_text(stamp: int | None, now: int) -> str:
    """How long ago an instant was, in words; "-" for none."""
    return duration_or_dash(None if stamp is None else now - stamp)


def sample_age_text(frame: FrameInfo, now: int) -> str:
    """How old the newest sample of a frame is ``now``, by the system's clock; else which clock stamps it."""
    from zstate.clock import SYSTEM  # loads numpy, which helps do without

    if frame.newest is None:
        return "no sample"
    newest = frame.newest_in(SYSTEM)
    return f"{frame.domain} time" if newest is None else age_text(newest, now)


def rate_text(rate_hz: float | None) -> str:
    """A rate with the digits that mean something; "-" for none."""
    return "-" if rate_hz is None else f"{rate_hz:.1f} Hz"


def count_text(count: int, what: str) -> str:
    """``count`` of ``what``: "1 joint", "7 joints"."""
    return f"{count} {what}{'' if count == 1 else 's'}"


def report_text(report: RateReport) -> str:
    """What became of a commanded rate."""
    achieved = f"{count_text(report.ticks, 'sample')}; commanded {report.commanded_hz:g} Hz"
    return f"{achieved}, achieved {report.rate_hz:.2f} Hz, skipped {report.skipped}"
