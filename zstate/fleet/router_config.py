"""Router configuration: commented JSON5 that zenohd reads unchanged, and that ``zstate router`` runs.

Downsampling limits the rate at which a router forwards streams, for slow links.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from zstate.errors import ConfigError, InvalidInput
from zstate.fleet.acl import AclRoles, access_control
from zstate.fleet.downsampling import Downsampling
from zstate.fleet.uplink import Uplink
from zstate.net.config import ROUTER_ENDPOINT, SETTINGS, check_credentials, endpoint_list
from zstate.net.security.credentials import Credentials

ROS_ROUTER: dict[str, object] = {
    "mode": "router",
    "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": True}},
    "routing": {"router": {"peers_failover_brokering": False}},
    "timestamping": {"enabled": True},
    # Many nodes start at once, and are busy with that for a while.
    "queries_default_timeout": 600_000,
    "transport": {
        "unicast": {
            "open_timeout": 60_000,
            "accept_timeout": 60_000,
            "accept_pending": 10_000,
            "max_sessions": 10_000,
        },
        "link": {"tx": {"lease": 60_000, "keep_alive": 2}},
        "shared_memory": {"enabled": False},
    },
}
"""The settings of rmw_zenohd, except that it listens at tcp/[::]:7447, which is open to the network.

ROS nodes are peers. They find each other through the router's gossip and exchange data directly; the router
forwards between peers and clients.
"""

_WIDTH = 100
_INDENT = "  "
_BARE_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


_ACCESS_HEAD = """\
Access control for a Zenoh router: what no rule allows is denied.

