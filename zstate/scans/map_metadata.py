"""The YAML file of a map of map_server: which image has the cells, and how they are placed.

Parsed once into a frozen ``MapMetadata``; a file with errors is refused with all of them, each with its line.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from zstate._util.format import did_you_mean
from zstate.errors import InvalidInput, printable

Mode = Literal["trinary", "scale", "raw"]
_Value = str | list[str] | None

MODES: tuple[Mode, ...] = ("trinary", "scale", "raw")

_MAX_BYTES = 8192  # libyaml's time grows with the square of nested brackets: 40 s for 60,000
_TRUE = {"true", "yes", "on", "y"}
_FALSE = {"false", "no", "off", "n"}


@dataclass(frozen=True, slots=True)
class MapMetadata:
    """The content of a map's YAML file; ``origin`` is x, y [m], yaw [rad] of the lower left corner."""

    image: Path
    resolution: float
    origin: tuple[float, float, float]
    negate: bool
    occupied_thresh: float
    free_thresh: float
    mode: Mode = "trinary"


def read_metadata(path: Path) -> MapMetadata:
    """The metadata in a YAML file. Relative paths of images start at its folder.

    Other keys are ignored, as map_server does. Raises InvalidInput with every finding and its line.
    """
    findings: list[tuple[int, str]] = []
    entries: dict[str, _Entry] = {}
    for key, entry in _parse(path):
        if key in entries:
            findings.append((entry.line, f"{_shown(key)} is given twice, first in line {entries[key].line}"))
        entries.setdefault(key, entry)
    unknown = entries.keys() - _CONVERTERS.keys()
    missing = _CONVERTERS.keys() - entries.keys() - {"mode"}
    findings += [(1, f"{key} is missing{did_you_mean(key, unknown)}") for key in missing]
    values: dict[str, Any] = {}
    for key in _CONVERTERS.keys() & entries.keys():
        try:
            values[key] = _CONVERTERS[key](path.parent, entries[key].value)
        except ValueError as error:
            findings.append((entries[key].line, f"{key} {error}"))
    free, occupied = values.get("free_thresh"), values.get("occupied_thresh")
    if free is not None and occupied is not None and free >= occupied:
        where = "above" if free > occupied else "equal to"
        text = (
            f"free_thresh {free:g} is {where} occupied_thresh {occupied:g}: free cells are below free_thresh"
        )
        findings.append((entries["free_thresh"].line, f"{text}, occupied ones above occupied_thresh"))
    if findings:
        raise InvalidInput("\n".join(f"{path}:{line}: {text}" for line, text in sorted(findings)))
    return MapMetadata(**values)


@dataclass(frozen=True, slots=True)
class _Entry:
    """A node of YAML: the text of a scalar, the texts in a list, or None for anything else."""

    line: int
    value: _Value


def _parse(path: Path) -> Iterator[tuple[str, _Entry]]:
    """The keys and values of the mapping in a YAML file. Raises InvalidInput for any other file."""
    yaml = _pyyaml()
    # Events, because libyaml composes nodes recursively: nested lists can overflow the stack of the process.
    try:
        events: list[Any] = list(yaml.parse(_yaml_text(path), getattr(yaml, "CSafeLoader", yaml.SafeLoader)))
    except yaml.MarkedYAMLError as error:
        raise InvalidInput(f"{path}:{error.problem_mark.line + 1}: not YAML: {error.problem}") from None
    except yaml.YAMLError as error:
        raise InvalidInput(f"{path}: not YAML: {' '.join(str(error).split())}") from None
    starts = [event for event in events if isinstance(event, yaml.DocumentStartEvent)]
    if len(starts) != 1 or not isinstance(events[2], yaml.MappingStartEvent):
        raise InvalidInput(f"{path}: a map file is one mapping with the keys {', '.join(_CONVERTERS)}")
    nodes = _nodes(yaml, events[3:])
    for key, value in zip(nodes[::2], nodes[1::2], strict=True):
        yield str(key.value), value


