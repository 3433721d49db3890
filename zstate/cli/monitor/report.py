"""What is reported of a path: a table for a person, facts for a program."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from zstate.cli.monitor.meter import EdgeMeasure, EdgeStatistics
from zstate.cli.output.console import rate_text
from zstate.cli.output.text_layout import Table
from zstate.errors import duration_text

if TYPE_CHECKING:
    from zstate.buffer.frame_tree import FrameInfo
    from zstate.clock import ClockOffset

_HEADINGS = ("frame", "edge", "rate", "latency", "max", "jitter", "missed", "clock", "writer")
# What a narrow terminal does without, in this order.
_DISPENSABLE = ("max", "clock", "edge", "jitter")

NO_NUMBERS = ("",) * (len(_HEADINGS) - 3)
"""The cells of an edge whose samples are not its own, or that has none."""

_OFFSET_NS = 1_000_000


@dataclass(frozen=True, slots=True)
class Row:
    """A frame on the path and the edge that leads to it, with what was measured; None for the first frame."""

    frame: str
    edge: FrameInfo | None
    measure: EdgeMeasure | None
    offset: ClockOffset | None

    def facts(self) -> dict[str, Any] | None:
        """The same as JSON has it; None for the first frame."""
        edge, offset = self.edge, self.offset
        if edge is None:
            return None
        return {
            "parent": edge.parent,
            "child": edge.name,
            "kind": edge.kind,
            "writer": edge.writer,
            **({} if self.measure is None else self.measure.facts()),
            "clock_offset_s": None if offset is None else offset.offset_ns * 1e-9,
            "clock_uncertainty_s": None if offset is None else offset.uncertainty_ns * 1e-9,
        }


Cells = list[tuple[str, ...]]


def report_text(rows: Sequence[Row], *, width: int | None = None) -> str:
    """The table of a path, from its first frame to its last."""
    return table_text(rows, _cells(rows), _DISPENSABLE, width=width)


def table_text(
    rows: Sequence[Row], cells: Cells, optional: Sequence[str], *, width: int | None = None
) -> str:
    """The table of ``cells`` and notes on clocks; ``optional`` columns may be left out to fit ``width``."""
    lines = Table(_HEADINGS, cells, optional, abbreviate="writer").lines(width)
    return "\n".join([*lines, *_clock_notes(rows)])


def _cells(rows: Sequence[Row]) -> Cells:
    """Edges whose samples are those of the edge above have only their kind: one robot's joints, mostly."""
    cells: Cells = []
    said: set[str] = set()
    for frame, row in zip(_names(rows), rows, strict=True):
        edge = row.edge
        if edge is None:
            cells.append((frame, *[""] * (len(_HEADINGS) - 1)))
            continue
        writer = edge.writer or ""
        if edge.kind == "static":
            cells.append((frame, edge.kind, *NO_NUMBERS, writer))
            continue
        source = EdgeStatistics.source(edge)
        numbers = NO_NUMBERS if source in said else measured_cells(row.measure, row.offset)
        cells.append((frame, edge.kind, *numbers, writer if source not in said else ""))
        said.add(source)
    return cells


def _names(rows: Sequence[Row]) -> list[str]:
    """The frames, without their robot where there is one only."""
    robots = {row.frame.partition("/")[0] for row in rows if "/" in row.frame}
    full = [row.frame for row in rows]
    return [name.partition("/")[2] or name for name in full] if len(robots) == 1 else full


def measured_cells(measure: EdgeMeasure | None, offset: ClockOffset | None) -> tuple[str, ...]:
    """What was measured, from rate to clock."""
    if measure is None:
        return ("no sample", *NO_NUMBERS[1:])
    return (
        _rate_text(measure),
        *(_time_text(seconds) for seconds in (measure.latency_s, measure.latency_max_s, measure.jitter_s)),
        str(measure.missed),
        "" if offset is None else _ahead_text(offset),
    )


def _rate_text(measure: EdgeMeasure) -> str:
    return f"silent {_time_text(measure.silent_s)}" if measure.is_stale else rate_text(measure.rate_hz)


def _time_text(seconds: float | None) -> str:
    return "-" if seconds is None else duration_text(round(seconds * 1e9))


def _ahead_text(offset: ClockOffset) -> str:
    """What is smaller than its uncertainty is none."""
    if abs(offset.offset_ns) <= offset.uncertainty_ns:
        return "0"
    return f"{'+' if offset.offset_ns > 0 else ''}{duration_text(offset.offset_ns)}"


def _clock_notes(rows: Sequence[Row]) -> list[str]:
    """Clocks that are off by more than the network alone explains."""
    notes: dict[str, str] = {}
    for row in rows:
        offset, writer = row.offset, row.edge.writer if row.edge is not None else None
        if offset is None or writer is None:
            continue
        off_ns = abs(offset.offset_ns)
        if off_ns > max(_OFFSET_NS, offset.uncertainty_ns):
            side = "ahead of" if offset.offset_ns > 0 else "behind"
            notes[writer] = (
                f"the clock of {writer} is {duration_text(off_ns)} {side} the one here "
                f"(± {duration_text(offset.uncertainty_ns)}), and its latencies are off by that"
            )
    return list(notes.values())
