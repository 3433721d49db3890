"""zstate demo: the whole chain, publisher process to lookup, in one command."""

from __future__ import annotations

import os
import socket
import threading
import time
from typing import TYPE_CHECKING

import click

from zstate.cli.options import load_robot, rate_option, seconds_option, xacro_arguments
from zstate.cli.output.console import count_text, fail, print_status, print_wrapped
from zstate.cli.session import SessionOptions, open_session
from zstate.errors import UnknownModel

if TYPE_CHECKING:
    from zstate.metrics.buffer import MeteredBuffer
    from zstate.model.robot import RobotModel

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


@click.command("demo")
@click.argument("robot", required=False)
@xacro_arguments
@click.option("--robot", "robot_option", metavar="ROBOT", help="The same as the argument.")
@rate_option
@seconds_option
def demo_command(
    robot: str | None,
    xacro_args: dict[str, str],
    robot_option: str | None,
    rate: float,
    seconds: float | None,
) -> None:
    """Publish ROBOT (default: panda) in one process and look its transforms up in another, over Zenoh.

    ROBOT is a name such as panda, which `zstate robots` lists, or a URDF or xacro file; NAME:=VALUE are
    xacro arguments. Where panda is not installed, the default is rrbot, which comes with zstate. The two
    processes meet on a port of their own and disturb nobody.
    """
    from zstate.cli.processes import ChildProcess

    if robot and robot_option and robot != robot_option:
        raise click.UsageError(f"which robot, {robot!r} or {robot_option!r}?")
    wanted = robot or robot_option or _default_robot()
    model, called = _load(wanted, xacro_args)
    for variable in _USERS_NETWORK:
        os.environ.pop(variable, None)
    endpoint = f"tcp/127.0.0.1:{_free_port()}"
    ended = threading.Event()
    words = [f"{name}:={value}" for name, value in xacro_args.items()]
    arguments = ["publish", wanted, *words, "--source", "sine", "--name", called, "--rate", repr(rate)]
    with ChildProcess(
        "publisher", [*arguments, "--connect", endpoint], on_end=lambda _: ended.set()
    ) as publisher:
        size = f"{count_text(len(model.joint_names), 'joint')}, {count_text(len(model.links), 'link')}"
        print_wrapped(
            f"{called} ({size}): process {publisher.pid} publishes it at {rate:g} Hz, this one looks it up"
        )
        _look(endpoint, model, called, ended, seconds)
        if ended.is_set():
            fail(f"the publisher ended with exit code {publisher.exit_code}: {publisher.last_error}")


def _default_robot() -> str:
    from zstate.model.catalog import example_name

    robot = example_name()
    if robot != _DEFAULT:
        print_status(f"{_DEFAULT!r} is not installed (pip install 'zstate[robots]'), so this shows {robot!r}")
    return robot


def _load(robot: str, xacro_args: dict[str, str]) -> tuple[RobotModel, str]:
    from zstate.model.robot import representative_links

    try:
        model, called = load_robot(robot, None, xacro_args)
    except UnknownModel as error:
        fail(f"{error}; `zstate demo rrbot` works with what is here")
    if not representative_links(model):
        fail(f"no link of {called!r} moves: there is nothing to show; `zstate check` shows its links")
    return model, called


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _look(
    endpoint: str, model: RobotModel, robot: str, ended: threading.Event, seconds: float | None
) -> None:
    from zstate.cli.output.demo_table import DemoTable
    from zstate.metrics.buffer import MeteredBuffer
    from zstate.model.robot import representative_links
    from zstate.nodes.listener import TransformListener

    buffer = MeteredBuffer()
    with (
        open_session(SessionOptions(listen=(endpoint,))) as session,
        TransformListener(session, robot, buffer, history_on_join=False) as listener,
    ):
        print_status(f"waiting for {robot!r} ...")
        if not _has_begun(buffer, ended):
            return
        print_status(f"heard {robot!r} over {endpoint}; Ctrl-C ends this")
        table = DemoTable(listener, buffer, robot, model.root, representative_links(model))
        try:
            table.show(ended, seconds)
        finally:
            print_wrapped(table.summary())


def _has_begun(buffer: MeteredBuffer, ended: threading.Event) -> bool:
    """Wait for the first sample; False when the publisher ended instead."""
    deadline = time.monotonic() + _START_WITHIN_S
    while not buffer.has_samples.wait(0.1):
        if ended.is_set():
            return False
        if time.monotonic() > deadline:
            fail(f"nothing of the publisher was heard in {_START_WITHIN_S:g} s")
    return True