{roles}
A name is the common name of a certificate (mTLS: enable_mtls in transport/link/tls) or a user
(transport/auth/usrpwd). A router that requires neither identifies no session, and denies everything.
It is read when the router starts."""
_PRIVATE = ("tcp/127.", "tcp/localhost:", "tcp/[::1]:", "unixsock-stream/")
_HEAD = "The configuration of a Zenoh router: `zenohd -c FILE.json5`, or `zstate router --config FILE.json5`."

# A router does not wait for peers at its start; its retries are in _CONNECT_SETTINGS.
_NATIVE_SETTINGS = {
    path: value for path, value in SETTINGS.items() if path not in ("scouting/delay", "connect/retry")
}
_CONNECT_SETTINGS: dict[str, object] = {
    "connect/timeout_ms": -1,
    "connect/exit_on_failure": False,
    "connect/retry": SETTINGS["connect/retry"],
}

_COMMENTS = {
    "listen": "Endpoints for robots, readers and other routers.",
    "connect": "The routers that it joins. Unreachable ones are retried without limit.",
    "scouting": "No discovery by multicast.",
    "timestamping": "Samples carry their own stamps; a router would replace stamps ahead of its clock.",
    "transport/link/tx": "A link without messages for so long [ms] is closed, and its liveliness tokens go.",
    "transport/unicast": "Limits on opening and accepting connections: time [ms], number of pending ones.",
    "transport/link/tls": "Encryption; with enable_mtls each side needs a certificate of this authority.",
    "transport/auth": "Users that may connect, with passwords.",
    "transport/shared_memory": "No gain for messages this small.",
    "downsampling": "Limit of samples per second [Hz] to each neighbour, by rule, not by key.",
    "qos": "Samples and values that leave on the uplink are dropped if it is full; none waits.",
    "low_pass_filter": "Larger samples, values and replies [B] do not leave on the uplink.",
    "access_control": "Allowed messages, by identity or link; all others are denied.",
}
_ROS_COMMENTS = {
    "scouting": "From here on as in rmw_zenohd: ROS nodes are peers, which find each other through it.",
    "timestamping": "Late joiners receive the history of topics in order.",
    "queries_default_timeout": "Long, as many nodes that start at once reply late.",
    "transport/link/tx": "",
    "transport/unicast": "",
}
_GOSSIP_COMMENTS = {
    "scouting/gossip": "Gossip lets peers link directly, past the rules of this router.\n"
    'Without it peers receive nothing from each other: connect with mode "client", ROS nodes too.',
}


@dataclass(frozen=True, slots=True)
class RouterConfig:
    """A router: endpoints, credentials, downsampling, access control, and the uplink of a site.

    It listens at ``tcp/127.0.0.1:7447`` by default. ``access_control`` is that section of a Zenoh
    configuration, and needs credentials that identify clients; it turns gossip off, because peers that
    gossip link directly, past the router. With ``ros2`` the other settings are those of rmw_zenohd. With
    certificates all links are encrypted, except those within this host.

    Raises InvalidInput and ConfigError for settings that cannot be used.
    """

    listen: tuple[str, ...] = (ROUTER_ENDPOINT,)
    connect: tuple[str, ...] = ()
    credentials: Credentials | None = None
    downsampling: Downsampling | None = None
    access_control: Mapping[str, object] = field(default_factory=dict[str, object])
    ros2: bool = False
    uplink: Uplink | None = None

    def __post_init__(self) -> None:
        if self.downsampling is not None and self.uplink is not None:
            raise InvalidInput("a router downsamples to all neighbours, or thins its uplink, not both")
        endpoint_list((*self.listen, *self._connected))
        check_credentials("router", self.credentials, self.listen)
        if self.credentials is not None:
            exposed = [endpoint for endpoint in self.listen if not endpoint.startswith(_PRIVATE)]
            self.credentials.check_endpoints(self._connected, exposed)
        identifies = self.credentials and (self.credentials.certificate or self.credentials.users)
        if self.access_control and not identifies:
            raise ConfigError(
                "access control without certificates or users denies every client; give the router "
                "certificates (--certs DIR --identity NAME), users (--users FILE), or both",
                path="access_control",
            )

    @property
    def _connected(self) -> tuple[str, ...]:
        """The endpoints of the routers that it joins."""
        return (*self.connect, *(self.uplink.endpoints if self.uplink is not None else ()))

    def settings(self) -> dict[str, object]:
        """The Zenoh configuration. Raises ConfigError as ``Uplink.settings``."""
        settings: dict[str, object] = {"mode": "router", "listen/endpoints": list(self.listen)}
        if self._connected:
            settings |= {"connect/endpoints": list(self._connected), **_CONNECT_SETTINGS}
        settings |= ROS_ROUTER if self.ros2 else _NATIVE_SETTINGS
        if self.credentials is not None:
            settings |= self.credentials.settings()
        if self.downsampling is not None:
            settings["downsampling"] = self.downsampling.settings()
        if self.access_control or self.uplink is not None:
            settings["scouting/gossip/enabled"] = False
        if self.uplink is not None:
            settings |= self.uplink.settings((*self.listen, *self.connect), self.access_control)
        elif self.access_control:
            settings["access_control"] = self.access_control
        nested: dict[str, Any] = {}
        _merge(nested, settings)
        return nested

    def text(self, *, masked: bool = False) -> str:
        """The configuration as commented JSON5; if ``masked``, with asterisks for the password."""
        comments = _COMMENTS | (_ROS_COMMENTS if self.ros2 else {})
        if self.access_control or self.uplink is not None:
            comments |= _GOSSIP_COMMENTS
        settings = self.settings()
        if masked and self.credentials is not None and self.credentials.password is not None:
            _merge(settings, {"transport/auth/usrpwd/password": "********"})
        return _json5(settings, comments, _HEAD)


def _merge(nested: dict[str, Any], settings: Mapping[str, Any]) -> None:
    """Add ``settings``, by path, to the objects of ``nested``; values may be objects."""
    for path, value in settings.items():
        *parents, last = path.split("/")
        place = nested
        for parent in parents:
            place = place.setdefault(parent, {})
        if isinstance(value, Mapping):
            _merge(place.setdefault(last, {}), value)  # pyright: ignore[reportUnknownArgumentType]
        else:
            place[last] = value


def access_text(roles: AclRoles) -> str:
    """The access control of ``roles`` as JSON5: the configuration of a router, or a part of it."""
    names = {
        "robots": roles.robots,
        "viewers": roles.viewers,
        "states only": roles.state_viewers,
        "operators": roles.operators,
        "commanders": roles.commanders,
        "timekeepers": roles.timekeepers,
        "placers": roles.placers,
        "sites": [f"{site} ({', '.join(robots)})" for site, robots in roles.sites.items()],
    }
    if roles.wires != ("native",):
        names["wires"] = roles.wires
    lines = [f"{role + ':':<13}{', '.join(listed)}\n" for role, listed in names.items() if listed]
    return _json5({"access_control": access_control(roles)}, head=_ACCESS_HEAD.format(roles="".join(lines)))


def _json5(settings: Mapping[str, object], comments: Mapping[str, str] | None = None, head: str = "") -> str:
    """``settings`` as a document that begins with the comment ``head``.

    ``comments`` are keyed by the path of the setting below them, such as "connect/endpoints".
    """
    return "\n".join([*_comment(head), *_value(settings, "", "", comments or {}).splitlines()]) + "\n"


def _comment(text: str, indent: str = "") -> list[str]:
    return [f"{indent}// {line}".rstrip() for line in text.splitlines()]


def _value(value: object, indent: str, path: str, comments: Mapping[str, str]) -> str:
    below = f"{path}/" if path else ""
    # One line per member if a comment is below, or if one line for all is too long.
    if not any(commented.startswith(below) and commented != path for commented in comments):
        short = _short(value)
        if len(indent) + len(short) < _WIDTH:
            return short
    inner = indent + _INDENT
    if isinstance(value, Mapping):
        lines = ["{"]
        for key, member in value.items():  # pyright: ignore
            lines += _comment(comments.get(below + key, ""), inner)  # pyright: ignore
            lines.append(f"{inner}{_name(key)}: {_value(member, inner, below + key, comments)},")  # pyright: ignore
        return "\n".join([*lines, f"{indent}}}"])
    if isinstance(value, Sequence) and not isinstance(value, str):
        elements = [f"{inner}{_value(element, inner, path, {})}," for element in value]  # pyright: ignore
        return "\n".join(["[", *elements, f"{indent}]"])
    return _short(value)


def _short(value: object) -> str:
    if isinstance(value, Mapping):
        members = [f"{_name(key)}: {_short(member)}" for key, member in value.items()]  # pyright: ignore
        return f"{{ {', '.join(members)} }}" if members else "{}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return f"[{', '.join(_short(element) for element in value)}]"  # pyright: ignore
    return json.dumps(value, ensure_ascii=False)


def _name(key: str) -> str:
    return key if _BARE_NAME.fullmatch(key) else json.dumps(key)
