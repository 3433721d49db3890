"""Uplink: what the router of a site passes to headquarters, and at which rates.

Three rules of Zenoh on that link: access control denies what is not named, downsampling limits the rate of
each named robot, and a low-pass filter drops what is too large.
"""

from __future__ import annotations

import socket
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from zstate.errors import ConfigError, InvalidInput
from zstate.fleet.acl import ALL_KEYS, MESSAGES, Rule, check_namespace
from zstate.fleet.downsampling import check_rates, rate_rules
from zstate.net.sites import UPLINK_OF
from zstate.stream_registry import all_streams
from zstate.streams import StreamName
from zstate.wire.keys import ANY, RELEASE, STATUS, check_robot, stream_expression

_EARLY = 0.96
"""A sample passes this part of the period after the last one: one that comes a little early passes as well,
and 50 Hz at 5 Hz gives 5 Hz, not every eleventh sample."""

_PROTOCOLS = ("tcp", "udp", "tls", "quic", "ws", "unixsock-stream", "unixpipe", "serial", "vsock")
"""All that access control of Zenoh knows."""
_WITHOUT_INTERFACE = ("unixsock-stream", "unixpipe", "serial", "vsock")

_Link = Mapping[str, list[str]]
"""The conditions by which Zenoh distinguishes links."""


