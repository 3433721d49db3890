"""Monitored: what is watched, every edge that is heard or the edges on the way to one pose.

Statistics of moving edges, or of the joints of each robot, whose samples arrive together.

Overview: all edges that are heard, with one line for those whose samples come together.

The way from one frame to another, edge by edge.

What is reported of a path: a table for a person, facts for a program.

Robots that are announced, and how the samples of each arrive: `zstate monitor --robots`.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

from zstate._util.bounded_dict import BoundedDict
from zstate._util.closeable import Closeable
from zstate.buffer.frame_tree import FrameInfo
from zstate.cli.output.console import (
    count_text,
    fail,
    keep_showing,
    output_width,
    print_json,
    print_result,
    print_status,
    print_wrapped,
    rate_text,
    terminal_width,
)
from zstate.cli.output.text_layout import Table
from zstate.cli.output.wire_text import default_stream, is_ros
from zstate.cli.robot_directory import RobotDirectory
from zstate.cli.waiting import ConditionWaiter, PoseWaiter
from zstate.errors import InvalidInput, format_duration
from zstate.metrics.buffer import MeteredBuffer
from zstate.net.topic_statistics import TopicStatistics
from zstate.nodes.listener import TransformListener
from zstate.transform import Transform
from zstate.wire.keys import ANY, Stream, check_robot, full_name
from zstate.wire.messages import JointState, Sample, TransformSample
from zstate.wire.registry import get_wire

if TYPE_CHECKING:
    from zstate.clock import Clock, ClockOffset
    from zstate.ingest.counters import ListenerStats
    from zstate.net.session import Session
    from zstate.nodes.listener import Follow

_WINDOW_NS = 5_000_000_000


@dataclass(frozen=True, slots=True)
class EdgeMeasure:
    """Statistics of one edge's samples in the last five seconds; None where they are not known.

    ``latency_s`` is the median time from stamp to arrival, by the clocks of both machines, and
    ``latency_max_s`` the longest; ``jitter_s`` is the standard deviation of the time between arrivals.
    ``missed`` counts the gaps in its writer's numbers since the start, ``silent_s`` goes since the last
    arrival, and ``is_stale`` is whether its writer has missed its deadline.
    """

    rate_hz: float | None
    latency_s: float | None
    latency_max_s: float | None
    jitter_s: float | None
    missed: int
    silent_s: float
    is_stale: bool = False

    def facts(self) -> dict[str, Any]:
        """As JSON has it."""
        return {name: value for name, value in asdict(self).items() if name != "is_stale"}


class EdgeStatistics(Closeable):
    """Subscribes to ``stream`` of ``robot`` ("*": of all) on ``wire``; ``clock`` is that of the stamps."""

    def __init__(self, session: Session, robot: str, wire: str, stream: Stream, clock: Clock) -> None:
        self._clock = clock
        self.topic = TopicStatistics(session, get_wire(wire), sources=_sources, clock=clock)
        self.topic.subscribe(stream, robot)

    def close(self) -> None:
        """Unsubscribe. A second call does nothing."""
        self.topic.close()

    def measure(self, edge: FrameInfo) -> EdgeMeasure | None:
        """The statistics of ``edge``; None if no sample has arrived."""
        statistics, now = self.topic.get(self.source(edge)), time.monotonic_ns()
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

    @staticmethod
    def source(edge: FrameInfo) -> str:
        """What edges with the same samples have in common: the joints of a robot arrive together."""
        return edge.name.partition("/")[0] + "/" if edge.kind == "joint" else edge.name


def _sources(robot: str, stream: Stream, sample: Sample) -> Iterator[str]:
    if isinstance(sample, JointState):
        yield f"{robot}/"
    elif isinstance(sample, TransformSample):
        with suppress(InvalidInput):  # refused by the listener
            yield from [full_name(robot, child) for _, child in sample.edges or ()]


_HEADINGS = ("frame", "edge", "rate", "latency", "max", "jitter", "missed", "clock", "writer")
# What a narrow terminal does without, in this order.
_DISPENSABLE = ("max", "clock", "edge", "jitter")

NO_NUMBERS = ("",) * (len(_HEADINGS) - 3)
"""The cells of an edge whose samples are not its own, or that has none."""

_OFFSET_NS = 1_000_000


@dataclass(frozen=True, slots=True)
class EdgeRow:
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


def report_text(rows: Sequence[EdgeRow], *, width: int | None = None) -> str:
    """The table of a path, from its first frame to its last."""
    return table_text(rows, _cells(rows), _DISPENSABLE, width=width)


def table_text(
    rows: Sequence[EdgeRow], cells: Cells, optional: Sequence[str], *, width: int | None = None
) -> str:
    """The table of ``cells`` and notes on clocks; ``optional`` columns may be left out to fit ``width``."""
    lines = Table(_HEADINGS, cells, optional, abbreviate="writer").lines(width)
    return "\n".join([*lines, *_clock_notes(rows)])


def _cells(rows: Sequence[EdgeRow]) -> Cells:
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


def _names(rows: Sequence[EdgeRow]) -> list[str]:
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
    return "-" if seconds is None else format_duration(round(seconds * 1e9))


def _ahead_text(offset: ClockOffset) -> str:
    """What is smaller than its uncertainty is none."""
    if abs(offset.offset_ns) <= offset.uncertainty_ns:
        return "0"
    return f"{'+' if offset.offset_ns > 0 else ''}{format_duration(offset.offset_ns)}"


def _clock_notes(rows: Sequence[EdgeRow]) -> list[str]:
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
                f"the clock of {writer} is {format_duration(off_ns)} {side} the one here "
                f"(± {format_duration(offset.uncertainty_ns)}), and its latencies are off by that"
            )
    return list(notes.values())


def overview_text(rows: Sequence[EdgeRow], *, width: int | None = None) -> str:
    """The table of ``rows``, of which each has an edge: a robot's joints first, its fixed edges last."""
    return table_text(rows, _group_cells(rows), ("max", "clock", "jitter", "missed"), width=width)


