"""zstate demo: the whole chain, publisher process to lookup, in one command."""

from __future__ import annotations

import fcntl
import os
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, nullcontext, suppress
from math import degrees
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import click

from zstate._util.closeable import Closeable
from zstate.cli import options
from zstate.cli.options import load_robot
from zstate.cli.output.console import (
    count_text,
    duration_or_dash,
    fail,
    is_terminal,
    print_result,
    print_status,
    print_wrapped,
    rate_text,
    terminal_width,
)
from zstate.cli.session import open_session
from zstate.errors import LookupFailed, UnknownModel, format_duration

if TYPE_CHECKING:
    from rich.table import Table

    from zstate.cli.processes import ChildProcess
    from zstate.model.robot import RobotModel
    from zstate.net.session import Session
    from zstate.net.topic_statistics import IntervalStatistics
    from zstate.nodes.listener import TransformListener
    from zstate.nodes.metered_buffer import MeteredBuffer, SampleKind
    from zstate.transform import Transform

_DEFAULT = "panda"
_START_WITHIN_S = 20.0
_TURN_POLL_S = 0.05
_NOT_OF_DEMOS = ("ZSTATE_WIRE", "ZSTATE_CLOCK")
_REFRESH_S = 0.1
# Rate and latency shown are those of the last second.
_RECENT_NS = 1_000_000_000
# The least terminal width that has room for angles.
_WIDTH_WITH_ANGLES = 72
_NOUNS: dict[SampleKind, str] = {"joint_states": "joint state", "transforms": "odometry sample"}

_ROVER = "rover"
# The robot with a laser in a room, and the map of that, next to its URDF file.
_ARM = "rrbot"
_LASER = "laser_link"
_ROOM = "room.yaml"


class Demo(NamedTuple):
    """A robot that moves: poses of ``links`` are shown in the frame ``root``.

    ``programs`` publish it: the arguments of each `zstate` process, by name. ``kinds`` are those of their
    samples. ``world`` are processes that publish the robot's surroundings, which are ``world_text``.
    ``advice`` has a command to try.
    """

    robot: str
    model: RobotModel
    root: str
    links: Sequence[str]
    programs: Mapping[str, Sequence[str]]
    kinds: Sequence[SampleKind] = ("joint_states",)
    world: Mapping[str, Sequence[str]] = MappingProxyType({})
    world_text: str = ""
    advice: str = ""


