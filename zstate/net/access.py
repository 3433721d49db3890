"""Who may do what behind a router: its access control, from the key space.

What nobody is allowed is denied. Zenoh allows a message when a rule's key expression includes that of
the message, so that a robot cannot write to others by a wildcard either.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from zstate.errors import InvalidInput
from zstate.net.access_rule import Rule
from zstate.net.json5 import json5_text
from zstate.net.native_access import NativeAccess
from zstate.net.ros_access import RosAccess
from zstate.net.wires import ros_options
from zstate.wire.keys import check_robot

_IDENTITY = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")

_HEAD = """\
Access control for a Zenoh router: what no rule allows is denied.

{roles}
A name is the common name of a certificate (mTLS: enable_mtls in transport/link/tls) or a user
(transport/auth/usrpwd). A router that asks for neither knows nobody, and denies everything.
It is read when the router starts."""


@dataclass(frozen=True, slots=True)
class Fleet:
    """Who is who behind a router, by name: the common name of a certificate, or a user.

    A robot writes its own keys and reads these; of others it reads who they are, their static edges,
    which it must not contradict, and the simulated time. A viewer reads everything and writes nothing; an
    operator, moreover, commands joints. A timekeeper, moreover, writes the simulated time. A placer writes
    static edges under its own name and nothing else, and reads those of the robots: it places their roots,
    as in ``fleet/map -> r1/odom``; readers that are given ``placers=`` take such edges from these alone.
    Somebody may be several of these. ``namespace`` is that of the sessions behind the router, if they
    have one. ``wires`` are what they speak: "native", and "ros2" with its options, for which see RosAccess.
    Raises InvalidInput for names that cannot be names of identities.
    """

    robots: tuple[str, ...] = ()
    viewers: tuple[str, ...] = ()
    operators: tuple[str, ...] = ()
    timekeepers: tuple[str, ...] = ()
    namespace: str = ""
    wires: tuple[str, ...] = ("native",)
    placers: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in self.names:
            _check_identity(name)
        check_namespace(self.namespace)
        if not self.names:
            raise InvalidInput("nobody is named; access control without names would deny everything")

    @property
    def names(self) -> tuple[str, ...]:
        """Everybody, each once."""
        names = (*self.robots, *self.viewers, *self.operators, *self.timekeepers, *self.placers)
        return tuple(dict.fromkeys(names))


def _check_identity(name: str) -> None:
    if not _IDENTITY.fullmatch(name):
        raise InvalidInput(
            f"{name!r} cannot be the name of an identity; use up to 64 of A-Z a-z 0-9 . _ -, beginning "
            "with a letter or digit"
        )


def check_namespace(namespace: str) -> str:
    """``namespace`` if it is empty or can stand before keys. Raises InvalidInput."""
    try:
        for chunk in namespace.split("/") if namespace else ():
            check_robot(chunk)
    except InvalidInput:
        raise InvalidInput(
            f"the namespace {namespace!r} is not made of chunks of a Zenoh key; write for instance 'site_1'"
        ) from None
    return namespace


def access_text(fleet: Fleet) -> str:
    """The access control of ``fleet`` as JSON5, which a router takes as its configuration or a part of it."""
    roles = {
        "robots": fleet.robots,
        "viewers": fleet.viewers,
        "operators": fleet.operators,
        "timekeepers": fleet.timekeepers,
        "placers": fleet.placers,
    }
    if fleet.wires != ("native",):
        roles["wires"] = fleet.wires
    lines = [f"{role + ':':<13}{', '.join(names)}\n" for role, names in roles.items() if names]
    return json5_text({"access_control": access_control(fleet)}, head=_HEAD.format(roles="".join(lines)))


def access_control(fleet: Fleet) -> dict[str, object]:
    """The section ``access_control`` of a Zenoh configuration."""
    wires = [_access(fleet, wire) for wire in dict.fromkeys(fleet.wires)]
    roles = {name: [rule for wire in wires for rule in wire.roles(name)] for name in fleet.names}
    used = {rule for rules in roles.values() for rule in rules}
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [rule for wire in wires for rule in wire.rules() if rule["id"] in used],
        "subjects": [subject for name in fleet.names for subject in _subjects(name)],
        "policies": [
            {"id": name, "rules": rules, "subjects": [str(one["id"]) for one in _subjects(name)]}
            for name, rules in roles.items()
        ],
    }


def _access(fleet: Fleet, wire: str) -> NativeAccess | RosAccess:
    kind, _, options = wire.partition(":")
    if wire == "native":
        return NativeAccess(fleet)
    if kind != "ros2":
        raise InvalidInput(
            f"there is no access control for the wire {wire!r}; there is for 'native' and 'ros2'"
        )
    if fleet.namespace:
        raise InvalidInput(
            f"ROS nodes have no Zenoh namespace, such as {fleet.namespace!r}; write 'ros2:namespace=NAME' "
            "for that of their topics"
        )
    return RosAccess(fleet, ros_options(options))


def _subjects(name: str) -> tuple[Rule, Rule]:
    # Apart, as one subject with both would be somebody who has both.
    return (
        {"id": f"certificate {name}", "cert_common_names": [name]},
        {"id": f"user {name}", "usernames": [name]},
    )
