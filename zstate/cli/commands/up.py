"""zstate up: several commands from one file, which live and end together."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import click

from zstate.cli.console import fail, say

if TYPE_CHECKING:
    from zstate.cli.children import ChildCommand
    from zstate.cli.starts import Start

_COLORS = ("cyan", "green", "magenta", "yellow", "blue")


@click.command("up")
@click.argument("file", type=click.Path(exists=True, dir_okay=False))
def up_command(file: str) -> None:
    """Start what FILE says, and end all of it with Ctrl-C, or when one part ends.

    Each part is a process, its lines begin with its name. With a [router] and no [network] the robots
    are its clients; without either, everything meets on this host. FILE is TOML:

    \b
    [router]                           # as `zstate router`; leave it out for none
    listen = ["tcp/0.0.0.0:7447"]
    ros2 = true                        # in the place of rmw_zenohd; false unless given
    [network]                          # session options of all that follows
    mode = "peer"
    connect = ["tcp/192.168.1.10:7447"]
    [[robot]]                          # as `zstate publish`
    model = "panda"                    # a name, or a file beside this one
    name = "left"
    source = "sine"                    # or "joints", which is the default
    rate = 100.0
    wires = ["native", "ros2"]         # "native" unless given
    [[static]]                         # as `zstate static`
    robot = "left"                     # not needed when there is one robot
    target = "panda_hand"
    source = "camera"
    xyz = [0.05, 0.0, 0.04]
    rpy_deg = [0.0, -90.0, 0.0]        # or rpy, or quat_xyzw; left out: not turned
    """
    from zstate.cli.config_file import read_config
    from zstate.cli.starts import planned

    _run(planned(read_config(file), Path(file)))


def _run(starts: Sequence[Start]) -> NoReturn:
    from zstate.cli.children import ChildCommand
    from zstate.clock import wait_in_slices

    width = max(len(start.name) for start in starts)
    ended: list[ChildCommand] = []
    is_over = threading.Event()

    def note_end(child: ChildCommand) -> None:
        ended.append(child)
        is_over.set()

    with ExitStack() as children:
        running: list[ChildCommand] = []
        try:
            for number, start in enumerate(starts):
                prefix = click.style(f"{start.name:<{width}} | ", fg=_COLORS[number % len(_COLORS)])
                child = ChildCommand(start.name, start.arguments, on_end=note_end, on_line=_prefixed(prefix))
                running.append(children.enter_context(child))
            wait_in_slices(is_over)
            first = ended[0]
        finally:
            # Asked all at once, they end in the time of one.
            for child in running:
                child.ask_to_end()
    fail(f"{first.name!r} ended with exit code {first.exit_code}: {first.last_error or 'it said nothing'}")


def _prefixed(prefix: str) -> Callable[[str], None]:
    return lambda line: say(prefix + line)