@dataclass(frozen=True, slots=True)
class Uplink:
    """The link from the router of ``site`` to those of headquarters at ``endpoints``, and what passes on it.

    ``rates_hz`` is the limit by stream, for each of ``robots``. Of streams at 0, of those without a rate, and
    of other robots no sample passes. Latched values, commands, stops, tokens, the simulated time, queries
    and their replies pass for all robots; of keys that are not zstate's, and of streams of packages that are
    not installed here, nothing does. What is larger than ``largest_bytes`` does not pass either, as a sample,
    a value or a reply: that is about what sensors and programs measure, while descriptions, edges and joints
    have any size. Samples and values are dropped if the link is full, and never wait.

    ``interfaces`` are the network interfaces of the link. Without them, its protocol distinguishes it from
    the local ones. Raises InvalidInput.
    """

    site: str
    endpoints: tuple[str, ...]
    rates_hz: Mapping[StreamName, float]
    robots: tuple[str, ...]
    interfaces: tuple[str, ...] = ()
    namespace: str = ""
    largest_bytes: int | None = None

    def __post_init__(self) -> None:
        check_robot(self.site, "site")
        check_namespace(self.namespace)
        check_rates(self.rates_hz, 0.0)
        for robot in self.robots:
            check_robot(robot)
        if not self.endpoints:
            raise InvalidInput(f"the site {self.site!r} has no uplink; give the endpoint of headquarters")
        if not self.robots:
            raise InvalidInput(
                f"the site {self.site!r} names no robots: each has a limit of its own on the uplink; give "
                "their names (--robot NAME, or --robot-file FILE with one name on each line)"
            )

    @property
    def passing(self) -> tuple[StreamName, ...]:
        """The streams of samples that pass, thinned."""
        return tuple(stream for stream, rate_hz in self.rates_hz.items() if rate_hz)

    @property
    def text(self) -> str:
        """What passes, in a sentence."""
        rates = [f"{stream} at {self.rates_hz[stream]:g} Hz" for stream in self.passing]
        count, robots = len(set(self.robots)), "robot" if len(set(self.robots)) == 1 else "robots"
        return (
            f"{' and '.join(rates) or 'no samples'} of {count} {robots} leave for {', '.join(self.endpoints)}"
        )

    def settings(self, others: Sequence[str], access: Mapping[str, object]) -> dict[str, object]:
        """The sections of a Zenoh configuration that thin the uplink.

        ``others`` are the endpoints of all other links of the router, and ``access`` the access control of
        their sessions; if it is empty, these may do everything. Raises ConfigError if the uplink cannot be
        distinguished from them.
        """
        link = self._link(others)
        uplink = {"id": f"{UPLINK_OF}{self.site}", **link, "flows": ["egress"]}
        thinned = {stream: self.rates_hz[stream] / _EARLY for stream in self.passing}
        rules = rate_rules(thinned, self.robots, self.namespace)
        keys = ["**", "**/@adv/**"]
        overwrite = {"key_exprs": keys, "overwrite": {"congestion_control": "drop"}}
        settings: dict[str, object] = {
            "qos/network": [{**uplink, "messages": ["put"], **overwrite}],
            "access_control": self._access_control(link, access),
        }
        if rules:
            settings["downsampling"] = [{**uplink, "messages": ["put"], "rules": rules}]
        if self.largest_bytes is not None:
            of = {"messages": ["put", "reply"], "key_exprs": [*self._measured()]}
            settings["low_pass_filter"] = [{**uplink, **of, "size_limit": self.largest_bytes}]
        return settings

    def _access_control(self, link: _Link, access: Mapping[str, object]) -> dict[str, object]:
        """``access`` with what passes on ``link`` added.

        Of a key that matches two rules of downsampling Zenoh takes any of them, so that one for all robots
        cannot stand next to those for each. Access control allows what one of its rules includes.
        """
        other = [message for message in MESSAGES if message not in _PUTS]
        rules = [
            _allow("leaves", _PUTS, ("egress",), self._leaving()),
            _allow("leaves without samples", other, ("egress",), ALL_KEYS),
            _allow("comes", MESSAGES, ("ingress",), ALL_KEYS),
        ]
        subjects: list[Mapping[str, object]] = [{"id": "uplink", **link}]
        policies = [{"id": "uplink", "rules": [one["id"] for one in rules], "subjects": ["uplink"]}]
        if not access:
            local = {f"local {number}": one for number, one in enumerate(self._local())}
            rules.append(_allow("within the site", MESSAGES, ("ingress", "egress"), ALL_KEYS))
            subjects += [{"id": name, **one} for name, one in local.items()]
            policies.append({"id": "site", "rules": ["within the site"], "subjects": [*local]})
        added: dict[str, Sequence[object]] = {"rules": rules, "subjects": subjects, "policies": policies}
        lists = {name: [*access.get(name, ()), *entries] for name, entries in added.items()}  # pyright: ignore
        return {"enabled": True, "default_permission": "deny", **lists}

    def _leaving(self) -> Iterator[str]:
        """The keys of samples and values that leave."""
        for row in all_streams():
            if row.name in self.passing:
                yield from (self._key(row.name, robot) for robot in dict.fromkeys(self.robots))
            elif not row.is_sampled:
                yield self._key(row.name)
        yield from (self._prefix + key.expression() for key in (STATUS, RELEASE))
        yield f"{self._prefix}zstate/**/@adv/**"

    def _measured(self) -> Iterator[str]:
        """The keys of what may be large, and is no part of a robot's pose."""
        for row in all_streams():
            if row.group == "measurement":
                yield from (self._key(row.name), f"{self._key(row.name)}/@adv/**")

    def _key(self, stream: StreamName, robot: str = ANY) -> str:
        return self._prefix + stream_expression(robot, stream)

    @property
    def _prefix(self) -> str:
        return f"{self.namespace}/" if self.namespace else ""

    def _link(self, others: Sequence[str]) -> _Link:
        """The conditions by which the uplink is distinguished from other links."""
        if self.interfaces:
            return {"interfaces": list(self.interfaces)}
        protocols = {endpoint.partition("/")[0] for endpoint in self.endpoints}
        if shared := protocols & {endpoint.partition("/")[0] for endpoint in others}:
            protocol = min(shared)
            alike = next(endpoint for endpoint in others if endpoint.startswith(f"{protocol}/"))
            raise ConfigError(
                f"the uplink {self.endpoints[0]!r} cannot be distinguished from {alike!r}: both are "
                f"{protocol}, and links are thinned by protocol or network interface; give the interface of "
                "the uplink (--wan wwan0), or choose another protocol for one of the two, such as quic for "
                "the uplink",
                path="uplink",
            )
        return {"link_protocols": sorted(protocols)}

    def _local(self) -> Iterator[_Link]:
        """The conditions of all links but the uplink, of which one holds: there is no "not" in Zenoh's."""
        if self.interfaces:
            names = [name for _, name in socket.if_nameindex() if name not in self.interfaces]
            yield {"interfaces": names}
            yield {"link_protocols": [*_WITHOUT_INTERFACE]}
        else:
            protocols = {endpoint.partition("/")[0] for endpoint in self.endpoints}
            yield {"link_protocols": [one for one in _PROTOCOLS if one not in protocols]}


_PUTS = ("put", "delete")


def _allow(name: str, messages: Sequence[str], flows: Sequence[str], keys: Iterable[str]) -> Rule:
    return {
        "id": name,
        "permission": "allow",
        "flows": [*flows],
        "messages": [*messages],
        "key_exprs": [*keys],
    }
