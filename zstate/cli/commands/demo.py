"""zstate demo: the whole chain, publisher process to lookup, in one command."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from math import degrees
from typing import TYPE_CHECKING

import click

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

    from zstate.metrics.buffer import MeteredBuffer
    from zstate.nodes.listener import TransformListener
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


@click.command("demo")
@click.argument("robot", required=False)
@options.xacro_arguments
@click.option("--robot", "robot_option", metavar="ROBOT", help="Same as the argument.")
@options.rate_option
@options.seconds_option
def demo_command(
    robot: str | None,
    xacro_args: dict[str, str],
    robot_option: str | None,
    rate: float,
    seconds: float | None,
) -> None:
    """Publish ROBOT (default: panda) in one process and look up its transforms in another, over Zenoh.

    ROBOT is a name that `zstate robots` lists, such as panda, or a URDF or xacro file; NAME:=VALUE are
    xacro arguments. If panda is not installed, the default is rrbot, which comes with zstate. The two
    processes use a port of their own and do not affect other sessions.
    """
    from zstate.cli.processes import ChildProcess
    from zstate.model.catalog import example_name
    from zstate.model.robot import representative_links

    if robot and robot_option and robot != robot_option:
        raise click.UsageError(f"two robots are named, {robot!r} and {robot_option!r}; give one")
    source = robot or robot_option or example_name()
    if not (robot or robot_option) and source != _DEFAULT:
        print_status(
            f"{_DEFAULT!r} is not installed (pip install 'zstate[robots]'), so this shows {source!r}"
        )
    try:
        model, name = load_robot(source, None, xacro_args)
    except UnknownModel as error:
        fail(f"{error}; `zstate demo rrbot` works without further packages")
    links = representative_links(model)
    if not links:
        fail(f"no link of {name!r} moves, so there is nothing to show; `zstate check` shows its links")
    for variable in _USERS_NETWORK:
        os.environ.pop(variable, None)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    ended = threading.Event()
    arguments = ["publish", source, *(f"{argument}:={value}" for argument, value in xacro_args.items())]
    arguments += ["--source", "sine", "--name", name, "--rate", repr(rate), "--connect", endpoint]
    with ChildProcess("publisher", arguments, on_end=lambda _: ended.set()) as publisher:
        size = f"{count_text(len(model.joint_names), 'joint')}, {count_text(len(model.links), 'link')}"
        print_wrapped(
            f"{name} ({size}): process {publisher.pid} publishes it at {rate:g} Hz, this one looks it up"
        )
        _show_transforms(endpoint, name, model.root, links, ended, seconds)
        if ended.is_set():
            fail(f"the publisher ended with exit code {publisher.exit_code}: {publisher.last_error}")


def _show_transforms(  # noqa: PLR0917 - one use
    endpoint: str, robot: str, root: str, links: Sequence[str], ended: threading.Event, seconds: float | None
) -> None:
    from zstate.metrics.buffer import MeteredBuffer
    from zstate.nodes.listener import TransformListener

    buffer = MeteredBuffer()
    with (
        open_session(SessionOptions(listen=(endpoint,))) as session,
        TransformListener(session, robot, buffer, history_on_join=False) as listener,
    ):
        print_status(f"waiting for {robot!r} ...")
        deadline = time.monotonic() + _START_WITHIN_S
        while not buffer.has_samples.wait(0.1):
            if ended.is_set():
                return
            if time.monotonic() > deadline:
                fail(f"no sample of the publisher arrived in {_START_WITHIN_S:g} s")
        print_status(f"receiving {robot!r} over {endpoint}; Ctrl-C ends this")
        table = DemoTable(listener, buffer, robot, root, links)
        try:
            table.show(ended, seconds)
        finally:
            print_wrapped(table.summary())


class DemoTable:
    """Transforms of ``links`` in ``root`` with their rate, latency and age.

    A live table on a terminal, one line per second otherwise.
    """

    def __init__(
        self, listener: TransformListener, buffer: MeteredBuffer, robot: str, root: str, links: Sequence[str]
    ) -> None:
        self._listener, self._buffer = listener, buffer
        self._robot, self._root, self._links = robot, root, links
        self._statistics = buffer.statistics_of(robot)
        self._start = time.monotonic_ns(), self._statistics.count

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
        stats, (start, before) = self._listener.stats, self._start
        count, now = self._statistics.count - before, time.monotonic_ns()
        seconds = (now - start) * 1e-9
        return (
            # So many digits that the rate is the shown count by the shown duration.
            f"{count_text(count, 'sample')} received in {seconds:.2f} s: {count / seconds:.1f} Hz, "
            f"{stats.missed + stats.dropped} missed, median latency {self._latency(now - start)}"
        )

    @property
    def _freshness(self) -> str:
        window = self._statistics.recent(_RECENT_NS)
        rate_hz = None if window is None else window.rate_hz
        rate = "silent" if self._statistics.is_stale() else rate_text(rate_hz)
        return f"{rate}, {self._latency(_RECENT_NS)}"

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
            xyz = " ".join(f"{value:7.3f}" for value in one.translation)
            rpy = (" ".join(f"{degrees(angle):6.1f}" for angle in one.rpy),) if with_angles else ()
            assert one.stamp is not None
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
