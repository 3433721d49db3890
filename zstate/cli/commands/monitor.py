"""zstate monitor: rate, latency, jitter and losses of edges or robots."""

from __future__ import annotations

import math
import time
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from threading import Event
from typing import TYPE_CHECKING, Any

import click

from zstate._util.bounded import BoundedDict
from zstate._util.closeable import Closeable
from zstate.cli import options
from zstate.cli.metrics import listener_rows, plugin_rows, serve_metrics, writer_rows
from zstate.cli.options import open_clock
from zstate.cli.output.console import (
    fail,
    is_terminal,
    keep_showing,
    output_width,
    print_json,
    print_result,
    print_status,
    print_wrapped,
    rate_text,
    terminal_width,
)
from zstate.cli.output.wire_text import default_stream, is_ros
from zstate.cli.robot_directory import RobotDirectory
from zstate.cli.session import SessionOptions, open_session
from zstate.errors import printable
from zstate.stream_registry import edge_streams, is_bulk, is_own, measured_streams
from zstate.streams import JOINT_STREAMS, StreamName
from zstate.wire.keys import ANY, check_robot

if TYPE_CHECKING:
    from collections.abc import Mapping

    from zstate.buffer.frame_tree import FrameInfo
    from zstate.cli.edge_statistics import EdgeRow, EdgeStatistics
    from zstate.clock import Clock
    from zstate.driving.driver_state import ReceivedState
    from zstate.ingest.counters import ListenerStats
    from zstate.metrics.endpoint import BindAddress
    from zstate.net.session import Session
    from zstate.net.topic_statistics import IntervalStatistics
    from zstate.nodes.listener import Follow, TransformListener
    from zstate.nodes.metered_buffer import MeteredBuffer, RobotMeasure
    from zstate.transform import Transform
    from zstate.wire.messages import Status

_FIRST_AFTER_S = 1.0
# Discovery takes less.
_DISCOVERY_S = 0.3
_WITHIN_NS = 2_000_000_000


