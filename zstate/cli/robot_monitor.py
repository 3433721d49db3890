"""Robots that are announced, and how the samples of each arrive: `zstate monitor --robots`."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from zstate._util.bounded_dict import BoundedDict
from zstate.cli.metered_buffer import MeteredBuffer
from zstate.cli.output.console import duration_or_dash, print_json, print_status, print_wrapped, rate_text
from zstate.cli.robot_directory import RobotDirectory
from zstate.cli.words import followed, is_ros
from zstate.closing import Closing
from zstate.nodes.listener import TransformListener
from zstate.wire.keys import ANY, check_robot

if TYPE_CHECKING:
    from zstate.clock import Clock
    from zstate.ingest.counters import ListenerStats
    from zstate.net.session import Session
    from zstate.nodes.listener import Follow, TransformListener
    from zstate.wire.keys import Stream


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


class RobotMonitor(Closing):
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
                f"following {self._roster.words.place(robot, (follow,))}", event="following", robot=robot
            )

    def _listen(self, follow: Follow) -> tuple[TransformListener, MeteredBuffer]:
        from zstate.cli.metered_buffer import MeteredBuffer
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
            return self._roster.silence(self._robot, followed(self._wire))
        robots = self._roster.robots()
        return self._roster.words.announced(robots) + ", but nothing that moves" * bool(robots)

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


def _time_text(seconds: float | None) -> str:
    return duration_or_dash(None if seconds is None else round(seconds * 1e9))


def _refused_text(refused: dict[str, int]) -> str:
    reasons = ", ".join(f"{reason} {count}" for reason, count in refused.items())
    return f"{sum(refused.values())}{f' ({reasons})' if reasons else ''}"
