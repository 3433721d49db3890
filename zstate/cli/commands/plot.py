"""zstate plot: joint positions, or the path of a frame, over time."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import click

from zstate.cli.network import Network, open_session
from zstate.cli.options import checked_seconds, session_options, wire_option
from zstate.cli.output.console import count_text, fail, print_wrapped
from zstate.cli.robot_directory import only_robot
from zstate.cli.words import words_of

if TYPE_CHECKING:
    from zstate.cli.plot.curves import Curves
    from zstate.net.session import Session

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
@click.option("--file", metavar="RECORDING", help="From a recording, instead of what is said now.")
@click.option(
    "--start",
    type=float,
    callback=checked_seconds,
    metavar="S",
    help="In a recording: from so long after its begin [s].",
)
@click.option(
    "--seconds",
    type=float,
    callback=checked_seconds,
    metavar="N",
    help="So long [s]; default: 5, or all of a recording.",
)
@click.option(
    "--output", callback=_checked_output, metavar="FILE", help="PNG, SVG or PDF; default: ROBOT.png or B.png."
)
@wire_option
@session_options
def plot_command(
    *,
    network: Network,
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

    What is said in the next seconds, or what a recording holds. ROBOT may be left out where there is
    only one. Needs Matplotlib: pip install 'zstate[plot]'.

    \b
    zstate plot panda                                  # panda.png
    zstate plot panda --joint panda_joint1 --seconds 20 --output joint1.svg
    zstate plot --path panda_link0 panda_hand          # panda_hand.png
    zstate plot --file run.mcap --start 60 --seconds 10
    """
    import_module("zstate.cli.plot.figure")  # told before anything is heard when Matplotlib is missing

    if joints and frames:
        raise click.UsageError("--joint and --path are two different pictures; give one of them")
    if file is None and start is not None:
        raise click.UsageError("--start is for recordings: --file RECORDING")
    if file is not None:
        name = robot or Path(file).stem
        curves = _recorded(file, robot, frames, start or 0.0, seconds)
    else:
        with open_session(network, (wire,)) as session:
            name = robot or words_of(wire).robot or ("*" if frames else only_robot(session))
            curves = _live(session, name, wire, frames, seconds or _LIVE_S)
    _draw(curves.chosen(joints), name, frames, output)


def _recorded(
    file: str, robot: str | None, frames: tuple[str, str] | None, start_s: float, seconds: float | None
) -> Curves:
    from zstate.cli.plot.sources import recorded_joints, recorded_path

    if frames:
        return recorded_path(file, robot, frames, start_s, seconds)
    return recorded_joints(file, robot, start_s, seconds)


def _live(session: Session, robot: str, wire: str, frames: tuple[str, str] | None, seconds: float) -> Curves:
    from zstate.cli.plot.sources import live_joints, live_path

    if frames:
        return live_path(session, robot, wire, frames, seconds)
    return live_joints(session, robot, wire, seconds)


def _draw(curves: Curves, name: str, frames: tuple[str, str] | None, output: Path | None) -> None:
    from zstate.cli.plot.figure import draw_joints, draw_path

    if len(curves.stamps) < 2:
        fail("a single sample makes no curve; give it more time: --seconds")
    path = output or Path(f"{(frames[1] if frames else name).replace('/', '_')}.png")
    if frames:
        draw_path(curves, f"{frames[1]} in {frames[0]}", path)
    else:
        draw_joints(curves, f"{name}: joint positions", path)
    what = "the path" if frames else count_text(len(curves.names), "curve")
    lasted = curves.seconds[-1]
    print_wrapped(f"wrote {path}: {what}, {count_text(len(curves.stamps), 'sample')} in {lasted:.1f} s")
