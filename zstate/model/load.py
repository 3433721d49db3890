"""load_model: a path, URDF text or a catalog name to a RobotModel; the one place that reads model files."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from zstate.errors import InvalidInput, ModelError
from zstate.model import xacro
from zstate.model.catalog import CatalogEntry, catalog, find_entry
from zstate.model.findings import Finding
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_document, xacro_elements
from zstate.model.xml import MAX_BYTES, read_document

__all__ = ["CatalogEntry", "catalog", "is_path", "load_model"]

_SUFFIXES = (".urdf", ".xacro", ".xml")


def load_model(
    source: str | bytes | os.PathLike[str], *, xacro_args: Mapping[str, str] | None = None
) -> RobotModel:
    """The robot in a file, in URDF text, or behind a catalog name such as "panda".

    A str that contains ``<`` is text; one that is the path of a file, contains a slash or ends in .urdf,
    .xacro or .xml is a path; any other is a name in ``zstate.model.load.catalog()``.
    Xacro is expanded, with ``xacro_args``, when ``zstate[xacro]`` is installed; that runs the expressions
    in the file.

    Raises ModelError with all ``findings`` and their lines; UnknownModel with near misses; InvalidInput
    when ``xacro_args`` are given for what is no xacro.
    """
    if isinstance(source, bytes) or (isinstance(source, str) and ("<" in source or not source.strip())):
        return _parse(source, "URDF text", None, xacro_args)
    if isinstance(source, str) and not is_path(source):
        path = find_entry(source).path
        return _parse(_read(path, str(path)), str(path), path, xacro_args)
    path = Path(source)
    return _parse(_read(path, os.fspath(source)), os.fspath(source), path, xacro_args)


def _parse(
    data: str | bytes, source: str, path: Path | None, xacro_args: Mapping[str, str] | None
) -> RobotModel:
    document = read_document(data, source)
    is_xacro = bool(xacro_elements(document.root)) or (path is not None and path.suffix == ".xacro")
    if is_xacro:
        urdf, warnings = xacro.expand(document.text, source, path=path, args=xacro_args or {})
        model = parse_document(read_document(urdf, f"{source} (expanded)"), f"{source} (expanded)")
        return replace(model, findings=(*warnings, *model.findings)) if warnings else model
    if xacro_args:
        given = " ".join(f"{name}:={value}" for name, value in xacro_args.items())
        raise InvalidInput(f"{source!r} contains no xacro, so it takes no xacro arguments; got {given}")
    return parse_document(document, source)


def is_path(source: str) -> bool:
    """Whether ``load_model`` takes this for the path of a file rather than for a name or for text."""
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
        raise _refusal(source, f"there is no such file{folder}") from None
    except IsADirectoryError:
        raise _refusal(source, "this is a directory; name the .urdf file in it") from None
    except (OSError, ValueError) as error:
        raise _refusal(source, f"the file cannot be read: {error}") from None
    if len(data) > MAX_BYTES:
        raise _refusal(source, f"the file has more than {MAX_BYTES} bytes, which is the limit")
    return data


def _refusal(source: str, message: str) -> ModelError:
    return ModelError(source, [Finding(None, message, "error")])
