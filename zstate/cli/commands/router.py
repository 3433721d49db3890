"""zstate router: a place where clients and other routers meet."""

from __future__ import annotations

import os
import threading
from typing import TYPE_CHECKING

import click

from zstate.cli.metrics import connection_collector, serve_metrics, writer_collector
from zstate.cli.options import config_option, metrics_option, router_identity_options
from zstate.cli.output.console import fail, print_result, print_status, print_wrapped
from zstate.cli.robot_directory import RobotDirectory
from zstate.cli.session import SessionOptions, open_session

if TYPE_CHECKING:
    from zstate.metrics.endpoint import BindAddress
    from zstate.net.security.credentials import Credentials
    from zstate.net.security.router_config import Downsampling, RouterConfig


@click.command("router")
@click.option(
    "--listen",
    multiple=True,
    metavar="ENDPOINT",
    help="Where clients come to; default: tcp/127.0.0.1:7447. May be repeated.",
)
@click.option("--connect", multiple=True, metavar="ENDPOINT", help="Another router to join; may be repeated.")
@click.option(
    "--acl",
    type=click.Path(exists=True, dir_okay=False),
    metavar="FILE",
    help="Who may do what: what `zstate acl` prints.",
)
@click.option(
    "--downsample",
    multiple=True,
    metavar="STREAM=HZ",
    help="At most HZ samples a second of joint_states or tf to each neighbour; may be repeated.",
)
@click.option("--robot", multiple=True, metavar="NAME", help="Whose streams those are; may be repeated.")
@click.option(
    "--wan", multiple=True, metavar="INTERFACE", help="Downsample there only, such as wwan0; may be repeated."
)
@click.option("--namespace", default="", metavar="KEY", help="The namespace of those robots' sessions.")
@click.option("--ros2", is_flag=True, help="With the settings of rmw_zenohd, in its place.")
@router_identity_options
@config_option
@metrics_option
@click.option("--print", "only_print", is_flag=True, help="Print the configuration (JSON5), and run nothing.")
@click.option(
    "--output",
    type=click.Path(dir_okay=False),
    metavar="FILE",
    help="Write it into a new FILE that only you can read, with the password of --user.",
)
def router_command(
    *,
    listen: tuple[str, ...],
    connect: tuple[str, ...],
    acl: str | None,
    downsample: tuple[str, ...],
    robot: tuple[str, ...],
    wan: tuple[str, ...],
    namespace: str,
    ros2: bool,
    config: str | None,
    metrics: BindAddress | None,
    only_print: bool,
    output: str | None,
    credentials: Credentials | None,
) -> None:
    """Run a Zenoh router until Ctrl-C.

    By default it serves this host alone; `--listen tcp/0.0.0.0:7447` opens it to the network. Other
    commands reach it with `--connect tcp/HOST:7447`. What `--print` prints, zenohd takes as it is; for the
    password of --user it prints asterisks, and `--output FILE` has it.

    \b
    zstate router --listen tls/0.0.0.0:7447 --certs fleet --identity router --acl acl.json5
    zstate router --connect tcp/fleet.example:7447 --downsample joint_states=10 --robot r1 --wan wwan0
    zstate router --listen tcp/0.0.0.0:7447 --print >router.json5
    zstate router --ros2                               # for ROS 2 nodes of this host
    zstate router --ros2 --listen "tcp/[::]:7447"      # for everybody, as rmw_zenohd
    """
    file = config or (None if ros2 else os.environ.get("ZENOH_CONFIG"))
    if file:
        made = {
            "--ros2": ros2,
            "--acl": acl,
            "--downsample": downsample,
            "--print": only_print,
            "--output": output,
        }
        _refuse_beside(file, [option for option, is_given in made.items() if is_given])
        _run(SessionOptions("router", connect, listen, config, credentials), listen, metrics, file)
        return
    thinning = _thinning(downsample, robot, wan, namespace)
    router = _router(listen, connect, credentials, acl, thinning, ros2=ros2)
    if only_print:
        print_result(router.text(masked=True).rstrip("\n"))
    if output is not None:
        _write_private(output, router.text())
    if not only_print and output is None:
        network = SessionOptions("router", config=router.settings(), credentials=credentials)
        _run(network, router.listen, metrics)


def _write_private(file: str, text: str) -> None:
    try:
        with os.fdopen(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as opened:
            opened.write(text)
    except OSError as error:
        fail(f"{file!r} cannot be written: {error.strerror}")


def _refuse_beside(file: str, options: list[str]) -> None:
    if options:
        raise click.UsageError(
            f"{' and '.join(options)} and the file {file!r} (--config, ZENOH_CONFIG) exclude each other: the "
            "file is the whole configuration; write it into that"
        )


def _router(
    listen: tuple[str, ...],
    connect: tuple[str, ...],
    credentials: Credentials | None,
    acl: str | None,
    thinning: Downsampling | None,
    *,
    ros2: bool,
) -> RouterConfig:
    from zstate.net.config import check_credentials, listen_endpoints
    from zstate.net.security.acl import read_access_control
    from zstate.net.security.router_config import RouterConfig

    where = listen_endpoints("router", listen, credentials)
    check_credentials("router", credentials, where)
    access = read_access_control(acl) if acl else {}
    return RouterConfig(where, connect, credentials, thinning, access, ros2)


def _thinning(
    downsample: tuple[str, ...], robots: tuple[str, ...], interfaces: tuple[str, ...], namespace: str
) -> Downsampling | None:
    from zstate.net.security.router_config import Downsampling

    if not downsample:
        if robots or interfaces or namespace:
            raise click.UsageError("--robot, --wan and --namespace say what --downsample STREAM=HZ is for")
        return None
    return Downsampling(dict(map(_stream_rate, downsample)), robots, interfaces, namespace)


def _stream_rate(text: str) -> tuple[str, float]:
    stream, _, rate = text.partition("=")
    try:
        return stream, float(rate)
    except ValueError:
        raise click.UsageError(f"--downsample {text!r}: write STREAM=HZ, such as joint_states=10") from None


def _run(
    network: SessionOptions, listen: tuple[str, ...], metrics: BindAddress | None, file: str = ""
) -> None:
    from zstate.clock import wait_interruptible
    from zstate.net.config import listen_endpoints

    with (
        open_session(network) as session,
        RobotDirectory(session) as roster,
        serve_metrics(metrics, connection_collector(session), writer_collector(roster)),
    ):
        print_wrapped(f"router {session.zid} listens at {', '.join(listen) or f'what {file!r} says'}")
        if listen == (default := listen_endpoints("router", (), network.credentials)):
            opened = default[0].replace("127.0.0.1", "0.0.0.0")
            print_status(f"it serves this host alone; --listen {opened} opens it to the network")
        wait_interruptible(threading.Event())
