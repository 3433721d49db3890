"""Lines on standard error, as text for users or as JSON objects for programs."""

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
from datetime import UTC, datetime
from typing import TextIO, cast

import click

FORMAT_VARIABLE = "ZSTATE_LOG_FORMAT"
FORMATS = ("text", "json")

# ``extra`` attributes that a log record of the library may have.
_FACTS = ("robot", "writer", "reason")
# Characters that control a terminal, except line ends and tabs: escape, C1 controls, direction overrides.
_CONTROLS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")
_COLORS = re.compile(r"\x1b\[[0-9;]*m")


def without_controls(text: str, *, colors: bool = False) -> str:
    """``text`` with control characters escaped, such as ``\\x1b``: printed names may come from the network.

    With ``colors``, colour sequences stay; they are this program's own, for a terminal.
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
    """Write all lines in one of ``FORMATS``, including unhandled exceptions of any thread."""
    _Settings.format = name
    if name == "json":
        sys.excepthook = lambda kind, error, trace: _log_crash(error)
        threading.excepthook = lambda crash: _log_crash(crash.exc_value)


def use_environment_format() -> None:
    """Use the format in ``FORMAT_VARIABLE`` if it is valid; otherwise the option reports it."""
    name = os.environ.get(FORMAT_VARIABLE, "")
    if name in FORMATS:
        use_format(name)


def _on_format_option(_: click.Context, __: click.Parameter, name: str | None) -> None:
    if name is not None:
        use_format(name)
        os.environ[FORMAT_VARIABLE] = name  # also for child processes


log_format_option = click.Option(
    ["--log-format"],
    type=click.Choice(FORMATS),
    envvar=FORMAT_VARIABLE,
    is_eager=True,
    expose_value=False,
    callback=_on_format_option,
    help="Format of standard error: text, or one JSON object per line; default: text.",
)
"""Every command has it."""


def is_json() -> bool:
    """Whether the format is JSON."""
    return _Settings.format == "json"


def write(text: str, *, level: str = "info", event: str = "note", **facts: object) -> None:
    """Write one line to standard error, flushed: ``text``, or a JSON object with all arguments.

    As text, warnings and errors begin with the program's name. ``facts`` that are None are left out.
    """
    if is_json():
        line = as_json(text, level=level, event=event, **facts)
    else:
        line = without_controls(text if level == "info" else f"zstate: {text}")
        if _standard_error().isatty():
            from zstate.cli.output.text_layout import wrap

            line = wrap(line, shutil.get_terminal_size().columns)
    _write_line(line)


def as_json(text: str, *, level: str = "info", event: str = "note", **facts: object) -> str:
    """A line of the JSON format, with the current time and the ``facts`` that are not None."""
    known = {name: fact for name, fact in facts.items() if fact is not None}
    return json.dumps({"time": _time_text(), "level": level, "event": event, **known, "text": text})


def forward_line(line: str, *, is_error: bool, **facts: object) -> None:
    """Write a line of another program as JSON: an object of zstate with ``facts`` added, or any text."""
    entry = _entry(line)
    if entry is None:
        entry = {"time": _time_text(), "event": "line", "text": line}
    written = json.dumps(entry | facts)
    if is_error:
        _write_line(written)
    else:
        click.echo(written)


def text_in(line: str) -> str:
    """The text of a line that another zstate process wrote, in either format."""
    text = (_entry(line) or {}).get("text")
    return line if text is None else str(text)


def _entry(line: str) -> dict[str, object] | None:
    """The JSON object in ``line``; None for any other text."""
    try:
        entry = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return cast("dict[str, object]", entry) if isinstance(entry, dict) else None


def warn_on_standard_error() -> None:
    """Write warnings of the library to standard error."""
    logger = logging.getLogger("zstate")
    if not any(isinstance(handler, _Lines) for handler in logger.handlers):
        logger.addHandler(_Lines(logging.WARNING))
        logger.propagate = False


def suppress_library_warnings() -> None:
    """Suppress warnings of the library, for a command that reports the same facts itself."""
    logging.getLogger("zstate").setLevel(logging.CRITICAL)


class _Lines(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        facts = {name: getattr(record, name, None) for name in _FACTS}
        event = getattr(record, "event", "log")
        write(self.format(record), level=record.levelname.lower(), event=event, **facts)


def _write_line(line: str) -> None:
    with suppress(OSError):  # the reader has gone
        stream = _standard_error()
        stream.write(line + "\n")
        stream.flush()


def _standard_error() -> TextIO:
    # rich's live display replaces sys.stderr so that lines appear above it. That is right on a terminal; a
    # file or a pipe gets its lines directly.
    behind = getattr(sys.stderr, "rich_proxied_file", sys.stderr)
    return sys.stderr if behind.isatty() else behind


def _log_crash(error: BaseException | None) -> None:
    if not isinstance(error, SystemExit):
        write("".join(traceback.format_exception(error)), level="error", event="crash")


def _time_text() -> str:
    """The current time in RFC 3339, with nanoseconds."""
    seconds, nanoseconds = divmod(time.time_ns(), 1_000_000_000)
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{nanoseconds:09d}Z"