def _group_cells(rows: Sequence[EdgeRow]) -> Cells:
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


def _place(row: EdgeRow) -> tuple[str, str, str, str]:
    """Where a row stands; rows of one place are one line."""
    edge = row.edge
    assert edge is not None
    robot, slash, _ = edge.name.partition("/")
    return robot if slash else "", edge.kind, edge.writer or "", edge.name if edge.kind == "pose" else ""


class Leg(NamedTuple):
    """A step of the way: it leads to ``frame``, over the edge that places ``edge.name`` on its parent."""

    frame: str
    edge: FrameInfo


def path_between(frames: Sequence[FrameInfo], target: str, source: str) -> tuple[str, list[Leg]]:
    """The full name of ``target``, and the steps from there to ``source``. Both are known, and connected."""
    by_name = {frame.name: frame for frame in frames}
    begin, end = _full(target, by_name), _full(source, by_name)
    up, down = _upwards(begin, by_name), _upwards(end, by_name)
    shared = {edge.name for edge in up} & {edge.name for edge in down}
    legs = [Leg(edge.parent or "", edge) for edge in up if edge.name not in shared]
    return begin, legs + [Leg(edge.name, edge) for edge in reversed(down) if edge.name not in shared]


def _full(name: str, by_name: Mapping[str, FrameInfo]) -> str:
    """A frame by its full name; a bare one is that of some robot's frame."""
    bare = (frame for frame in by_name if frame.partition("/")[2] == name)
    return name if name in by_name else next(bare, name)


def _upwards(frame: str, by_name: Mapping[str, FrameInfo]) -> list[FrameInfo]:
    edges: list[FrameInfo] = []
    info = by_name.get(frame)
    while info is not None and info.parent is not None:
        edges.append(info)
        info = by_name.get(info.parent)
    return edges