@click.command("monitor")
@click.argument("target", metavar="[A]", required=False)
@click.argument("source", metavar="B", required=False)
@click.option("--robots", is_flag=True, help="Monitor robots rather than edges: one line for each.")
@click.option("--once", is_flag=True, help="Print one report, of the first second; give up after --timeout.")
@options.timeout_option("How long --once waits for the pose, or for a robot.")
@options.seconds_option
@options.robot_filter_option
@options.placer_option
@options.json_option()
@options.wire_option
@options.reading_clock_option
@options.metrics_option
@options.session_options
def monitor_command(
    *,
    network: SessionOptions,
    target: str | None,
    source: str | None,
    robots: bool,
    once: bool,
    timeout: float,
    seconds: float | None,
    robot: str,
    placers: tuple[str, ...] | None,
    wire: str,
    clock: str | None,
    metrics: BindAddress | None,
    as_json: bool,
) -> None:
    """Monitor each edge between the frames A and B, or all edges, until Ctrl-C.

    The table goes from A to B; each line is the edge from the frame of the line above. Without A and B,
    edges whose samples arrive together share a line, such as the joints of a robot. Figures of the last 5 s:
    rate; latency, from a sample's stamp to its arrival (median and maximum); jitter, the standard deviation
    of the time between arrivals. "missed" counts gaps in the writer's sequence numbers. "clock" is how far
    the writer's clock is ahead of this one, measured over the network.

    With --robots each robot has a line per second: rate, age of its newest sample, latency until a sample can
    be looked up, and counts since the start: received, dropped here, missed on the way, late (older than the
    history), refused, and off the clock (stamped more than a minute away from the time here). Rate, age and
    latency are those of its joint states, if it has any; transforms besides them, odometry and scans have a
    rate of their own. A robot with a driver has a second line, with the driver's state, and a line for each
    writer that reports a fault: late ticks, refused samples, no new ones, or odometry whose sensors
    contradict it.
    On a ROS wire this is /tf, all nodes together; with --robot, the joint states of a robot that has a
    description.

    \b
    zstate monitor
    zstate monitor panda_link0 panda_hand
    zstate monitor map r1/base_link --once --json | jq '.edges[] | {child, rate_hz}'
    zstate monitor odom base_link --wire ros2
    zstate monitor --robots
    zstate monitor --robots --robot panda --json --metrics 9100
    """
    from zstate.cli.edge_statistics import EdgeStatistics
    from zstate.nodes.listener import TransformListener

    if robots and target is not None:
        raise click.UsageError("--robots takes no frames; --robot NAME selects a robot")
    if robots and placers is not None:
        raise click.UsageError("--placer is for edges, which --robots does not show")
    if metrics is not None and not robots:
        raise click.UsageError("--metrics needs --robots")
    if target is not None and source is None:
        raise click.UsageError(f"{target!r} is one frame; give two frames, or none for all edges")
    options.check_end(seconds, once=once)
    follow, within_s = default_stream(wire), timeout if once else seconds
    with (
        open_session(network, (wire,)) as session,
        RobotDirectory(session, robot, wire) as directory,
        open_clock(session, clock, wire, timeout_s=within_s) as selected_clock,
        ExitStack() as opened,
    ):
        if robots:
            monitor = opened.enter_context(RobotMonitor(session, directory, robot, wire, selected_clock))
            if metrics is not None:
                rows = [listener_rows(monitor.robots), writer_rows(directory)]
                rows += opened.enter_context(plugin_rows(session, robot))
                opened.enter_context(serve_metrics(metrics, *rows))
            _report_robots(monitor, within_s, once=once, as_json=as_json)
            return
        listener = opened.enter_context(
            TransformListener(
                session,
                robot,
                wire=wire,
                follow=follow,
                clock=selected_clock,
                history_on_join=False,
                placers=placers,
            )
        )
        statistics = opened.enter_context(EdgeStatistics(session, robot, wire, follow, listener.buffer.clock))
        if target is None or source is None:
            monitored = AllEdges(listener, statistics, directory, within_s)
        else:
            monitored = PathEdges(listener, statistics, directory, within_s, (target, source))
        _report_edges(monitored, seconds, once=once, as_json=as_json)


def _report_edges(monitored: AllEdges, seconds: float | None, *, once: bool, as_json: bool) -> None:
    from zstate.clock import SystemClock
    from zstate.rate import Rate

    def report() -> None:
        if as_json:
            print_json(monitored.json())
        else:
            print_result(f"{monitored.text(output_width())}\n")

    monitored.wait()
    Event().wait(_FIRST_AFTER_S)
    if once:
        report()
    elif as_json or not is_terminal():
        for _ in Rate(1.0, SystemClock(), Event(), seconds):
            report()
    else:
        keep_showing(lambda: monitored.text(terminal_width()), seconds)


def _report_robots(monitor: RobotMonitor, within_s: float | None, *, once: bool, as_json: bool) -> None:
    from zstate.clock import SystemClock
    from zstate.rate import Rate

    forever = Event()
    forever.wait(_DISCOVERY_S)
    deadline = math.inf if within_s is None else time.monotonic() + within_s
    while reason := monitor.update():
        if time.monotonic() > deadline:
            fail(f"gave up after {within_s:g} s: {reason}")
        forever.wait(_DISCOVERY_S)
    forever.wait(_FIRST_AFTER_S)
    for _ in Rate(1.0, SystemClock(), forever, 1.0 if once else within_s):
        monitor.report(as_json=as_json)
        monitor.update()


