"""zstate router: Zenoh router for clients and other routers."""

from __future__ import annotations

import os
import threading
from typing import TYPE_CHECKING

import click

from zstate.cli import options
from zstate.cli.metrics import connection_rows, serve_metrics, writer_rows
from zstate.cli.output.console import fail, print_result, print_status, print_wrapped
from zstate.cli.robot_directory import RobotDirectory
from zstate.cli.session import SessionOptions, open_session

if TYPE_CHECKING:
    from zstate.metrics.endpoint import BindAddress
    from zstate.net.security.credentials import Credentials


@click.command("router")
@click.option(
    "--listen",
    multiple=True,
    metavar="ENDPOINT",
    help="Endpoint for clients; default: tcp/127.0.0.1:7447. May be repeated.",
)
@click.option("--connect", multiple=True, metavar="ENDPOINT", help="Another router; may be repeated.")
@click.option("--acl", type=options.EXISTING_FILE, help="Access control: the output of `zstate acl`.")
@click.option(
    "--downsample",
    multiple=True,
    metavar="STREAM=HZ",
    help="At most HZ samples per second of joint_states, partial_joint_states, tf or transforms to each "
    "neighbour; may be repeated.",
)
@click.option("--robot", multiple=True, metavar="NAME", help="Downsample this robot; may be repeated.")
@click.option(
    "--wan",
    multiple=True,
    metavar="INTERFACE",
    help="Downsample only on this interface, such as wwan0; may be repeated.",
)
@click.option("--namespace", default="", metavar="KEY", help="Zenoh namespace of the --robot sessions.")
@click.option("--ros2", is_flag=True, help="Use the settings of rmw_zenohd, to replace it.")
@options.router_identity_options
@options.config_option
@options.metrics_option
@click.option("--print", "only_print", is_flag=True, help="Print the configuration (JSON5) and exit.")
@click.option(
    "--output",
    type=click.Path(dir_okay=False),
    help="Write the configuration, with the password of --user, to a new FILE that only you can read.",
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

    By default it serves only this host; `--listen tcp/0.0.0.0:7447` opens it to the network. Other commands
    use it with `--connect tcp/HOST:7447`. zenohd accepts the output of `--print`; the password of --user is
    masked there, but not with `--output FILE`.

    \b
    zstate router --listen tls/0.0.0.0:7447 --certs fleet --identity router --acl acl.json5
    zstate router --connect tcp/fleet.example:7447 --downsample joint_states=10 --robot r1 --wan wwan0
    zstate router --listen tcp/0.0.0.0:7447 --print >router.json5
    zstate router --ros2                               # for ROS 2 nodes of this host
    zstate router --ros2 --listen "tcp/[::]:7447"      # for all hosts, as rmw_zenohd
    """
    from zstate.fleet.acl import read_access_control
    from zstate.fleet.router_config import Downsampling, RouterConfig
    from zstate.net.config import check_credentials, listen_endpoints

    file = config or (None if ros2 else os.environ.get("ZENOH_CONFIG"))
    if file:
        names = ("ros2", "acl", "downsample", "print", "output")
        values = (ros2, acl, downsample, only_print, output)
        conflicts = [f"--{name}" for name, value in zip(names, values, strict=True) if value]
        if conflicts:
            raise click.UsageError(
                f"{' and '.join(conflicts)} and the file {file!r} (--config, ZENOH_CONFIG) exclude each "
                "other: the file is the whole configuration; change it there"
            )
        _run(SessionOptions("router", connect, listen, config, credentials), listen, metrics, file)
        return
    downsampling = None
    if downsample:
        rates: dict[str, float] = {}
        for text in downsample:
            stream, _, rate = text.partition("=")
            try:
                rates[stream] = float(rate)
            except ValueError:
                raise click.UsageError(
                    f"--downsample {text!r}: write STREAM=HZ, such as joint_states=10"
                ) from None
        downsampling = Downsampling(rates, robot, wan, namespace)
    elif robot or wan or namespace:
        raise click.UsageError("--robot, --wan and --namespace need --downsample STREAM=HZ")
    endpoints = listen_endpoints("router", listen, credentials)
    check_credentials("router", credentials, endpoints)
    access = read_access_control(acl) if acl else {}
    router = RouterConfig(endpoints, connect, credentials, downsampling, access, ros2)
    if only_print:
        print_result(router.text(masked=True).rstrip("\n"))
    if output is not None:
        try:
            with os.fdopen(os.open(output, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as opened:
                opened.write(router.text())
        except OSError as error:
            fail(f"{output!r} cannot be written: {error.strerror}")
    if not only_print and output is None:
        network = SessionOptions("router", config=router.settings(), credentials=credentials)
        _run(network, router.listen, metrics)


def _run(
    network: SessionOptions, listen: tuple[str, ...], metrics: BindAddress | None, file: str = ""
) -> None:
    from zstate.clock import wait_interruptible
    from zstate.net.config import listen_endpoints

    with (
        open_session(network) as session,
        RobotDirectory(session) as directory,
        serve_metrics(metrics, connection_rows(session), writer_rows(directory)),
    ):
        place = ", ".join(listen) or f"the endpoints in {file!r}"
        print_wrapped(f"router {session.zid} listens at {place}")
        if listen == (default := listen_endpoints("router", (), network.credentials)):
            opened = default[0].replace("127.0.0.1", "0.0.0.0")
            print_status(f"it serves only this host; --listen {opened} opens it to the network")
        wait_interruptible(threading.Event())
