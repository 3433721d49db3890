"""Connections: whom a session has links to."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

from zstate.net.session import Session

_MODES = ("client", "peer", "router")


class Connections(NamedTuple):
    """How many: sessions by their mode, of all three; links by their protocol ("tcp", "tls", ...)."""

    sessions: dict[str, int]
    links: dict[str, int]


def connections(session: Session) -> Connections:
    """Who is connected to ``session`` directly, now. Raises Closed."""
    info = session.zenoh.info
    met = Counter(str(transport.whatami).lower() for transport in info.transports())
    links = Counter(str(link.dst).partition("/")[0] for link in info.links())
    return Connections({mode: met[mode] for mode in _MODES}, dict(links))
