"""zstate view: robots drawn in a browser, or in a picture file."""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import click

from zstate.cli import options
from zstate.cli.options import load_robot, open_clock, parse_models
from zstate.cli.output.console import count_text, fail, print_result, print_status
from zstate.cli.session import SessionOptions, open_session
from zstate.errors import InvalidInput

if TYPE_CHECKING:
    from zstate.model.robot import RobotModel
    from zstate.net.session import Session
    from zstate.view.camera import Camera
    from zstate.view.data_source import ViewSource
    from zstate.view.server import ViewServer
    from zstate.view.sliders import SliderPublisher
    from zstate.view.view import View

_RECORDINGS = (".mcap", ".db3")
_DISCOVERY_S = 0.3
_DRIVER_WITHIN_S = 0.5
_ANNOUNCED_WITHIN_S = 5.0
# Several robots are rarely announced at once.
_OTHERS_WITHIN_S = 0.5
_SAMPLES_WITHIN_S = 1.0
_ENDS_WITHIN_S = 0.8
_MAX_NAMED = 3


def _check_picture(file: str) -> Path:
    if Path(file).suffix.lower() != ".png":
        raise InvalidInput(f"{file!r} does not end with .png")
    return Path(file)


def _parse_camera(text: str) -> Camera:
    from zstate.view.camera import Camera

    eye, separator, target = text.partition(":")
    camera = Camera(_point(eye), _point(target) if separator else None)
    if camera.look_at == camera.position:
        raise InvalidInput(f"a camera at {eye} cannot look at the same point")
    return camera


def _point(text: str) -> tuple[float, float, float]:
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not all(map(math.isfinite, (x, y, z))):
        raise InvalidInput(f"{text!r} is not three numbers with commas between, such as 2,1.5,1")
    return x, y, z


@click.command("view")
@click.argument("robots", nargs=-1, metavar="[ROBOT [NAME:=VALUE]...]...")
@click.option(
    "--sliders",
    is_flag=True,
    help="Move robots from the page: command their drivers, or publish joint states.",
)
@click.option(
    "--host", default="127.0.0.1", show_default=True, help="Listen at this address; 0.0.0.0 is all of them."
)
@click.option(
    "--port", type=click.IntRange(0, 65535), help="0: any free port; default: the first free one from 8080."
)
@click.option("--rate", type=options.RATE, default=30.0, show_default=True, help="Updates per second [Hz].")
@click.option(
    "--snapshot",
    type=options.Checked("file", _check_picture),
    metavar="FILE.png",
    help="Write one picture and exit.",
)
@click.option(
    "--size",
    nargs=2,
    type=click.IntRange(16, 8192),
    default=(1280, 800),
    show_default=True,
    metavar="WIDTH HEIGHT",
    help="Size of that picture in pixels.",
)
@click.option("--fixed-frame", default="", metavar="FRAME", help="Initial fixed frame.")
@click.option(
    "--camera",
    type=options.Checked("X,Y,Z[:X,Y,Z]", _parse_camera),
    help="Initial position of the camera and, after the colon, the point it looks at [m, fixed frame]; "
    "default: all robots in sight.",
)
@click.option("--robot", "archived", metavar="ROBOT", help="The robot of an archive.")
@options.window_options
@options.placer_option
@options.wire_option
@options.reading_clock_option
@options.session_options
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
    archived: str | None,
    window: tuple[int, int] | None,
    placers: tuple[str, ...] | None,
    wire: str,
    clock: str | None,
) -> None:
    """Show the announced robots, or ROBOTs, in a browser.

    Prints the address to open. By default only this host can open it; from another host forward the port with
    ssh -L 8080:127.0.0.1:8080 HOST. With --host, other hosts can open it with the token in the printed
    address; the connection is not encrypted.

    With --sliders you move each ROBOT from the page: an announced robot, or a name or file as for `zstate
    publish`, with NAME:=VALUE for xacro. It must have no other writer of joint states than its driver. A
    ROBOT may also be a recording, or an archive with --robot and a window. --snapshot needs an installed
    Chromium, but no screen. Needs viser: pip install 'zstate[view]'.

    A robot with a driver has a stop button; it is no emergency stop. With --sliders a browser can take
    control of the driver. It then commands each joint from the first move of its slider, until it releases
    control or leaves the page, or the driver is stopped; the driver holds the joints.

    Meshes package://NAME/... are searched below the folders in ROS_PACKAGE_PATH, in share/ of those in
    AMENT_PREFIX_PATH, and in example-robot-data. Relative paths, and packages around the URDF file, are used
    only if that file is given as ROBOT. Robots without a common frame are drawn next to each other.

    Maps, and the last laser scans and clouds of each sensor, are drawn as soon as they are published; of a
    recording, those of the instant on display.

    \b
    zstate view
    zstate view panda --sliders
    zstate view arm.urdf.xacro prefix:=left_ --sliders
    zstate view run.mcap
    zstate view s3://plant/fleet --robot robot17 --at 2026-11-20T14:03    # a minute of an archive
    zstate view --wire ros2                 # robots of ROS 2 nodes that run rmw_zenoh
    zstate view panda --snapshot panda.png --camera 2,1,1:0,0,0.5
    zstate view urdf/arm.urdf               # announced robot 'arm', with the meshes near this file
    zstate view --host 0.0.0.0 --port 9000
    """
    from zstate.view import check_libraries

    check_libraries()  # before anything starts
    from zstate.cli.processes import BackgroundCall
    from zstate.model.load import is_path
    from zstate.recording.stores import opened_path
    from zstate.view.data_source import ViewSource
    from zstate.view.server import ViewServer
    from zstate.view.view import View
    from zstate.web_access import is_loopback

    models = parse_models(robots)
    files = _recordings(models, is_live=sliders or placers is not None, has_window=bool(archived or window))
    named = [
        _load_named(one, xacro_args)[0] if xacro_args or is_path(one) else NamedRobot(one)
        for one, xacro_args in ({} if files else models).items()
    ]
    with ExitStack() as opened:
        publishers: list[SliderPublisher] = []
        if files:
            recording = opened.enter_context(opened_path(files[0], archived, window))
            source = opened.enter_context(ViewSource.from_recording(recording.path))
        else:
            session = opened.enter_context(open_session(network, (wire,)))
            if sliders:
                moved = [(one, opened.enter_context(its)) for one, its in _open_sliders(session, named, wire)]
                named = [one for one, _ in moved]
                publishers = [its for _, its in moved if not _has_driver(session, its)]
            selected_clock = opened.enter_context(open_clock(session, clock, wire))
            source = opened.enter_context(
                ViewSource(
                    session,
                    [one.robot for one in named],
                    wire=wire,
                    clock=selected_clock,
                    placers=placers,
                )
            )
        page = opened.enter_context(ViewServer(port=0) if snapshot else ViewServer(host, port))
        view = opened.enter_context(
            View(
                source,
                page,
                sliders=publishers,
                can_command=sliders,
                rate_hz=rate,
                folders={one.model.urdf: one.folder for one in named if one.model and one.folder},
                fixed_frame=fixed_frame,
                camera=camera,
                aspect=size[0] / size[1] if snapshot else 1.0,
                receives_always=snapshot is not None,  # its browser is there for one picture
            )
        )
        stop = threading.Event()
        call = BackgroundCall("zstate view", lambda: view.run(stop))
        try:
            if snapshot is None:
                print_result(f"the view is at {page.url}")
                if not is_loopback(page.host):
                    print_status(
                        "anyone with this address can see the view and move sliders; it is sent unencrypted"
                    )
                elif os.environ.get("SSH_CONNECTION"):
                    tunnel = f"ssh -L {page.port}:127.0.0.1:{page.port} {os.uname().nodename}"
                    print_status(f"from your own machine: {tunnel}")
                call.result()
            else:
                names = tuple(one.robot for one in named)
                _write_snapshot(source, view, page, names, path=snapshot, size=size, fixed_frame=fixed_frame)
        finally:
            stop.set()
            with suppress(TimeoutError):
                call.result(_ENDS_WITHIN_S)


