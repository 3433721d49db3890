"""zstate view: the robots, drawn in a browser.

What `zstate view` does around the view itself: whom it shows, whom it moves, and where.
"""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import click

from zstate.cli.options import (
    checked_rate,
    load_robot,
    open_clock,
    parse_models,
    reading_clock_option,
    session_options,
    wire_option,
)
from zstate.cli.output.console import count_text, fail, print_result, print_status
from zstate.cli.processes import BackgroundCall
from zstate.cli.session import SessionOptions, open_session
from zstate.cli.waiting import ConditionWaiter
from zstate.model.catalog import find_entry
from zstate.model.load import is_path
from zstate.model.robot import RobotModel
from zstate.net.presence import discover
from zstate.net.session import Session
from zstate.view.access import is_loopback
from zstate.view.camera import Sight
from zstate.view.data_source import ViewSource
from zstate.view.screenshot import save_screenshot
from zstate.view.server import ViewServer
from zstate.view.sliders import SliderPublisher
from zstate.view.view import View

if TYPE_CHECKING:
    from zstate.view.camera import Camera
    from zstate.view.sliders import SliderPublisher


def _checked_picture(_: click.Context, __: click.Parameter, file: str | None) -> Path | None:
    if file is not None and Path(file).suffix.lower() != ".png":
        raise click.BadParameter(f"{file!r} does not end with .png")
    return None if file is None else Path(file)


def _checked_camera(_: click.Context, __: click.Parameter, text: str | None) -> Camera | None:
    if text is None:
        return None
    from zstate.view.camera import Camera

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
    network: SessionOptions,
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

    from zstate.view.data_source import ViewSource
    from zstate.view.server import ViewServer
    from zstate.view.view import View

    models = parse_models(robots)
    recording = recording_among(tuple(models))
    if recording is not None and sliders:
        raise click.UsageError("--sliders moves robots that are here, not those of a recording")
    named = [] if recording is not None else named_robots(models)
    with ExitStack() as opened:
        moved: list[SliderPublisher] = []
        if recording is None:
            session = opened.enter_context(open_session(network, (wire,)))
            if sliders:
                chosen = [
                    (one, opened.enter_context(its)) for one, its in chosen_sliders(session, named, wire)
                ]
                named, moved = [one for one, _ in chosen], [its for _, its in chosen]
            kept = opened.enter_context(open_clock(session, clock, wire))
            world = opened.enter_context(
                ViewSource(session, [one.robot for one in named], wire=wire, clock=kept)
            )
        else:
            world = opened.enter_context(ViewSource.of_recording(recording))
        page = opened.enter_context(ViewServer(port=0) if snapshot else ViewServer(host, port))
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


_RECORDINGS = (".mcap", ".db3")
_MEETING_S = 0.3
_ANNOUNCED_WITHIN_S = 5.0
# Several robots are rarely announced at once.
_OTHERS_WITHIN_S = 0.5
_SAMPLES_WITHIN_S = 1.0
_ENDS_WITHIN_S = 0.8
_MOST_NAMED = 3


def recording_among(robots: Sequence[str]) -> Path | None:
    """The recording that is meant instead of robots."""
    files = [Path(one) for one in robots if Path(one).suffix in _RECORDINGS or Path(one).is_dir()]
    if files and len(robots) > 1:
        raise click.UsageError(f"a recording is viewed alone; got {', '.join(robots)}")
    return files[0] if files else None


class Named(NamedTuple):
    """A ROBOT argument: the robot's name, with its model and the folder of its file where it is local."""

    robot: str
    model: RobotModel | None = None
    folder: Path | None = None


def named_robots(models: Mapping[str, Mapping[str, str]]) -> list[Named]:
    """The robots behind ROBOT arguments and their xacro arguments: files that are read now, and names."""
    return [
        _local(one, xacro_args)[0] if xacro_args or is_path(one) else Named(one)
        for one, xacro_args in models.items()
    ]


def folders_of(named: Iterable[Named]) -> dict[str, Path]:
    """The folders of local robots by the text of their URDF."""
    return {one.model.urdf: one.folder for one in named if one.model is not None and one.folder is not None}


def _local(argument: str, xacro_args: Mapping[str, str] | None = None) -> tuple[Named, RobotModel]:
    model, robot = load_robot(argument, None, xacro_args)
    path = Path(argument) if is_path(argument) else find_entry(argument).path
    return Named(robot, model, path.parent), model


def chosen_sliders(
    session: Session, named: Sequence[Named], wire: str
) -> Iterator[tuple[Named, SliderPublisher]]:
    """Each robot that is named, or all that are announced, with its sliders.

    A name is an announced robot's; only where nobody announces it, it is one of the catalog.
    """
    within_s = _MEETING_S if named else _ANNOUNCED_WITHIN_S
    announced = [info.name for info in discover(session, within_s, wire=wire)]
    if not named and not announced:
        fail("no robot is announced that could be moved; name one, as in `zstate view panda --sliders`")
    for one in named or map(Named, announced):
        chosen, model = one, one.model
        if model is None and one.robot in announced:
            model = _announced_model(session, one.robot, wire)
        elif model is None:
            chosen, model = _local(one.robot)
        sliders = SliderPublisher(session, model, chosen.robot, wires=(wire,))
        if sliders.refusal:
            print_status(f"{chosen.robot!r} is not moved: {sliders.refusal}", robot=chosen.robot)
        yield chosen, sliders


