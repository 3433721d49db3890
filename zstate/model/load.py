"""Loader of robot models from files, URDF text, xacro and catalog names; the only reader of model files.

Xacro is expanded if it is installed, see xacro_expansion. The expansion runs the Python expressions in the
file, which read other files: expand only files you trust.
"""

from __future__ import annotations

import os
import select
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from zstate.errors import InvalidInput
from zstate.model.catalog import CatalogEntry, catalog, find_entry
from zstate.model.findings import model_error
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_document, xacro_elements
from zstate.model.xacro_expansion import expand_xacro
from zstate.model.xml import MAX_BYTES, read_document
from zstate.model.xml_text import decode

__all__ = ["CatalogEntry", "catalog", "is_path", "load_model"]

_SUFFIXES = (".urdf", ".xacro", ".xml")
_CHUNK_BYTES = 1 << 20
_SILENT_S = 60.0
"""A pipe, such as that of `<(xacro arm.xacro)`, may be silent for so long."""


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
    document = read_document(decode(data, label) if isinstance(data, bytes) else data, label)
    if xacro_elements(document.root) or (path is not None and path.suffix == ".xacro"):
        urdf, warnings = expand_xacro(document.text, label, path, xacro_args or {})
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
        data = _read_bytes(path)
    except TimeoutError:
        message = f"nothing has been written to this pipe for {_SILENT_S:g} s; is its writer running?"
        raise model_error(source, message) from None
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


def _read_bytes(path: Path) -> bytes:
    """The content of a file, or a little more than the limit. Raises TimeoutError for a silent pipe."""
    data = b""

    def open_at_once(name: str, flags: int) -> int:
        return os.open(name, flags | os.O_NONBLOCK)  # or opening a pipe waits for its writer

    with open(path, "rb", buffering=0, opener=open_at_once) as file:
        readable = select.poll()
        readable.register(file, select.POLLIN)
        while len(data) <= MAX_BYTES:
            if not readable.poll(1e3 * _SILENT_S):
                raise TimeoutError
            chunk = file.read(_CHUNK_BYTES)
            if chunk is None:
                continue
            data += chunk
            if not chunk:
                break
    return data
