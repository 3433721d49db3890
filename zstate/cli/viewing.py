"""What `zstate view` does around the view itself: whom it shows, whom it moves, and where."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import click

from zstate.cli.options import load_robot
from zstate.cli.output.console import count_text, fail, print_result, print_status
from zstate.cli.processes import BackgroundCall
from zstate.cli.waiting import ConditionWaiter
from zstate.model.catalog import is_path
from zstate.model.known import find
from zstate.model.robot import RobotModel
from zstate.net.presence import discover
from zstate.net.session import Session
from zstate.view.door import is_loopback
from zstate.view.framing import Sight
from zstate.view.page import Page
from zstate.view.picture import take_picture
from zstate.view.sliders import Sliders
from zstate.view.view import View
from zstate.view.world import World

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
    path = Path(argument) if is_path(argument) else find(argument).path
    return Named(robot, model, path.parent), model


def chosen_sliders(session: Session, named: Sequence[Named], wire: str) -> Iterator[tuple[Named, Sliders]]:
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
        sliders = Sliders(session, model, chosen.robot, wires=(wire,))
        if sliders.refusal:
            print_status(f"{chosen.robot!r} is not moved: {sliders.refusal}", robot=chosen.robot)
        yield chosen, sliders


def _announced_model(session: Session, robot: str, wire: str) -> RobotModel:
    with World(session, (robot,), wire=wire) as world:
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


def show_address(page: Page) -> None:
    """Say what to open, and how that is reached from elsewhere."""
    print_result(f"the view is at {page.url}")
    if not is_loopback(page.host):
        print_status("whoever has this address may look, and move what has sliders; it travels in the clear")
    elif os.environ.get("SSH_CONNECTION"):
        print_status(f"from your own machine: ssh -L {page.port}:127.0.0.1:{page.port} {os.uname().nodename}")


def take_snapshot(
    world: World,
    view: View,
    page: Page,
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
    take_picture(page, path, width=width, height=height, hold=view.hold)
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


def _is_there(world: World, robots: Sequence[str]) -> bool:
    models = world.models
    return all(robot in models for robot in robots) if robots else bool(models)


def _wait_for(world: World, condition: Callable[[], bool], timeout_s: float) -> bool:
    """Wait until ``condition()``, on what the world shows, is true; False after ``timeout_s``."""
    waiter = ConditionWaiter()
    if world.listener is not None:
        world.listener.add_observer(waiter.notify)
    return waiter.wait_for(condition, timeout_s)
