"""Who may do what behind a router: its access control, from the key space.

What nobody is allowed is denied. Zenoh allows a message when a rule's key expression includes that of
the message, so that a robot cannot write to others by a wildcard either.

A rule of Zenoh's access control: who has it may send, or is given, some messages on some keys.

Access control from a file: what ``zstate acl`` printed, or somebody wrote.

NativeAccess: who may do what in a fleet that speaks zstate's own wire.

``**`` goes past chunks that begin with ``@``, which are named apart: late joiners ask under ``@adv``,
presence stands under ``@writer``, static edges are announced under ``@edge``, and clocks are compared
under ``@clock``. Whoever reads may say so, under ``@reader``.

RosAccess: who may do what in a fleet that speaks ROS 2 as rmw_zenoh_cpp does.

Topics and services stand under ``<domain>/``, late joiners ask under ``@adv`` below them, and the ROS
graph is made of tokens under ``@ros2_lv/<domain>/``, which tell node and topic with ``%`` for ``/``.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from zstate.errors import ConfigError, InvalidInput
from zstate.net.config import user_config
from zstate.net.security.json5 import json5_text
from zstate.wire.keys import CLOCK_KEY, check_robot
from zstate.wire.registry import ros_options
from zstate.wire.ros2.options import Ros2Options

Rule = dict[str, object]

PUBLISH = ("put", "delete", "reply", "declare_queryable", "liveliness_token")
SUBSCRIBE = ("declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query")


def ingress(name: str, messages: Sequence[str], keys: Iterable[str]) -> Rule:
    """What somebody sends to the router."""
    return _rule(name, "ingress", messages, keys)


def egress(name: str, messages: Sequence[str], keys: Iterable[str]) -> Rule:
    """What the router passes on to somebody."""
    return _rule(name, "egress", messages, keys)


def _rule(name: str, flow: str, messages: Sequence[str], keys: Iterable[str]) -> Rule:
    return {
        "id": name,
        "permission": "allow",
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": list(keys),
    }


_APART = ("@adv", "@writer", "@clock", "@edge", "@reader")


class NativeAclRules:
    """The rules for ``fleet``."""

    def __init__(self, fleet: AclRoles) -> None:
        self._fleet = fleet

    def roles(self, name: str) -> Iterator[str]:
        """The rules that ``name`` has, by their names."""
        fleet = self._fleet
        if name in fleet.robots:
            yield from (f"{name} writes", f"{name} reads", f"{name} is given")
            yield from ("robots read", "robots are given", "robots are asked")
        elif name in fleet.placers:
            yield from (f"{name} places", "robots read", "robots are given", "robots are asked")
        yield "readers are known"
        if name in (*fleet.viewers, *fleet.operators, *fleet.timekeepers):
            yield from ("viewers read", "viewers are given")
        if name in fleet.operators:
            yield "operators command"
        if name in fleet.timekeepers:
            yield "timekeepers write"

    def rules(self) -> Iterator[Rule]:
        """All of them."""
        fleet = self._fleet
        root = f"{fleet.namespace}/zstate" if fleet.namespace else "zstate"
        everything, clock = _under(root), root.removesuffix("zstate") + CLOCK_KEY
        statics = f"{root}/*/tf_static/*"
        shared = (statics, f"{statics}/@adv/**", f"{root}/*/@edge/**", f"{root}/*/@writer/**", clock)
        for robot in dict.fromkeys(fleet.robots):
            own = _under(f"{root}/{check_robot(robot)}")
            yield ingress(f"{robot} writes", PUBLISH, own)
            yield ingress(f"{robot} reads", SUBSCRIBE, own)
            yield egress(f"{robot} is given", PUBLISH, own)
        for placer in dict.fromkeys(fleet.placers):
            own = f"{root}/{check_robot(placer)}"
            edges = (f"{own}/tf_static/*", f"{own}/tf_static/*/@adv/**")
            yield ingress(
                f"{placer} places", PUBLISH, (*edges, f"{own}/@writer/tf_static/*", f"{own}/@edge/**")
            )
        yield ingress("robots read", SUBSCRIBE, shared)
        yield egress("robots are given", PUBLISH, shared)
        # What is asked of all robots at once is asked of each; only its own is in what it answers.
        yield egress("robots are asked", SUBSCRIBE, everything)
        yield ingress("viewers read", SUBSCRIBE, everything)
        yield egress("viewers are given", PUBLISH, everything)
        yield ingress("readers are known", ("liveliness_token",), (f"{root}/@reader/**",))
        yield ingress("operators command", ("put",), (f"{root}/*/joint_commands",))
        yield ingress("timekeepers write", ("put",), (clock,))


def _under(key: str) -> tuple[str, ...]:
    return (f"{key}/**", *(f"{key}/**/{chunk}/**" for chunk in _APART))


_OF_EVERY_NODE = ("rosout", "parameter_events")
"""Topics outside of all namespaces that each ROS node writes."""


class Ros2AclRules:
    """The rules for ``fleet`` in one domain. Robots are told apart by their namespaces.

    A robot writes the topics of its namespace and answers its services, and stands in the graph with
    nothing else; /tf and /tf_static, where they are global, belong to all robots. A viewer hears all
    topics and calls no service, which an operator does. Raises InvalidInput for robots in one namespace.
    """

    def __init__(self, fleet: AclRoles, options: Ros2Options) -> None:
        self._fleet = fleet
        self._options = options
        self._domain = str(options.domain)
        self._graph = f"@ros2_lv/{options.domain}"
        self._global = (*(("tf", "tf_static") if options.tf == "global" else ()), *_OF_EVERY_NODE)
        _check_apart(fleet.robots, [options.robot_namespace(robot) for robot in fleet.robots])

    def roles(self, name: str) -> Iterator[str]:
        """The rules that ``name`` has, by their names."""
        fleet = self._fleet
        if name in fleet.robots:
            yield from map(self._id, (f"{name} writes", f"{name} reads", f"{name} is given"))
            yield from map(self._id, ("robots write", "robots read", "robots are given", "robots are asked"))
        if name in (*fleet.viewers, *fleet.operators, *fleet.timekeepers):
            yield from map(
                self._id, ("viewers are known", "viewers hear", "viewers ask", "viewers are given")
            )
        if name in fleet.operators:
            yield self._id("operators call")
        if name in fleet.timekeepers:
            yield self._id("timekeepers write")

    def rules(self) -> Iterator[Rule]:
        """All of them."""
        whole = (f"{self._domain}/**", f"{self._domain}/**/@adv/**", f"{self._graph}/**")
        clock = self._topic("clock")
        shared = tuple(key for name in self._global for key in self._topic(name))
        for robot in dict.fromkeys(self._fleet.robots):
            own = self._own(robot)
            yield ingress(self._id(f"{robot} writes"), PUBLISH, (*own, *self._tokens(robot)))
            yield ingress(self._id(f"{robot} reads"), SUBSCRIBE, own)
            yield egress(self._id(f"{robot} is given"), PUBLISH, own)
        yield ingress(self._id("robots write"), PUBLISH, shared)
        yield ingress(self._id("robots read"), SUBSCRIBE, (*shared, *clock, whole[2]))
        yield egress(self._id("robots are given"), PUBLISH, (*shared, *clock, whole[2]))
        # What is asked of all at once is asked of each; only its own is in what it answers.
        yield egress(self._id("robots are asked"), SUBSCRIBE, whole)
        yield ingress(self._id("viewers are known"), ("liveliness_token",), self._reader_tokens())
        yield ingress(self._id("viewers hear"), ("declare_subscriber",), whole[:1])
        yield ingress(self._id("viewers ask"), SUBSCRIBE, whole[1:])
        yield egress(self._id("viewers are given"), PUBLISH, whole)
        yield ingress(self._id("operators call"), ("query",), whole[:1])
        yield ingress(self._id("timekeepers write"), PUBLISH, (*clock, self._token("MP", "*", "%clock")))

    def _id(self, text: str) -> str:
        return f"{text} in ROS domain {self._domain}"

    def _own(self, robot: str) -> tuple[str, ...]:
        namespace = self._options.robot_namespace(robot)
        return self._topic(namespace) if namespace else (f"{self._domain}/**", f"{self._domain}/**/@adv/**")

    def _topic(self, name: str) -> tuple[str, str]:
        return f"{self._domain}/{name}/**", f"{self._domain}/{name}/**/@adv/**"

    def _tokens(self, robot: str) -> Iterator[str]:
        """Its nodes, what they read, and what they offer of its own and of everybody's."""
        namespace = self._options.robot_namespace(robot)
        if not namespace:
            yield f"{self._graph}/**"
            return
        root = "%" + namespace.replace("/", "%")
        for place in (root, f"{root}%$*"):
            for kind in ("NN", "MS", "SC"):
                yield f"{self._graph}/*/*/*/{kind}/*/{place}/**"
            yield self._token("SS", place, f"{root}%$*")
            for topic in (f"{root}%$*", *(f"%{name}" for name in self._global)):
                yield self._token("MP", place, topic)

    def _token(self, kind: str, place: str, topic: str) -> str:
        return f"{self._graph}/*/*/*/{kind}/*/{place}/*/{topic}/**"

    def _reader_tokens(self) -> tuple[str, ...]:
        nodes = (f"{self._graph}/*/*/*/{kind}/**" for kind in ("NN", "MS", "SC"))
        return (*nodes, f"{self._domain}/**/@adv/sub/**")


