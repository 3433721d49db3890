"""What stands at the address of an endpoint, asked by a plain socket."""

from __future__ import annotations

import re
import socket
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from textwrap import shorten
from typing import NamedTuple

_ADDRESS = re.compile(r"(?:tcp|tls|ws)/\[?(?P<host>[^\]?#]+)\]?:(?P<port>\d+)")
_ANSWERS_WITHIN_S = 1.0


class Objection(NamedTuple):
    """Why no connection comes about, and the command to go on with."""

    text: str
    next: str


def objection(endpoint: str) -> Objection | None:
    """What keeps one from ``endpoint``; None where nothing does, or where it cannot be tried."""
    match = _ADDRESS.match(endpoint)
    if match is None:
        return None
    host, port = match["host"], int(match["port"])
    try:
        socket.create_connection((host, port), _ANSWERS_WITHIN_S).close()
    except socket.gaierror:
        return Objection(f"the name {host!r} is not known here", f"getent hosts {host}")
    except ConnectionRefusedError:
        text = "connection refused: the host is there, and nobody listens at that port"
        return Objection(text, _listening(host, port, endpoint))
    except TimeoutError:
        text = f"no answer within {_ANSWERS_WITHIN_S:g} s: is the host switched on, and no firewall between?"
        return Objection(text, f"ping -c 3 {host}")
    except (OSError, UnicodeError) as error:
        text = (getattr(error, "strerror", None) or str(error)).lower()
        return Objection(text, f"ping -c 3 {host}")
    return None


def _listening(host: str, port: int, endpoint: str) -> str:
    if host == "localhost" or host.startswith(("127.", "::1")):
        return f"zstate router --listen {endpoint}"
    return f"zstate router --listen {endpoint.partition('/')[0]}/0.0.0.0:{port}  # on {host}"


def unanswered(endpoints: Sequence[str]) -> Objection:
    """Why nobody answers at any of ``endpoints``."""
    from zstate.net.refusal import SILENT  # loads ssl, which few need

    found = {endpoint: objection(endpoint) for endpoint in endpoints}
    # Where a connection is accepted, the session was not.
    accepted = {endpoint: SILENT.text if _ADDRESS.match(endpoint) else "no answer" for endpoint in endpoints}
    reasons = [f"{endpoint!r} ({why.text if why else accepted[endpoint]})" for endpoint, why in found.items()]
    then = next((why.next for why in found.values() if why), "")
    return Objection(f"nothing answers at {' or '.join(reasons)}", then)


def is_open(endpoint: str) -> bool:
    """Whether somebody listens there by TCP, whoever that is."""
    return bool(_ADDRESS.match(endpoint)) and objection(endpoint) is None


def silent_rendezvous() -> Objection | None:
    """Which program keeps the processes of this host from meeting; None where they meet."""
    from zstate.net.rendezvous import silent_addresses

    for host, port in silent_addresses():
        met = f"programs of this host meet at {host}:{port}, and"
        holder = _holder(port)
        if holder is None:
            text = f"{met} whoever has that port does not answer: it is another program, or a stopped one"
            return Objection(text, f"ss -ltnp 'sport = :{port}'  # who is it?")
        pid, command, is_stopped = holder
        met += f" process {pid} ({command}), which has that port, does not answer:"
        if is_stopped:
            text = f"{met} it is stopped, as by Ctrl-Z; continue it (`fg`), or end it"
            return Objection(text, f"kill -CONT {pid}")
        return Objection(f"{met} it is another program, or one of zstate that hangs", f"ps -fp {pid}")
    return None


def _holder(port: int) -> tuple[int, str, bool] | None:
    """Which process listens at ``port`` of this host, its command, and whether it is stopped (on Linux)."""
    with suppress(OSError):
        rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
        listening = {f"socket:[{row[9]}]" for row in rows if row[3] == "0A" and int(row[1][-4:], 16) == port}
        for process in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):  # of another user, or gone
                if listening.intersection(str(link.readlink()) for link in process.glob("fd/*")):
                    command = process.joinpath("cmdline").read_text().replace("\0", " ").strip()
                    state = process.joinpath("stat").read_text().rpartition(")")[2].split()[0]
                    return int(process.name), shorten(command, 60), state in "Tt"
    return None
