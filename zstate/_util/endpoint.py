"""Hosts, ports and Zenoh endpoints (``protocol/host:port?metadata#config``), parsed and written."""

from __future__ import annotations

import re
from typing import NamedTuple

_HOST_PORT = re.compile(r"(?:\[(?P<ipv6>[0-9A-Fa-f:.%\w]+)\]|(?P<name>[^\s:/\[\]?#]+)):(?P<port>[0-9]{1,5})")
_METADATA = re.compile(r"[?#]")


class Endpoint(NamedTuple):
    """Protocol, host and port of an endpoint; IPv6 hosts without brackets."""

    protocol: str
    host: str
    port: int


def parse_endpoint(text: str) -> Endpoint | None:
    """The parts of ``text``; None if it is not of the form ``protocol/host:port``."""
    protocol, _, rest = text.partition("/")
    address = parse_host_port(_METADATA.split(rest, maxsplit=1)[0])
    return Endpoint(protocol, *address) if protocol and address else None


def parse_host_port(text: str) -> tuple[str, int] | None:
    """``host:port`` or ``[IPv6]:port``; None for any other text, and for ports above 65535."""
    match = _HOST_PORT.fullmatch(text)
    if match is None or int(match["port"]) > 65535:
        return None
    return match["ipv6"] or match["name"], int(match["port"])


def format_host(host: str) -> str:
    """``host`` as written before ``:port``: IPv6 addresses in brackets."""
    return f"[{host}]" if ":" in host else host