def _check_apart(robots: Sequence[str], namespaces: Sequence[str]) -> None:
    if len(set(robots)) > 1 and len(set(namespaces)) < len(set(robots)):
        raise InvalidInput(
            f"the robots {', '.join(map(repr, robots))} would write the same topics, so that access control "
            "could not tell them apart; give each a namespace of its name: 'ros2:namespace=*'"
        )


_IDENTITY = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")

_HEAD = """\
Access control for a Zenoh router: what no rule allows is denied.

{roles}
A name is the common name of a certificate (mTLS: enable_mtls in transport/link/tls) or a user
(transport/auth/usrpwd). A router that asks for neither knows nobody, and denies everything.
It is read when the router starts."""


@dataclass(frozen=True, slots=True)
class AclRoles:
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
        for name in self.identities:
            _check_identity(name)
        check_namespace(self.namespace)
        if not self.identities:
            raise InvalidInput("nobody is named; access control without names would deny everything")

    @property
    def identities(self) -> tuple[str, ...]:
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


def access_text(fleet: AclRoles) -> str:
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


def access_control(fleet: AclRoles) -> dict[str, object]:
    """The section ``access_control`` of a Zenoh configuration."""
    wires = [_access(fleet, wire) for wire in dict.fromkeys(fleet.wires)]
    roles = {name: [rule for wire in wires for rule in wire.roles(name)] for name in fleet.identities}
    used = {rule for rules in roles.values() for rule in rules}
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [rule for wire in wires for rule in wire.rules() if rule["id"] in used],
        "subjects": [subject for name in fleet.identities for subject in _subjects(name)],
        "policies": [
            {"id": name, "rules": rules, "subjects": [str(one["id"]) for one in _subjects(name)]}
            for name, rules in roles.items()
        ],
    }