class AllEdges:
    """All edges that ``listener`` receives, as measured."""

    def __init__(
        self,
        listener: TransformListener,
        statistics: EdgeStatistics,
        directory: RobotDirectory,
        within_s: float | None,
    ) -> None:
        self._listener, self._statistics, self._directory = listener, statistics, directory
        self._within_s = within_s

    def wait(self) -> None:
        """Wait until there are edges; prints what is missing, and fails after ``within_s``."""
        from zstate.cli.waiting import ConditionWaiter

        def reason() -> str:
            robot, robots = self._listener.robot, self._directory.robots()
            return self._directory.messages.missing_text(robot, "robot_description", robots, has_frames=False)

        waiter = ConditionWaiter()
        self._listener.add_observer(waiter.notify)
        if not waiter.wait_for(self._rows, self._within_s, reason):
            fail(f"gave up after {self._within_s:g} s: {reason()}")

    def text(self, width: int | None) -> str:
        from zstate.cli.edge_statistics import overview_text

        return self._directory.messages.translate(overview_text(self._rows(), width=width))

    def json(self) -> dict[str, Any]:
        return {"edges": [row.json() for row in self._rows()]}

    def _rows(self) -> list[EdgeRow]:
        frames = self._listener.buffer.frames()
        return [self._row(frame.name, frame) for frame in frames if frame.parent is not None]

    def _row(self, frame: str, edge: FrameInfo | None) -> EdgeRow:
        from zstate.buffer.buffer import feed_of
        from zstate.cli.edge_statistics import EdgeRow

        if edge is None:
            return EdgeRow(frame, None, None, None)
        offset = feed_of(self._listener.buffer).clock_offsets.get(edge.writer or "")
        return EdgeRow(frame, edge, self._statistics.measure(edge), None if offset is None else offset())


class PathEdges(AllEdges):
    """The edges on the path between two frames, as measured, and the pose."""

    def __init__(
        self,
        listener: TransformListener,
        statistics: EdgeStatistics,
        directory: RobotDirectory,
        within_s: float | None,
        frames: tuple[str, str],
    ) -> None:
        from zstate.cli.waiting import PoseWaiter

        super().__init__(listener, statistics, directory, within_s)
        self._frames = frames
        self._pose = PoseWaiter(listener, directory, *frames)

    def wait(self) -> None:
        self._wait()

    def _wait(self) -> Transform:
        return self._pose.wait(timeout_s=self._within_s)

    def text(self, width: int | None) -> str:
        from zstate.cli.edge_statistics import path_text, time_text

        transform, (target, source) = self._wait(), self._frames
        age_s = self._pose.age_s(transform)
        newest = "at any time (static)" if transform.stamp is None else "there"
        if age_s is not None:
            newest = f"the newest is {time_text(age_s)} old"
        table = path_text(self._rows(), width=width)
        return self._pose.translate(f"pose of {source} in {target}: {newest}\n{table}")

    def json(self) -> dict[str, Any]:
        transform, (target, source) = self._wait(), self._frames
        return {
            "target": target,
            "source": source,
            "stamp": transform.stamp,
            "age_s": self._pose.age_s(transform),
            "edges": [row.json() for row in self._rows()[1:]],
        }

    def _rows(self) -> list[EdgeRow]:
        frames = self._listener.buffer.path_frames(*self._frames)
        return [self._row(name, edge) for name, edge in frames]


@dataclass(eq=False)
class MonitoredRobot:
    """One robot and its listener, which may listen to other robots, too."""

    robot: str
    follow: Follow
    listener: TransformListener
    buffer: MeteredBuffer

    @property
    def stats(self) -> ListenerStats:
        return self.listener.stats_of(self.robot)


