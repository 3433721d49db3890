"""The overview of the Python API: Markdown, generated from docstrings by docs/generate.py."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from importlib import import_module

MODULES = (
    *("zstate", "zstate.driving", "zstate.odometry", "zstate.scans", "zstate.clouds", "zstate.cameras"),
    *("zstate.sources", "zstate.errors"),
)

_INTRODUCTION = """# Overview

Each class and function of the Python API, with the first sentence of its description. The pages of modules
have the rest. [Which class for which job](zstate.md#which-class-for-which-job) begins with the job."""


def api_overview() -> str:
    """The page: a table for each public module. A name that two modules have is with the first."""
    parts, seen = [_INTRODUCTION], set[object]()
    for module in MODULES:
        rows = [(name, thing) for name, thing in _public(module) if thing not in seen]
        seen.update(thing for _, thing in rows)
        lines = [f"| `{name}` | {_first_sentence(thing)} |" for name, thing in rows]
        parts.append(f"## [{module}]({module.removeprefix('zstate.')}.md)")
        parts.append("\n".join(["| name | |", "|---|---|", *lines]))
    return "\n\n".join(parts)


def _public(module: str) -> Iterator[tuple[str, object]]:
    loaded = import_module(module)
    # The module of errors has no __all__: its exceptions are the API.
    names = getattr(loaded, "__all__", [name for name in vars(loaded) if not name.startswith("_")])
    for name in names:
        thing = getattr(loaded, name)
        is_error = isinstance(thing, type) and issubclass(thing, Exception)
        if is_error if module == "zstate.errors" else callable(thing):
            yield name, thing


def _first_sentence(thing: object) -> str:
    """The first sentence of a docstring, which is reST, in a cell of Markdown."""
    paragraph = " ".join((inspect.getdoc(thing) or "").split("\n\n")[0].split())
    sentence = re.split(r"(?<=\.) (?=[A-Z`])", paragraph)[0]
    return sentence.replace("``", "`").replace("|", r"\|")
