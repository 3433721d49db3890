"""Overview: all edges that are heard, with one line for those whose samples come together."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

from zstate.cli.monitor.report import NO_NUMBERS, Cells, Row, measured_cells, table_text
from zstate.cli.output.console import count_text


def overview_text(rows: Sequence[Row], *, width: int | None = None) -> str:
    """The table of ``rows``, of which each has an edge: a robot's joints first, its fixed edges last."""
    return table_text(rows, _cells(rows), ("max", "clock", "jitter", "missed"), width=width)


def _cells(rows: Sequence[Row]) -> Cells:
    cells: Cells = []
    for (robot, kind, writer, _), group in groupby(sorted(rows, key=_place), key=_place):
        alike = list(group)
        of_robot = f"{robot}/*" if robot else "*"
        measured = measured_cells(alike[0].measure, alike[0].offset)
        if kind == "pose":
            cells += [(row.frame, kind, *measured, writer) for row in alike]
        elif kind == "joint":
            cells.append((of_robot, count_text(len(alike), kind), *measured, writer))
        else:
            cells.append((of_robot, f"{len(alike)} {kind}", *NO_NUMBERS, writer))
    return cells


def _place(row: Row) -> tuple[str, str, str, str]:
    """Where a row stands; rows of one place are one line."""
    edge = row.edge
    assert edge is not None
    robot, slash, _ = edge.name.partition("/")
    return robot if slash else "", edge.kind, edge.writer or "", edge.name if edge.kind == "pose" else ""
