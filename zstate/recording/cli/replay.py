"""zstate replay: playback of a recording."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

import click

from zstate.cli import options
from zstate.cli.output.console import count_text, fail, is_terminal, print_status, print_wrapped
from zstate.cli.session import SessionOptions, open_session
from zstate.errors import format_duration

if TYPE_CHECKING:
    from zstate.cli.processes import BackgroundCall
    from zstate.net.session import Session
    from zstate.recording.player import Player, PlayerReport

_LINE_S = 1.0
_REFRESH_S = 0.1


def _check_speed(rate: float) -> float:
    from zstate.recording.player_clock import check_speed

    return check_speed(rate)


@click.command("replay")
@click.argument("file", type=click.Path(exists=True))
@click.argument("robots", metavar="[ROBOT]...", nargs=-1)
@click.option(
    "--rate",
    type=options.number("X", _check_speed),
    default=1.0,
    show_default=True,
    help="Playback speed, 1 is real time; inf: as fast as possible.",
)
@click.option(
    "--start",
    type=click.FloatRange(min=0.0),
    default=0.0,
    metavar="S",
    help="Start S seconds after the start of the recording.",
)
@click.option("--seconds", type=options.SECONDS, metavar="N", help="Replay N seconds of the recording.")
@click.option("--loop", is_flag=True, help="Start again at the end, until Ctrl-C.")
@options.wires_option
@options.takeover_option
@options.session_options
def replay_command(
    *,
    file: str,
    robots: tuple[str, ...],
    rate: float,
    start: float,
    seconds: float | None,
    loop: bool,
    wires: tuple[str, ...],
    takeover: bool,
    network: SessionOptions,
) -> None:
    """Publish the ROBOTs in FILE, by default all, with their recorded stamps.

    FILE is an MCAP file of `zstate record`, or a ROS 2 bag. The time of the recording is published on
    zstate/clock, and on /clock for a ROS wire. Fails if the same robots have live writers, unless --takeover.

    Recorded commands of drivers are never published: a replay moves no hardware.

    A recording of maps alone, or of models and static edges, has no samples: they are published until Ctrl-C,
    or for --seconds.

    \b
    zstate replay run.mcap
    zstate replay run.mcap panda --rate 0.5 --start 30 --seconds 10 --loop
    zstate replay bag_folder --wire ros2:domain=5
    """
    from zstate.cli.processes import BackgroundCall
    from zstate.clock import format_stamp
    from zstate.recording.player import Player

    with (
        open_session(network, wires) as session,
        Player(
            session,
            file,
            robots,
            wires=wires,
            rate=rate,
            start_s=start,
            duration_s=seconds,
            loop=loop,
            takeover=takeover,
        ) as player,
    ):
        conflicts = _conflicting_writers(session, player.robots, wires)
        if conflicts and not takeover:
            fail(f"already published on the network: {'; '.join(conflicts)}; stop that, or use --takeover")
        first, last = player.span
        names = ", ".join(map(repr, player.robots))
        speed = "as fast as possible" if rate == float("inf") else f"at {rate:g} times its speed"
        span = f"{(last - first) / 1e9:.1f} s, {format_stamp(first)} to {format_stamp(last)}"
        if not player.has_samples:
            speed = "no samples; what is latched is published" + (" until Ctrl-C" if player.is_held else "")
        print_wrapped(f"replaying {names} from {file}: {span}, {speed}")
        call = BackgroundCall("zstate replay", player.run)
        try:
            report = _show(player, call)
        except SystemExit:
            player.close()
            print_wrapped(_summary(player))
            raise
        print_wrapped(_summary(player))
        if player.has_samples and not report.samples:
            fail("no sample was published; `zstate info` shows the contents of the file")


def _show(player: Player, call: BackgroundCall[PlayerReport]) -> PlayerReport:
    """Show progress until the playback has ended."""

    def wait(timeout_s: float) -> PlayerReport | None:
        with suppress(TimeoutError):
            return call.result(timeout_s)
        return None

    if not is_terminal():
        while (report := wait(_LINE_S)) is None:
            print_status(_line(player))
        return report
    from rich.live import Live
    from rich.text import Text

    with Live(auto_refresh=False, transient=True) as live:
        while (report := wait(_REFRESH_S)) is None:
            live.update(Text(_line(player)), refresh=True)
    return report


def _conflicting_writers(session: Session, robots: Sequence[str], wires: Sequence[str]) -> list[str]:
    """Writers on the network of streams that a replay of ``robots`` would publish."""
    from zstate.net.discovery import discover
    from zstate.recording.decode import further_streams
    from zstate.streams import JOINT_STREAMS
    from zstate.wire.registry import get_wire

    conflicts: list[str] = []
    for name in wires:
        wire = get_wire(name)
        # The name of a replayed robot on this wire: ROS has only namespaces.
        names = {wire.robot_from_key(wire.expression(robot, "joint_states")): robot for robot in robots}
        replayed = {
            *JOINT_STREAMS,
            "robot_description",
            "tf",
            *further_streams(),
        } - wire.shared
        for info in discover(session, wire=name):
            writers = {str(writer) for stream, writer in info.writers if stream in replayed}
            if info.name in names and writers:
                conflicts.append(f"{names[info.name]!r} by {', '.join(sorted(writers))}")
    return conflicts


def _line(player: Player) -> str:
    from zstate.clock import format_stamp

    first, last = player.span
    now, report = player.position, player.report()
    position = f"{(now - first) / 1e9:.1f} of {(last - first) / 1e9:.1f} s"
    late = format_duration(report.lateness_p99)
    return f"{position}  {format_stamp(now)}  {report.samples} samples  {report.rate:.2f}x  late {late}"


def _summary(player: Player) -> str:
    report = player.report()
    reasons = ", ".join(f"{reason} {count}" for reason, count in report.refused.items())
    refused = f"; not published: {reasons}" if reasons else ""
    if not player.has_samples:
        return f"replayed what is latched{refused}"
    late = (
        f"late by {format_duration(report.lateness_p50)} (median), {format_duration(report.lateness_p99)} "
        f"(p99), {format_duration(report.lateness_max)} (maximum)"
    )
    passes = f" in {report.passes} passes" if report.passes > 1 else ""
    delays = f"; fell {count_text(report.delays, 'time')} more than a second behind" if report.delays else ""
    return (
        f"replayed {count_text(report.samples, 'sample')}{passes} at {report.rate:.3f} times the speed, "
        f"{late}{delays}{refused}"
    )