class MonitorView(ABC):
    """Edges that are heard, and what is measured of them."""

    def __init__(self, listener: TransformListener, meter: EdgeStatistics) -> None:
        self._listener = listener
        self._meter = meter

    @abstractmethod
    def wait(self, timeout_s: float | None) -> None:
        """Until there is something to report; says what it waits for, and fails after ``timeout_s``."""

    @abstractmethod
    def _facts(self) -> dict[str, Any]: ...

    @abstractmethod
    def _text(self, width: int | None) -> str: ...

    def print_report(self, *, as_json: bool) -> None:
        """One report."""
        if as_json:
            print_json(self._facts())
        else:
            print_result(f"{self._text(output_width())}\n")

    def show(self) -> NoReturn:
        """A report that keeps up to date."""
        keep_showing(lambda: self._text(terminal_width()))

    def _row(self, frame: str, edge: FrameInfo) -> EdgeRow:
        ask = self._listener.buffer.clock_offsets.get(edge.writer or "")
        return EdgeRow(frame, edge, self._meter.measure(edge), None if ask is None else ask())


class AllEdgesView(MonitorView):
    """All edges."""

    def __init__(self, listener: TransformListener, meter: EdgeStatistics, roster: RobotDirectory) -> None:
        super().__init__(listener, meter)
        self._roster = roster

    def wait(self, timeout_s: float | None) -> None:
        waiter = ConditionWaiter()
        self._listener.add_observer(waiter.notify)
        if not waiter.wait_for(self._rows, timeout_s, self._reason):
            fail(f"gave up after {timeout_s:g} s: {self._reason()}")

    def _reason(self) -> str:
        roster = self._roster
        return roster.messages.missing_text(
            self._listener.robot, "robot_description", roster.robots(), heard=False
        )

    def _rows(self) -> list[EdgeRow]:
        frames = self._listener.buffer.frames()
        return [self._row(frame.name, frame) for frame in frames if frame.parent is not None]

    def _text(self, width: int | None) -> str:
        return self._roster.messages.translate(overview_text(self._rows(), width=width))

    def _facts(self) -> dict[str, Any]:
        return {"edges": [row.facts() for row in self._rows()]}


class PoseView(MonitorView):
    """One pose, and the edges on its path."""

    def __init__(
        self,
        listener: TransformListener,
        meter: EdgeStatistics,
        roster: RobotDirectory,
        frames: tuple[str, str],
    ) -> None:
        super().__init__(listener, meter)
        self._target, self._source = frames
        self._awaited = PoseWaiter(listener, roster, *frames)

    def wait(self, timeout_s: float | None) -> None:
        self._awaited.wait(timeout_s=timeout_s)

    def _rows(self) -> list[EdgeRow]:
        begin, legs = path_between(self._listener.buffer.frames(), self._target, self._source)
        return [EdgeRow(begin, None, None, None), *(self._row(leg.frame, leg.edge) for leg in legs)]

    def _text(self, width: int | None) -> str:
        head = f"pose of {self._source} in {self._target}: {self._newest(self._awaited.wait())}"
        return self._awaited.translate(f"{head}\n{report_text(self._rows(), width=width)}")

    def _newest(self, transform: Transform) -> str:
        if transform.stamp is None:
            return "at any time (static)"
        age_s = self._awaited.age_s(transform)
        return "there" if age_s is None else f"the newest is {format_duration(round(age_s * 1e9))} old"

    def _facts(self) -> dict[str, Any]:
        transform = self._awaited.wait()
        return {
            "target": self._target,
            "source": self._source,
            "stamp": transform.stamp,
            "age_s": self._awaited.age_s(transform),
            "edges": [facts for row in self._rows() if (facts := row.facts()) is not None],
        }


@dataclass(eq=False)
class MonitoredRobot:
    """One robot, and the listener that follows it; others may share that."""

    robot: str
    listener: TransformListener
    buffer: MeteredBuffer

    @property
    def stats(self) -> ListenerStats:
        """The counts of its samples."""
        return self.listener.stats_of(self.robot)