class RobotMonitor(Closeable):
    """Listens to the selected robots that are announced: one listener for all with the same stream."""

    def __init__(
        self, session: Session, directory: RobotDirectory, robot: str, wire: str, clock: Clock | None
    ) -> None:
        from zstate.net.sites import NO_SITES, discover_sites
        from zstate.net.status_monitor import StatusMonitor
        from zstate.net.topic_statistics import TopicStatistics
        from zstate.wire.registry import get_wire

        self._selected = robot
        self._robot = None if robot == ANY else check_robot(robot)
        self._session, self._directory, self._wire, self._clock = session, directory, wire, clock
        self._sites = NO_SITES if is_ros(wire) else discover_sites(session)
        self._reported = ""
        self._listeners: dict[Follow, tuple[TransformListener, MeteredBuffer]] = {}
        self._robots: BoundedDict[str, MonitoredRobot] = BoundedDict()
        self._opened = ExitStack()
        self.drivers: DriverStateListener | None = None
        """Those of the native wire; other wires have none."""
        if is_own("driver"):
            from zstate.driving.driver_state import DriverStateListener

            self.drivers = self._opened.enter_context(DriverStateListener(session, robot))
        self._statuses = self._opened.enter_context(StatusMonitor(session, robot))
        counted = TopicStatistics(
            session, get_wire(wire), sources=lambda name, stream, _: ((name, stream),), clock=clock
        )
        self._counted = self._opened.enter_context(counted)
        # The streams with a rate apart from that of the joint states; on a ROS wire edges are on /tf, which
        # the listener counts.
        measured = [stream for stream in measured_streams() if not is_bulk(stream)]
        self._rated = (*edge_streams(), *measured)
        carried = filter(get_wire(wire).carries, measured) if is_ros(wire) else self._rated
        for stream in carried:
            counted.subscribe(stream, robot)

    def close(self) -> None:
        self._opened.close()

    def robots(self) -> list[MonitoredRobot]:
        return sorted(dict(self._robots).values(), key=lambda one: one.robot)

    def update(self) -> str:
        """Add robots that have appeared. While there is none, prints and returns what is missing."""
        directory, reason = self._directory, ""
        for info in directory.robots():
            if self._robot in (None, info.name):
                self._follow(info.name, directory.streams(info.name))
        if not self._robots and self._robot is not None:
            reason = directory.no_sample_text(self._robot, default_stream(self._wire))
        elif not self._robots:
            robots = directory.robots()
            reason = directory.messages.announced(robots) + ", but nothing that moves" * bool(robots)
        if reason and reason != self._reported:
            print_status(f"waiting: {reason}", event="waiting", robot=self._robot)
        self._reported = reason
        return reason

    def _follow(self, robot: str, streams: frozenset[StreamName]) -> None:
        """Follow a robot that has appeared, or whose joint states have."""
        from zstate.nodes.listener import TransformListener
        from zstate.nodes.metered_buffer import MeteredBuffer

        follow: Follow = "tf" if JOINT_STREAMS.isdisjoint(streams) else "joint_states"
        if is_ros(self._wire) and "tf" in streams:
            # All nodes share /tf. A selected robot means its joints, which need its model.
            is_described = self._robot is not None and {"joint_states", "robot_description"} <= streams
            follow = "joint_states" if is_described else "tf"
        known = self._robots.get(robot)
        if known is not None and follow in (known.follow, "tf"):
            return
        # A native listener also receives moving edges, and partial joint states as joint states.
        others: tuple[StreamName, ...] = (
            () if is_ros(self._wire) else ("partial_joint_states", *edge_streams())
        )
        shown: list[StreamName] = [stream for stream in (follow, *others) if stream in streams]
        if not shown:
            return
        if follow not in self._listeners:
            buffer = MeteredBuffer(self._clock)
            listener = TransformListener(
                self._session, self._selected, buffer, self._wire, follow, history_on_join=False
            )
            self._listeners[follow] = self._opened.enter_context(listener), buffer
        self._robots[robot] = MonitoredRobot(robot, follow, *self._listeners[follow])
        place = self._directory.messages.topics(robot, shown)
        print_status(f"following {place}", event="following", robot=robot)

    def report(self, *, as_json: bool) -> None:
        from zstate.cli.edge_statistics import time_text

        drivers = {} if self.drivers is None else self.drivers.states()
        for one in self.robots():
            measure, stats = one.buffer.measure(one.robot), one.stats
            driver = drivers.get(one.robot)
            rates = self._own_rates(one.robot, measure)
            faulty = [status for status in self._statuses.recent(one.robot) if status.level != "ok"]
            if as_json:
                facts = {"robot": one.robot, **asdict(measure), **self._rate_facts(rates), **asdict(stats)}
                facts["site"] = self._sites.site_of(one.robot)
                facts["driver"] = None if driver is None else _driver_facts(driver)
                print_json({**facts, "faults": list(map(_fault_facts, faulty))})
                continue
            statistics = one.buffer.statistics_of(one.robot)
            rate = _rate_text(statistics, measure.rate_hz)
            for stream, rate_hz in rates.items():
                rate += f"  {stream} {rate_text(rate_hz) if rate_hz else 'silent'}"
            reasons = ", ".join(f"{reason} {count}" for reason, count in stats.refused.items())
            thinning = self._sites.thinning(one.robot, one.follow)
            is_thinned = thinning is not None and thinning.explains(statistics.window())
            gaps = "held back on purpose" if is_thinned else "missed"
            print_wrapped(
                f"{one.robot}  {rate}  "
                f"age {time_text(measure.age_s)}  latency {time_text(measure.latency_s)}  "
                f"received {stats.received}  dropped {stats.dropped}  {gaps} {stats.missed}  "
                f"late {stats.late}  refused {sum(stats.refused.values())}"
                f"{f' ({reasons})' if reasons else ''}"
                f"{f'  off the clock {stats.off_clock}' if stats.off_clock else ''}"
            )
            if driver is not None:
                print_wrapped(f"{one.robot}  driver {_driver_text(driver)}")
            for status in faulty:
                print_wrapped(printable(f"{one.robot}  {status.level}  {_program(status)}: {status.text}"))

    def _own_rates(self, robot: str, measure: RobotMeasure) -> dict[StreamName, float]:
        """The rates of streams other than the joint states, 0 for those that are silent."""
        rates: dict[StreamName, float] = {}
        for stream in self._rated:
            counted = self._counted.get((robot, stream))
            if counted is not None:
                window = counted.recent(_WITHIN_NS)
                rates[stream] = 0.0 if window is None or counted.is_stale() else window.rate_hz or 0.0
        if measure.transforms_hz is None:
            rates.pop("transforms", None)  # they are its samples
        elif is_ros(self._wire):
            rates["transforms"] = measure.transforms_hz
        return rates

    def _rate_facts(self, rates: Mapping[StreamName, float]) -> dict[str, float | None]:
        return {f"{stream}_hz": rates.get(stream) for stream in self._rated}


