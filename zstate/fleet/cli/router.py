"""zstate router: Zenoh router for clients and other routers."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import click

from zstate.cli import options
from zstate.cli.metrics import connection_rows, serve_metrics, writer_rows
from zstate.cli.output.console import fail, print_result, print_status, print_wrapped
from zstate.cli.robot_directory import RobotDirectory
from zstate.cli.session import SessionOptions, open_session
from zstate.errors import InvalidInput
from zstate.streams import KILOBYTE

if TYPE_CHECKING:
    from zstate.fleet.uplink import Uplink
    from zstate.metrics.endpoint import BindAddress
    from zstate.net.security.credentials import Credentials
    from zstate.net.session import Session
    from zstate.streams import StreamName


def _check_size(kilobytes: float) -> float:
    if not 0.001 <= kilobytes < math.inf:
        raise InvalidInput(f"a size is a number of kilobytes, at least one byte; got {kilobytes:g}")
    return kilobytes


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
    help="At most HZ samples per second of this stream to each neighbour; may be repeated.",
)
@click.option("--site", metavar="NAME", help="The router of this site, which thins what leaves on --uplink.")
@click.option(
    "--uplink",
    multiple=True,
    metavar="ENDPOINT",
    help="A router of headquarters, for --site; may be repeated.",
)
@click.option(
    "--thin",
    multiple=True,
    metavar="STREAM=HZ[,...]",
    help="Samples per second of each robot that pass on the uplink; of other streams none pass.",
)
@click.option(
    "--largest",
    type=options.number("KB", _check_size),
    help="Larger pictures, clouds, scans and maps do not pass on the uplink; models and joints do.",
)
@click.option("--robot", multiple=True, metavar="NAME", help="Thin this robot; may be repeated.")
@click.option("--robot-file", type=options.EXISTING_FILE, help="Thin these robots: a name on each line.")
@click.option(
    "--wan",
    multiple=True,
    metavar="INTERFACE",
    help="Thin only on this interface, such as wwan0; may be repeated.",
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
    site: str | None,
    uplink: tuple[str, ...],
    thin: tuple[str, ...],
    largest: float | None,
    robot: tuple[str, ...],
    robot_file: str | None,
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

    With --site, programs of the site have all samples at their full rate, and headquarters has those of the
    robots and streams that --robot and --thin name. Latched values, commands, stops and queries pass as well.

    \b
    zstate router --listen tls/0.0.0.0:7447 --certs fleet --identity router --acl acl.json5
    zstate router --connect tcp/fleet.example:7447 --downsample joint_states=10 --robot r1 --wan wwan0
    zstate router --site plant1 --uplink tls/hq.example:7447 --thin joint_states=5 --robot-file r.txt
    zstate router --listen tcp/0.0.0.0:7447 --print >router.json5
    zstate router --ros2                               # for ROS 2 nodes of this host
    zstate router --ros2 --listen "tcp/[::]:7447"      # for all hosts, as rmw_zenohd
    """
    from zstate.fleet.acl import read_access_control
    from zstate.fleet.downsampling import Downsampling
    from zstate.fleet.router_config import RouterConfig
    from zstate.fleet.uplink import Uplink
    from zstate.net.config import ROUTER_ENDPOINT, check_credentials, listen_endpoints

    file = config or (None if ros2 else os.environ.get("ZENOH_CONFIG"))
    if file:
        names = ("ros2", "acl", "downsample", "site", "print", "output")
        values = (ros2, acl, downsample, site, only_print, output)
        conflicts = [f"--{name}" for name, value in zip(names, values, strict=True) if value]
        if conflicts:
            raise click.UsageError(
                f"{' and '.join(conflicts)} and the file {file!r} (--config, ZENOH_CONFIG) exclude each "
                "other: the file is the whole configuration; change it there"
            )
        _run(SessionOptions("router", connect, listen, config, credentials), listen, metrics, file)
        return
    robots = (*robot, *(_names_in(robot_file) if robot_file else ()))
    if site is None and (uplink or thin or largest):
        raise click.UsageError("--uplink, --thin and --largest need --site NAME")
    if site is not None and (downsample or ros2):
        what = "--downsample" if downsample else "--ros2, whose topics no rule thins,"
        raise click.UsageError(f"{what} and --site exclude each other; --thin limits what leaves a site")
    if not (downsample or site is not None) and (robots or wan or namespace):
        raise click.UsageError(
            "--robot, --robot-file, --wan and --namespace need --downsample STREAM=HZ, or --site"
        )
    link = downsampling = None
    if site is not None:
        rates = _rates("--thin", [text for one in thin for text in one.split(",")])
        largest_bytes = None if largest is None else round(largest * KILOBYTE)
        link = Uplink(site, uplink, rates, robots, wan, namespace, largest_bytes)
        # Of a site with certificates the uplink is encrypted, and the programs of this host need not be.
        listen = listen or (ROUTER_ENDPOINT,)
    elif downsample:
        downsampling = Downsampling(_rates("--downsample", downsample), robots, wan, namespace)
    endpoints = listen_endpoints("router", listen, credentials)
    check_credentials("router", credentials, endpoints)
    access = read_access_control(acl) if acl else {}
    router = RouterConfig(endpoints, connect, credentials, downsampling, access, ros2, link)
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
        _run(network, router.listen, metrics, uplink=link)


