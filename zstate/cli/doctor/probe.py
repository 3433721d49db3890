"""What stands at the address of an endpoint, asked by a plain socket."""

from __future__ import annotations

import re
import socket

_ADDRESS = re.compile(r"(?:tcp|tls|ws)/\[?(?P<host>[^\]?#]+)\]?:(?P<port>\d+)")
_ANSWERS_WITHIN_S = 1.0


def objection(endpoint: str) -> str:
    """Why no connection comes about; empty where one does, or where it cannot be tried."""
    match = _ADDRESS.match(endpoint)
    if match is None:
        return ""
    try:
        socket.create_connection((match["host"], int(match["port"])), _ANSWERS_WITHIN_S).close()
    except socket.gaierror:
        return f"the name {match['host']!r} is not known here"
    except ConnectionRefusedError:
        return "connection refused: the host is there, and nobody listens at that port"
    except TimeoutError:
        return f"no answer within {_ANSWERS_WITHIN_S:g} s: is the host switched on, and no firewall between?"
    except (OSError, UnicodeError) as error:
        return (getattr(error, "strerror", None) or str(error)).lower()
    return ""


def is_open(endpoint: str) -> bool:
    """Whether somebody listens there by TCP, whoever that is."""
    return bool(_ADDRESS.match(endpoint)) and not objection(endpoint)
