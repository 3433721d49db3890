"""Access control of a Zenoh router, generated from roles: robots, viewers, operators, commanders and others.

Messages that no rule allows are denied. Zenoh allows a message if a rule's key expression includes that of
the message, so a robot cannot write to other robots by a wildcard either.

Native wire: ``**`` does not match chunks that begin with ``@``, so each needs a key expression: history
queries of late joiners (``@adv``), liveliness tokens (``@writer``, ``@reader``, ``@site``), static edges
(``@edge``) and clocks (``@clock``). Requests for motions (``@motion``) and to an odometry (``@odometry``)
are verbatim so that viewers cannot send them.

ROS 2 (rmw_zenoh_cpp): topics and services are below ``<domain>/``, history queries under ``@adv`` below
them, and the tokens of the ROS graph under ``@ros2_lv/<domain>/``, with node and topic names in which ``%``
replaces ``/``.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from zstate.errors import ConfigError, InvalidInput
from zstate.net.security.credentials import check_identity
from zstate.net.sites import SITE_TOKEN
from zstate.net.user_config import user_config
from zstate.stream_registry import all_streams, is_named, latched_streams, own_streams
from zstate.wire.keys import (
    CLOCK_KEY,
    EDGE_TOKEN,
    MOTION,
    ODOMETRY_REQUEST,
    READER_TOKEN,
    WRITER_CLOCK,
    WRITER_TOKEN,
    check_robot,
    check_writer,
)
from zstate.wire.registry import ros_options
from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.types import FLOAT64_MULTI_ARRAY, JOINT_TRAJECTORY, OCCUPANCY_GRID

Rule = dict[str, object]

PUBLISH = ("put", "delete", "reply", "declare_queryable", "liveliness_token")
SUBSCRIBE = ("declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query")

_WRITER, _EDGE, _READER = WRITER_TOKEN.verbatim, EDGE_TOKEN.verbatim, READER_TOKEN.verbatim
_REQUESTS = (MOTION, ODOMETRY_REQUEST)
_VERBATIM = ("@adv", _WRITER, WRITER_CLOCK.verbatim, _EDGE, _READER, SITE_TOKEN.verbatim)
"""What viewers read although ``zstate/**`` does not match it: cached values, tokens and clocks."""
MESSAGES = (*PUBLISH, *SUBSCRIBE)
"""All messages that access control knows."""
ALL_KEYS = (
    "**",
    *(f"**/{chunk}/**" for chunk in (*_VERBATIM, *(one.verbatim for one in _REQUESTS), "@", "@ros2_lv")),
    "@/*/@ros2_lv/**",
)
"""All keys of zstate, of ROS and of Zenoh, and those of other programs without a chunk that begins with @."""
_READING = ("NN", "MS", "SC")  # tokens of nodes, of their subscribers and of their service clients
_NODE_TOPICS = ("rosout", "parameter_events")  # outside of all namespaces; each ROS node writes them
_SECTIONS = ("rules", "subjects", "policies")


@dataclass(frozen=True, slots=True)
class AclRoles:
    """Roles of identities behind a router, by name: the common name of a certificate, or a user.

    A robot writes and reads its own keys; of other robots it reads their names, their static edges, which it
    must not contradict, their maps, as those of places, their datums, the calibrations of their cameras, and
    the states of their drivers; and it reads the simulated time. A viewer reads everything and writes nothing
    but stops of drivers, which every identity may send: the joints hold. A state viewer is one that does not
    read what shows people and places (``Stream.private``), such as pictures; of other packages it reads the
    streams of those that are installed where the rules are made. A commander also commands joints, releases
    stops, resets and places an odometry, and may switch the torque off; an operator does, too, and calls
    services of ROS; a timekeeper also writes the simulated time. A placer writes only static edges under its
    own name, and reads those of the robots: it places their roots, as in ``fleet/map -> r1/odom``; readers
    with ``placers=`` accept such edges from these only. A site is the router of one, which forwards what its
    robots write and is given what they are: with it headquarters accepts these robots from that site alone.
    A name may have several roles. ``namespace`` is that
    of the sessions behind the router, if they have one. ``wires``: "native", and "ros2" with its options, see
    ``_Ros2Rules``.
    Raises InvalidInput for names that cannot be names of identities.
    """

    robots: tuple[str, ...] = ()
    viewers: tuple[str, ...] = ()
    operators: tuple[str, ...] = ()
    timekeepers: tuple[str, ...] = ()
    namespace: str = ""
    wires: tuple[str, ...] = ("native",)
    placers: tuple[str, ...] = ()
    commanders: tuple[str, ...] = ()
    state_viewers: tuple[str, ...] = ()
    sites: Mapping[str, tuple[str, ...]] = field(default_factory=dict[str, tuple[str, ...]])

    def __post_init__(self) -> None:
        for name in self.identities:
            check_identity(name)
        owners: dict[str, str] = {}
        for site, robots in self.sites.items():
            check_robot(site, "site")
            for robot in robots:
                if owners.setdefault(check_robot(robot), site) != site:
                    raise InvalidInput(
                        f"the robot {robot!r} is given to the sites {owners[robot]!r} and {site!r}; one of "
                        "them could write as the other's robot"
                    )
        check_namespace(self.namespace)
        if not self.identities:
            raise InvalidInput("no role has a name; access control without names would deny everything")

    @property
    def identities(self) -> tuple[str, ...]:
        """All names, each once."""
        writers = (*self.robots, *self.placers, *self.sites)
        return tuple(dict.fromkeys((*self.robots, *self.readers, *self.state_viewers, *writers)))

    @property
    def readers(self) -> tuple[str, ...]:
        """The names that may read everything."""
        return (*self.viewers, *self.operators, *self.commanders, *self.timekeepers)


def check_namespace(namespace: str) -> str:
    """``namespace`` if it is empty or a valid prefix of keys. Raises InvalidInput otherwise."""
    try:
        for chunk in namespace.split("/") if namespace else ():
            check_writer(chunk)
    except InvalidInput:
        raise InvalidInput(
            f"the namespace {namespace!r} is not made of chunks of a Zenoh key; write for instance 'site_1'"
        ) from None
    return namespace


def _rule(flow: str, name: str, messages: Sequence[str], keys: Iterable[str]) -> Rule:
    return {
        "id": name,
        "permission": "allow",
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": list(keys),
    }


_ingress, _egress = partial(_rule, "ingress"), partial(_rule, "egress")
"""A rule for messages to the router; and for messages that the router forwards."""


Grants = Iterator[tuple[Sequence[str], Rule]]
"""Rules, each with the names that it is for; a rule without names is left out."""


def _native_rules(roles: AclRoles) -> Grants:
    site = f"{roles.namespace}/" if roles.namespace else ""
    root = f"{site}zstate"
    everything, clock = _below(root), site + CLOCK_KEY
    latched = tuple(
        f"{root}/*/{stream}/*{end}"
        for stream in latched_streams()
        if is_named(stream)
        for end in ("", "/@adv/**")
    )
    # A program that may stop a driver reads whether that has stopped.
    drivers = tuple(f"{root}/*/driver{end}" for end in ("", "/@adv/**"))
    shared = (*latched, *drivers, f"{root}/*/{_EDGE}/**", f"{root}/*/{_WRITER}/**", clock)
    requests = tuple(site + key.expression() for key in _REQUESTS)
    writers: dict[str, tuple[str, ...]] = {robot: (robot,) for robot in roles.robots}
    for place, names in roles.sites.items():
        writers |= {robot: (*writers.get(robot, ()), place) for robot in names}
    for robot, names in writers.items():
        prefix = f"{root}/{check_robot(robot)}"
        keys = (*_below(prefix), *(site + key.expression(robot) for key in _REQUESTS))
        yield names, _ingress(f"{robot} writes", PUBLISH, keys)
        yield names, _ingress(f"{robot} reads", SUBSCRIBE, keys)
        yield names, _egress(f"{robot} is given", PUBLISH, keys)
    for place in roles.sites:
        tokens = (site + SITE_TOKEN.expression(site=place),)
        yield (place,), _ingress(f"{place} is announced", ("liveliness_token",), tokens)
    for placer in dict.fromkeys(roles.placers):
        prefix = f"{root}/{check_robot(placer)}"
        edges = (f"{prefix}/tf_static/*", f"{prefix}/tf_static/*/@adv/**")
        tokens = (f"{prefix}/{_WRITER}/tf_static/*", f"{prefix}/{_EDGE}/**")
        names = (placer,) if placer not in roles.robots else ()
        yield names, _ingress(f"{placer} places", PUBLISH, (*edges, *tokens))
    robots = (*roles.robots, *roles.placers, *roles.sites)
    yield robots, _ingress("robots read", SUBSCRIBE, shared)
    yield robots, _egress("robots are given", PUBLISH, shared)
    # A query for all robots goes to each of them; a reply has the robot's own data only.
    yield robots, _egress("robots are asked", SUBSCRIBE, (*everything, *requests))
    yield roles.readers, _ingress("viewers read", SUBSCRIBE, everything)
    yield roles.readers, _egress("viewers are given", PUBLISH, everything)
    states = _states(root)
    yield roles.state_viewers, _ingress("state viewers read", SUBSCRIBE, states)
    yield roles.state_viewers, _egress("state viewers are given", PUBLISH, states)
    yield roles.identities, _ingress("readers are known", ("liveliness_token",), (f"{root}/{_READER}/**",))
    streams = ("joint_commands", "release/*", f"{_WRITER}/joint_commands/*")
    commands = tuple(f"{root}/*/{stream}" for stream in streams)
    commanders = (*roles.operators, *roles.commanders)
    yield commanders, _ingress("commanders command", ("put", "liveliness_token"), commands)
    # A publisher sends nothing before its session knows of a subscriber.
    yield commanders, _egress("commanders are asked", SUBSCRIBE, commands)
    yield commanders, _ingress("commanders move", ("query",), requests)
    yield commanders, _egress("commanders are answered", PUBLISH, requests)
    relaxing = (f"{root}/*/relax/*", f"{root}/*/relax/*/@adv/**")
    yield commanders, _ingress("commanders relax", PUBLISH, relaxing)
    yield commanders, _egress("commanders are asked for that", SUBSCRIBE, relaxing)
    stops = (f"{root}/*/stop/*", f"{root}/*/stop/*/@adv/**")
    yield roles.identities, _ingress("everyone stops", PUBLISH, stops)
    yield roles.identities, _egress("everyone is asked for stops", SUBSCRIBE, stops)
    yield roles.timekeepers, _ingress("timekeepers write", ("put",), (clock,))


