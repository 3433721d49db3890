"""Loader of robot models from files, URDF text, xacro and catalog names; the only reader of model files.

Xacro is expanded by the ``xacrodoc`` or ``xacro`` package if one is installed. The expansion runs the
Python expressions in the file: expand only files you trust.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Generator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

from zstate._util.format import did_you_mean
from zstate.errors import InvalidInput
from zstate.model.catalog import CatalogEntry, catalog, find_entry
from zstate.model.findings import Finding, model_error
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_document, xacro_elements
from zstate.model.xml import MAX_BYTES, read_document

__all__ = ["CatalogEntry", "catalog", "is_path", "load_model"]

_SUFFIXES = (".urdf", ".xacro", ".xml")


def load_model(
    source: str | bytes | os.PathLike[str], *, xacro_args: Mapping[str, str] | None = None
) -> RobotModel:
    """The robot in a file, in URDF text, or in the catalog under a name such as "panda".

    A str that contains ``<`` is text; one that is the path of a file, contains a slash or ends in .urdf,
    .xacro or .xml is a path; any other is a name in ``zstate.model.load.catalog()``.
    Xacro is expanded, with ``xacro_args``, when ``zstate[xacro]`` is installed; that runs the expressions
    in the file.

    Raises ModelError with all ``findings`` and their lines; UnknownModel with near misses; InvalidInput
    if ``xacro_args`` are passed for a source without xacro.
    """
    path: Path | None = None
    if isinstance(source, bytes) or (isinstance(source, str) and ("<" in source or not source.strip())):
        data, label = source, "URDF text"
    else:
        if isinstance(source, str) and not is_path(source):
            path = find_entry(source).path
            label = str(path)
        else:
            path, label = Path(source), os.fspath(source)
        data = _read(path, label)
    document = read_document(data, label)
    if xacro_elements(document.root) or (path is not None and path.suffix == ".xacro"):
        urdf, warnings = _expand(document.text, label, path, xacro_args or {})
        model = parse_document(read_document(urdf, f"{label} (expanded)"), f"{label} (expanded)")
        return replace(model, findings=(*warnings, *model.findings)) if warnings else model
    if xacro_args:
        args = " ".join(f"{name}:={value}" for name, value in xacro_args.items())
        raise InvalidInput(f"{label!r} contains no xacro, so it takes no xacro arguments; got {args}")
    return parse_document(document, label)


def is_path(source: str) -> bool:
    """Whether ``load_model`` takes ``source`` as the path of a file, not as a name or as text."""
    if "/" in source or os.sep in source or source.endswith(_SUFFIXES):
        return True
    try:
        return Path(source).is_file()
    except (OSError, ValueError):
        return False


def _read(path: Path, source: str) -> bytes:
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        folder = "" if path.is_absolute() else f" in {Path.cwd()}"
        raise model_error(source, f"there is no such file{folder}") from None
    except IsADirectoryError:
        raise model_error(source, "this is a directory; name the .urdf file in it") from None
    except (OSError, ValueError) as error:
        raise model_error(source, f"the file cannot be read: {error}") from None
    if len(data) > MAX_BYTES:
        raise model_error(source, f"the file has more than {MAX_BYTES} bytes, which is the limit")
    return data


def _expand(
    text: str, source: str, path: Path | None, args: Mapping[str, str]
) -> tuple[str, tuple[Finding, ...]]:
    """The URDF that ``text`` expands to with the xacro arguments ``args``, and xacro's warnings.

    Each distinct warning is one finding, and so is an argument that the file does not use. ``path`` is the
    file of the text, if there is one: includes are relative to it, and packages are searched from there
    upwards (with xacrodoc) or where ROS has them. Raises ModelError with the cause in one line.
    """
    with suppress(ImportError):
        xacrodoc = import_module("xacrodoc")  # replaces xacro's search for packages, which needs ROS
        if path is not None:
            xacrodoc.packages.walk_up_from(path)
    try:
        xacro: Any = import_module("xacro")
    except ImportError:
        message = "this is a xacro file, which must be expanded: pip install 'zstate[xacro]'"
        raise model_error(source, message) from None
    arguments = _XacroArguments(args)
    try:
        xacro.init_stacks(None if path is None else os.fspath(path))  # the base of includes
        document = xacro.parse(text)
        with _count_warnings(xacro) as warnings:
            xacro.process_doc(document, mappings=arguments, verbosity=0)
        urdf = document.toprettyxml(indent="  ")
    except Exception as error:  # the file's own expressions may raise anything
        cause = " ".join(str(error).split()) or type(error).__name__
        hint = ""
        if "package" in cause.lower() or "PackageNotFound" in type(error).__name__:
            hint = "; packages are found by ROS_PACKAGE_PATH, a sourced ROS, or a package.xml above the file"
        raise model_error(source, f"xacro could not expand it: {cause[:500]}{hint}") from error
    messages = [
        f"xacro: {' '.join(text.split())}{f', {count} times' if count > 1 else ''}"
        for text, count in warnings.items()
    ]
    messages += [
        f"the xacro argument {name!r} is not used by the file{did_you_mean(name, arguments.used)}"
        for name in args
        if name not in arguments.used
    ]
    return urdf, tuple(Finding(None, message, "warning") for message in messages)


class _XacroArguments(dict[str, str]):
    """Xacro's arguments; ``used`` has those that the file has declared or read."""

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
def _count_warnings(xacro: Any) -> Generator[Counter[str]]:
    """Counts xacro's warnings, which it prints to standard error with three lines for each use of a macro."""
    counts: Counter[str] = Counter()
    color: Any = import_module("xacro.color")

    def message(*parts: object, **options: Any) -> None:
        if not options.get("alt_text"):
            kept_message(*parts, **options)  # printed by the file itself with xacro.message()
            return
        file = next((name for name in reversed(xacro.filestack or []) if name), None)
        where = "" if file is None else f" ({Path(file).name})"
        counts[" ".join(map(str, parts)) + where] += 1

    def print_location(*_: object, **__: object) -> None:
        pass  # the warning names its file

    # All warnings, of xacro and of the expressions in a file, go through these two functions.
    kept_message, kept_location = color.message, xacro.print_location
    color.message, xacro.print_location = message, print_location
    try:
        yield counts
    finally:
        color.message, xacro.print_location = kept_message, kept_location