class RobotMonitor(Closeable):
    """Follows the selected robots that are announced: one listener for all that write the same stream."""

    def __init__(
        self, session: Session, roster: RobotDirectory, robot: str, wire: str, clock: Clock | None
    ) -> None:
        self._selected = robot
        self._robot = None if robot == ANY else check_robot(robot)
        self._session = session
        self._wire = wire
        self._roster = roster
        self._clock = clock
        self._reported = ""
        self._listeners: dict[Follow, tuple[TransformListener, MeteredBuffer]] = {}
        self._robots: BoundedDict[str, MonitoredRobot] = BoundedDict()
        self._opened = ExitStack()

    def close(self) -> None:
        self._opened.close()

    def robots(self) -> list[MonitoredRobot]:
        """The robots that are followed, by name."""
        return sorted(dict(self._robots).values(), key=lambda one: one.robot)

    def update(self) -> str:
        """Follow robots that have appeared. Returns and reports what is missing while there is none."""
        for info in self._roster.robots():
            if self._robot in (None, info.name) and info.name not in self._robots:
                self._follow(info.name, self._roster.streams(info.name))
        reason = "" if self._robots else self._reason()
        if reason and reason != self._reported:
            print_status(f"waiting: {reason}", event="waiting", robot=self._robot)
        self._reported = reason
        return reason

    def _follow(self, robot: str, streams: frozenset[Stream]) -> None:
        follow = self._stream(streams)
        if follow in streams:
            listener, buffer = self._listeners.get(follow) or self._listen(follow)
            self._robots[robot] = MonitoredRobot(robot, listener, buffer)
            print_status(
                f"following {self._roster.messages.place(robot, (follow,))}", event="following", robot=robot
            )

    def _listen(self, follow: Follow) -> tuple[TransformListener, MeteredBuffer]:
        from zstate.metrics.buffer import MeteredBuffer
        from zstate.nodes.listener import TransformListener

        buffer = MeteredBuffer(self._clock)
        listener = self._opened.enter_context(
            TransformListener(
                self._session, self._selected, buffer, self._wire, follow, history_on_join=False
            )
        )
        self._listeners[follow] = listener, buffer
        return listener, buffer

    def _stream(self, streams: frozenset[Stream]) -> Follow:
        if is_ros(self._wire) and "tf" in streams:
            # All nodes share /tf: who names a robot means its joints, which need its model.
            is_one = self._robot is not None and {"joint_states", "robot_description"} <= streams
            return "joint_states" if is_one else "tf"
        return "joint_states" if "joint_states" in streams else "tf"

    def _reason(self) -> str:
        if self._robot is not None:
            return self._roster.no_sample_text(self._robot, default_stream(self._wire))
        robots = self._roster.robots()
        return self._roster.messages.announced(robots) + ", but nothing that moves" * bool(robots)

    def report(self, *, as_json: bool) -> None:
        """One line for each robot."""
        for one in self.robots():
            measure, stats = one.buffer.measure(one.robot), one.stats
            if as_json:
                print_json({"robot": one.robot, **asdict(measure), **asdict(stats)})
                continue
            is_stale = one.buffer.statistics_of(one.robot).is_stale()
            print_wrapped(
                f"{one.robot}  {'silent' if is_stale else rate_text(measure.rate_hz)}  "
                f"age {_time_text(measure.age_s)}  latency {_time_text(measure.latency_s)}  "
                f"received {stats.received}  dropped {stats.dropped}  missed {stats.missed}  "
                f"late {stats.late}  refused {_refused_text(stats.refused)}"
                f"{f'  off the clock {stats.off_clock}' if stats.off_clock else ''}"
            )


def _refused_text(refused: dict[str, int]) -> str:
    reasons = ", ".join(f"{reason} {count}" for reason, count in refused.items())
    return f"{sum(refused.values())}{f' ({reasons})' if reasons else ''}"
