"""Explains why an endpoint does not accept a session, with plain sockets.

Zenoh reports "unable to connect" for every reason: no route, refused port, TLS, certificate or user.
"""

from __future__ import annotations

import socket
import ssl
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten
from typing import NamedTuple

from zstate._util.endpoint import parse_endpoint
from zstate.errors import AccessDenied, NetworkError, Unreachable
from zstate.net.security.credential_files import client_context
from zstate.net.security.credentials import Credentials

ANSWERS_WITHIN_S = 2.0

_REFUSES_WITHIN_S = 1.0  # judged is our certificate after our part of the handshake is over
_CONNECTS_WITHIN_S = 1.0  # check_tcp


@dataclass(frozen=True, slots=True)
class RefusalReason:
    """``reason`` for programs, ``text`` for people: what happened, and what to check."""

    reason: str
    text: str


@dataclass(frozen=True, slots=True)
class CheckResults:
    """What those behind some endpoints object to: None where nobody is, or where it cannot be asked.

    SILENT where connections are accepted and nothing is answered: that router may let us in later.
    """

    refusals: Mapping[str, RefusalReason | None]

    @property
    def are_refusals(self) -> bool:
        """Whether there are any, and nobody is left who might let us in."""
        return bool(self.refusals) and {None, SILENT}.isdisjoint(self.refusals.values())

    @property
    def error(self) -> NetworkError:
        """The error for whoever reached none of them: AccessDenied, or Unreachable if none answers."""
        for endpoint, refusal in self.refusals.items():
            if refusal not in (None, SILENT):
                return AccessDenied(self._text(endpoint, refusal), reason=refusal.reason, endpoint=endpoint)
        endpoints = tuple(self.refusals)
        silent = [repr(endpoint) for endpoint, refusal in self.refusals.items() if refusal is SILENT]
        if silent:
            return Unreachable(f"{' and '.join(silent)}: {SILENT.text}", endpoints=endpoints)
        where = " or ".join(map(repr, self.refusals)) or "the configured endpoints"
        text = f"nothing answers at {where}; is the router running? `zstate router`"
        return Unreachable(text, endpoints=endpoints)

    def _text(self, endpoint: str, refusal: RefusalReason) -> str:
        silent = [repr(other) for other, answer in self.refusals.items() if answer in (None, SILENT)]
        rest = f" (nothing answers at {' or '.join(silent)})" if silent else ""
        return f"{endpoint!r} answers and does not let this session in: {refusal.text}{rest}"


def check_endpoints(endpoints: Sequence[str], credentials: Credentials | None) -> CheckResults:
    """Ask at each of ``endpoints``, by plain sockets, at once; takes seconds at most.

    Who answers and does not object to a certificate is said to object to the user: whoever is let in
    by Zenoh has no reason to ask.
    """
    if len(endpoints) == 1:
        return CheckResults({endpoint: _knock(endpoint, credentials) for endpoint in endpoints})
    with ThreadPoolExecutor(len(endpoints) or 1) as pool:
        asked = {endpoint: pool.submit(_knock, endpoint, credentials) for endpoint in endpoints}
        return CheckResults({endpoint: answer.result() for endpoint, answer in asked.items()})


def _knock(endpoint: str, credentials: Credentials | None) -> RefusalReason | None:
    """What the one behind ``endpoint`` objects to; None where nobody is, or where it cannot be asked."""
    parsed = parse_endpoint(endpoint)
    if parsed is None or parsed.protocol not in ("tcp", "tls"):
        return None
    address = (parsed.host, parsed.port)
    try:
        with socket.create_connection(address, ANSWERS_WITHIN_S) as link:
            if parsed.protocol == "tls":
                refusal = _handshake(link, parsed.host, credentials)
            elif credentials is not None and credentials.ca is not None:
                refusal = _SPEAKS_NO_TLS  # found by multicast; ours would not speak to it
            else:
                refusal = _SPEAKS_TLS if _speaks_tls(link) else _user_reason(credentials)
    except (OSError, UnicodeError):
        return None
    presumes_plain = refusal is _SPEAKS_NO_TLS or (parsed.protocol == "tcp" and refusal is not _SPEAKS_TLS)
    if presumes_plain and not _answers_plainly(address):
        return SILENT
    return refusal


def _answers_plainly(address: tuple[str, int]) -> bool:
    """Whether a Zenoh session without TLS answers there.

    It answers a message of one byte, which is none of its protocol, by closing the link with a reason. A
    listener that is stopped says nothing, nor does one of TLS that is busy with other handshakes; one
    that has too many connections pending closes this one without a word.
    """
    try:
        with socket.create_connection(address, ANSWERS_WITHIN_S) as link:
            link.settimeout(_REFUSES_WITHIN_S)
            link.sendall(b"\x01\x00\x00")
            return bool(link.recv(1))
    except OSError:
        return False


