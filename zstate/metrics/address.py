"""Address: where metrics are served, as a user says it."""

from __future__ import annotations

from typing import NamedTuple

from zstate._util.endpoint import parse_host_port
from zstate.errors import InvalidInput

LOCAL = "127.0.0.1"


class Address(NamedTuple):
    """A host to bind to and a port; port 0 is a free one."""

    host: str
    port: int

    @classmethod
    def parse(cls, text: str) -> Address:
        """ "9100" (this host alone), "0.0.0.0:9100" or "[::]:9100". Raises InvalidInput."""
        address = parse_host_port(text if ":" in text else f"{LOCAL}:{text}")
        if address is None:
            raise InvalidInput(f"{text!r} is not PORT or HOST:PORT; for instance 9100, or 0.0.0.0:9100")
        return cls(*address)