def _nodes(yaml: Any, events: list[Any]) -> list[_Entry]:
    """The nodes of a mapping, keys and values in turn, from the events after its start."""
    nodes: list[_Entry] = []
    depth = 0
    for event in events:
        if isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        elif depth == 0:
            texts: list[str] | None = [] if isinstance(event, yaml.SequenceStartEvent) else None
            nodes.append(_Entry(event.start_mark.line + 1, getattr(event, "value", texts)))
        elif depth == 1 and isinstance(items := nodes[-1].value, list):
            items.append(getattr(event, "value", ""))
        if depth < 0:
            break
        depth += isinstance(event, yaml.CollectionStartEvent)
    return nodes


def _yaml_text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            content = file.read(_MAX_BYTES + 1)
        text = content.decode()
    except OSError as error:
        raise InvalidInput(f"{path} cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise InvalidInput(
            f"{path} is not text in UTF-8; name the YAML file of a map, not its image"
        ) from None
    if len(content) > _MAX_BYTES:
        raise InvalidInput(f"{path} has more than {_MAX_BYTES} bytes: it is not the YAML file of a map")
    return text


def _image(folder: Path, value: _Value) -> Path:
    if not isinstance(value, str) or not value:
        raise ValueError("is the path of a file, from the folder of the YAML file")
    path = folder / value
    try:
        is_file = path.is_file()
    except (OSError, ValueError):  # a name that is too long, or has a zero byte
        is_file = False
    if not is_file:
        raise ValueError(f"{printable(str(path.absolute()))!r} is not a file")
    return path


def _number(value: _Value) -> float:
    try:
        number = float(value) if isinstance(value, str) else math.nan
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"is a finite number, not {_shown(value)}")
    return number


def _resolution(_: Path, value: _Value) -> float:
    number = _number(value)
    if number <= 0.0:
        raise ValueError(f"is the side of a cell [m], above zero; not {number:g}")
    return number


def _origin(_: Path, value: _Value) -> tuple[float, float, float]:
    if not isinstance(value, list) or len(value) != 3:
        raise ValueError(f"is a list of three numbers, [x, y, yaw] in [m] and [rad]; not {_shown(value)}")
    x, y, yaw = map(_number, value)
    if abs(yaw) > math.tau:
        raise ValueError(
            f"has a yaw of {yaw:g} rad, more than a full turn. If it is in degrees, it is "
            f"{math.radians(yaw):.6g} rad"
        )
    return x, y, yaw


def _negate(_: Path, value: _Value) -> bool:
    text = value.lower() if isinstance(value, str) else ""
    if text in _TRUE | _FALSE:
        return text in _TRUE
    try:
        return bool(int(text))
    except ValueError:
        raise ValueError(f"is 0 or 1, not {_shown(value)}") from None


def _threshold(_: Path, value: _Value) -> float:
    number = _number(value)
    if not 0.0 <= number <= 1.0:
        hint = f"; {number:g} % is {number / 100.0:g}" if 1.0 < number <= 100.0 else ""
        raise ValueError(f"is an occupancy from 0 to 1, not {number:g}{hint}")
    return number


def _mode(_: Path, value: _Value) -> Mode:
    text = value.lower() if isinstance(value, str) else ""
    for mode in MODES:
        if text == mode:
            return mode
    raise ValueError(f"is one of {', '.join(MODES)}; not {_shown(value)}")


def _shown(value: _Value) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:80]}..."


_CONVERTERS = {
    "image": _image,
    "resolution": _resolution,
    "origin": _origin,
    "negate": _negate,
    "occupied_thresh": _threshold,
    "free_thresh": _threshold,
    "mode": _mode,
}


def _pyyaml() -> Any:
    import yaml  # noqa: PLC0415 - loaded when it is needed

    return yaml
