"""Xacro text to URDF text, by the ``xacrodoc`` or ``xacro`` package when one is installed.

Expanding runs the Python expressions that the file holds: expand only files you trust.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Generator, Mapping
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from zstate._util.suggestions import did_you_mean
from zstate.errors import ModelError
from zstate.model.findings import Finding


def expand(
    text: str, source: str, *, path: Path | None, args: Mapping[str, str]
) -> tuple[str, tuple[Finding, ...]]:
    """The URDF that ``text`` expands to with the xacro arguments ``args``, and xacro's warnings.

    Each distinct warning is one finding, and so is an argument that the file does not use. ``path`` is the
    file of the text, if there is one: includes are relative to it, and packages are looked for from there
    upwards (with xacrodoc) or where ROS has them. Raises ModelError with the cause in one line.
    """
    xacro = _import_expander(source, path)
    mappings = _Arguments(args)
    try:
        xacro.init_stacks(None if path is None else os.fspath(path))  # what includes are relative to
        document = xacro.parse(text)
        with _warnings(xacro) as warnings:
            xacro.process_doc(document, mappings=mappings, verbosity=0)
        return document.toprettyxml(indent="  "), tuple(_findings(warnings, mappings, args))
    except Exception as error:  # anything: the file's own expressions are evaluated
        raise _refusal(source, _one_line(error)) from error


class _Arguments(dict[str, str]):
    """Xacro's arguments, and which of them the file has declared or read."""

    def __init__(self, args: Mapping[str, str]) -> None:
        super().__init__(args)
        self.used: dict[str, None] = {}

    def __contains__(self, name: object) -> bool:
        self.used[str(name)] = None
        return super().__contains__(name)

    def __getitem__(self, name: str) -> str:
        self.used[name] = None
        return super().__getitem__(name)


@contextmanager
def _warnings(xacro: Any) -> Generator[Counter[str]]:
    """Counts xacro's warnings, which it prints to standard error with three lines for each use of a macro."""
    counts: Counter[str] = Counter()

    color: Any = import_module("xacro.color")

    def message(*parts: object, **options: Any) -> None:
        if not options.get("alt_text"):
            kept_message(*parts, **options)  # what the file itself prints with xacro.message()
            return
        file = next((name for name in reversed(xacro.filestack or []) if name), None)
        where = "" if file is None else f" ({Path(file).name})"
        counts[" ".join(map(str, parts)) + where] += 1

    def print_location(*_: object, **__: object) -> None:
        pass  # the warning names its file

    # Every warning of xacro, and of the expressions in a file, goes through these two.
    kept_message, kept_location = color.message, xacro.print_location
    color.message, xacro.print_location = message, print_location
    try:
        yield counts
    finally:
        color.message, xacro.print_location = kept_message, kept_location


def _findings(warnings: Counter[str], mappings: _Arguments, args: Mapping[str, str]) -> Generator[Finding]:
    for text, count in warnings.items():
        times = f", {count} times" if count > 1 else ""
        yield Finding(None, f"xacro: {' '.join(text.split())}{times}", "warning")
    for name in args:
        if name not in mappings.used:
            hint = did_you_mean(name, mappings.used)
            yield Finding(None, f"the xacro argument {name!r} is not used by the file{hint}", "warning")


def _import_expander(source: str, path: Path | None) -> Any:
    """The ``xacro`` module, with xacrodoc's way of finding packages where that is installed."""
    with suppress(ImportError):
        xacrodoc = import_module("xacrodoc")  # replaces the search of xacro, which needs ROS
        if path is not None:
            xacrodoc.packages.walk_up_from(path)
    try:
        return import_module("xacro")
    except ImportError:
        message = "this is a xacro file, which must be expanded: pip install 'zstate[xacro]'"
        raise _refusal(source, message) from None


def _one_line(error: Exception) -> str:
    cause = " ".join(str(error).split()) or type(error).__name__
    hint = ""
    if "package" in cause.lower() or "PackageNotFound" in type(error).__name__:
        hint = "; packages are found by ROS_PACKAGE_PATH, a sourced ROS, or a package.xml above the file"
    return f"xacro could not expand it: {cause[:500]}{hint}"


def _refusal(source: str, message: str) -> ModelError:
    return ModelError(source, [Finding(None, message, "error")])
