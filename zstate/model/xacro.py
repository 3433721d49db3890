"""Xacro text to URDF text, by the ``xacrodoc`` or ``xacro`` package when one is installed.

Expanding runs the Python expressions that the file holds: expand only files you trust.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from zstate.errors import ModelError
from zstate.model.findings import Finding


def expand(text: str, source: str, *, path: Path | None, args: Mapping[str, str]) -> str:
    """The URDF that ``text`` expands to with the xacro arguments ``args``.

    ``path`` is the file of the text, if there is one: includes are relative to it, and packages are
    looked for from there upwards (with xacrodoc) or where ROS has them. Raises ModelError with the
    cause in one line.
    """
    xacro = _import_expander(source, path)
    try:
        xacro.init_stacks(None if path is None else os.fspath(path))  # what includes are relative to
        document = xacro.parse(text)
        xacro.process_doc(document, mappings=dict(args), verbosity=0)
        return document.toprettyxml(indent="  ")
    except Exception as error:  # anything: the file's own expressions are evaluated
        raise _refusal(source, _one_line(error)) from error


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