@click.command("demo")
@click.argument("robot", type=options.MODEL, required=False)
@options.xacro_arguments
@click.option("--world", is_flag=True, help="Put rrbot into a room, which its laser sweeps.")
@click.option("--camera", is_flag=True, help="Give the rover a camera, image/front.")
@options.rate_option
@options.seconds_option
# For the process with the hardware that `zstate demo rover` starts; its ROBOT is the name of the rover.
@click.option("--program", type=click.Choice(("wheels",)), hidden=True, allow_from_autoenv=False)
@options.plain_session_options
def demo_command(
    *,
    robot: str | None,
    xacro_args: dict[str, str],
    world: bool,
    camera: bool,
    rate: float,
    seconds: float | None,
    program: Literal["wheels"] | None,
    **session_options: Any,
) -> None:
    """Publish ROBOT (default: panda) in one process and look up its transforms in another, over Zenoh.

    ROBOT is a name that `zstate robots` lists, such as panda, or a URDF or xacro file; NAME:=VALUE are
    xacro arguments. If panda is not installed, the default is rrbot, which comes with zstate. The demo is on
    the network of all other commands, so that `zstate view`, `zstate tf` and `zstate doctor` in another
    terminal see it. If a robot of this name is announced there, the demo takes another one, such as panda-2.

    `zstate demo rover` is a mobile robot with simulated wheels, IMU and laser in a room. One process is its
    hardware, another one `zstate odometry`, which estimates odom -> base_footprint. It drives a square until
    its first command, such as by `zstate move rover --keys` in another terminal. The room and the laser need
    pip install 'zstate[maps]'. With --camera it also has a camera on a mast, which sees the room and the
    rover itself; this needs pip install 'zstate[cameras]'.

    `zstate demo rrbot --world` has four processes: two more publish the map of a room, and the scans of the
    laser on the arm, simulated in that map. `zstate view` draws all of it. Needs pip install 'zstate[maps]'.

    \b
    zstate demo
    zstate demo path/to/arm.urdf --rate 500
    zstate demo rover
    zstate demo rover --camera
    zstate demo rrbot --world
    """
    from zstate.model.catalog import example_name

    network = options.build_network(session_options)
    if program is not None:
        from zstate.odometry.cli.rover import run_rover

        with open_session(network) as session:
            run_rover(session, rate, robot or _ROVER, with_camera=camera)
        return
    source = robot or (_ARM if world else example_name())
    if world and (source != _ARM or xacro_args):
        raise click.UsageError(f"--world is for {_ARM!r} alone; got {source!r}")
    if camera and source != _ROVER:
        raise click.UsageError(f"--camera is for {_ROVER!r} alone; got {source!r}")
    if source == _ROVER and xacro_args:
        raise click.UsageError(f"{_ROVER!r} takes no xacro arguments; got {', '.join(xacro_args)}")
    if not (robot or world) and source != _DEFAULT:
        print_status(
            f"{_DEFAULT!r} is not installed (pip install 'zstate[robots]'), so this shows {source!r}"
        )
    for variable in _NOT_OF_DEMOS:
        os.environ.pop(variable, None)
    with open_session(network) as session, _Turn() as turn:
        names = _Names(session)
        if world:
            demo = _robot_in_room(names)
        elif source == _ROVER:
            demo = _rover(names, with_camera=camera)
        else:
            demo = _swinging_robot(source, xacro_args, names)
        _run(session, demo, _environment(session_options), rate, seconds, on_pose=turn.close)


class _Turn(Closeable):
    """Held by a demo from the choice of its names until its robot moves.

    So each of several demos that one user starts at the same time sees the names of those before it.
    """

    def __init__(self) -> None:
        from zstate.clock import wait_interruptible

        self._held = ExitStack()
        path = Path(tempfile.gettempdir(), f"zstate-demo-{os.getuid()}.lock")
        with suppress(OSError):  # no folder for temporary files: no turns
            lock = self._held.enter_context(path.open("a"))
            deadline = time.monotonic() + _START_WITHIN_S
            while not _is_locked(lock.fileno()) and time.monotonic() < deadline:
                wait_interruptible(threading.Event(), _TURN_POLL_S)

    def close(self) -> None:
        self._held.close()


