"""zstate ls: the announced robots and who writes for them."""

from __future__ import annotations

import time
from dataclasses import asdict
from datetime import datetime
from typing import TYPE_CHECKING, Any

import click

from zstate.cli.console import note, say, say_json
from zstate.cli.layout import in_columns
from zstate.cli.network import Network, open_session
from zstate.cli.options import session_options
from zstate.cli.roster import announced_text
from zstate.errors import duration_text

if TYPE_CHECKING:
    from zstate.net.presence import RobotInfo
    from zstate.wire.writer import Writer


@click.command("ls")
@click.option("--json", "as_json", is_flag=True, help="One JSON array.")
@session_options
def ls_command(network: Network, as_json: bool) -> None:
    """List the announced robots and, for each stream, who writes it since when."""
    from zstate.net.presence import discover

    with open_session(network) as session:
        robots = discover(session)
    if as_json:
        say_json([_facts(robot) for robot in robots])
    elif robots:
        say("\n".join(_lines(robots)))
    else:
        note(announced_text(robots))


def _lines(robots: tuple[RobotInfo, ...]) -> list[str]:
    rows = in_columns(
        [(f"  {stream}", str(writer), _since(writer)) for robot in robots for stream, writer in robot.writers]
    )
    lines: list[str] = []
    for robot in robots:
        count = len(robot.writers)
        lines += [robot.name, *rows[:count]]
        rows = rows[count:]
    return lines


def _since(writer: Writer) -> str:
    began = datetime.fromtimestamp(writer.since // 1_000_000_000).astimezone()
    return f"since {began:%Y-%m-%d %H:%M:%S}, {_lasting(time.time_ns() - writer.since)}"


def _lasting(nanoseconds: int) -> str:
    minutes, seconds = divmod(nanoseconds // 1_000_000_000, 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {seconds:02d} s" if minutes else duration_text(nanoseconds)


def _facts(robot: RobotInfo) -> dict[str, Any]:
    writers = [{"stream": stream, **asdict(writer)} for stream, writer in robot.writers]
    return {"robot": robot.name, "writers": writers}
