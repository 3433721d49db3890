"""zstate acl: the access control of a fleet, for its routers."""

from __future__ import annotations

from collections.abc import Callable

import click

from zstate.cli.options import Command
from zstate.cli.output.console import print_result


def _named(option: str, what: str) -> Callable[[Command], Command]:
    return click.option(option, multiple=True, metavar="NAME", help=f"{what}; may be repeated.")


@click.command("acl")
@_named("--robot", "A robot: writes its own keys, reads these and the clock")
@_named("--viewer", "Somebody who reads everything, and writes nothing")
@_named("--operator", "A viewer who also commands joints")
@_named("--timekeeper", "A viewer who also writes the simulated time")
@_named("--placer", "Writes static edges as robot NAME, and nothing else: where robots' roots are, in a map")
@click.option(
    "--namespace", default="", metavar="KEY", help="The namespace of their sessions, if they have one."
)
@click.option(
    "--wire",
    "wires",
    multiple=True,
    default=("native",),
    show_default=True,
    metavar="WIRE",
    envvar="ZSTATE_WIRE",
    help="What they speak, as in `--wire native --wire 'ros2:domain=5,namespace=*'`; may be repeated.",
)
def acl_command(
    *,
    robot: tuple[str, ...],
    viewer: tuple[str, ...],
    operator: tuple[str, ...],
    timekeeper: tuple[str, ...],
    placer: tuple[str, ...],
    namespace: str,
    wires: tuple[str, ...],
) -> None:
    """Print who may do what in a fleet, as a router's configuration (JSON5).

    What is not allowed there is denied. NAME is the common name of a certificate (`zstate certs`), or a
    user; that of a robot or a placer is also its name in the keys. Somebody may be several of these: a
    robot that looks at the others is a viewer, too.

    A router checks keys, readers check frames: r1 writes under zstate/r1/ alone, and readers take a frame
    r1/... from those keys alone, but for the root of r1, which others may place in frames of theirs. With
    TransformListener(session, placers=["site"]) only the placer `site` may.

    Robots that speak ROS 2 (rmw_zenoh_cpp) have a namespace each: topics, services and nodes in it are
    theirs, /tf and /tf_static everybody's unless tf=namespace. There an operator may call services.

    \b
    zstate acl --robot r1 --robot r2 --viewer desk >acl.json5
    zstate acl --robot r1 --robot r2 --viewer desk --placer site >acl.json5
    zstate acl --robot r1 --robot r2 --viewer rviz --wire 'ros2:namespace=*,tf=namespace' >acl.json5
    zstate router --listen tls/0.0.0.0:7447 --certs certs --identity router --acl acl.json5
    """
    from zstate.net.security.acl import AclRoles, access_text

    if not any((robot, viewer, operator, timekeeper, placer)):
        raise click.UsageError(
            "name somebody: --robot NAME, --viewer NAME, --operator NAME, --timekeeper NAME or --placer NAME"
        )
    fleet = AclRoles(robot, viewer, operator, timekeeper, namespace, wires, placer)
    print_result(access_text(fleet).rstrip("\n"))