def _access(fleet: AclRoles, wire: str) -> NativeAclRules | Ros2AclRules:
    kind, _, options = wire.partition(":")
    if wire == "native":
        return NativeAclRules(fleet)
    if kind != "ros2":
        raise InvalidInput(
            f"there is no access control for the wire {wire!r}; there is for 'native' and 'ros2'"
        )
    if fleet.namespace:
        raise InvalidInput(
            f"ROS nodes have no Zenoh namespace, such as {fleet.namespace!r}; write 'ros2:namespace=NAME' "
            "for that of their topics"
        )
    return Ros2AclRules(fleet, ros_options(options))


def _subjects(name: str) -> tuple[Rule, Rule]:
    # Apart, as one subject with both would be somebody who has both.
    return (
        {"id": f"certificate {name}", "cert_common_names": [name]},
        {"id": f"user {name}", "usernames": [name]},
    )


_SECTIONS = ("rules", "subjects", "policies")


def read_access_control(path: str | os.PathLike[str]) -> dict[str, object]:
    """That section of the Zenoh configuration in a file. Raises ConfigError where there is none."""
    given = json.loads(str(user_config(path, "peer", (), ())))["access_control"]
    if not given["enabled"]:
        raise ConfigError(
            f"{str(path)!r} has no access_control that is enabled; `zstate acl` prints one", path=str(path)
        )
    lists = {section: [_as_written(one) for one in given[section] or ()] for section in _SECTIONS}
    return {"enabled": True, "default_permission": given["default_permission"], **lists}


def _as_written(entry: Mapping[str, Any]) -> dict[str, Any]:
    # Zenoh sorts the names, and adds those that were not there.
    names = sorted(entry, key=lambda name: (name != "id", isinstance(entry[name], list), name))
    return {name: entry[name] for name in names if entry[name] is not None}
