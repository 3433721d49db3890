"""zstate plot: joint positions, or the path of a frame, over time."""

from __future__ import annotations

from pathlib import Path

import click

from zstate.cli.options import checked_seconds, session_options, wire_option
from zstate.cli.output.console import count_text, fail, print_wrapped
from zstate.cli.output.wire_text import messages_for
from zstate.cli.robot_directory import only_robot
from zstate.cli.session import SessionOptions, open_session

_LIVE_S = 5.0
_FORMATS = (".png", ".svg", ".pdf")


def _checked_output(_: click.Context, __: click.Parameter, file: str | None) -> Path | None:
    if file is None:
        return None
    if Path(file).suffix.lower() not in _FORMATS:
        raise click.BadParameter(f"{file!r} ends with none of {', '.join(_FORMATS)}")
    return Path(file)


@click.command("plot")
@click.argument("robot", required=False)
@click.option("--joint", "joints", multiple=True, metavar="NAME", help="Only this joint; may be repeated.")
@click.option("--path", "frames", nargs=2, metavar="A B", help="The path of frame B in frame A instead.")
@click.option("--file", metavar="RECORDING", help="From a recording instead of live data.")
@click.option(
    "--start",
    type=float,
    callback=checked_seconds,
    metavar="S",
    help="Where to start in a recording [s]; default: 0.",
)
@click.option(
    "--seconds",
    type=float,
    callback=checked_seconds,
    metavar="N",
    help="Duration [s]; default: 5, or the whole recording.",
)
@click.option(
    "--output", callback=_checked_output, metavar="FILE", help="PNG, SVG or PDF; default: ROBOT.png or B.png."
)
@wire_option
@session_options
def plot_command(
    *,
    network: SessionOptions,
    robot: str | None,
    joints: tuple[str, ...],
    frames: tuple[str, str] | None,
    file: str | None,
    start: float | None,
    seconds: float | None,
    output: Path | None,
    wire: str,
) -> None:
    """Draw the joint positions of ROBOT over time, or the path of a frame, into a file.

    Plots live data of the next seconds, or a recording. ROBOT may be left out if there is only one robot.
    Needs Matplotlib: pip install 'zstate[plot]'.

    \b
    zstate plot panda                                  # panda.png
    zstate plot panda --joint panda_joint1 --seconds 20 --output joint1.svg
    zstate plot --path panda_link0 panda_hand          # panda_hand.png
    zstate plot --file run.mcap --start 60 --seconds 10
    """
    from zstate.cli import plot

    plot.new_figure("", 1.0)  # reports a missing Matplotlib before it collects data
    if joints and frames:
        raise click.UsageError("--joint and --path exclude each other: they are different plots")
    if file is None and start is not None:
        raise click.UsageError("--start needs --file RECORDING")
    if file is not None:
        name, start_s = robot or Path(file).stem, start or 0.0
        if frames:
            series = plot.recorded_path(file, robot, frames, start_s, seconds)
        else:
            series = plot.recorded_joints(file, robot, start_s, seconds)
    else:
        with open_session(network, (wire,)) as session:
            name = robot or messages_for(wire).robot or ("*" if frames else only_robot(session))
            if frames:
                series = plot.live_path(session, name, wire, frames, seconds or _LIVE_S)
            else:
                series = plot.live_joints(session, name, wire, seconds or _LIVE_S)
    series = series.select(joints)
    if len(series.stamps) < 2:
        fail("fewer than two samples arrived, so there is no curve; use a longer --seconds")
    path = output or Path(f"{(frames[1] if frames else name).replace('/', '_')}.png")
    if frames:
        plot.draw_path(series, f"{frames[1]} in {frames[0]}", path)
    else:
        plot.draw_joints(series, f"{name}: joint positions", path)
    content = "the path" if frames else count_text(len(series.names), "curve")
    samples = count_text(len(series.stamps), "sample")
    print_wrapped(f"wrote {path}: {content}, {samples} in {series.seconds[-1]:.1f} s")
