"""zstate acl: access control of a fleet, as a router's configuration."""

from __future__ import annotations

from typing import Any

import click

from zstate.cli.output.console import print_result

_ROLES = {
    "robot": "A robot: writes its own keys; reads these, the clock and the states of drivers",
    "viewer": "Reads everything and writes nothing but stops",
    "state_viewer": "A viewer that does not read pictures, or what else shows people and places",
    "operator": "A commander that also calls ROS services",
    "timekeeper": "A viewer that also writes the simulated time",
    "placer": "Writes static edges as robot NAME and nothing else, for instance where robots are in a map",
    "commander": "A viewer that also commands joints, releases stops, and may switch the torque off",
}


def _role_options(command: Any) -> Any:
    for role, text in reversed(_ROLES.items()):
        option = click.option(
            f"--{role.replace('_', '-')}", multiple=True, metavar="NAME", help=f"{text}; may be repeated."
        )
        command = option(command)
    return command


@click.command("acl")
@_role_options
@click.option(
    "--site",
    "sites",
    multiple=True,
    metavar="NAME=ROBOT,...",
    help="The router of a site: forwards what these robots write; may be repeated.",
)
@click.option("--namespace", default="", metavar="KEY", help="Zenoh namespace of their sessions, if any.")
@click.option(
    "--wire",
    "wires",
    multiple=True,
    default=("native",),
    show_default=True,
    metavar="WIRE",
    envvar="ZSTATE_WIRE",
    help="Their wire format, as in `--wire native --wire 'ros2:domain=5,namespace=*'`; may be repeated.",
)
def acl_command(
    *, sites: tuple[str, ...], namespace: str, wires: tuple[str, ...], **roles: tuple[str, ...]
) -> None:
    """Print the access control of a fleet as a router's configuration (JSON5).

    Everything that is not allowed there is denied. NAME is the common name of a certificate (`zstate certs`)
    or a user; for a robot or a placer it is also the name in the keys. One NAME may have several roles: a
    robot that reads other robots is also a viewer. Every NAME may stop the driver of a robot, whose
    joints then hold; only a commander or an operator may command it, switch its torque off (`zstate stop
    --relax`), and release the stop.

    The router checks keys, listeners check frames: r1 writes only under zstate/r1/, and listeners accept
    frames r1/... only from those keys. The exception is the root of r1, which other writers may place in
    their own frames; with TransformListener(session, placers=["site"]) only the placer `site` may.

    Robots on ROS 2 (rmw_zenoh_cpp) have a namespace each and own the topics, services and nodes in it.
    /tf and /tf_static are shared by all unless tf=namespace. An operator may also call services there.

    \b
    zstate acl --robot r1 --robot r2 --viewer desk >acl.json5
    zstate acl --robot r1 --robot r2 --viewer desk --placer site >acl.json5
    zstate acl --site plant1=r1,r2 --site plant2=r3 --viewer desk >headquarters.json5
    zstate acl --robot r1 --robot r2 --viewer rviz --wire 'ros2:namespace=*,tf=namespace' >acl.json5
    zstate router --listen tls/0.0.0.0:7447 --certs certs --identity router --acl acl.json5
    """
    from zstate.fleet.acl import AclRoles
    from zstate.fleet.router_config import access_text

    if not (sites or any(roles.values())):
        *others, last = (f"--{role.replace('_', '-')} NAME" for role in _ROLES)
        raise click.UsageError(f"give at least one of {', '.join(others)} and {last}")
    robots_of: dict[str, tuple[str, ...]] = {}
    for text in sites:
        site, _, names = text.partition("=")
        if not names:
            raise click.UsageError(f"--site {text!r}: write NAME=ROBOT,..., such as plant1=r1,r2")
        robots_of[site] = (*robots_of.get(site, ()), *names.split(","))
    named = {f"{role}s": roles[role] for role in _ROLES}
    fleet = AclRoles(**named, namespace=namespace, wires=wires, sites=robots_of)
    print_result(access_text(fleet).rstrip("\n"))
