"""zstate monitor: how the samples behind one pose come in, edge by edge."""

from __future__ import annotations

from threading import Event
from typing import TYPE_CHECKING, Any, NoReturn

import click

from zstate.cli.console import is_terminal, say, say_json, terminal_width
from zstate.cli.network import Network, open_session
from zstate.cli.options import (
    heard_robot_option,
    json_option,
    reading_clock_option,
    session_options,
    timeout_option,
    wire_option,
)
from zstate.cli.roster import Roster
from zstate.cli.words import followed
from zstate.errors import duration_text

if TYPE_CHECKING:
    from zstate.cli.awaited_pose import AwaitedPose
    from zstate.cli.monitor.meter import PathMeter
    from zstate.cli.monitor.report import Row
    from zstate.listener import TransformListener
    from zstate.transform import Transform

_FIRST_AFTER_S = 1.0


@click.command("monitor")
@click.argument("target", metavar="A")
@click.argument("source", metavar="B")
@click.option("--once", is_flag=True, help="Print one report, of the first second; give up after --timeout.")
@timeout_option("How long --once waits for the pose.")
@heard_robot_option
@json_option()
@wire_option
@reading_clock_option
@session_options
def monitor_command(
    *,
    network: Network,
    target: str,
    source: str,
    once: bool,
    timeout: float,
    robot: str,
    wire: str,
    clock: str | None,
    as_json: bool,
) -> None:
    """Watch each edge between the frames A and B, until Ctrl-C.

    The table goes from A to B: each line tells of the edge from the line above. Rate, latency (from a
    sample's stamp until it is here: the median and the longest) and jitter (the standard deviation of the
    time between arrivals) are those of the last five seconds; missed are gaps in the writer's numbers;
    clock is how far the writer's clock is ahead of the one here, measured over the network.

    \b
    zstate monitor panda_link0 panda_hand
    zstate monitor map r1/base_link --once --json | jq '.edges[] | {child, rate_hz}'
    zstate monitor odom base_link --wire ros2
    """
    from zstate.cli.awaited_pose import AwaitedPose
    from zstate.cli.clocks import open_clock
    from zstate.cli.monitor.meter import PathMeter
    from zstate.clock import SystemClock
    from zstate.listener import TransformListener
    from zstate.rate import Rate

    follow = followed(wire)
    with (
        open_session(network, (wire,)) as session,
        Roster(session, robot, wire) as roster,
        open_clock(session, clock, wire, timeout_s=timeout if once else None) as kept,
        TransformListener(
            session, robot, wire=wire, follow=follow, clock=kept, history_on_join=False
        ) as listener,
        PathMeter(session, robot, wire, follow, listener.buffer.clock) as meter,
    ):
        awaited = AwaitedPose(listener, roster, target, source)
        monitored = _Monitored(listener, awaited, meter, (target, source))
        awaited.answer(timeout_s=timeout if once else None)
        Event().wait(_FIRST_AFTER_S)
        if once:
            monitored.say(as_json=as_json)
        elif as_json or not is_terminal():
            for _ in Rate(1.0, SystemClock(), Event()):
                monitored.say(as_json=as_json)
        else:
            monitored.show()


class _Monitored:
    """One pose, and the edges on its path."""

    def __init__(
        self,
        listener: TransformListener,
        awaited: AwaitedPose,
        meter: PathMeter,
        frames: tuple[str, str],
    ) -> None:
        self._listener = listener
        self._awaited = awaited
        self._meter = meter
        self._target, self._source = frames

    def say(self, *, as_json: bool) -> None:
        """One report, once there is a pose."""
        transform = self._awaited.answer()
        rows = self._rows()
        if as_json:
            say_json(self._facts(transform, rows))
        else:
            say(f"{self._text(transform, rows, None)}\n")

    def show(self) -> NoReturn:
        """A report that keeps up to date."""
        from zstate.cli.live_text import keep_showing

        keep_showing(lambda: self._text(self._awaited.answer(), self._rows(), terminal_width()))

    def _rows(self) -> list[Row]:
        from zstate.cli.monitor.path import path_between
        from zstate.cli.monitor.report import Row

        buffer = self._listener.buffer
        begin, legs = path_between(buffer.frames(), self._target, self._source)
        rows = [Row(begin, None, None, None)]
        for leg in legs:
            ask = buffer.clock_offsets.get(leg.edge.writer or "")
            offset = None if ask is None else ask()
            rows.append(Row(leg.frame, leg.edge, self._meter.measure(leg.edge), offset))
        return rows

    def _text(self, transform: Transform, rows: list[Row], width: int | None) -> str:
        from zstate.cli.monitor.report import report_text

        head = f"pose of {self._source} in {self._target}: {self._newest(transform)}"
        return self._awaited.explained(f"{head}\n{report_text(rows, width=width)}")

    def _newest(self, transform: Transform) -> str:
        if transform.stamp is None:
            return "at any time (static)"
        age_s = self._awaited.age_s(transform)
        return "there" if age_s is None else f"the newest is {duration_text(round(age_s * 1e9))} old"

    def _facts(self, transform: Transform, rows: list[Row]) -> dict[str, Any]:
        return {
            "target": self._target,
            "source": self._source,
            "stamp": transform.stamp,
            "age_s": self._awaited.age_s(transform),
            "edges": [facts for row in rows if (facts := row.facts()) is not None],
        }
