"""Statistics of the edges between frames, and the tables of them that `zstate monitor` prints."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Any, NamedTuple

from zstate._util.closeable import Closeable
from zstate.cli.output.console import count_text, rate_text
from zstate.cli.output.text_layout import Table
from zstate.errors import InvalidInput, format_duration
from zstate.net.topic_statistics import TopicStatistics
from zstate.streams import StreamName
from zstate.wire.keys import full_name
from zstate.wire.messages import JointState, StampedMessage, TransformSample
from zstate.wire.registry import get_wire

if TYPE_CHECKING:
    from zstate.buffer.frame_tree import FrameInfo
    from zstate.clock import Clock, ClockOffset
    from zstate.net.session import Session

_WINDOW_NS = 5_000_000_000
_CLOCK_WARNING_NS = 1_000_000

_HEADINGS = ("frame", "edge", "rate", "latency", "max", "jitter", "missed", "clock", "writer")
_NO_NUMBERS = ("",) * 6
"""The cells from rate to clock of an edge without samples of its own."""
# The columns that a narrow terminal leaves out, in this order.
_OPTIONAL_OF_PATH = ("max", "clock", "edge", "jitter")
_OPTIONAL_OF_ALL = ("max", "clock", "jitter", "missed")


@dataclass(frozen=True, slots=True)
class EdgeMeasure:
    """Statistics of one edge's samples in the last five seconds; None if they are not known.

    ``latency_s`` is the median time from stamp to arrival, by the clocks of both machines, and
    ``latency_max_s`` the longest; ``jitter_s`` is the standard deviation of the time between arrivals.
    ``missed`` counts the missing sequence numbers since the start, ``silent_s`` is the time since the last
    arrival, and ``is_stale`` is whether the writer has missed its deadline.
    """

    rate_hz: float | None
    latency_s: float | None
    latency_max_s: float | None
    jitter_s: float | None
    missed: int
    silent_s: float
    is_stale: bool = False


class EdgeStatistics(Closeable):
    """Subscribes to ``stream`` and the transforms and odometry of ``robot`` ("*": of all) on ``wire``.

    ``clock`` is the one of the stamps.
    """

    def __init__(self, session: Session, robot: str, wire: str, stream: StreamName, clock: Clock) -> None:
        def sources(robot: str, published: StreamName, sample: StampedMessage) -> Iterator[str]:
            if isinstance(sample, JointState) and published == "partial_joint_states":
                yield from [f"{robot}//{joint}" for joint in sample.names or ()]
            elif isinstance(sample, JointState):
                yield f"{robot}/"
            elif isinstance(sample, TransformSample):
                with suppress(InvalidInput):  # the listener reports it
                    yield from [full_name(robot, child) for _, child in sample.edges or ()]

        self._clock = clock
        wire_format = get_wire(wire)
        self.topic = TopicStatistics(session, wire_format, sources=sources, clock=clock)
        self.topic.subscribe(stream, robot)
        for edges in wire_format.edges:
            if edges != stream:
                self.topic.subscribe(edges, robot)
        if stream == "joint_states" != wire_format.partial_joint_states:
            self.topic.subscribe(wire_format.partial_joint_states, robot)

    def close(self) -> None:
        self.topic.close()

    def measure(self, edge: FrameInfo) -> EdgeMeasure | None:
        """The statistics of ``edge``; None if no sample has arrived."""
        by_joint = self.topic.get(f"{edge.name.partition('/')[0]}//{edge.joint}")
        statistics, now = by_joint or self.topic.get(_source(edge)), time.monotonic_ns()
        if statistics is None:
            return None
        window = statistics.recent(_WINDOW_NS, now)
        is_comparable = window is not None and edge.domain in (None, self._clock.domain)
        return EdgeMeasure(
            rate_hz=None if window is None else window.rate_hz,
            latency_s=window.delay_s if window is not None and is_comparable else None,
            latency_max_s=window.delays[1] * 1e-9 if window is not None and is_comparable else None,
            jitter_s=None if window is None else window.jitter_s,
            missed=self.topic.gaps.missed(statistics.session),
            silent_s=statistics.silent_s(now),
            is_stale=statistics.is_stale(now),
        )


def _source(edge: FrameInfo) -> str:
    """The key of the samples of ``edge``; all joints of a robot have the same ones if it has one driver."""
    return edge.name.partition("/")[0] + "/" if edge.kind == "joint" else edge.name


class EdgeRow(NamedTuple):
    """A frame and the edge that places it or leads to it, as measured; None for the first frame of a path."""

    frame: str
    edge: FrameInfo | None
    measure: EdgeMeasure | None
    offset: ClockOffset | None

    def json(self) -> dict[str, Any] | None:
        """The edge as a JSON object; None for the first frame."""
        edge, offset = self.edge, self.offset
        if edge is None:
            return None
        numbers = {} if self.measure is None else asdict(self.measure)
        numbers.pop("is_stale", None)
        return {
            "parent": edge.parent,
            "child": edge.name,
            "kind": edge.kind,
            "writer": edge.writer,
            **numbers,
            "clock_offset_s": None if offset is None else offset.offset_ns * 1e-9,
            "clock_uncertainty_s": None if offset is None else offset.uncertainty_ns * 1e-9,
        }


_Cells = list[tuple[str, ...]]


def path_text(rows: Sequence[EdgeRow], *, width: int | None = None) -> str:
    """The table of a path, from its first frame to its last.

    The names are without their robot if all have the same. Edges with the samples of an edge above, mostly
    the joints of one robot, have no numbers of their own.
    """
    robots = {row.frame.partition("/")[0] for row in rows if "/" in row.frame}
    cells: _Cells = []
    shown: set[tuple[str, str | None]] = set()
    for row in rows:
        frame, edge = row.frame, row.edge
        if len(robots) == 1:
            frame = frame.partition("/")[2] or frame
        if edge is None:
            cells.append((frame, "", *_NO_NUMBERS, ""))
        elif edge.kind == "static":
            cells.append((frame, edge.kind, *_NO_NUMBERS, edge.writer or ""))
        elif (source := (_source(edge), edge.writer)) in shown:
            cells.append((frame, edge.kind, *_NO_NUMBERS, ""))
        else:
            cells.append((frame, edge.kind, *_measured_cells(row), edge.writer or ""))
            shown.add(source)
    return _table_text(rows, cells, _OPTIONAL_OF_PATH, width)


def overview_text(rows: Sequence[EdgeRow], *, width: int | None = None) -> str:
    """The table of ``rows`` with an edge each: one line for a robot's joints, and one for its fixed edges."""

    def group(row: EdgeRow) -> tuple[str, str, str, str]:
        edge = row.edge
        assert edge is not None
        robot, slash, _ = edge.name.partition("/")
        own = edge.name if edge.kind == "pose" else ""
        return robot if slash else "", edge.kind, edge.writer or "", own

    cells: _Cells = []
    for (robot, kind, writer, frame), members in groupby(sorted(rows, key=group), key=group):
        first, *others = members
        name, count = f"{robot}/*" if robot else "*", 1 + len(others)
        if kind == "pose":
            cells.append((frame, kind, *_measured_cells(first), writer))
        elif kind == "joint":
            cells.append((name, count_text(count, kind), *_measured_cells(first), writer))
        else:
            cells.append((name, f"{count} {kind}", *_NO_NUMBERS, writer))
    return _table_text(rows, cells, _OPTIONAL_OF_ALL, width)