def _recordings(models: Collection[str], *, is_live: bool, has_window: bool) -> list[str]:
    """The only argument, if it is a recording or an archive. Raises UsageError for others beside it."""
    from zstate.recording.stores import find_store

    is_archive = any(map(find_store, models))
    files = [one for one in models if is_archive or Path(one).suffix in _RECORDINGS or Path(one).is_dir()]
    if has_window and not is_archive:
        raise click.UsageError("--robot, --at, --from and --to are for an archive: name it as ROBOT")
    if files and len(models) > 1:
        raise click.UsageError(f"a recording must be the only argument; got {', '.join(models)}")
    if files and is_live:
        raise click.UsageError("--sliders and --placer are for live robots, not those of a recording")
    return files


class NamedRobot(NamedTuple):
    """A ROBOT argument: the robot's name; for a local model also the model and the folder of its file."""

    robot: str
    model: RobotModel | None = None
    folder: Path | None = None


def _load_named(argument: str, xacro_args: Mapping[str, str] | None = None) -> tuple[NamedRobot, RobotModel]:
    from zstate.model.catalog import find_entry
    from zstate.model.load import is_path

    model, robot = load_robot(argument, None, xacro_args)
    path = Path(argument) if is_path(argument) else find_entry(argument).path
    return NamedRobot(robot, model, path.parent), model


def _open_sliders(
    session: Session, named: Sequence[NamedRobot], wire: str
) -> Iterator[tuple[NamedRobot, SliderPublisher]]:
    """Each of the ``named`` robots, by default all announced ones, with its sliders.

    A name is that of an announced robot; if no such robot is announced, that of a catalog model.
    """
    from zstate.net.discovery import discover
    from zstate.view.sliders import SliderPublisher

    within_s = _DISCOVERY_S if named else _ANNOUNCED_WITHIN_S
    announced = [info.name for info in discover(session, within_s, wire=wire)]
    if not named and not announced:
        fail("no robot is announced that could be moved; name one, as in `zstate view panda --sliders`")
    for one in named or map(NamedRobot, announced):
        selected, model = one, one.model
        if model is None and one.robot in announced:
            model = _receive_model(session, one.robot, wire)
        elif model is None:
            selected, model = _load_named(one.robot)
        yield selected, SliderPublisher(session, model, selected.robot, wires=(wire,))


