"""zstate replay: what was recorded, said again."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

import click

from zstate.cli.options import checked_seconds, session_options, takeover_option, wires_option
from zstate.cli.output.console import fail, is_terminal, print_status, print_wrapped
from zstate.cli.session import SessionOptions, open_session
from zstate.errors import InvalidInput

if TYPE_CHECKING:
    from zstate.cli.processes import BackgroundCall
    from zstate.recording.player import Player, PlayerReport

_LINE_S = 1.0
_REFRESH_S = 0.1


def _checked_rate(_: click.Context, __: click.Parameter, rate: float) -> float:
    from zstate.recording.player_clock import check_speed

    try:
        return check_speed(rate)
    except InvalidInput as error:
        raise click.BadParameter(str(error)) from None


@click.command("replay")
@click.argument("file", type=click.Path(exists=True))
@click.argument("robots", metavar="[ROBOT]...", nargs=-1)
@click.option(
    "--rate",
    type=float,
    default=1.0,
    show_default=True,
    callback=_checked_rate,
    metavar="X",
    help="Recorded seconds a second; inf: as fast as it can.",
)
@click.option(
    "--start",
    type=click.FloatRange(min=0.0),
    default=0.0,
    metavar="S",
    help="Begin so long after the recording's beginning [s].",
)
@click.option(
    "--duration", type=float, callback=checked_seconds, metavar="S", help="Replay so much of it [s]."
)
@click.option("--loop", is_flag=True, help="Begin again at the end, until Ctrl-C.")
@wires_option
@takeover_option
@session_options
def replay_command(
    *,
    file: str,
    robots: tuple[str, ...],
    rate: float,
    start: float,
    duration: float | None,
    loop: bool,
    wires: tuple[str, ...],
    takeover: bool,
    network: SessionOptions,
) -> None:
    """Publish what FILE holds of ROBOTs, or of all there are, with the stamps it was recorded with.

    FILE is an MCAP file of `zstate record`, or a bag of ROS 2. The time of the recording is said on
    zstate/clock, and on /clock. Not where somebody else writes the same robots now.

    \b
    zstate replay run.mcap
    zstate replay run.mcap panda --rate 0.5 --start 30 --duration 10 --loop
    zstate replay bag_folder --wire ros2:domain=5
    """
    from zstate.cli.output.recording_text import conflicting_writers, replay_heading
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
            duration_s=duration,
            loop=loop,
            takeover=takeover,
        ) as replayer,
    ):
        live = conflicting_writers(session, replayer.robots, wires)
        if live and not takeover:
            fail(f"there is {'; '.join(live)} on the network already; end that first, or use --takeover")
        print_wrapped(replay_heading(replayer, file))
        _run(replayer)


def _run(replayer: Player) -> None:
    from zstate.cli.output.recording_text import replay_summary

    worker = BackgroundCall("zstate replay", replayer.run)
    try:
        report = _show(replayer, worker)
    except SystemExit:
        replayer.close()
        print_wrapped(replay_summary(replayer.report()))
        raise
    print_wrapped(replay_summary(report))
    if not report.samples:
        fail("no sample was published; `zstate info` shows what the file holds")


def _show(replayer: Player, worker: BackgroundCall[PlayerReport]) -> PlayerReport:
    """Until it has ended."""
    from zstate.cli.output.recording_text import replay_line

    if not is_terminal():
        while (report := _result(worker, _LINE_S)) is None:
            print_status(replay_line(replayer))
        return report
    from rich.live import Live
    from rich.text import Text

    with Live(auto_refresh=False, transient=True) as live:
        while (report := _result(worker, _REFRESH_S)) is None:
            live.update(Text(replay_line(replayer)), refresh=True)
    return report


def _result(worker: BackgroundCall[PlayerReport], timeout_s: float) -> PlayerReport | None:
    with suppress(TimeoutError):
        return worker.result(timeout_s)
    return None