def _table_text(rows: Sequence[EdgeRow], cells: _Cells, optional: Sequence[str], width: int | None) -> str:
    """The table, and a note on each clock that is off by more than the network alone explains."""
    notes: dict[str, str] = {}
    for row in rows:
        offset, writer = row.offset, row.edge.writer if row.edge is not None else None
        if offset is None or writer is None:
            continue
        off_ns = abs(offset.offset_ns)
        if off_ns > max(_CLOCK_WARNING_NS, offset.uncertainty_ns):
            side = "ahead of" if offset.offset_ns > 0 else "behind"
            notes[writer] = (
                f"the clock of {writer} is {format_duration(off_ns)} {side} the one here "
                f"(± {format_duration(offset.uncertainty_ns)}), and its latencies are off by that"
            )
    lines = Table(_HEADINGS, cells, optional, abbreviate="writer").lines(width)
    return "\n".join([*lines, *notes.values()])


def _measured_cells(row: EdgeRow) -> tuple[str, ...]:
    """The cells from rate to clock. A clock offset below its uncertainty counts as none."""
    measure, offset = row.measure, row.offset
    if measure is None:
        return ("no sample", *_NO_NUMBERS[1:])
    ahead = "" if offset is None else "0"
    if offset is not None and abs(offset.offset_ns) > offset.uncertainty_ns:
        ahead = f"{'+' if offset.offset_ns > 0 else ''}{format_duration(offset.offset_ns)}"
    silent = f"silent {time_text(measure.silent_s)}"
    times = (measure.latency_s, measure.latency_max_s, measure.jitter_s)
    rate = silent if measure.is_stale else rate_text(measure.rate_hz)
    return (rate, *map(time_text, times), str(measure.missed), ahead)


def time_text(seconds: float | None) -> str:
    """A duration; "-" for None."""
    return "-" if seconds is None else format_duration(round(seconds * 1e9))
