"""zstate router: a place where clients and other routers meet."""

from __future__ import annotations

import os
import threading

import click

from zstate.cli.console import note, say
from zstate.cli.network import Network, open_session
from zstate.cli.options import config_option


@click.command("router")
@click.option(
    "--listen",
    multiple=True,
    metavar="ENDPOINT",
    help="Where clients come to; default: tcp/127.0.0.1:7447. May be repeated.",
)
@click.option("--connect", multiple=True, metavar="ENDPOINT", help="Another router to join; may be repeated.")
@click.option("--ros2", is_flag=True, help="With the settings of rmw_zenohd, in its place.")
@config_option
def router_command(listen: tuple[str, ...], connect: tuple[str, ...], ros2: bool, config: str | None) -> None:
    """Run a Zenoh router until Ctrl-C.

    By default it serves this host alone; `--listen tcp/0.0.0.0:7447` opens it to the network. Other
    commands reach it with `--connect tcp/HOST:7447`.

    \b
    zstate router --listen tcp/0.0.0.0:7447
    zstate router --ros2                               # for ROS 2 nodes of this host
    zstate router --ros2 --listen "tcp/[::]:7447"      # for everybody, as rmw_zenohd
    """
    from zstate.clock import wait_in_slices
    from zstate.net.config import CONFIG_VARIABLE, ROS_ROUTER, ROUTER_ENDPOINT

    if ros2 and config:
        raise click.UsageError("--ros2 is a configuration of its own; give that, or --config")
    file = None if ros2 else config or os.environ.get(CONFIG_VARIABLE)
    where = listen or (() if file else (ROUTER_ENDPOINT,))
    with open_session(Network("router", connect, where, ROS_ROUTER if ros2 else config)) as session:
        say(f"router {session.zid} listens at {', '.join(where) or f'what {file!r} says'}")
        if where == (ROUTER_ENDPOINT,):
            note("it serves this host alone; --listen tcp/0.0.0.0:7447 opens it to the network")
        wait_in_slices(threading.Event())