def _is_locked(file: int) -> bool:
    """Lock ``file`` for this process, unless another one has it."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


class _Names:
    """The names that are free on the network of ``session``."""

    def __init__(self, session: Session) -> None:
        from zstate.cli.processes import BackgroundCall
        from zstate.net.discovery import discover

        # Without any robot it takes a second, in which the model is loaded.
        self._robots = BackgroundCall("zstate discovery", lambda: discover(session))

    def free(self, name: str) -> str:
        """``name``, or ``name-2`` and so on if a robot or place of that name is announced."""
        taken = {robot.name for robot in self._robots.result()}
        found, number = name, 1
        while found in taken:
            number += 1
            found = f"{name}-{number}"
        if found != name:
            print_status(f"{name!r} is announced by another program already; that of this demo is {found!r}")
        return found


def _environment(session_options: Mapping[str, Any]) -> dict[str, str]:
    """The session options as the variables from which the processes of a demo read them."""
    texts = {
        name: " ".join(value) if isinstance(value, tuple) else value  # pyright: ignore
        for name, value in session_options.items()
    }
    return {f"ZSTATE_{name.upper()}": text for name, text in texts.items() if text}


def _swinging_robot(source: str, xacro_args: Mapping[str, str], names: _Names) -> Demo:
    """A robot whose joints swing, published by one program."""
    from zstate.model.representative_links import representative_links

    try:
        model, name = load_robot(source, None, xacro_args)
    except UnknownModel as error:
        fail(f"{error}; `zstate demo rrbot` works without further packages")
    links = representative_links(model)
    if not links:
        fail(f"no link of {name!r} moves, so there is nothing to show; `zstate check` shows its links")
    name = names.free(name)
    arguments = ["publish", source, *(f"{argument}:={value}" for argument, value in xacro_args.items())]
    arguments += ["--source", "sine", "--name", name]
    return Demo(name, model, model.root, links, {"publisher": arguments})


def _rover(names: _Names, *, with_camera: bool) -> Demo:
    """A mobile robot: one program is its hardware, another one its odometry, and one publishes the room."""
    from zstate.odometry.cli import rover

    if with_camera:
        rover.check_camera()
    model, _ = load_robot(rover.ROVER_MODEL, None)
    name = names.free(_ROVER)
    advice = f"it drives a square until it is commanded: zstate move {name} --keys"
    if with_camera:
        advice += (
            f"; its camera is image/{rover.ROVER_CAMERA}: zstate view, zstate echo {name} --stream image"
        )
    demo = Demo(
        name,
        model,
        rover.ROVER_ODOM,
        (rover.ROVER_LASER, "left_wheel", "right_wheel"),
        rover.programs(name, with_camera=with_camera),
        ("joint_states", "transforms"),
        advice=advice,
    )
    if rover.load_room() is None:
        print_status("without a room and its laser, which need pip install 'zstate[maps]'")
        return demo
    room = {"map": _map_arguments(rover.room_file(), f"{name}/{rover.ROVER_ODOM}", names)}
    return demo._replace(world=room, world_text=f"the map of a room, which {rover.ROVER_LASER} measures")


def _robot_in_room(names: _Names) -> Demo:
    """The arm in a room: the map is one program, the laser that measures it another one."""
    from zstate.model.catalog import find_entry
    from zstate.scans import load_map

    demo = _swinging_robot(_ARM, {}, names)
    file = find_entry(_ARM).path.with_name(_ROOM)
    load_map(file)  # reports missing libraries before anything starts
    laser = ("scan", demo.robot, "--frame", _LASER, "--sensor", "laser", "--simulate", str(file))
    world = {"map": _map_arguments(file, f"{demo.robot}/{demo.root}", names), "laser": laser}
    return demo._replace(world=world, world_text=f"the map of a room and the scans of {_LASER} in it")


def _map_arguments(file: Path, frame: str, names: _Names) -> Sequence[str]:
    name = names.free(options.place_name(str(file)))
    return ("map", str(file), "--name", name, "--frame", frame)


def _run(
    session: Session,
    demo: Demo,
    environment: Mapping[str, str],
    rate_hz: float,
    seconds: float | None,
    *,
    on_pose: Callable[[], None],
) -> None:
    """Run the programs, and show the transforms in this process."""
    from zstate.cli.processes import ChildProcess

    ended = threading.Event()
    programs = {name: (*arguments, "--rate", repr(rate_hz)) for name, arguments in demo.programs.items()}
    with ExitStack() as running:
        children = [
            running.enter_context(
                ChildProcess(name, arguments, on_end=lambda _: ended.set(), environment=environment)
            )
            for name, arguments in {**programs, **demo.world}.items()
        ]
        model = demo.model
        size = f"{count_text(len(model.joint_names), 'joint')}, {count_text(len(model.links), 'link')}"
        processes = f"process {children[0].pid} publishes"
        if len(programs) > 1:
            processes = _named(children[: len(programs)])
        print_wrapped(f"{demo.robot} ({size}): {processes} it at {rate_hz:g} Hz, this one looks it up")
        if demo.world:
            print_wrapped(f"{_named(children[len(programs) :])} {demo.world_text}")
        _show_transforms(session, demo, ended, seconds, on_pose)
        for child in children:
            if child.exit_code is not None:
                fail(f"the process {child.name!r} ended with exit code {child.exit_code}: {child.last_error}")


def _named(children: Sequence[ChildProcess]) -> str:
    """The processes with their verb."""
    names = " and ".join(f"{child.pid} ({child.name})" for child in children)
    return f"process {names} publishes" if len(children) == 1 else f"processes {names} publish"


def _show_transforms(
    session: Session,
    demo: Demo,
    ended: threading.Event,
    seconds: float | None,
    on_pose: Callable[[], None],
) -> None:
    """Show transforms from the first pose on, when ``on_pose()`` is called."""
    from zstate.nodes.listener import TransformListener
    from zstate.nodes.metered_buffer import MeteredBuffer

    buffer = MeteredBuffer()
    with (
        TransformListener(session, demo.robot, buffer, history_on_join=False) as listener,
        _PlacedScans(session, demo, buffer) if demo.world else nullcontext() as scans,
    ):
        print_status(f"waiting for {demo.robot!r} ...")
        frames = f"{demo.robot}/{demo.root}", f"{demo.robot}/{demo.links[0]}"
        deadline = time.monotonic() + _START_WITHIN_S
        while (reason := _missing_pose(buffer, *frames)) is not None:
            if ended.is_set():
                return
            if time.monotonic() > deadline:
                fail(f"no pose arrived in {_START_WITHIN_S:g} s: {reason}")
        on_pose()
        print_status(
            f"receiving {demo.robot!r}; in another terminal: zstate view, zstate doctor, "
            f"zstate tf {' '.join(frames)}; Ctrl-C ends this"
        )
        if demo.advice:
            print_status(demo.advice)
        table = DemoTable(listener, buffer, demo)
        try:
            table.show(ended, seconds)
        finally:
            print_wrapped(table.summary())
            if scans is not None:
                print_wrapped(scans.summary())


class _PlacedScans(Closeable):
    """Counts the scans of ``demo`` whose rays have been placed in its root."""

    def __init__(self, session: Session, demo: Demo, buffer: MeteredBuffer) -> None:
        from zstate.scans import ScanListener

        self._scans = ScanListener(session, demo.robot, demo.root, buffer=buffer)
        self._root = demo.root
        self._count = self._points = 0
        threading.Thread(target=self._run, name="zstate demo scans", daemon=True).start()

    def _run(self) -> None:
        for placed in self._scans:
            self._count += 1
            self._points += int(placed.valid.sum())

    def summary(self) -> str:
        placed = f"{count_text(self._count, 'scan')} with {count_text(self._points, 'point')}"
        return (
            f"{placed} placed in {self._root}, each point by the pose at its own instant; "
            f"{self._scans.dropped.total()} dropped"
        )

    def close(self) -> None:
        self._scans.close()


def _missing_pose(buffer: MeteredBuffer, target: str, source: str) -> LookupFailed | None:
    """The reason why a pose is still missing after 0.1 s; None as soon as it is known."""
    try:
        buffer.wait(target, source, timeout_s=0.1)
    except LookupFailed as reason:
        return reason
    return None


class DemoTable:
    """The transforms of ``demo`` with their rate, latency and age.

    A live table on a terminal, one line per second otherwise.
    """

    def __init__(self, listener: TransformListener, buffer: MeteredBuffer, demo: Demo) -> None:
        self._listener, self._buffer = listener, buffer
        self._robot, self._root, self._links = demo.robot, demo.root, demo.links
        self._statistics: dict[SampleKind, IntervalStatistics] = {
            kind: buffer.statistics_of(demo.robot, kind) for kind in demo.kinds
        }
        self._start_ns = time.monotonic_ns()
        self._before = [statistics.count for statistics in self._statistics.values()]

    def show(self, ended: threading.Event, seconds: float | None) -> None:
        from zstate.clock import wait_interruptible

        until = float("inf") if seconds is None else time.monotonic() + seconds

        def is_over(pause_s: float) -> bool:
            pause_s = min(pause_s, max(0.0, until - time.monotonic()))
            return wait_interruptible(ended, pause_s) or time.monotonic() >= until

        if not is_terminal():
            while not is_over(1.0):
                print_result(self.line())
            return
        from rich.live import Live

        with Live(self.table(), auto_refresh=False) as live:
            while not is_over(_REFRESH_S):
                live.update(self.table(), refresh=True)

    def summary(self) -> str:
        stats, now = self._listener.stats, time.monotonic_ns()
        seconds = (now - self._start_ns) * 1e-9
        counts = [
            statistics.count - before
            for statistics, before in zip(self._statistics.values(), self._before, strict=True)
        ]
        nouns = [_NOUNS[kind] for kind in self._statistics] if len(counts) > 1 else ["sample"]
        # So many digits that each rate is the shown count by the shown duration.
        received = " and ".join(map(count_text, counts, nouns))
        rates = " and ".join(f"{count / seconds:.1f}" for count in counts)
        return (
            f"{received} received in {seconds:.2f} s: {rates} Hz, "
            f"{stats.missed + stats.dropped} missed, median latency {self._latency(now - self._start_ns)}"
        )

    @property
    def _freshness(self) -> str:
        rates: list[str] = []
        for kind, statistics in self._statistics.items():
            window = statistics.recent(_RECENT_NS)
            rate_hz = None if window is None else window.rate_hz
            rate = "silent" if statistics.is_stale() else rate_text(rate_hz)
            rates.append(f"{_NOUNS[kind]}s {rate}" if len(self._statistics) > 1 else rate)
        return f"{', '.join(rates)}, {self._latency(_RECENT_NS)}"

    def _latency(self, within_ns: int) -> str:
        latency_s = self._buffer.measure(self._robot, within_ns).latency_s
        text = duration_or_dash(None if latency_s is None else round(latency_s * 1e9))
        return f"{text} from stamp to lookup"

    def transforms(self) -> list[Transform]:
        """The transforms now, without those that cannot be looked up yet."""
        found: list[Transform] = []
        for link in self._links:
            with suppress(LookupFailed):
                found.append(self._buffer.lookup(f"{self._robot}/{self._root}", f"{self._robot}/{link}"))
        return found

    def table(self) -> Table:
        """The transforms for a terminal of at most 80 columns; figures for all rows are in the caption."""
        from rich import box
        from rich.table import Table

        table = Table(
            box=box.SIMPLE_HEAD,
            pad_edge=False,
            caption=self._freshness,
            caption_style="",
            caption_justify="left",
        )
        table.add_column(f"pose in {self._root}", style="bold", overflow="fold")
        with_angles = terminal_width() >= _WIDTH_WITH_ANGLES
        angles = (r"roll   pitch  yaw \[deg]",) if with_angles else ()
        for title in (r"x       y       z \[m]", *angles, "age"):
            table.add_column(title, justify="right", no_wrap=True)
        for one in self.transforms():
            xyz = " ".join(f"{round(value, 3) + 0.0:7.3f}" for value in one.translation)
            rpy = (
                (" ".join(f"{round(degrees(angle), 1) + 0.0:6.1f}" for angle in one.rpy),)
                if with_angles
                else ()
            )
            table.add_row(_link(one), xyz, *rpy, format_duration(time.time_ns() - one.stamp))
        return table

    def line(self) -> str:
        """The first transform on one line."""
        from zstate.cli.commands.tf import numbers_text

        text = self._freshness
        for one in self.transforms()[:1]:
            xyz = numbers_text(one.translation.tolist(), 3)
            rpy = numbers_text([degrees(angle) for angle in one.rpy], 1)
            text += f"; {_link(one)} in {self._root}: xyz {xyz} m, rpy {rpy} deg"
        return text


def _link(transform: Transform) -> str:
    return transform.source.partition("/")[2]
