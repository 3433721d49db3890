"""Documents as text: YAML, one field, or columns."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Iterable
from math import isnan
from typing import TYPE_CHECKING, Any, cast

from zstate._util.suggestions import did_you_mean
from zstate.errors import InvalidInput

if TYPE_CHECKING:
    from zstate.cli.documents import Document

# Names that YAML would not read as text, were they not quoted.
_PLAIN = re.compile(r"[A-Za-z_][\w./-]*", re.ASCII)
_ALWAYS_NEW = {"stamp", "seq"}
_WORDS = {"true", "false", "yes", "no", "on", "off", "null", "y", "n"}


def yaml_text(value: Any, indent: str = "") -> str:
    """Mappings, lists of numbers and numbers as YAML, without the end of the last line."""
    if not isinstance(value, dict):
        return json.dumps(value)
    entries = cast("dict[str, Any]", value).items()
    return "\n".join(f"{indent}{_yaml_key(key)}:{_yaml_value(inner, indent)}" for key, inner in entries)


def _yaml_value(value: Any, indent: str) -> str:
    if isinstance(value, dict) and value:
        return f"\n{yaml_text(value, indent + '  ')}"
    return f" {json.dumps(value)}"


def _yaml_key(key: str) -> str:
    return key if _PLAIN.fullmatch(key) and key.lower() not in _WORDS else json.dumps(key)


def columns(value: Any, name: str = "") -> dict[str, int | float]:
    """The numbers of a document, or a part of one, as columns called "positions.elbow" and the like."""
    if isinstance(value, dict):
        items = list(cast("dict[str, Any]", value).items())
    elif isinstance(value, list):
        items = [(str(number), inner) for number, inner in enumerate(cast("list[Any]", value))]
    else:
        return {name: value}
    found: dict[str, int | float] = {}
    for key, inner in items:
        found |= columns(inner, f"{name}.{key}" if name else key)
    return found


class Changes:
    """Which documents, or parts of them, differ from the last that did, in a number by more than ``by``."""

    def __init__(self, by: float = 0.0) -> None:
        self._by = by
        self._last: dict[str, int | float] | None = None

    def note(self, value: Any) -> bool:
        """Whether ``value`` is news. A whole document's stamp and number are none."""
        numbers, last = columns(value), self._last
        if numbers.keys() >= _ALWAYS_NEW:
            numbers = {name: number for name, number in numbers.items() if name not in _ALWAYS_NEW}
        if last is not None and last.keys() == numbers.keys() and not self._differ(last, numbers):
            return False
        self._last = numbers
        return True

    def _differ(self, last: dict[str, int | float], numbers: dict[str, int | float]) -> bool:
        pairs = [(last[name], number) for name, number in numbers.items()]
        # NaN, by which ROS drivers say that they do not measure something, is no number and differs from any.
        return any(abs(after - before) > self._by or isnan(after) != isnan(before) for before, after in pairs)


class Columns:
    """Comma-separated lines; a line of names stands first, and again wherever the names change."""

    def __init__(self) -> None:
        self._names: list[str] = []

    def lines(self, value: Any, name: str) -> list[str]:
        """The lines for one more document, or the part of one called ``name``."""
        cells = columns(value, name)
        head = [] if list(cells) == self._names else [_csv_line(cells)]
        self._names = list(cells)
        return [*head, _csv_line(cells.values())]


def _csv_line(cells: Iterable[Any]) -> str:
    line = io.StringIO()
    csv.writer(line, lineterminator="").writerow(cells)
    return line.getvalue()


def field_of(document: Document, field: str) -> Any:
    """The part of a document called "stamp", "positions" or "positions.elbow"; "elbow" is its position.

    Raises InvalidInput that lists what there is.
    """
    known = _fields(document)
    for name in (field, f"positions.{field}"):
        if name in known:
            return known[name]
    joints = list(dict.fromkeys(name.partition(".")[2] for name in known if "." in name))
    hint = did_you_mean(field, [*known, *joints])
    raise InvalidInput(
        f"a joint state of this robot has no field {field!r}{hint} (fields: {', '.join(document)}; "
        f"joints: {', '.join(joints) or 'without names'})"
    )


def _fields(document: Document) -> dict[str, Any]:
    fields: dict[str, Any] = dict(document)
    for block, numbers in document.items():
        if isinstance(numbers, dict):
            fields |= {f"{block}.{joint}": value for joint, value in numbers.items()}
    return fields