def _speaks_tls(link: socket.socket) -> bool:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE  # nothing is said over it
    link.settimeout(_REFUSES_WITHIN_S)
    try:
        context.wrap_socket(link).close()
    except OSError:
        return False
    return True


def _handshake(link: socket.socket, host: str, credentials: Credentials | None) -> RefusalReason:
    link.settimeout(_REFUSES_WITHIN_S)
    try:
        secured = _context(credentials).wrap_socket(link, server_hostname=host)
    except ssl.SSLCertVerificationError as error:
        return _server_certificate_reason(error, host, credentials)
    except ssl.SSLError as error:
        return _alert_reason(error, credentials) or _SPEAKS_NO_TLS
    except OSError:
        return _SPEAKS_NO_TLS
    with secured:
        return _verdict(secured, credentials)


def _verdict(secured: ssl.SSLSocket, credentials: Credentials | None) -> RefusalReason:
    secured.settimeout(_REFUSES_WITHIN_S)
    try:
        secured.recv(1)
    except ssl.SSLError as error:
        return _alert_reason(error, credentials) or _user_reason(credentials)
    except OSError:
        pass  # silence is consent: the router waits for Zenoh's first word
    return _user_reason(credentials)


def _context(credentials: Credentials | None) -> ssl.SSLContext:
    if credentials is None or credentials.ca is None:
        return ssl.create_default_context()
    return client_context(credentials)


SILENT = RefusalReason(
    "no answer",
    "connections are accepted and nothing is answered: the router process is stopped, or busy with other "
    "connections that never complete (deploy/README.md: firewall), or it is no router",
)
"""The answer of a listener that accepts connections and is silent: not a refusal, it may be over soon."""

_SPEAKS_NO_TLS = RefusalReason(
    "no TLS there",
    "it speaks no TLS; let it listen at tls/... with a certificate (`zstate router --certs DIR "
    "--identity NAME`), or write 'tcp/' here and leave the certificates out",
)
_SPEAKS_TLS = RefusalReason(
    "TLS demanded",
    "it speaks TLS only; write 'tls/' and show a certificate: --certs DIR --identity NAME, or credentials=",
)
_WANTS_CERTIFICATE = RefusalReason(
    "certificate demanded",
    "it demands a certificate and was shown none; give --certs DIR --identity NAME, or certificate= and key=",
)
_WANTS_USER = RefusalReason(
    "user demanded",
    "it takes the link and refuses the session, as one does that asks for a user; give --user NAME with the "
    "password in ZSTATE_PASSWORD, or user= and password=",
)
_OF_ANOTHER_AUTHORITY = RefusalReason(
    "wrong CA",
    "its certificate is signed by no public authority, and this session was given no other to trust; give "
    "--certs DIR --identity NAME, or credentials= with the ca.pem of the authority that signed it",
)
_NO_SERVER = RefusalReason(
    "not a server",
    "its certificate is one to connect with, not to listen; make one for it that is: `zstate certs DIR "
    "--server NAME`",
)
_EXPIRED = RefusalReason(
    "their certificate expired", "its certificate has expired; renew it there, and check both clocks"
)
_NOT_YET_VALID = RefusalReason(
    "their certificate not yet valid", "its certificate is not valid yet; is this machine's clock behind?"
)


def _server_certificate_reason(
    error: ssl.SSLCertVerificationError, host: str, credentials: Credentials | None
) -> RefusalReason:
    # OpenSSL's numbers (x509_vfy.h).
    if error.verify_code in (9, 10):
        return _NOT_YET_VALID if error.verify_code == 9 else _EXPIRED
    if error.verify_code == 26:
        return _NO_SERVER
    if error.verify_code in (62, 64):
        return RefusalReason(
            "name mismatch",
            f"its certificate is not for {host!r}; connect to a name or address that is in it, or make one "
            f"that is: `zstate certs DIR --server NAME --host {host}`",
        )
    if credentials is None or credentials.ca is None:
        return _OF_ANOTHER_AUTHORITY
    return RefusalReason(
        "wrong CA",
        f"its certificate is not signed by {str(credentials.ca)!r} ({error.verify_message}); both sides "
        "need the ca.pem of one authority: make their identities in one folder",
    )


