"""What goes on, line by line on standard error: in words, or as JSON for programs."""

from __future__ import annotations

import json
import logging
import os
import re
import shutil
import sys
import threading
import time
import traceback
from contextlib import suppress
from datetime import datetime, timezone
from typing import TextIO, cast

import click

FORMAT_VARIABLE = "ZSTATE_LOG_FORMAT"
FORMATS = ("text", "json")

# What a record of the library may carry besides its text, as ``extra``.
_FACTS = ("robot", "writer", "reason")


# What a terminal acts on, but for line ends and tabs: escape sequences, C1 controls, overrides of direction.
_CONTROLS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")
_COLORS = re.compile(r"\x1b\[[0-9;]*m")


def without_controls(text: str, *, colors: bool = False) -> str:
    """``text`` with escapes such as ``\\x1b`` for control characters: what prints it may come from anywhere.

    With ``colors`` the sequences that change colours stay: our own, for a terminal.
    """
    if not _CONTROLS.search(text):
        return text
    if not colors:
        return _CONTROLS.sub(lambda control: repr(control[0])[1:-1], text)
    kept = _COLORS.findall(text)
    parts = [without_controls(part) for part in _COLORS.split(text)]
    return "".join(part + color for part, color in zip(parts, [*kept, ""], strict=True))


class _Settings:
    format = "text"


def use_format(name: str) -> None:
    """Say everything in one of ``FORMATS`` from now on, also what a thread ends with."""
    _Settings.format = name
    if name == "json":
        sys.excepthook = lambda kind, error, trace: _note_crash(error)
        threading.excepthook = lambda given: _note_crash(given.exc_value)


def use_format_of_environment() -> None:
    """The format that the environment names, if it is one; the option says what is wrong with others."""
    name = os.environ.get(FORMAT_VARIABLE, "")
    if name in FORMATS:
        use_format(name)


def _use_chosen(_: click.Context, __: click.Parameter, name: str | None) -> None:
    if name is not None:
        use_format(name)
        os.environ[FORMAT_VARIABLE] = name  # also for the commands that this one starts


log_format_option = click.Option(
    ["--log-format"],
    type=click.Choice(FORMATS),
    envvar=FORMAT_VARIABLE,
    is_eager=True,
    expose_value=False,
    callback=_use_chosen,
    help="What goes on, on standard error: in words, or as one JSON object a line; default: text.",
)
"""Every command has it."""


def write(text: str, *, level: str = "info", event: str = "note", **facts: object) -> None:
    """One line on standard error, there at once: ``text``, or a JSON object that has it and the rest.

    In words, warnings and errors begin with the program's name. ``facts`` that are None are left out.
    """
    if _Settings.format == "json":
        line = as_json(text, level=level, event=event, **facts)
    else:
        line = _as_wide_as_seen(without_controls(text if level == "info" else f"zstate: {text}"))
    _write_line(line)


def as_json(text: str, *, level: str = "info", event: str = "note", **facts: object) -> str:
    """A line of the JSON format: now, and ``facts`` that are not None."""
    known = {name: fact for name, fact in facts.items() if fact is not None}
    return json.dumps({"time": _time_text(), "level": level, "event": event, **known, "text": text})


def _as_wide_as_seen(text: str) -> str:
    if not _standard_error().isatty():
        return text
    from zstate.cli.output.text_layout import wrap

    return wrap(text, shutil.get_terminal_size().columns)


def _write_line(line: str) -> None:
    with suppress(OSError):  # nobody reads it any more
        stream = _standard_error()
        stream.write(line + "\n")
        stream.flush()


def is_json() -> bool:
    """Whether what goes on is said as JSON."""
    return _Settings.format == "json"


def forward_line(line: str, *, is_error: bool, **facts: object) -> None:
    """As JSON, a line that another program wrote: an object of ours with ``facts`` besides, or any text."""
    try:
        said = json.loads(line)
    except ValueError:
        said = None
    if isinstance(said, dict):
        written = json.dumps({**cast("dict[str, object]", said), **facts})
    else:
        written = json.dumps({"time": _time_text(), "event": "line", "text": line, **facts})
    if is_error:
        _write_line(written)
    else:
        click.echo(written)


def text_in(line: str) -> str:
    """The text of a line that another zstate wrote, in either format."""
    try:
        said = json.loads(line)
    except ValueError:
        return line
    text = cast("dict[str, object]", said).get("text") if isinstance(said, dict) else None
    return line if text is None else str(text)


def warn_on_standard_error() -> None:
    """Warnings of the library go to standard error from now on."""
    logger = logging.getLogger("zstate")
    if not any(isinstance(handler, _Lines) for handler in logger.handlers):
        logger.addHandler(_Lines(logging.WARNING))
        logger.propagate = False


def keep_warnings_back() -> None:
    """Warnings of the library go nowhere from now on: the command says them itself."""
    logging.getLogger("zstate").setLevel(logging.CRITICAL)


class _Lines(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        facts = {name: getattr(record, name, None) for name in _FACTS}
        event = getattr(record, "event", "log")
        write(self.format(record), level=record.levelname.lower(), event=event, **facts)


def _standard_error() -> TextIO:
    # A live table stands in for standard error, so that lines come above it: right where both are on
    # one terminal, while a file or a pipe is to have its lines itself.
    behind = getattr(sys.stderr, "rich_proxied_file", sys.stderr)
    return sys.stderr if behind.isatty() else behind


def _note_crash(error: BaseException | None) -> None:
    if not isinstance(error, SystemExit):
        write("".join(traceback.format_exception(error)), level="error", event="crash")


def _time_text() -> str:
    """Now, as RFC 3339 has it, to the nanosecond."""
    seconds, nanoseconds = divmod(time.time_ns(), 1_000_000_000)
    return f"{datetime.fromtimestamp(seconds, timezone.utc):%Y-%m-%dT%H:%M:%S}.{nanoseconds:09d}Z"
