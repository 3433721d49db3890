"""Access control of a Zenoh router, generated from roles: robots, viewers, operators, timekeepers, placers.

Messages that no rule allows are denied. Zenoh allows a message if a rule's key expression includes that of
the message, so a robot cannot write to other robots by a wildcard either.

Native wire: ``**`` does not match chunks that begin with ``@``, so each needs a key expression: history
queries of late joiners (``@adv``), liveliness tokens (``@writer``, ``@reader``), static edges (``@edge``)
and clocks (``@clock``).

ROS 2 (rmw_zenoh_cpp): topics and services are below ``<domain>/``, history queries under ``@adv`` below
them, and the tokens of the ROS graph under ``@ros2_lv/<domain>/``, with node and topic names in which ``%``
replaces ``/``.
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

_AT_CHUNKS = ("@adv", "@writer", "@clock", "@edge", "@reader")
_NODE_TOPICS = ("rosout", "parameter_events")  # outside of all namespaces; each ROS node writes them
_SECTIONS = ("rules", "subjects", "policies")
_IDENTITY = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")

_HEAD = """\
Access control for a Zenoh router: what no rule allows is denied.

{roles}
A name is the common name of a certificate (mTLS: enable_mtls in transport/link/tls) or a user
(transport/auth/usrpwd). A router that requires neither identifies no session, and denies everything.
It is read when the router starts."""


@dataclass(frozen=True, slots=True)
class AclRoles:
    """Roles of identities behind a router, by name: the common name of a certificate, or a user.

    A robot writes and reads its own keys; of other robots it reads their names, their static edges,
    which it must not contradict, and the simulated time. A viewer reads everything and writes nothing; an
    operator also commands joints; a timekeeper also writes the simulated time. A placer writes only static
    edges under its own name, and reads those of the robots: it places their roots, as in
    ``fleet/map -> r1/odom``; readers with ``placers=`` accept such edges from these only. A name may have
    several roles. ``namespace`` is that of the sessions behind the router, if they have one. ``wires``:
    "native", and "ros2" with its options, see Ros2AclRules.
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
            if not _IDENTITY.fullmatch(name):
                raise InvalidInput(
                    f"{name!r} cannot be the name of an identity; use up to 64 of A-Z a-z 0-9 . _ -, "
                    "beginning with a letter or digit"
                )
        check_namespace(self.namespace)
        if not self.identities:
            raise InvalidInput("no role has a name; access control without names would deny everything")

    @property
    def identities(self) -> tuple[str, ...]:
        """All names, each once."""
        names = (*self.robots, *self.viewers, *self.operators, *self.timekeepers, *self.placers)
        return tuple(dict.fromkeys(names))


def check_namespace(namespace: str) -> str:
    """``namespace`` if it is empty or a valid prefix of keys. Raises InvalidInput otherwise."""
    try:
        for chunk in namespace.split("/") if namespace else ():
            check_robot(chunk)
    except InvalidInput:
        raise InvalidInput(
            f"the namespace {namespace!r} is not made of chunks of a Zenoh key; write for instance 'site_1'"
        ) from None
    return namespace


def ingress(name: str, messages: Sequence[str], keys: Iterable[str]) -> Rule:
    """A rule for messages to the router."""
    return _rule(name, "ingress", messages, keys)


def egress(name: str, messages: Sequence[str], keys: Iterable[str]) -> Rule:
    """A rule for messages that the router forwards."""
    return _rule(name, "egress", messages, keys)


def _rule(name: str, flow: str, messages: Sequence[str], keys: Iterable[str]) -> Rule:
    return {
        "id": name,
        "permission": "allow",
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": list(keys),
    }


