"""zstate listen: how the samples of robots come in."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from threading import Event
from typing import TYPE_CHECKING

import click

from zstate.cli.console import note, say_fitted, say_json
from zstate.cli.metrics import of_listeners, of_writers, served
from zstate.cli.network import Network, open_session
from zstate.cli.options import json_option, metrics_option, reading_clock_option, session_options, wire_option
from zstate.cli.roster import Roster
from zstate.cli.words import followed, is_ros
from zstate.closing import Closing
from zstate.errors import duration_text
from zstate.following.bounded import remember

if TYPE_CHECKING:
    from zstate.cli.metered_buffer import Mark, Measure, MeteredBuffer
    from zstate.clock import Clock
    from zstate.following.tally import Stats
    from zstate.listener import Follow, TransformListener
    from zstate.metrics.endpoint import BindAddress
    from zstate.net.session import Session
    from zstate.wire.keys import Stream

# Meeting everybody takes less.
_MEETING_S = 0.3


@click.command("listen")
@click.argument("robot", default="*", metavar="[ROBOT]")
@json_option()
@wire_option
@reading_clock_option
@metrics_option
@session_options
def listen_command(
    *,
    network: Network,
    robot: str,
    as_json: bool,
    wire: str,
    clock: str | None,
    metrics: BindAddress | None,
) -> None:
    """Follow ROBOT, or all robots, and say once a second how their samples come in.

    Rate and age are measured here, latency is the median time from a sample's stamp until it can be
    looked up. The counts are those since the start: received, dropped here, missed on the way, late
    (older than the history) and refused; and those off the clock, whose stamps are more than a minute away
    from the time here. On ROS's side it follows /tf, all nodes together; joint states
    of a robot that is named and described.

    \b
    zstate listen
    zstate listen panda --json
    zstate listen --wire ros2:domain=5
    """
    from zstate.cli.clocks import open_clock
    from zstate.clock import SystemClock
    from zstate.rate import Rate

    with (
        open_session(network, (wire,)) as session,
        Roster(session, robot, wire) as roster,
        open_clock(session, clock, wire) as time,
        Ears(session, roster, robot, wire, time) as ears,
        served(metrics, of_listeners(ears.listeners), of_writers(roster)),
    ):
        forever = Event()
        forever.wait(_MEETING_S)
        for _ in Rate(1.0, SystemClock(), forever):
            for name, measure, stats in ears.measures():
                _show(name, measure, stats, as_json=as_json)
            ears.open_new()


@dataclass(eq=False)
class Ear:
    """One robot that is listened to: what its samples come to since ``mark``."""

    robot: str
    listener: TransformListener
    buffer: MeteredBuffer
    mark: Mark

    @property
    def stats(self) -> Stats:
        """The counts of its samples."""
        return self.listener.stats_of(self.robot)

    def measure(self) -> Measure:
        """How its samples came in since the last call."""
        since, self.mark = self.mark, self.buffer.meter_of(self.robot).mark()
        return self.buffer.measure(self.robot, since, self.mark)


class Ears(Closing):
    """Listens to the robots that are wanted and announced: one listener for all that follow one stream."""

    def __init__(self, session: Session, roster: Roster, robot: str, wire: str, clock: Clock | None) -> None:
        from zstate.wire.keys import ANY, check_robot

        self._wanted = robot
        self._robot = None if robot == ANY else check_robot(robot)
        self._session = session
        self._wire = wire
        self._roster = roster
        self._clock = clock
        self._said = ""
        self._listeners: dict[Follow, tuple[TransformListener, MeteredBuffer]] = {}
        self._ears: dict[str, Ear] = {}
        self._opened = ExitStack()

    def close(self) -> None:
        self._opened.close()

    def listeners(self) -> list[Ear]:
        """Those that are open."""
        return list(self._ears.copy().values())

    def open_new(self) -> None:
        """Listen to robots that have appeared; says what is waited for while there is none."""
        for info in self._roster.robots():
            if self._robot in (None, info.name) and info.name not in self._ears:
                self._open(info.name, self._roster.streams(info.name))
        reason = "" if self._ears else self._reason()
        if reason and reason != self._said:
            note(f"waiting: {reason}", event="waiting", robot=self._robot)
        self._said = reason

    def _open(self, robot: str, streams: frozenset[Stream]) -> None:
        follow = self._followed(streams)
        if follow in streams:
            listener, buffer = self._listeners.get(follow) or self._listen(follow)
            remember(self._ears, robot, Ear(robot, listener, buffer, buffer.meter_of(robot).mark()))
            note(f"following {self._roster.words.place(robot, (follow,))}", event="following", robot=robot)

    def _listen(self, follow: Follow) -> tuple[TransformListener, MeteredBuffer]:
        from zstate.cli.metered_buffer import MeteredBuffer
        from zstate.listener import TransformListener

        buffer = MeteredBuffer(self._clock)
        listener = self._opened.enter_context(
            TransformListener(self._session, self._wanted, buffer, self._wire, follow, history_on_join=False)
        )
        self._listeners[follow] = listener, buffer
        return listener, buffer

    def _followed(self, streams: frozenset[Stream]) -> Follow:
        if is_ros(self._wire) and "tf" in streams:
            # /tf is everybody's: whoever names a robot means its joints, which a model makes sense of.
            is_one = self._robot is not None and {"joint_states", "robot_description"} <= streams
            return "joint_states" if is_one else "tf"
        return "joint_states" if "joint_states" in streams else "tf"

    def _reason(self) -> str:
        if self._robot is not None:
            return self._roster.silence(self._robot, followed(self._wire))
        robots = self._roster.robots()
        return self._roster.words.announced(robots) + ", but nothing that moves" * bool(robots)

    def measures(self) -> Iterator[tuple[str, Measure, Stats]]:
        """How the samples of each robot came in since the last call."""
        for robot, ear in sorted(self._ears.items()):
            yield robot, ear.measure(), ear.stats


def _show(robot: str, measure: Measure, stats: Stats, *, as_json: bool) -> None:
    if as_json:
        say_json({"robot": robot, **asdict(measure), **asdict(stats)})
        return
    say_fitted(
        f"{robot}  {measure.rate_hz:.1f} Hz  age {_time_text(measure.age_s)}  "
        f"latency {_time_text(measure.latency_s)}  received {stats.received}  dropped {stats.dropped}  "
        f"missed {stats.missed}  late {stats.late}  refused {_refused_text(stats.refused)}"
        f"{f'  off the clock {stats.off_clock}' if stats.off_clock else ''}"
    )


def _time_text(seconds: float | None) -> str:
    return "-" if seconds is None else duration_text(round(seconds * 1e9))


def _refused_text(refused: dict[str, int]) -> str:
    reasons = ", ".join(f"{reason} {count}" for reason, count in refused.items())
    return f"{sum(refused.values())}{f' ({reasons})' if reasons else ''}"