def _has_driver(session: Session, sliders: SliderPublisher) -> bool:
    """Whether the robot of ``sliders`` is moved by its driver; prints any other reason for not moving it."""
    from zstate.driving.stops import wait_for_state

    robot = sliders.robot
    if not sliders.conflict:
        return False
    if wait_for_state(session, robot, lambda state: state.state != "off", _DRIVER_WITHIN_S) is not None:
        text = f"{robot!r} has a driver: the page commands it after a click, in its tab Joints"
        print_status(text, robot=robot)
        return True
    print_status(f"{robot!r} is not moved: {sliders.conflict}", robot=robot)
    return False


def _receive_model(session: Session, robot: str, wire: str) -> RobotModel:
    from zstate.view.data_source import ViewSource

    with ViewSource(session, (robot,), wire=wire) as source:
        if not _wait_for(source, lambda: robot in source.models, _ANNOUNCED_WITHIN_S):
            fail(f"{robot!r} is announced, but its model does not arrive; `zstate doctor {robot}` shows why")
        return source.models[robot]


def _write_snapshot(
    source: ViewSource,
    view: View,
    page: ViewServer,
    robots: Sequence[str],
    *,
    path: Path,
    size: tuple[int, int],
    fixed_frame: str,
) -> None:
    """Write a picture once ``robots`` have arrived, and print which robots and meshes are not in it."""
    from zstate.view.server import save_screenshot

    def has_models() -> bool:
        models = source.models
        return all(robot in models for robot in robots) if robots else bool(models)

    def has_frames() -> bool:
        moving = source.snapshot().tree.tracks_of
        return all(moving.get(robot) for robot in robots) if robots else bool(moving)

    # The transforms of a robot with a model may arrive first.
    if not _wait_for(source, has_models, _ANNOUNCED_WITHIN_S) and not has_frames():
        received = ", ".join(map(repr, source.robots())) or "none"
        expected = " and ".join(map(repr, robots)) or "any robot"
        fail(f"waited {_ANNOUNCED_WITHIN_S:g} s for {expected}; robots that were received: {received}")
    if fixed_frame and not _wait_for(
        source, lambda: fixed_frame in source.snapshot().tree.index, _ANNOUNCED_WITHIN_S
    ):
        source.snapshot().tree.row(fixed_frame)  # raises, with near misses
    if not robots and source.session is not None:
        time.sleep(_OTHERS_WITHIN_S)
    _wait_for(source, lambda: not source.snapshot().reasons, _SAMPLES_WITHIN_S)
    width, height = size
    save_screenshot(page, path, width=width, height=height, hold=view.hold)
    sights = view.visibility()
    seen = ", ".join(one.robot for one in sights if one.is_visible) or "no robot"
    print_result(f"wrote {path}: {seen}, {width} x {height} pixels")
    for one in sights:
        if one.reason:
            part = "partly in the picture" if one.is_visible else "not in the picture"
            print_status(f"{one.robot!r} is {part}: {one.reason}", robot=one.robot)
    roots = sorted({one.root for one in sights if one.is_visible})
    if len(roots) > 1:
        command = f"zstate static {roots[0]} {roots[1]} --xyz 1 0 0"
        print_status(
            f"the frames are in {len(roots)} trees ({_first_few(roots)}), drawn next to each other because "
            f"their relative pose is unknown; join them, for instance with: {command}"
        )
    missing = {uri: why for one in sights for uri, why in view.scene.missing_meshes(one.robot)}
    if missing:
        count = count_text(len(missing), "mesh file")
        files = _first_few([f"{uri} ({why})" for uri, why in missing.items()])
        print_status(f"{count} cannot be drawn: {files}")
        print_status(
            "packages are searched below ROS_PACKAGE_PATH and in share/ of AMENT_PREFIX_PATH; for a URDF "
            "file given as argument, as in `zstate view arm.urdf`, also around that file"
        )


def _first_few(lines: Sequence[str]) -> str:
    more = len(lines) - _MAX_NAMED
    return "; ".join(lines[:_MAX_NAMED]) + (f"; and {more} more" if more > 0 else "")


def _wait_for(source: ViewSource, condition: Callable[[], bool], timeout_s: float) -> bool:
    """Wait until ``condition()``, on the contents of ``source``, is true; False after ``timeout_s``."""
    from zstate.cli.waiting import ConditionWaiter

    waiter = ConditionWaiter()
    if source.listener is not None:
        source.listener.add_observer(waiter.notify)
    return waiter.wait_for(condition, timeout_s)