class NativeAclRules:
    """The rules for ``roles`` on the native wire."""

    def __init__(self, roles: AclRoles) -> None:
        self._roles = roles

    def rule_ids(self, name: str) -> Iterator[str]:
        """The ids of the rules of ``name``."""
        roles = self._roles
        if name in roles.robots:
            yield from (f"{name} writes", f"{name} reads", f"{name} is given")
            yield from ("robots read", "robots are given", "robots are asked")
        elif name in roles.placers:
            yield from (f"{name} places", "robots read", "robots are given", "robots are asked")
        yield "readers are known"
        if name in (*roles.viewers, *roles.operators, *roles.timekeepers):
            yield from ("viewers read", "viewers are given")
        if name in roles.operators:
            yield "operators command"
        if name in roles.timekeepers:
            yield "timekeepers write"

    def rules(self) -> Iterator[Rule]:
        """The rules of all names."""
        namespace = self._roles.namespace
        root = f"{namespace}/zstate" if namespace else "zstate"
        everything, clock = _below(root), root.removesuffix("zstate") + CLOCK_KEY
        statics = f"{root}/*/tf_static/*"
        shared = (statics, f"{statics}/@adv/**", f"{root}/*/@edge/**", f"{root}/*/@writer/**", clock)
        for robot in dict.fromkeys(self._roles.robots):
            keys = _below(f"{root}/{check_robot(robot)}")
            yield ingress(f"{robot} writes", PUBLISH, keys)
            yield ingress(f"{robot} reads", SUBSCRIBE, keys)
            yield egress(f"{robot} is given", PUBLISH, keys)
        for placer in dict.fromkeys(self._roles.placers):
            prefix = f"{root}/{check_robot(placer)}"
            edges = (f"{prefix}/tf_static/*", f"{prefix}/tf_static/*/@adv/**")
            tokens = (f"{prefix}/@writer/tf_static/*", f"{prefix}/@edge/**")
            yield ingress(f"{placer} places", PUBLISH, (*edges, *tokens))
        yield ingress("robots read", SUBSCRIBE, shared)
        yield egress("robots are given", PUBLISH, shared)
        # A query for all robots goes to each of them; a reply has the robot's own data only.
        yield egress("robots are asked", SUBSCRIBE, everything)
        yield ingress("viewers read", SUBSCRIBE, everything)
        yield egress("viewers are given", PUBLISH, everything)
        yield ingress("readers are known", ("liveliness_token",), (f"{root}/@reader/**",))
        yield ingress("operators command", ("put",), (f"{root}/*/joint_commands",))
        yield ingress("timekeepers write", ("put",), (clock,))


def _below(key: str) -> tuple[str, ...]:
    return (f"{key}/**", *(f"{key}/**/{chunk}/**" for chunk in _AT_CHUNKS))


class Ros2AclRules:
    """The rules for ``roles`` in one ROS domain, where each robot has a namespace.

    A robot writes the topics of its namespace, serves its services, and announces only these in the graph;
    global /tf and /tf_static belong to all robots. A viewer subscribes to all topics and calls no service;
    an operator does. Raises InvalidInput for robots in one namespace.
    """

    def __init__(self, roles: AclRoles, options: Ros2Options) -> None:
        self._roles = roles
        self._options = options
        self._domain = str(options.domain)
        self._graph = f"@ros2_lv/{options.domain}"
        self._global = (*(("tf", "tf_static") if options.tf == "global" else ()), *_NODE_TOPICS)
        namespaces = {options.robot_namespace(robot) for robot in roles.robots}
        if len(namespaces) < len(set(roles.robots)):
            raise InvalidInput(
                f"the robots {', '.join(map(repr, roles.robots))} would write the same topics, which access "
                "control cannot separate; give each a namespace of its name: 'ros2:namespace=*'"
            )

    def rule_ids(self, name: str) -> Iterator[str]:
        """The ids of the rules of ``name``."""
        roles = self._roles
        if name in roles.robots:
            yield from map(self._id, (f"{name} writes", f"{name} reads", f"{name} is given"))
            yield from map(self._id, ("robots write", "robots read", "robots are given", "robots are asked"))
        if name in (*roles.viewers, *roles.operators, *roles.timekeepers):
            viewing = ("viewers are known", "viewers subscribe", "viewers ask", "viewers are given")
            yield from map(self._id, viewing)
        if name in roles.operators:
            yield self._id("operators call")
        if name in roles.timekeepers:
            yield self._id("timekeepers write")

    def rules(self) -> Iterator[Rule]:
        """The rules of all names."""
        topics, history = f"{self._domain}/**", f"{self._domain}/**/@adv/**"
        graph = f"{self._graph}/**"
        everything = (topics, history, graph)
        clock = self._topic("clock")
        shared = tuple(key for name in self._global for key in self._topic(name))
        for robot in dict.fromkeys(self._roles.robots):
            namespace = self._options.robot_namespace(robot)
            keys = self._topic(namespace) if namespace else (topics, history)
            yield ingress(self._id(f"{robot} writes"), PUBLISH, (*keys, *self._robot_tokens(namespace)))
            yield ingress(self._id(f"{robot} reads"), SUBSCRIBE, keys)
            yield egress(self._id(f"{robot} is given"), PUBLISH, keys)
        yield ingress(self._id("robots write"), PUBLISH, shared)
        yield ingress(self._id("robots read"), SUBSCRIBE, (*shared, *clock, graph))
        yield egress(self._id("robots are given"), PUBLISH, (*shared, *clock, graph))
        # A query for all robots goes to each of them; a reply has the robot's own data only.
        yield egress(self._id("robots are asked"), SUBSCRIBE, everything)
        tokens = (f"{self._graph}/*/*/*/{kind}/**" for kind in ("NN", "MS", "SC"))
        viewers = (*tokens, f"{self._domain}/**/@adv/sub/**")
        yield ingress(self._id("viewers are known"), ("liveliness_token",), viewers)
        yield ingress(self._id("viewers subscribe"), ("declare_subscriber",), (topics,))
        yield ingress(self._id("viewers ask"), SUBSCRIBE, (history, graph))
        yield egress(self._id("viewers are given"), PUBLISH, everything)
        yield ingress(self._id("operators call"), ("query",), (topics,))
        yield ingress(self._id("timekeepers write"), PUBLISH, (*clock, self._token("MP", "*", "%clock")))

    def _id(self, text: str) -> str:
        return f"{text} in ROS domain {self._domain}"

    def _topic(self, name: str) -> tuple[str, str]:
        return f"{self._domain}/{name}/**", f"{self._domain}/{name}/**/@adv/**"

    def _robot_tokens(self, namespace: str) -> Iterator[str]:
        """A robot's nodes, their readers, and their writers of its own and of the shared topics."""
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