def _program(status: Status) -> str:
    return f"{status.program}@{status.host} pid {status.pid}"


def _fault_facts(status: Status) -> dict[str, str]:
    return {"writer": _program(status), "level": status.level, "text": status.text}


def _driver_text(driver: ReceivedState) -> str:
    """The state of a driver, the age of its newest command, and counts since its start."""
    from zstate.cli.edge_statistics import time_text

    state = driver.state
    age_s = None if state.command_age is None else state.command_age * 1e-9
    waited = "" if state.transit_excess is None else f", waited {time_text(state.transit_excess * 1e-9)}"
    reasons = ", ".join(f"{reason} {count}" for reason, count in state.refused.items())
    limited = ", ".join(state.limited)
    return printable(
        f"{driver}  loop {rate_text(state.rate_hz)}  skipped {state.skipped}  faults {state.faults}  "
        f"command age {time_text(age_s)}{waited}  refused {sum(state.refused.values())}"
        f"{f' ({reasons})' if reasons else ''}"
        f"{f'  slowed by limits {limited}' if limited else ''}"
        f"{f'  last motion {driver.last_motion}' if driver.last_motion else ''}"
    )


def _driver_facts(driver: ReceivedState) -> dict[str, Any]:
    """The same for JSON: the fields of its state, ages in seconds."""
    state = driver.state
    names = ("program", "state", "reason", "commander", "rate_hz", "ticks", "skipped", "faults", "refused")
    facts: dict[str, Any] = {name: getattr(state, name) for name in names}
    facts["command_age_s"] = None if state.command_age is None else state.command_age * 1e-9
    facts["transit_excess_s"] = None if state.transit_excess is None else state.transit_excess * 1e-9
    facts["motion_progress"] = None if state.motion is None else state.progress
    return {**facts, "last_motion": driver.last_motion, "age_s": driver.age_s}


def _rate_text(statistics: IntervalStatistics, rate_hz: float | None) -> str:
    return "silent" if statistics.is_stale() else rate_text(rate_hz)
