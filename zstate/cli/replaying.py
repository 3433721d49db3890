"""What a person is told of a replay, and who would be disturbed by it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from zstate.cli.output.console import count_text
from zstate.errors import duration_text

if TYPE_CHECKING:
    from zstate.net.session import Session
    from zstate.recording.player import Player, PlayerReport


def live_writers(session: Session, robots: Sequence[str], wires: Sequence[str]) -> list[str]:
    """Who writes now what a replay of ``robots`` would write as well."""
    from zstate.net.presence import discover
    from zstate.net.wires import wire_named

    found: list[str] = []
    for name in wires:
        wire = wire_named(name)
        # Under which name a replayed robot is seen there: ROS knows namespaces only.
        seen = {wire.robot_of(wire.expression(robot, "joint_states")): robot for robot in robots}
        written = {"joint_states", "robot_description", "tf"} - wire.shared
        for info in discover(session, wire=name):
            writers = {str(writer) for stream, writer in info.writers if stream in written}
            if info.name in seen and writers:
                found.append(f"{seen[info.name]!r} by {', '.join(sorted(writers))}")
    return found


def introduction(replayer: Player, file: str) -> str:
    """Which robots, when, and how fast."""
    from zstate.clock import stamp_text

    first, last = replayer.span
    robots = ", ".join(map(repr, replayer.robots))
    pace = "as fast as it can" if replayer.rate == float("inf") else f"at {replayer.rate:g} times its speed"
    took = f"{(last - first) / 1e9:.1f} s"
    return f"replaying {robots} from {file}: {took}, {stamp_text(first)} to {stamp_text(last)}, {pace}"


def progress_line(replayer: Player) -> str:
    """Where it is."""
    from zstate.clock import stamp_text

    first, last = replayer.span
    now, report = replayer.position, replayer.report()
    where = f"{(now - first) / 1e9:.1f} of {(last - first) / 1e9:.1f} s"
    late = duration_text(report.lateness_p99)
    return f"{where}  {stamp_text(now)}  {report.samples} samples  {report.rate:.2f}x  late {late}"


def report_text(report: PlayerReport) -> str:
    """What became of it."""
    late = (
        f"late by {duration_text(report.lateness_p50)} (median), {duration_text(report.lateness_p99)} "
        f"(99 of 100), {duration_text(report.lateness_max)} (at most)"
    )
    passes = f" in {report.passes} passes" if report.passes > 1 else ""
    delays = f"; fell {count_text(report.delays, 'time')} more than a second behind" if report.delays else ""
    reasons = ", ".join(f"{reason} {count}" for reason, count in report.refused.items())
    refused = f"; not published: {reasons}" if reasons else ""
    return (
        f"replayed {count_text(report.samples, 'sample')}{passes} at {report.rate:.3f} times the speed, "
        f"{late}{delays}{refused}"
    )