def access_text(roles: AclRoles) -> str:
    """The access control of ``roles`` as JSON5: the configuration of a router, or a part of it."""
    names = {
        "robots": roles.robots,
        "viewers": roles.viewers,
        "operators": roles.operators,
        "timekeepers": roles.timekeepers,
        "placers": roles.placers,
    }
    if roles.wires != ("native",):
        names["wires"] = roles.wires
    lines = [f"{role + ':':<13}{', '.join(listed)}\n" for role, listed in names.items() if listed]
    return json5_text({"access_control": access_control(roles)}, head=_HEAD.format(roles="".join(lines)))


def access_control(roles: AclRoles) -> dict[str, object]:
    """The section ``access_control`` of a Zenoh configuration."""
    wires = [_wire_rules(roles, wire) for wire in dict.fromkeys(roles.wires)]
    ids = {name: [rule for wire in wires for rule in wire.rule_ids(name)] for name in roles.identities}
    used = {rule for rules in ids.values() for rule in rules}
    # Two subjects for a name, as one subject with both properties would match only sessions with both.
    subjects = {
        name: (
            {"id": f"certificate {name}", "cert_common_names": [name]},
            {"id": f"user {name}", "usernames": [name]},
        )
        for name in roles.identities
    }
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [rule for wire in wires for rule in wire.rules() if rule["id"] in used],
        "subjects": [subject for pair in subjects.values() for subject in pair],
        "policies": [
            {"id": name, "rules": rules, "subjects": [subject["id"] for subject in subjects[name]]}
            for name, rules in ids.items()
        ],
    }


def _wire_rules(roles: AclRoles, wire: str) -> NativeAclRules | Ros2AclRules:
    kind, _, options = wire.partition(":")
    if wire == "native":
        return NativeAclRules(roles)
    if kind != "ros2":
        raise InvalidInput(
            f"there is no access control for the wire {wire!r}; there is for 'native' and 'ros2'"
        )
    if roles.namespace:
        raise InvalidInput(
            f"ROS nodes have no Zenoh namespace, such as {roles.namespace!r}; write 'ros2:namespace=NAME' "
            "for that of their topics"
        )
    return Ros2AclRules(roles, ros_options(options))


def read_access_control(path: str | os.PathLike[str]) -> dict[str, object]:
    """The section ``access_control`` of a Zenoh configuration file. Raises ConfigError if there is none."""
    section = json.loads(str(user_config(path, "peer", (), ())))["access_control"]
    if not section["enabled"]:
        raise ConfigError(
            f"{str(path)!r} has no access_control that is enabled; `zstate acl` prints one", path=str(path)
        )
    lists = {name: [_without_defaults(entry) for entry in section[name] or ()] for name in _SECTIONS}
    return {"enabled": True, "default_permission": section["default_permission"], **lists}


def _without_defaults(entry: Mapping[str, Any]) -> dict[str, Any]:
    # Zenoh sorts the names, and adds absent ones as null.
    names = sorted(entry, key=lambda name: (name != "id", isinstance(entry[name], list), name))
    return {name: entry[name] for name in names if entry[name] is not None}
