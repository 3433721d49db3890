"""The configuration of a router: JSON5 that zenohd takes unchanged, and that ``zstate router`` runs.

Thinning: streams that a router passes on more slowly than they come, for links that are narrow.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from zstate.errors import ConfigError, InvalidInput
from zstate.net.config import ROS_ROUTER, ROUTER_ENDPOINT, SETTINGS, check_credentials, endpoint_list
from zstate.net.security.acl import check_namespace
from zstate.net.security.credentials import Credentials
from zstate.net.security.json5 import json5_text
from zstate.wire.keys import Stream, stream_key

THINNED: tuple[Stream, ...] = ("joint_states", "tf")
"""The streams whose samples may be left out: each is followed by a newer one."""


@dataclass(frozen=True, slots=True)
class Downsampling:
    """Streams of which a router passes on at most so many samples a second, to each neighbour.

    ``rates_hz`` says how many, of each of ``robots``; ``interfaces`` names the network interfaces to
    whose neighbours that applies, all unless given. Latched values are never left out. Readers count
    the samples left out as missed. Raises InvalidInput.
    """

    rates_hz: Mapping[str, float]
    robots: tuple[str, ...]
    interfaces: tuple[str, ...] = ()
    namespace: str = ""

    def __post_init__(self) -> None:
        check_namespace(self.namespace)
        for stream, rate_hz in self.rates_hz.items():
            if stream not in THINNED:
                raise InvalidInput(f"{stream!r} cannot be downsampled; {' and '.join(THINNED)} can")
            if not (math.isfinite(rate_hz) and rate_hz > 0.0):
                raise InvalidInput(f"{stream!r} at {rate_hz} Hz; give a positive number of samples a second")
        if not self.rates_hz or not self.robots:
            # One rule for all robots would let through so many of them together, and starve some.
            raise InvalidInput(
                "downsampling needs streams and the names of the robots: each is counted apart"
            )

    def settings(self) -> list[dict[str, object]]:
        """The section ``downsampling`` of a Zenoh configuration."""
        among = {"interfaces": list(self.interfaces)} if self.interfaces else {}
        rules = list(self._rules())
        return [{"id": "streams", **among, "flows": ["egress"], "messages": ["put"], "rules": rules}]

    def _rules(self) -> Iterator[dict[str, object]]:
        prefix = f"{self.namespace}/" if self.namespace else ""
        for robot in dict.fromkeys(self.robots):
            for stream in THINNED:
                if stream in self.rates_hz:
                    yield {"key_expr": prefix + stream_key(robot, stream), "freq": self.rates_hz[stream]}


_PRIVATE = ("tcp/127.", "tcp/localhost:", "tcp/[::1]:", "unixsock-stream/")
_HEAD = "The configuration of a Zenoh router: `zenohd -c FILE.json5`, or `zstate router --config FILE.json5`."

# How long peers are waited for at the start is not a router's; how it seeks other routers stands below.
_OURS = {path: value for path, value in SETTINGS.items() if path not in ("scouting/delay", "connect/retry")}
_SEEKING: dict[str, object] = {
    "connect/timeout_ms": -1,
    "connect/exit_on_failure": False,
    "connect/retry": SETTINGS["connect/retry"],
}

_COMMENTS = {
    "listen": "Where robots, readers and other routers come to.",
    "connect": "The routers that it joins. One that is not there yet, or no more, is sought for ever.",
    "scouting": "Nobody is sought by multicast.",
    "timestamping": "Samples carry their own stamps, and a router would replace those ahead of its clock.",
    "transport/link/tx": "Whoever is silent for so long [ms] is gone, and its liveliness tokens with it.",
    "transport/unicast": "How long opening and accepting a connection may take [ms]; how many may pend.",
    "transport/link/tls": "Encryption; with enable_mtls everybody shows a certificate of this authority.",
    "transport/auth": "Who may connect by name and password.",
    "transport/shared_memory": "No gain for messages this small.",
    "downsampling": "At most so many samples a second [Hz] to each neighbour, by rule, not by key.",
    "access_control": "Who may do what; what no rule allows is denied.",
}
_ROS_COMMENTS = {
    "scouting": "As rmw_zenohd has it, from here on: ROS nodes are peers, which find each other through it.",
    "timestamping": "Late joiners are given the past values of topics in order.",
    "queries_default_timeout": "Many nodes start at once, and are busy with that for a while.",
    "transport/link/tx": "",
    "transport/unicast": "",
}
_ACCESS_COMMENTS = {
    "scouting/gossip": "Peers that it introduces link directly, which access control does not see.\n"
    'Without, they get nothing from each other: connect with mode "client", ROS nodes too.',
}


@dataclass(frozen=True, slots=True)
class RouterConfig:
    """A router: where it listens, which routers it joins, whom it lets in, what it passes on.

    It listens at ``tcp/127.0.0.1:7447`` unless told otherwise. ``access_control`` is that section of a
    Zenoh configuration, for which somebody has to be asked for names; with it peers are not introduced
    to each other by gossip, as the router does not see what goes over their direct links. With ``ros2``
    the rest is as rmw_zenohd has it. With certificates everything is encrypted, but for what stays on
    this host.

    Raises InvalidInput and ConfigError for what cannot be used.
    """

    listen: tuple[str, ...] = (ROUTER_ENDPOINT,)
    connect: tuple[str, ...] = ()
    credentials: Credentials | None = None
    thinning: Downsampling | None = None
    access_control: Mapping[str, object] = field(default_factory=dict[str, object])
    ros2: bool = False

    def __post_init__(self) -> None:
        endpoint_list((*self.listen, *self.connect))
        check_credentials("router", self.credentials, self.listen)
        if self.credentials is not None:
            exposed = [endpoint for endpoint in self.listen if not endpoint.startswith(_PRIVATE)]
            self.credentials.check_endpoints(self.connect, exposed)
        if self.access_control and not self._asks_for_names:
            raise ConfigError(
                "there is access control, and nobody is asked for a name: everybody would be denied; give "
                "the router certificates (--certs DIR --identity NAME), users (--users FILE), or both",
                path="access_control",
            )

    @property
    def _asks_for_names(self) -> bool:
        return self.credentials is not None and bool(self.credentials.certificate or self.credentials.users)

    def settings(self) -> dict[str, object]:
        """As a Zenoh configuration."""
        told: dict[str, object] = {"mode": "router", "listen/endpoints": list(self.listen)}
        if self.connect:
            told |= {"connect/endpoints": list(self.connect), **_SEEKING}
        told |= ROS_ROUTER if self.ros2 else _OURS
        if self.credentials is not None:
            told |= self.credentials.settings()
        if self.thinning is not None:
            told["downsampling"] = self.thinning.settings()
        if self.access_control:
            told |= {"scouting/gossip/enabled": False, "access_control": self.access_control}
        whole: dict[str, Any] = {}
        _merge(whole, told)
        return whole

    def text(self, *, masked: bool = False) -> str:
        """As commented JSON5; ``masked``, with asterisks for the password."""
        comments = _COMMENTS | (_ROS_COMMENTS if self.ros2 else {})
        if self.access_control:
            comments |= _ACCESS_COMMENTS
        settings = self.settings()
        if masked and self.credentials is not None and self.credentials.password is not None:
            _merge(settings, {"transport/auth/usrpwd/password": "********"})
        return json5_text(settings, comments, _HEAD)


def _merge(whole: dict[str, Any], told: Mapping[str, Any]) -> None:
    """Put what is ``told`` by path, which may be objects, where it belongs in ``whole``."""
    for path, value in told.items():
        *parents, last = path.split("/")
        place = whole
        for parent in parents:
            place = place.setdefault(parent, {})
        if isinstance(value, Mapping):
            _merge(place.setdefault(last, {}), value)  # pyright: ignore[reportUnknownArgumentType]
        else:
            place[last] = value
