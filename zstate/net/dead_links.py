"""Links that were cut: how long a TLS connection waits for a host that does not respond.

Zenoh closes a link from which nothing has come for its lease. For TLS it first sends what waits in the
socket. If that is full the end of a cut connection comes with the next attempt of TCP to send again, whose
pauses double (RFC 6298): after a cut of 30 s for up to 21 s more, while Zenoh adds new connections to the
neighbour to the old transport, without any declarations. So the kernel gives up such a connection after
the lease (TCP_USER_TIMEOUT, RFC 5482).
"""

from __future__ import annotations

import json
import socket
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TypeAlias

import zenoh

from zstate._util.endpoint import parse_endpoint

LinkListener: TypeAlias = "zenoh.LinkEventsListener[None]"


# zenoh 1.10, closing a TLS link that was cut off waits until its socket has room: delete when fixed
def limit_dead_links(session: zenoh.Session, config: zenoh.Config) -> LinkListener | None:
    """Let the kernel end TLS connections of ``session`` whose other host acknowledges nothing for the lease.

    The result holds as long as it is referenced. None where the kernel has no such limit: Linux has one.
    """
    if sys.platform != "linux":
        return None
    lease_ms = int(json.loads(config.get_json("transport/link/tx/lease")))
    handler = zenoh.handlers.Callback(partial(_on_link, lease_ms), indirect=False)
    return session.info.declare_link_events_listener(handler, history=True)


def _on_link(lease_ms: int, event: zenoh.LinkEvent) -> None:
    """Called in a thread of Zenoh, which must not wait."""
    ends = parse_endpoint(str(event.link.src)), parse_endpoint(str(event.link.dst))
    if event.kind != zenoh.SampleKind.PUT or None in ends or not str(event.link.src).startswith("tls/"):
        return
    ports = tuple(end.port for end in ends if end is not None)
    for number in Path("/proc/self/fd").iterdir():
        with suppress(OSError):  # it is no socket, or was closed at the same time
            _limit_if_between(int(number.name), ports, lease_ms)


def _limit_if_between(number: int, ports: tuple[int, ...], limit_ms: int) -> None:
    """Set the limit of the socket with this file descriptor if it connects ``ports``, here and there."""
    opened = socket.socket(fileno=number)
    try:
        is_tcp = opened.family in (socket.AF_INET, socket.AF_INET6) and opened.type == socket.SOCK_STREAM
        if is_tcp and (opened.getsockname()[1], opened.getpeername()[1]) == ports:
            opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, limit_ms)
    finally:
        opened.detach()  # it is Zenoh's, and stays open
