"""What `zstate monitor` measures and prints: all edges, the edges of one path, or robots.

``EdgeStatistics`` measures edges; ``overview_text`` and ``path_text`` are their tables. ``AllEdgesView`` and
``PathView`` wait for edges and report them, ``RobotMonitor`` reports one line for each robot.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

from zstate._util.bounded import BoundedDict
from zstate._util.closeable import Closeable
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
from zstate.wire.keys import ANY, Stream, check_robot, full_name
from zstate.wire.messages import JointState, Sample, TransformSample
from zstate.wire.registry import get_wire

if TYPE_CHECKING:
    from zstate.buffer.frame_tree import FrameInfo
    from zstate.clock import Clock, ClockOffset
    from zstate.ingest.counters import ListenerStats
    from zstate.net.session import Session
    from zstate.nodes.listener import Follow

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
    """Subscribes to ``stream`` of ``robot`` ("*": of all) on ``wire``; ``clock`` is the one of the stamps."""

    def __init__(self, session: Session, robot: str, wire: str, stream: Stream, clock: Clock) -> None:
        self._clock = clock
        self.topic = TopicStatistics(session, get_wire(wire), sources=_sources, clock=clock)
        self.topic.subscribe(stream, robot)

    def close(self) -> None:
        """Unsubscribe. A second call does nothing."""
        self.topic.close()

    def measure(self, edge: FrameInfo) -> EdgeMeasure | None:
        """The statistics of ``edge``; None if no sample has arrived."""
        statistics, now = self.topic.get(_source(edge)), time.monotonic_ns()
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
    """The key of the samples of ``edge``; all joints of a robot have the same samples."""
    return edge.name.partition("/")[0] + "/" if edge.kind == "joint" else edge.name


def _sources(robot: str, stream: Stream, sample: Sample) -> Iterator[str]:
    if isinstance(sample, JointState):
        yield f"{robot}/"
    elif isinstance(sample, TransformSample):
        with suppress(InvalidInput):  # the listener reports it
            yield from [full_name(robot, child) for _, child in sample.edges or ()]


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
    shown: set[str] = set()
    for row in rows:
        frame, edge = row.frame, row.edge
        if len(robots) == 1:
            frame = frame.partition("/")[2] or frame
        if edge is None:
            cells.append((frame, "", *_NO_NUMBERS, ""))
        elif edge.kind == "static":
            cells.append((frame, edge.kind, *_NO_NUMBERS, edge.writer or ""))
        elif (source := _source(edge)) in shown:
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
    silent = f"silent {_time_text(measure.silent_s)}"
    times = (measure.latency_s, measure.latency_max_s, measure.jitter_s)
    rate = silent if measure.is_stale else rate_text(measure.rate_hz)
    return (rate, *map(_time_text, times), str(measure.missed), ahead)


def _time_text(seconds: float | None) -> str:
    return "-" if seconds is None else format_duration(round(seconds * 1e9))


class MonitorView(ABC):
    """Measured edges of ``listener``, as text and JSON."""

    def __init__(self, listener: TransformListener, statistics: EdgeStatistics) -> None:
        self._listener = listener
        self._statistics = statistics

    @abstractmethod
    def wait(self, timeout_s: float | None) -> None:
        """Wait until there are edges; prints what is missing, and fails after ``timeout_s``."""

    @abstractmethod
    def _json(self) -> dict[str, Any]: ...

    @abstractmethod
    def _text(self, width: int | None) -> str: ...

    def print_report(self, *, as_json: bool) -> None:
        """Print one report."""
        if as_json:
            print_json(self._json())
        else:
            print_result(f"{self._text(output_width())}\n")

    def show(self) -> NoReturn:
        """Show a report on the terminal and keep it up to date."""
        keep_showing(lambda: self._text(terminal_width()))

    def _row(self, frame: str, edge: FrameInfo | None) -> EdgeRow:
        if edge is None:
            return EdgeRow(frame, None, None, None)
        offset = self._listener.buffer.clock_offsets.get(edge.writer or "")
        return EdgeRow(frame, edge, self._statistics.measure(edge), None if offset is None else offset())


class AllEdgesView(MonitorView):
    """All received edges."""

    def __init__(
        self, listener: TransformListener, statistics: EdgeStatistics, directory: RobotDirectory
    ) -> None:
        super().__init__(listener, statistics)
        self._directory = directory

    def wait(self, timeout_s: float | None) -> None:
        waiter = ConditionWaiter()
        self._listener.add_observer(waiter.notify)
        if not waiter.wait_for(self._rows, timeout_s, self._reason):
            fail(f"gave up after {timeout_s:g} s: {self._reason()}")

    def _reason(self) -> str:
        robot, robots = self._listener.robot, self._directory.robots()
        return self._directory.messages.missing_text(robot, "robot_description", robots, has_frames=False)

    def _rows(self) -> list[EdgeRow]:
        frames = self._listener.buffer.frames()
        return [self._row(frame.name, frame) for frame in frames if frame.parent is not None]

    def _text(self, width: int | None) -> str:
        return self._directory.messages.translate(overview_text(self._rows(), width=width))

    def _json(self) -> dict[str, Any]:
        return {"edges": [row.json() for row in self._rows()]}


class PathView(MonitorView):
    """The edges on the path between two frames, and the pose."""

    def __init__(
        self,
        listener: TransformListener,
        statistics: EdgeStatistics,
        directory: RobotDirectory,
        frames: tuple[str, str],
    ) -> None:
        super().__init__(listener, statistics)
        self._target, self._source = frames
        self._pose = PoseWaiter(listener, directory, *frames)

    def wait(self, timeout_s: float | None) -> None:
        self._pose.wait(timeout_s=timeout_s)

    def _rows(self) -> list[EdgeRow]:
        frames = self._listener.buffer.path_frames(self._target, self._source)
        return [self._row(name, edge) for name, edge in frames]

    def _text(self, width: int | None) -> str:
        transform = self._pose.wait()
        age_s = self._pose.age_s(transform)
        newest = "at any time (static)" if transform.stamp is None else "there"
        if age_s is not None:
            newest = f"the newest is {_time_text(age_s)} old"
        table = path_text(self._rows(), width=width)
        return self._pose.translate(f"pose of {self._source} in {self._target}: {newest}\n{table}")

    def _json(self) -> dict[str, Any]:
        transform = self._pose.wait()
        return {
            "target": self._target,
            "source": self._source,
            "stamp": transform.stamp,
            "age_s": self._pose.age_s(transform),
            "edges": [row.json() for row in self._rows()[1:]],
        }


@dataclass(eq=False)
class MonitoredRobot:
    """One robot and its listener, which may listen to other robots, too."""

    robot: str
    listener: TransformListener
    buffer: MeteredBuffer

    @property
    def stats(self) -> ListenerStats:
        """The counts of its samples."""
        return self.listener.stats_of(self.robot)


class RobotMonitor(Closeable):
    """Listens to the selected robots that are announced: one listener for all with the same stream."""

    def __init__(
        self, session: Session, directory: RobotDirectory, robot: str, wire: str, clock: Clock | None
    ) -> None:
        self._selected = robot
        self._robot = None if robot == ANY else check_robot(robot)
        self._session, self._directory, self._wire, self._clock = session, directory, wire, clock
        self._reported = ""
        self._listeners: dict[Follow, tuple[TransformListener, MeteredBuffer]] = {}
        self._robots: BoundedDict[str, MonitoredRobot] = BoundedDict()
        self._opened = ExitStack()

    def close(self) -> None:
        self._opened.close()

    def robots(self) -> list[MonitoredRobot]:
        """The monitored robots, by name."""
        return sorted(dict(self._robots).values(), key=lambda one: one.robot)

    def update(self) -> str:
        """Add robots that have appeared. While there is none, prints and returns what is missing."""
        for info in self._directory.robots():
            if self._robot in (None, info.name) and info.name not in self._robots:
                self._add(info.name, self._directory.streams(info.name))
        reason = "" if self._robots else self._reason()
        if reason and reason != self._reported:
            print_status(f"waiting: {reason}", event="waiting", robot=self._robot)
        self._reported = reason
        return reason

    def _add(self, robot: str, streams: frozenset[Stream]) -> None:
        follow: Follow = "joint_states" if "joint_states" in streams else "tf"
        if is_ros(self._wire) and "tf" in streams:
            # All nodes share /tf. A selected robot means its joints, which need its model.
            is_described = self._robot is not None and {"joint_states", "robot_description"} <= streams
            follow = "joint_states" if is_described else "tf"
        if follow not in streams:
            return
        if follow not in self._listeners:
            buffer = MeteredBuffer(self._clock)
            listener = TransformListener(
                self._session, self._selected, buffer, self._wire, follow, history_on_join=False
            )
            self._listeners[follow] = self._opened.enter_context(listener), buffer
        self._robots[robot] = MonitoredRobot(robot, *self._listeners[follow])
        place = self._directory.messages.place(robot, (follow,))
        print_status(f"following {place}", event="following", robot=robot)

    def _reason(self) -> str:
        if self._robot is not None:
            return self._directory.no_sample_text(self._robot, default_stream(self._wire))
        robots = self._directory.robots()
        return self._directory.messages.announced(robots) + ", but nothing that moves" * bool(robots)

    def report(self, *, as_json: bool) -> None:
        """Print one line for each robot."""
        for one in self.robots():
            measure, stats = one.buffer.measure(one.robot), one.stats
            if as_json:
                print_json({"robot": one.robot, **asdict(measure), **asdict(stats)})
                continue
            is_stale = one.buffer.statistics_of(one.robot).is_stale()
            reasons = ", ".join(f"{reason} {count}" for reason, count in stats.refused.items())
            print_wrapped(
                f"{one.robot}  {'silent' if is_stale else rate_text(measure.rate_hz)}  "
                f"age {_time_text(measure.age_s)}  latency {_time_text(measure.latency_s)}  "
                f"received {stats.received}  dropped {stats.dropped}  missed {stats.missed}  "
                f"late {stats.late}  refused {sum(stats.refused.values())}"
                f"{f' ({reasons})' if reasons else ''}"
                f"{f'  off the clock {stats.off_clock}' if stats.off_clock else ''}"
            )