def _below(key: str) -> tuple[str, ...]:
    return (f"{key}/**", *(f"{key}/**/{chunk}/**" for chunk in _VERBATIM))


def _states(root: str) -> tuple[str, ...]:
    """What viewers read without the streams that are private."""
    rows = [row for row in all_streams() if not row.private and row.group != "time"]
    streams = [f"{root}/*/{row.name}{'/*' if row.named else ''}" for row in rows]
    cached = [f"{key}/@adv/**" for key in streams]
    tokens = [f"{root}/**/{chunk}/**" for chunk in _VERBATIM if chunk != "@adv"]
    return (*streams, *cached, *tokens, f"{root}/*/status/*", f"{root}/*/lookup", f"{root}/clock")


class _Ros2Rules:
    """The rules in one ROS domain, where each robot has a namespace.

    A robot writes the topics of its namespace, serves its services, and announces only these in the graph;
    global /tf and /tf_static belong to all robots, and all robots read the maps in other namespaces. A viewer
    subscribes to all topics and calls no service; an operator does. A state viewer subscribes to the
    topics whose types are those of streams that are not private. A commander writes
    ``<controller>/commands`` and ``<controller>/joint_trajectory`` of all robots. Raises InvalidInput for
    robots in one namespace.
    """

    def __init__(self, roles: AclRoles, options: Ros2Options) -> None:
        self._roles = roles
        self._options = options
        self._domain = str(options.domain)
        self._graph = f"@ros2_lv/{options.domain}"
        self._global = (*(("tf", "tf_static") if options.tf == "global" else ()), *_NODE_TOPICS)
        namespaces = {options.robot_namespace(robot) for robot in roles.robots}
        if "clock" in namespaces:
            raise InvalidInput("the topics of a robot in the namespace 'clock' include /clock of all robots")
        if len(namespaces) < len(set(roles.robots)):
            raise InvalidInput(
                f"the robots {', '.join(map(repr, roles.robots))} would write the same topics, which access "
                "control cannot separate; give each a namespace of its name: 'ros2:namespace=*'"
            )

    def rules(self) -> Grants:
        roles = self._roles
        topics, history = f"{self._domain}/**", f"{self._domain}/**/@adv/**"
        graph = f"{self._graph}/**"
        everything = (topics, history, graph)
        clock = self._topic("clock")
        shared = tuple(key for name in self._global for key in self._topic(name))
        maps = f"{self._domain}/**/{OCCUPANCY_GRID.dds}/*"
        read = (*shared, *clock, maps, f"{maps}/@adv/**", graph)
        for robot in dict.fromkeys(roles.robots):
            namespace = self._options.robot_namespace(robot)
            keys = self._topic(namespace) if namespace else (topics, history)
            tokens = self._robot_tokens(namespace)
            yield (robot,), _ingress(self._id(f"{robot} writes"), PUBLISH, (*keys, *tokens))
            yield (robot,), _ingress(self._id(f"{robot} reads"), SUBSCRIBE, keys)
            yield (robot,), _egress(self._id(f"{robot} is given"), PUBLISH, keys)
        yield roles.robots, _ingress(self._id("robots write"), PUBLISH, shared)
        yield roles.robots, _ingress(self._id("robots read"), SUBSCRIBE, read)
        yield roles.robots, _egress(self._id("robots are given"), PUBLISH, read)
        # A query for all robots goes to each of them; a reply has the robot's own data only.
        yield roles.robots, _egress(self._id("robots are asked"), SUBSCRIBE, everything)
        viewers = (*(f"{self._graph}/*/*/*/{kind}/**" for kind in _READING), f"{self._domain}/**/@adv/sub/**")
        yield roles.readers, _ingress(self._id("viewers subscribe"), ("declare_subscriber",), (topics,))
        yield roles.readers, _ingress(self._id("viewers ask"), SUBSCRIBE, (history, graph))
        yield roles.readers, _egress(self._id("viewers are given"), PUBLISH, everything)
        kinds = {row.ros_form.type.dds for row in own_streams() if row.ros and not row.private}
        states = [f"{self._domain}/**/{kind}/*{end}" for kind in sorted(kinds) for end in ("", "/@adv/**")]
        yield roles.state_viewers, _ingress(self._id("state viewers read"), SUBSCRIBE, (*states, graph))
        yield roles.state_viewers, _egress(self._id("state viewers are given"), PUBLISH, (*states, graph))
        known = (*roles.readers, *roles.state_viewers)
        yield known, _ingress(self._id("viewers are known"), ("liveliness_token",), viewers)
        yield roles.operators, _ingress(self._id("operators call"), ("query",), (topics,))
        topics_in = {"commands": FLOAT64_MULTI_ARRAY, "joint_trajectory": JOINT_TRAJECTORY}
        commands = [f"{self._domain}/**/{name}/{kind.dds}/*" for name, kind in topics_in.items()]
        command_writers = [self._token("MP", "*", f"$*%{name}") for name in topics_in]
        commanders = (*roles.operators, *roles.commanders)
        written = ("put", "liveliness_token")
        yield commanders, _ingress(self._id("commanders command"), written, (*commands, *command_writers))
        yield commanders, _egress(self._id("commanders are asked"), SUBSCRIBE, commands)
        clock_writer = self._token("MP", "*", "%clock")
        yield roles.timekeepers, _ingress(self._id("timekeepers write"), PUBLISH, (*clock, clock_writer))

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
            for kind in _READING:
                yield f"{self._graph}/*/*/*/{kind}/*/{place}/**"
            yield self._token("SS", place, f"{root}%$*")
            for topic in (f"{root}%$*", *(f"%{name}" for name in self._global)):
                yield self._token("MP", place, topic)

    def _token(self, kind: str, place: str, topic: str) -> str:
        return f"{self._graph}/*/*/*/{kind}/*/{place}/*/{topic}/**"


