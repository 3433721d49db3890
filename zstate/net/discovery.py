"""Discovery: the robots, writers and readers that are announced now, and the links of a session."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

from zstate.errors import InvalidInput, Unreachable
from zstate.net.presence import ALL_TOKENS_WITHIN_S
from zstate.net.queryable import check_timeout, query_tokens
from zstate.net.session import Session
from zstate.streams import StreamName
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.keys import ANY, READER_TOKEN
from zstate.wire.registry import get_wire

_ROUND_S = 0.1


@dataclass(frozen=True, order=True, slots=True)
class RobotInfo:
    """A robot with its writers as (stream, writer), sorted.

    ``names`` are (stream, name, writer), sorted, of the streams whose writers have names: sensors, maps,
    drivers of some joints, writers of edges.
    """

    name: str
    writers: tuple[tuple[StreamName, WriterId], ...]
    names: tuple[tuple[StreamName, str, WriterId], ...] = ()

    def __repr__(self) -> str:
        streams: dict[str, list[str]] = {}
        for stream, writer in self.writers:
            streams.setdefault(str(writer), []).append(stream)
        written = "; ".join(f"{writer} writes {', '.join(names)}" for writer, names in streams.items())
        return f"<robot {self.name!r}: {written or 'no writer'}>"

    def names_of(self, writer: WriterId, stream: StreamName) -> tuple[str, ...]:
        """The names under which ``writer`` writes on ``stream``, sorted; empty for streams without names."""
        return tuple(name for name, owner in self.named(stream) if owner == writer)

    def named(self, stream: StreamName) -> tuple[tuple[str, WriterId], ...]:
        """The names of the writers of ``stream``, sorted: (name, writer)."""
        return tuple((name, writer) for one, name, writer in self.names if one == stream)


def discover(session: Session, timeout_s: float = 1.0, *, wire: str = "native") -> tuple[RobotInfo, ...]:
    """Every announced robot with its writers, sorted by name.

    A session that has just connected has not discovered all others yet: queries until two replies in a row,
    a tenth of a second apart, have the same writers; without any writer for ``timeout_s`` [s].

    Raises Unreachable if Zenoh has not received the whole reply within 5 s, or ``timeout_s`` if that is more.
    """
    format_ = get_wire(wire)
    tokens = discover_tokens(session, format_.writers_expression(ANY), timeout_s)
    return by_robot({one for token in tokens for one in format_.parse_token(token, ANY)})


def discover_readers(session: Session, timeout_s: float = 1.0) -> tuple[Announcement, ...]:
    """Every announced reader of the native wire, sorted; the robot "*" stands for all robots.

    Queries like ``discover``. Programs that subscribe to keys without zstate are not announced.
    """
    found: set[Announcement] = set()
    for token in discover_tokens(session, READER_TOKEN.expression(), timeout_s):
        with suppress(InvalidInput):
            found.update(Announcement.parse_all(*READER_TOKEN.parse(token)))
    return tuple(sorted(found, key=lambda one: (one.robot, one.stream, one.writer)))


def discover_tokens(session: Session, expression: str, timeout_s: float = 1.0) -> frozenset[str]:
    """The liveliness tokens that match ``expression``, queried like ``discover``. Raises Unreachable."""
    deadline = time.monotonic() + check_timeout(timeout_s)
    found = last = frozenset[str]()
    is_complete = True
    while (remaining_s := deadline - time.monotonic()) > 0.0:
        # Thousands of tokens take a moment: no query is cut short.
        within_s, start_s = max(remaining_s, ALL_TOKENS_WITHIN_S), time.monotonic()
        tokens, is_complete = query_tokens(session.zenoh, expression, within_s)
        if tokens and tokens == found:
            break
        if not is_complete:
            found |= tokens
        elif tokens or not last:  # one reply without tokens may be wrong; two are not
            found = tokens
        last = tokens
        now_s = time.monotonic()
        time.sleep(max(0.0, min(start_s + _ROUND_S, deadline) - now_s))
    if not is_complete:
        waited_s = max(timeout_s, ALL_TOKENS_WITHIN_S)
        raise Unreachable(
            f"discovery is incomplete: {len(found)} announcements in {waited_s:g} s, and then no end of the "
            "reply; this host, its router or the link between them is overloaded: try again",
            endpoints=(),
        )
    return found


def by_robot(found: Iterable[Announcement]) -> tuple[RobotInfo, ...]:
    """The announced writers, grouped by robot, sorted."""
    writers: dict[str, set[tuple[StreamName, WriterId]]] = {}
    names: dict[str, set[tuple[StreamName, str, WriterId]]] = {}
    for one in found:
        writers.setdefault(one.robot, set()).add((one.stream, one.writer))
        if one.name:
            names.setdefault(one.robot, set()).add((one.stream, one.name, one.writer))
    return tuple(
        RobotInfo(robot, tuple(sorted(writers[robot])), tuple(sorted(names.get(robot, ()))))
        for robot in sorted(writers)
    )


class Connections(NamedTuple):
    """Numbers of sessions by their mode, of all three, and of links by their protocol ("tcp", "tls", ...)."""

    sessions: dict[str, int]
    links: dict[str, int]


def connections(session: Session) -> Connections:
    """The current direct connections of ``session``. Raises Closed."""
    info = session.zenoh.info
    sessions = Counter(str(transport.whatami).lower() for transport in info.transports())
    links = Counter(str(link.dst).partition("/")[0] for link in info.links())
    return Connections({mode: sessions[mode] for mode in ("client", "peer", "router")}, dict(links))