def _rates(option: str, texts: Iterable[str]) -> dict[StreamName, float]:
    """The rates [Hz] in ``texts``, each STREAM=HZ."""
    rates: dict[str, float] = {}
    for text in texts:
        stream, _, rate = text.partition("=")
        try:
            rates[stream.strip()] = float(rate)
        except ValueError:
            raise click.UsageError(f"{option} {text!r}: write STREAM=HZ, such as joint_states=10") from None
    return rates


def _names_in(path: str) -> list[str]:
    """The names in a file, one on each line; # begins a comment."""
    lines = Path(path).read_text(encoding="utf-8").splitlines()
    return [name for line in lines if (name := line.partition("#")[0].strip())]


def _run(
    network: SessionOptions,
    listen: tuple[str, ...],
    metrics: BindAddress | None,
    file: str = "",
    uplink: Uplink | None = None,
) -> None:
    from zstate.clock import wait_interruptible
    from zstate.net.config import listen_endpoints
    from zstate.net.sites import SiteAnnouncement

    changed = threading.Event()
    with (
        open_session(network) as session,
        RobotDirectory(session, on_change=changed.set) as directory,
        serve_metrics(metrics, connection_rows(session), writer_rows(directory)),
        ExitStack() as opening,
    ):
        if uplink is not None:
            opening.enter_context(SiteAnnouncement(session, uplink.site, uplink.rates_hz, uplink.robots))
        place = ", ".join(listen) or f"the endpoints in {file!r}"
        print_wrapped(f"router {session.zid} listens at {place}")
        if listen == (default := listen_endpoints("router", (), network.credentials)):
            opened = default[0].replace("127.0.0.1", "0.0.0.0")
            print_status(f"it serves only this host; --listen {opened} opens it to the network")
        if uplink is None:
            wait_interruptible(threading.Event())
            return
        print_wrapped(f"site {uplink.site!r}: {uplink.text}")
        named: set[str] = set()
        while True:
            wait_interruptible(changed)
            changed.clear()
            for robot in sorted(_unnamed_robots(session, directory, uplink) - named):
                named.add(robot)
                print_status(
                    f"{robot!r} is not named: if it is behind this router, no sample of it leaves on the "
                    f"uplink; start the router with --robot {robot}"
                )


def _unnamed_robots(session: Session, directory: RobotDirectory, uplink: Uplink) -> set[str]:
    """The announced robots with a stream that passes on ``uplink``, but for those of all announced sites."""
    from zstate.net.sites import discover_sites

    passing, named = set(uplink.passing), set(uplink.robots)
    writers = ((one.name, stream) for one in directory.robots() for stream, _ in one.writers)
    robots = {robot for robot, stream in writers if stream in passing and robot not in named}
    return robots.difference(*discover_sites(session).robots.values()) if robots else robots
