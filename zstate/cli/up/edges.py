"""The static edges of a file: their poses, and whose they are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from zstate.buffer.buffer import TransformBuffer
from zstate.cli.up.calibration import read_calibration, renamed
from zstate.cli.up.cell import Cell
from zstate.cli.up.sections import StaticSection, in_a_list
from zstate.cli.up.tables import Placed
from zstate.errors import ConfigError, InvalidInput
from zstate.transform import Transform
from zstate.wire.keys import check_robot, full_name


@dataclass(frozen=True, slots=True)
class OwnedEdge:
    """An edge, whose it is (None: not said), and the wires to say it on (None: those of the command)."""

    edge: Transform
    robot: str | None = None
    wires: tuple[str, ...] | None = None


def owned_edges(cell: Cell, robots: Sequence[str]) -> list[OwnedEdge]:
    """The edges of every [[static]], of the file's ``robots``. Raises ConfigError."""
    return [
        OwnedEdge(edge, robot, placed.section.wires)
        for placed in cell.static
        for edge in edges(placed)
        for robot in _owners(placed, robots, edge) or (None,)
    ]


def check_edges(cell: Cell, robots: Sequence[str]) -> None:
    """Raise ConfigError where an edge is nobody's, or where the edges of a robot contradict each other."""
    check = TransformBuffer()
    for placed in cell.static:
        for edge in edges(placed):
            named = _owners(placed, robots, edge)
            if not named:
                known = ", ".join(map(repr, robots)) or "none"
                raise placed.error(f"whose edge is this? Add robot = (in this file: {known})")
            try:
                for robot in named:
                    check.insert_static(_in_full(check_robot(robot), edge))
            except InvalidInput as error:
                raise placed.error(str(error)) from None


def edges(placed: Placed[StaticSection]) -> tuple[Transform, ...]:
    """The edges of one [[static]], written there or in its calibration file."""
    section = placed.section
    if section.file is None:
        return (section.transform(),)
    try:
        found = read_calibration(Path(placed.beside(section.file)))
    except ConfigError as error:
        raise placed.error(str(error), "file") from None
    if len(found) > 1 and (section.target or section.source):
        raise placed.error(f"{section.file!r} has {len(found)} transforms; leave out target and source")
    return tuple(renamed(edge, section.target, section.source) for edge in found)


def _owners(placed: Placed[StaticSection], robots: Sequence[str], edge: Transform) -> tuple[str, ...]:
    patterns = in_a_list(placed.section.robot)
    if not patterns:
        named = [frame.partition("/")[0] for frame in (edge.source, edge.target) if "/" in frame]
        return tuple(named[:1]) or (tuple(robots) if len(robots) == 1 else ())
    return tuple(dict.fromkeys(name for pattern in patterns for name in _meant(placed, pattern, robots)))


def _meant(placed: Placed[StaticSection], pattern: str, robots: Sequence[str]) -> Iterator[str]:
    if "*" not in pattern:
        yield pattern
        return
    meant = [robot for robot in robots if fnmatchcase(robot, pattern)]
    if not meant:
        known = ", ".join(map(repr, robots)) or "none"
        raise placed.error(f"no robot is called like {pattern!r}; in this file: {known}", "robot")
    yield from meant


def _in_full(robot: str, edge: Transform) -> Transform:
    return Transform(
        full_name(robot, edge.target), full_name(robot, edge.source), edge.translation, edge.rotation
    )
