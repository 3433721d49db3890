"""zstate demo: the whole chain, publisher process to lookup, in one command."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, nullcontext, suppress
from math import degrees
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal, NamedTuple

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
from zstate.cli.session import SessionOptions, open_session
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
_USERS_NETWORK = (
    "ZENOH_CONFIG",
    "ZSTATE_MODE",
    "ZSTATE_CONNECT",
    "ZSTATE_LISTEN",
    "ZSTATE_CONFIG",
    "ZSTATE_WIRE",
)
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
    ``advice`` has a command to try, with ``{connect}`` for the options of the network.
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
@options.rate_option
@options.seconds_option
# Of the process with the hardware that `zstate demo rover` starts.
@click.option("--program", type=click.Choice(("wheels",)), hidden=True, allow_from_autoenv=False)
@click.option("--connect", "endpoint", hidden=True, allow_from_autoenv=False)
def demo_command(
    *,
    robot: str | None,
    xacro_args: dict[str, str],
    world: bool,
    rate: float,
    seconds: float | None,
    program: Literal["wheels"] | None,
    endpoint: str | None,
) -> None:
    """Publish ROBOT (default: panda) in one process and look up its transforms in another, over Zenoh.

    ROBOT is a name that `zstate robots` lists, such as panda, or a URDF or xacro file; NAME:=VALUE are
    xacro arguments. If panda is not installed, the default is rrbot, which comes with zstate. The two
    processes use a port of their own and do not affect other sessions; other commands reach them with the
    printed --connect.

    `zstate demo rover` is a mobile robot with simulated wheels, IMU and laser in a room. One process is its
    hardware, another one `zstate odometry`, which estimates odom -> base_footprint. It drives a square until
    its first command, such as by `zstate move rover --keys` in another terminal with the printed --connect.
    The room and the laser need pip install 'zstate[maps]'.

    `zstate demo rrbot --world` has four processes: two more publish the map of a room, and the scans of the
    laser on the arm, simulated in that map. `zstate view` draws all of it. Needs pip install 'zstate[maps]'.

    \b
    zstate demo
    zstate demo path/to/arm.urdf --rate 500
    zstate demo rover
    zstate demo rrbot --world
    """
    from zstate.model.catalog import example_name

    if program is not None and endpoint is not None:
        with open_session(SessionOptions(connect=(endpoint,))) as session:
            from zstate.odometry.cli.rover import run_rover

            run_rover(session, rate)
        return
    source = robot or (_ARM if world else example_name())
    if world:
        if source != _ARM or xacro_args:
            raise click.UsageError(f"--world is for {_ARM!r} alone; got {source!r}")
        _run(_robot_in_room(), rate, seconds)
        return
    if not robot and source != _DEFAULT:
        print_status(
            f"{_DEFAULT!r} is not installed (pip install 'zstate[robots]'), so this shows {source!r}"
        )
    demo = _rover(xacro_args) if source == _ROVER else _swinging_robot(source, xacro_args)
    _run(demo, rate, seconds)


def _swinging_robot(source: str, xacro_args: Mapping[str, str]) -> Demo:
    """A robot whose joints swing, published by one program."""
    from zstate.model.robot import representative_links

    try:
        model, name = load_robot(source, None, xacro_args)
    except UnknownModel as error:
        fail(f"{error}; `zstate demo rrbot` works without further packages")
    links = representative_links(model)
    if not links:
        fail(f"no link of {name!r} moves, so there is nothing to show; `zstate check` shows its links")
    arguments = ["publish", source, *(f"{argument}:={value}" for argument, value in xacro_args.items())]
    arguments += ["--source", "sine", "--name", name]
    return Demo(name, model, model.root, links, {"publisher": arguments})


def _rover(xacro_args: Mapping[str, str]) -> Demo:
    """A mobile robot: one program is its hardware, another one its odometry, and one publishes the room."""
    from zstate.odometry.cli import rover

    if xacro_args:
        raise click.UsageError(f"{_ROVER!r} takes no xacro arguments; got {', '.join(xacro_args)}")
    model, _ = load_robot(rover.ROVER_MODEL, None)
    demo = Demo(
        _ROVER,
        model,
        rover.ROVER_ODOM,
        (rover.ROVER_LASER, "left_wheel", "right_wheel"),
        rover.programs(),
        ("joint_states", "transforms"),
        advice="it drives a square until it is commanded: zstate move rover --keys {connect}",
    )
    if rover.load_room() is None:
        print_status("without a room and its laser, which need pip install 'zstate[maps]'")
        return demo
    room = {"map": ("map", str(rover.room_file()), "--frame", f"{_ROVER}/{rover.ROVER_ODOM}")}
    return demo._replace(world=room, world_text=f"the map of a room, which {rover.ROVER_LASER} measures")


def _robot_in_room() -> Demo:
    """The arm in a room: the map is one program, the laser that measures it another one."""
    from zstate.model.catalog import find_entry
    from zstate.scans import load_map

    demo = _swinging_robot(_ARM, {})
    file = find_entry(_ARM).path.with_name(_ROOM)
    load_map(file)  # reports missing libraries before anything starts
    world = {
        "map": ("map", str(file), "--frame", f"{_ARM}/{demo.root}"),
        "laser": ("scan", _ARM, "--frame", _LASER, "--sensor", "laser", "--simulate", str(file)),
    }
    return demo._replace(world=world, world_text=f"the map of a room and the scans of {_LASER} in it")


def _run(demo: Demo, rate_hz: float, seconds: float | None) -> None:
    """Run the programs, isolated from the user's network, and show the transforms in this process."""
    from zstate.cli.processes import ChildProcess

    for variable in _USERS_NETWORK:
        os.environ.pop(variable, None)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    ended = threading.Event()
    programs = {name: (*arguments, "--rate", repr(rate_hz)) for name, arguments in demo.programs.items()}
    with ExitStack() as running:
        children = [
            running.enter_context(
                ChildProcess(name, [*arguments, "--connect", endpoint], on_end=lambda _: ended.set())
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
        _show_transforms(endpoint, demo, ended, seconds)
        for child in children:
            if child.exit_code is not None:
                fail(f"the process {child.name!r} ended with exit code {child.exit_code}: {child.last_error}")


def _named(children: Sequence[ChildProcess]) -> str:
    """The processes with their verb."""
    names = " and ".join(f"{child.pid} ({child.name})" for child in children)
    return f"process {names} publishes" if len(children) == 1 else f"processes {names} publish"


def _show_transforms(endpoint: str, demo: Demo, ended: threading.Event, seconds: float | None) -> None:
    from zstate.nodes.listener import TransformListener
    from zstate.nodes.metered_buffer import MeteredBuffer

    buffer = MeteredBuffer()
    with (
        open_session(SessionOptions(listen=(endpoint,))) as session,
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
        print_status(
            f"receiving {demo.robot!r}; other commands do so with --connect {endpoint}; Ctrl-C ends this"
        )
        if demo.advice:
            print_status(demo.advice.format(connect=f"--connect {endpoint}"))
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