def access_control(roles: AclRoles) -> dict[str, object]:
    """The section ``access_control`` of a Zenoh configuration."""
    rules: list[Rule] = []
    ids: dict[str, list[object]] = {name: [] for name in roles.identities}
    for wire in dict.fromkeys(roles.wires):
        for names, rule in _wire_rules(roles, wire):
            rules += [rule] if names else []
            for name in dict.fromkeys(names):
                ids[name].append(rule["id"])
    # Two subjects for a name, as one subject with both properties would match only sessions with both.
    subjects = {
        name: (
            {"id": f"certificate {name}", "cert_common_names": [name]},
            {"id": f"user {name}", "usernames": [name]},
        )
        for name in ids
    }
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [subject for pair in subjects.values() for subject in pair],
        "policies": [
            {"id": name, "rules": ids[name], "subjects": [subject["id"] for subject in pair]}
            for name, pair in subjects.items()
        ],
    }


def _wire_rules(roles: AclRoles, wire: str) -> Grants:
    kind, _, options = wire.partition(":")
    if wire == "native":
        return _native_rules(roles)
    if kind != "ros2":
        raise InvalidInput(
            f"there is no access control for the wire {wire!r}; there is for 'native' and 'ros2'"
        )
    if roles.sites:
        raise InvalidInput("the uplink of a site carries the native wire; leave out --site, or --wire ros2")
    if roles.namespace:
        raise InvalidInput(
            f"ROS nodes have no Zenoh namespace, such as {roles.namespace!r}; write 'ros2:namespace=NAME' "
            "for that of their topics"
        )
    return _Ros2Rules(roles, ros_options(options)).rules()


def read_access_control(path: str | os.PathLike[str]) -> dict[str, object]:
    """The section ``access_control`` of a Zenoh configuration file. Raises ConfigError if there is none."""
    section = json.loads(str(user_config(path, "peer", (), ())))["access_control"]
    if not section["enabled"]:
        raise ConfigError(
            f"{str(path)!r} has no access_control that is enabled; `zstate acl` prints one", path=str(path)
        )

    def without_defaults(entry: Mapping[str, Any]) -> dict[str, Any]:
        # Zenoh sorts the names, and adds absent ones as null.
        names = sorted(entry, key=lambda name: (name != "id", isinstance(entry[name], list), name))
        return {name: entry[name] for name in names if entry[name] is not None}

    lists = {name: list(map(without_defaults, section[name] or ())) for name in _SECTIONS}
    return {"enabled": True, "default_permission": section["default_permission"], **lists}