def _alert_reason(error: ssl.SSLError, credentials: Credentials | None) -> RefusalReason | None:
    """What the other side said to our certificate, by the alerts of TLS (RFC 8446, section 6)."""
    alert = (error.reason or "").partition("ALERT_")[2]
    ours = repr(str(credentials.certificate)) if credentials and credentials.certificate else "no certificate"
    if not alert or alert == "CERTIFICATE_REQUIRED":
        return _WANTS_CERTIFICATE if alert else None
    if alert == "CERTIFICATE_EXPIRED":
        return RefusalReason(
            "our certificate expired",
            f"{ours} has expired, or is not valid yet by the router's clock; renew it, and check both clocks",
        )
    return RefusalReason(
        "our certificate refused",
        f"it refuses {ours} ({alert.lower().replace('_', ' ')}); make the identity in the folder in "
        "which the router's was made",
    )


def _user_reason(credentials: Credentials | None) -> RefusalReason:
    if credentials is None or credentials.user is None:
        return _WANTS_USER
    return RefusalReason(
        "user or password",
        f"the user {credentials.user!r} or the password is not what it knows; check its --users file (a "
        "router that has none refuses whoever names a user)",
    )


class Unreachability(NamedTuple):
    """Why no TCP connection is established, and the command to run next."""

    text: str
    next: str


def check_tcp(endpoint: str) -> Unreachability | None:
    """Why ``endpoint`` accepts no TCP connection; None if it does, or if it is not reached by TCP."""
    address = _tcp_address(endpoint)
    if address is None:
        return None
    host, port = address
    try:
        socket.create_connection(address, _CONNECTS_WITHIN_S).close()
    except socket.gaierror:
        return Unreachability(f"the name {host!r} is not known here", f"getent hosts {host}")
    except ConnectionRefusedError:
        text = "connection refused: the host is there, and nobody listens at that port"
        if host == "localhost" or host.startswith(("127.", "::1")):
            return Unreachability(text, f"zstate router --listen {endpoint}")
        protocol = endpoint.partition("/")[0]
        return Unreachability(text, f"zstate router --listen {protocol}/0.0.0.0:{port}  # on {host}")
    except TimeoutError:
        text = f"no answer within {_CONNECTS_WITHIN_S:g} s: is the host switched on, and no firewall between?"
    except (OSError, UnicodeError) as error:
        text = (getattr(error, "strerror", None) or str(error)).lower()
    else:
        return None
    return Unreachability(text, f"ping -c 3 {host}")


def accepts_tcp(endpoint: str) -> bool:
    """Whether any program accepts TCP connections at ``endpoint``."""
    return _tcp_address(endpoint) is not None and check_tcp(endpoint) is None


def check_all_tcp(endpoints: Sequence[str]) -> Unreachability:
    """Why no session was opened at any of ``endpoints``, and the command for the first that explains it."""
    found = {endpoint: check_tcp(endpoint) for endpoint in endpoints}
    # Where a TCP connection is accepted, the session was not.
    accepted = {endpoint: SILENT.text if _tcp_address(endpoint) else "no answer" for endpoint in endpoints}
    reasons = [f"{endpoint!r} ({why.text if why else accepted[endpoint]})" for endpoint, why in found.items()]
    then = next((why.next for why in found.values() if why), "")
    return Unreachability(f"nothing answers at {' or '.join(reasons)}", then)


def _tcp_address(endpoint: str) -> tuple[str, int] | None:
    parsed = parse_endpoint(endpoint)
    return (parsed.host, parsed.port) if parsed and parsed.protocol in ("tcp", "tls", "ws") else None


def check_rendezvous(silent: Sequence[tuple[str, int]]) -> Unreachability | None:
    """The program at the first of the ``silent`` rendezvous addresses; None without any."""
    for host, port in silent:
        met = f"programs of this host meet at {host}:{port}, and"
        holder = _holder(port)
        if holder is None:
            text = f"{met} whoever has that port does not answer: it is another program, or a stopped one"
            return Unreachability(text, f"ss -ltnp 'sport = :{port}'  # who is it?")
        pid, command, is_stopped = holder
        met += f" process {pid} ({command}), which has that port, does not answer:"
        if is_stopped:
            text = f"{met} it is stopped, as by Ctrl-Z; continue it (`fg`), or end it"
            return Unreachability(text, f"kill -CONT {pid}")
        return Unreachability(f"{met} it is another program, or one of zstate that hangs", f"ps -fp {pid}")
    return None


def _holder(port: int) -> tuple[int, str, bool] | None:
    """Id and command of the process that listens at ``port``, and whether it is stopped; Linux only."""
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
