"""zstate view: the robots, drawn in a browser."""

from __future__ import annotations

import math
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import click

from zstate.cli.network import Network, open_session
from zstate.cli.options import (
    checked_rate,
    named_models,
    open_clock,
    reading_clock_option,
    session_options,
    wire_option,
)

if TYPE_CHECKING:
    from zstate.view.framing import Camera
    from zstate.view.sliders import Sliders


def _checked_picture(_: click.Context, __: click.Parameter, file: str | None) -> Path | None:
    if file is not None and Path(file).suffix.lower() != ".png":
        raise click.BadParameter(f"{file!r} does not end with .png")
    return None if file is None else Path(file)


def _checked_camera(_: click.Context, __: click.Parameter, text: str | None) -> Camera | None:
    if text is None:
        return None
    from zstate.view.framing import Camera

    eye, separator, target = text.partition(":")
    camera = Camera(_point(eye), _point(target) if separator else None)
    if camera.look_at == camera.position:
        raise click.BadParameter(f"a camera at {eye} cannot look at the same point")
    return camera


def _point(text: str) -> tuple[float, float, float]:
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not all(map(math.isfinite, (x, y, z))):
        raise click.BadParameter(f"{text!r} is not three numbers with commas between, such as 2,1.5,1")
    return x, y, z


@click.command("view")
@click.argument("robots", nargs=-1, metavar="[ROBOT [NAME:=VALUE]...]...")
@click.option("--sliders", is_flag=True, help="Move the robots from the page, and publish what they do.")
@click.option(
    "--host", default="127.0.0.1", show_default=True, help="Where to listen; 0.0.0.0 is everywhere."
)
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    help="0 is any that is free; default: the first free one from 8080 on.",
)
@click.option(
    "--rate",
    type=float,
    default=30.0,
    show_default=True,
    callback=checked_rate,
    help="Pictures a second [Hz].",
)
@click.option("--snapshot", callback=_checked_picture, metavar="FILE.png", help="Write one picture, and end.")
@click.option(
    "--size",
    nargs=2,
    type=click.IntRange(16, 8192),
    default=(1280, 800),
    show_default=True,
    metavar="WIDTH HEIGHT",
    help="Of that picture, in pixels.",
)
@click.option("--fixed-frame", default="", metavar="FRAME", help="See everything from this frame at first.")
@click.option(
    "--camera",
    callback=_checked_camera,
    metavar="X,Y,Z[:X,Y,Z]",
    help="Where the camera stands at first, and after a colon the point it looks at, in the fixed frame [m]; "
    "default: so that all robots are seen.",
)
@wire_option
@reading_clock_option
@session_options
def view_command(
    *,
    network: Network,
    robots: tuple[str, ...],
    sliders: bool,
    host: str,
    port: int | None,
    rate: float,
    snapshot: Path | None,
    size: tuple[int, int],
    fixed_frame: str,
    camera: Camera | None,
    wire: str,
    clock: str | None,
) -> None:
    """Draw the announced robots, or those that are named, in a browser.

    Prints the address to open. It is for this machine only; from another one, forward its port:
    ssh -L 8080:127.0.0.1:8080 HOST. With --host others may open it too, who have the token in the
    address that is printed; what they see travels in the clear.

    With --sliders each ROBOT is moved from the page. It is a robot that is announced, or a name or file
    as `zstate publish` takes it, with NAME:=VALUE for xacro, and nobody else may write its joints. A ROBOT
    may also be a recording. --snapshot draws with an installed Chromium, without a screen.
    Needs viser: pip install 'zstate[view]'.

    Meshes named package://NAME/... are found below the folders in ROS_PACKAGE_PATH, in share/ of those in
    AMENT_PREFIX_PATH, and in example-robot-data. Other files are drawn only for a robot whose URDF file is
    given as ROBOT: then also relative paths, and packages around the file. Robots that share no frame are
    drawn beside each other.

    \b
    zstate view
    zstate view panda --sliders
    zstate view arm.urdf.xacro prefix:=left_ --sliders
    zstate view run.mcap
    zstate view --wire ros2                 # robots of ROS 2 nodes that run rmw_zenoh
    zstate view panda --snapshot panda.png --camera 2,1,1:0,0,0.5
    zstate view urdf/arm.urdf               # 'arm' on the network, with the meshes beside this file
    zstate view --host 0.0.0.0 --port 9000
    """
    import_module("zstate.view.library")  # told before anything is heard when it is missing

    from zstate.cli.viewing import (
        chosen_sliders,
        folders_of,
        named_robots,
        recording_among,
        running,
        show_address,
        take_snapshot,
    )
    from zstate.view.page import Page
    from zstate.view.view import View
    from zstate.view.world import World

    models = named_models(robots)
    recording = recording_among(tuple(models))
    if recording is not None and sliders:
        raise click.UsageError("--sliders moves robots that are here, not those of a recording")
    named = [] if recording is not None else named_robots(models)
    with ExitStack() as opened:
        moved: list[Sliders] = []
        if recording is None:
            session = opened.enter_context(open_session(network, (wire,)))
            if sliders:
                chosen = [
                    (one, opened.enter_context(its)) for one, its in chosen_sliders(session, named, wire)
                ]
                named, moved = [one for one, _ in chosen], [its for _, its in chosen]
            kept = opened.enter_context(open_clock(session, clock, wire))
            world = opened.enter_context(World(session, [one.robot for one in named], wire=wire, clock=kept))
        else:
            world = opened.enter_context(World.of_recording(recording))
        page = opened.enter_context(Page(port=0) if snapshot else Page(host, port))
        view = opened.enter_context(
            View(
                world,
                page,
                sliders=moved,
                rate_hz=rate,
                folders=folders_of(named),
                fixed_frame=fixed_frame,
                camera=camera,
                aspect=size[0] / size[1] if snapshot else 1.0,
            )
        )
        with running(view) as worker:
            if snapshot is None:
                show_address(page)
                worker.result()
            else:
                robots = tuple(one.robot for one in named)
                take_snapshot(world, view, page, robots, path=snapshot, size=size, fixed_frame=fixed_frame)