def _announced_model(session: Session, robot: str, wire: str) -> RobotModel:
    with ViewSource(session, (robot,), wire=wire) as world:
        if not _wait_for(world, lambda: robot in world.models, _ANNOUNCED_WITHIN_S):
            fail(f"{robot!r} is announced, but not what it looks like; `zstate doctor {robot}` says more")
        return world.models[robot]


@contextmanager
def running(view: View) -> Generator[BackgroundCall[None]]:
    """The view at work, until this is left."""
    stop = threading.Event()
    worker = BackgroundCall("zstate view", lambda: view.run(stop))
    try:
        yield worker
    finally:
        stop.set()
        with suppress(TimeoutError):
            worker.result(_ENDS_WITHIN_S)


def show_address(page: ViewServer) -> None:
    """Say what to open, and how that is reached from elsewhere."""
    print_result(f"the view is at {page.url}")
    if not is_loopback(page.host):
        print_status("whoever has this address may look, and move what has sliders; it travels in the clear")
    elif os.environ.get("SSH_CONNECTION"):
        print_status(f"from your own machine: ssh -L {page.port}:127.0.0.1:{page.port} {os.uname().nodename}")


def take_snapshot(
    world: ViewSource,
    view: View,
    page: ViewServer,
    robots: Sequence[str],
    *,
    path: Path,
    size: tuple[int, int],
    fixed_frame: str = "",
) -> None:
    """Write one picture, once the robots are there, and name those that are in it, and not, and why."""
    if not _wait_for(world, lambda: _is_there(world, robots), _ANNOUNCED_WITHIN_S):
        there = ", ".join(map(repr, world.robots())) or "none"
        whom = " and ".join(map(repr, robots)) or "any robot"
        fail(f"waited {_ANNOUNCED_WITHIN_S:g} s for {whom}; robots that were heard: {there}")
    if fixed_frame and not _wait_for(
        world, lambda: fixed_frame in world.moment().tree.index, _ANNOUNCED_WITHIN_S
    ):
        world.moment().tree.row(fixed_frame)  # raises, with near misses
    if not robots and world.session is not None:
        time.sleep(_OTHERS_WITHIN_S)
    _wait_for(world, lambda: not world.moment().reasons, _SAMPLES_WITHIN_S)
    width, height = size
    save_screenshot(page, path, width=width, height=height, hold=view.hold)
    sights = view.sights()
    seen = ", ".join(one.robot for one in sights if one.is_seen) or "no robot"
    print_result(f"wrote {path}: {seen}, {width} x {height} pixels")
    _note_what_is_missing(view, sights)


def _note_what_is_missing(view: View, sights: Sequence[Sight]) -> None:
    """Notes on robots that are not in a picture, on those without a place of their own, and on meshes."""
    for one in sights:
        if one.reason:
            part = "in the picture in part" if one.is_seen else "not in the picture"
            print_status(f"{one.robot!r} is {part}: {one.reason}", robot=one.robot)
    roots = sorted({one.root for one in sights if one.is_seen})
    if len(roots) > 1:
        joined = f"zstate static {roots[0]} {roots[1]} --xyz 1 0 0"
        print_status(
            f"the frames are in {len(roots)} trees ({_first_few(roots)}), drawn beside each other: their "
            f"relative place is not known; join them, for instance with: {joined}"
        )
    missing = {uri: why for one in sights for uri, why in view.scene.missing_meshes(one.robot)}
    if missing:
        count = count_text(len(missing), "file")
        named = _first_few([f"{uri} ({why})" for uri, why in missing.items()])
        print_status(f"{count} of the robots cannot be drawn: {named}")
        print_status(
            "packages are found below ROS_PACKAGE_PATH and in share/ of AMENT_PREFIX_PATH; a URDF file that "
            "is named, as in `zstate view arm.urdf`, is drawn with the files around it"
        )


def _first_few(lines: Sequence[str]) -> str:
    more = len(lines) - _MOST_NAMED
    return "; ".join(lines[:_MOST_NAMED]) + (f"; and {more} more" if more > 0 else "")


def _is_there(world: ViewSource, robots: Sequence[str]) -> bool:
    models = world.models
    return all(robot in models for robot in robots) if robots else bool(models)


def _wait_for(world: ViewSource, condition: Callable[[], bool], timeout_s: float) -> bool:
    """Wait until ``condition()``, on what the world shows, is true; False after ``timeout_s``."""
    waiter = ConditionWaiter()
    if world.listener is not None:
        world.listener.add_observer(waiter.notify)
    return waiter.wait_for(condition, timeout_s)
