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
from functools import partial
from pathlib import Path
from textwrap import shorten
from typing import NamedTuple

from zstate._util.endpoint import parse_endpoint
from zstate.errors import AccessDenied, NetworkError, Unreachable
from zstate.net.security.credentials import Credentials, client_context

_CONNECT_TIMEOUT_S = 2.0
_DENIAL_TIMEOUT_S = 1.0  # a router checks our certificate after our part of the handshake
_TCP_TIMEOUT_S = 1.0  # check_tcp


@dataclass(frozen=True, slots=True)
class DenialReason:
    """Why a router denies a session: ``reason`` for programs, ``text`` for users, with what to check."""

    reason: str
    text: str


@dataclass(frozen=True, slots=True)
class CheckResults:
    """The reasons of denials by endpoint; None if no program listens, or the protocol has no check.

    NO_REPLY if connections are accepted without a reply: such a router may accept the session later.
    """

    denials: Mapping[str, DenialReason | None]

    @property
    def is_denied(self) -> bool:
        """Whether every endpoint denies the session."""
        return bool(self.denials) and {None, NO_REPLY}.isdisjoint(self.denials.values())

    @property
    def error(self) -> NetworkError:
        """The error if none is reached: AccessDenied, or Unreachable if none answers."""
        no_answer = [repr(one) for one, denial in self.denials.items() if denial in (None, NO_REPLY)]
        for endpoint, denial in self.denials.items():
            if denial not in (None, NO_REPLY):
                rest = f" (nothing answers at {' or '.join(no_answer)})" if no_answer else ""
                text = f"{endpoint!r} answers and does not let this session in: {denial.text}{rest}"
                return AccessDenied(text, reason=denial.reason, endpoint=endpoint)
        endpoints = tuple(self.denials)
        no_reply = [repr(endpoint) for endpoint, denial in self.denials.items() if denial is NO_REPLY]
        if no_reply:
            return Unreachable(f"{' and '.join(no_reply)}: {NO_REPLY.text}", endpoints=endpoints)
        where = " or ".join(no_answer) or "the configured endpoints"
        text = f"nothing answers at {where}; is the router running? `zstate router`"
        return Unreachable(text, endpoints=endpoints)


def check_connections(endpoints: Sequence[str], credentials: Credentials | None) -> CheckResults:
    """Connects plain sockets to all ``endpoints`` in parallel; takes a few seconds at most.

    For sessions that Zenoh did not open: a router that accepts the certificate is assumed to deny the user.
    """
    if len(endpoints) == 1:  # without a pool, which starts no thread while the interpreter exits
        return CheckResults({endpoints[0]: _check_connection(endpoints[0], credentials)})
    with ThreadPoolExecutor(len(endpoints) or 1) as pool:
        denials = pool.map(partial(_check_connection, credentials=credentials), endpoints)
        return CheckResults(dict(zip(endpoints, denials, strict=True)))


def _check_connection(endpoint: str, credentials: Credentials | None) -> DenialReason | None:
    parsed = parse_endpoint(endpoint)
    if parsed is None or parsed.protocol not in ("tcp", "tls"):
        return None
    address = (parsed.host, parsed.port)
    try:
        with socket.create_connection(address, _CONNECT_TIMEOUT_S) as link:
            if parsed.protocol == "tls":
                denial = _handshake(link, parsed.host, credentials)
            elif credentials is not None and credentials.ca is not None:
                denial = _NO_TLS  # found by multicast; a session with a ca does not connect to it
            else:
                denial = _TLS_ONLY if _accepts_tls(link) else _user_reason(credentials)
    except (OSError, UnicodeError):
        return None
    assumes_no_tls = denial is _NO_TLS or (parsed.protocol == "tcp" and denial is not _TLS_ONLY)
    return NO_REPLY if assumes_no_tls and not _replies_without_tls(address) else denial


def _replies_without_tls(address: tuple[str, int]) -> bool:
    """Whether a Zenoh session without TLS replies at ``address``.

    It replies to a message of one byte, which is not of its protocol, by closing the link with a reason. A
    stopped listener does not reply, nor does one of TLS that is busy with other handshakes; a listener
    with too many pending connections closes this one without a reply.
    """
    try:
        with socket.create_connection(address, _CONNECT_TIMEOUT_S) as link:
            link.settimeout(_DENIAL_TIMEOUT_S)
            link.sendall(b"\x01\x00\x00")
            return bool(link.recv(1))
    except OSError:
        return False


def _accepts_tls(link: socket.socket) -> bool:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE  # no data is sent
    link.settimeout(_DENIAL_TIMEOUT_S)
    try:
        context.wrap_socket(link).close()
    except OSError:
        return False
    return True


def _handshake(link: socket.socket, host: str, credentials: Credentials | None) -> DenialReason:
    link.settimeout(_DENIAL_TIMEOUT_S)
    trusted = credentials if credentials and credentials.ca else None
    context = client_context(trusted) if trusted else ssl.create_default_context()
    try:
        secured = context.wrap_socket(link, server_hostname=host)
    except ssl.SSLCertVerificationError as error:
        return _server_certificate_reason(error, host, credentials)
    except ssl.SSLError as error:
        return _alert_reason(error, credentials) or _NO_TLS
    except OSError:
        return _NO_TLS
    with secured:
        secured.settimeout(_DENIAL_TIMEOUT_S)
        try:
            secured.recv(1)
        except ssl.SSLError as error:
            return _alert_reason(error, credentials) or _user_reason(credentials)
        except OSError:
            pass  # no alert: the router accepts the certificate and waits for Zenoh's first message
    return _user_reason(credentials)


NO_REPLY = DenialReason(
    "no answer",
    "connections are accepted and nothing is answered: the router process is stopped, or busy with other "
    "connections that never complete (deploy/README.md: firewall), or it is no router",
)
"""A listener accepts connections and does not reply: not a denial, as it may be temporary."""

_NO_TLS = DenialReason(
    "no TLS there",
    "it does not use TLS; let it listen at tls/... with a certificate (`zstate router --certs DIR "
    "--identity NAME`), or write 'tcp/' here without certificates",
)
_TLS_ONLY = DenialReason(
    "TLS demanded",
    "it accepts TLS only; write 'tls/' and give a certificate: --certs DIR --identity NAME, or credentials=",
)
_WANTS_CERTIFICATE = DenialReason(
    "certificate demanded",
    "it requires a certificate; give --certs DIR --identity NAME, or certificate= and key=",
)
_WANTS_USER = DenialReason(
    "user demanded",
    "it accepts the link and refuses the session; it probably requires a user: give --user NAME with the "
    "password in ZSTATE_PASSWORD, or user= and password=",
)
_UNKNOWN_AUTHORITY = DenialReason(
    "wrong CA",
    "its certificate is signed by no public authority, and this session was given no other to trust; give "
    "--certs DIR --identity NAME, or credentials= with the ca.pem of the authority that signed it",
)
_NO_SERVER = DenialReason(
    "not a server",
    "its certificate is for clients only; make one for servers: `zstate certs DIR --server NAME`",
)
_EXPIRED = DenialReason(
    "their certificate expired", "its certificate has expired; renew it there, and check both clocks"
)
_NOT_YET_VALID = DenialReason(
    "their certificate not yet valid", "its certificate is not valid yet; is this machine's clock behind?"
)


def _server_certificate_reason(
    error: ssl.SSLCertVerificationError, host: str, credentials: Credentials | None
) -> DenialReason:
    # OpenSSL's numbers (x509_vfy.h).
    if error.verify_code in (9, 10):
        return _NOT_YET_VALID if error.verify_code == 9 else _EXPIRED
    if error.verify_code == 26:
        return _NO_SERVER
    if error.verify_code in (62, 64):
        return DenialReason(
            "name mismatch",
            f"its certificate is not for {host!r}; connect to a name or address in it, or make one "
            f"for {host!r}: `zstate certs DIR --server NAME --host {host}`",
        )
    if credentials is None or credentials.ca is None:
        return _UNKNOWN_AUTHORITY
    return DenialReason(
        "wrong CA",
        f"its certificate is not signed by {str(credentials.ca)!r} ({error.verify_message}); both sides "
        "need the ca.pem of one authority: make their identities in one folder",
    )


def _alert_reason(error: ssl.SSLError, credentials: Credentials | None) -> DenialReason | None:
    """The reason in the TLS alert of a router that refuses our certificate (RFC 8446, section 6)."""
    alert = (error.reason or "").partition("ALERT_")[2]
    local = (
        repr(str(credentials.certificate)) if credentials and credentials.certificate else "no certificate"
    )
    if not alert or alert == "CERTIFICATE_REQUIRED":
        return _WANTS_CERTIFICATE if alert else None
    if alert == "CERTIFICATE_EXPIRED":
        return DenialReason(
            "our certificate expired",
            f"{local} has expired, or is not valid yet by the router's clock; "
            "renew it, and check both clocks",
        )
    return DenialReason(
        "our certificate refused",
        f"it refuses {local} ({alert.lower().replace('_', ' ')}); make the identity in the folder of "
        "the router's",
    )


def _user_reason(credentials: Credentials | None) -> DenialReason:
    if credentials is None or credentials.user is None:
        return _WANTS_USER
    return DenialReason(
        "user or password",
        f"the user {credentials.user!r} or the password is not in its --users file (a router without "
        "one refuses every session with a user)",
    )


class Unreachability(NamedTuple):
    """Why no TCP connection is established, and the command to run next."""

    text: str
    next: str


def check_tcp(endpoint: str) -> Unreachability | None:
    """Why ``endpoint`` accepts no TCP connection; None if it does, or if its protocol is not over TCP."""
    address = _tcp_address(endpoint)
    if address is None:
        return None
    host, port = address
    try:
        socket.create_connection(address, _TCP_TIMEOUT_S).close()
    except socket.gaierror:
        return Unreachability(f"the host name {host!r} is unknown", f"getent hosts {host}")
    except ConnectionRefusedError:
        text = "connection refused: the host is up, and no program listens at that port"
        if host == "localhost" or host.startswith(("127.", "::1")):
            return Unreachability(text, f"zstate router --listen {endpoint}")
        protocol = endpoint.partition("/")[0]
        return Unreachability(text, f"zstate router --listen {protocol}/0.0.0.0:{port}  # on {host}")
    except TimeoutError:
        text = f"no answer within {_TCP_TIMEOUT_S:g} s; check that the host is on, and the firewalls"
    except (OSError, UnicodeError) as error:
        text = (getattr(error, "strerror", None) or str(error)).lower()
    else:
        return None
    return Unreachability(text, f"ping -c 3 {host}")


def check_all_tcp(endpoints: Sequence[str]) -> Unreachability:
    """Why no session was opened at any of ``endpoints``, and the command for the first one with a reason."""
    reasons: list[str] = []
    command = ""
    for endpoint in dict.fromkeys(endpoints):
        found = check_tcp(endpoint)
        # Without a finding TCP is accepted, but the session was not.
        accepted = NO_REPLY.text if _tcp_address(endpoint) else "no answer"
        reasons.append(f"{endpoint!r} ({found.text if found else accepted})")
        command = command or (found.next if found else "")
    return Unreachability(f"nothing answers at {' or '.join(reasons)}", command)


def _tcp_address(endpoint: str) -> tuple[str, int] | None:
    parsed = parse_endpoint(endpoint)
    return (parsed.host, parsed.port) if parsed and parsed.protocol in ("tcp", "tls", "ws") else None


def check_rendezvous(addresses: Sequence[tuple[str, int]]) -> Unreachability | None:
    """The program at the first rendezvous address without a reply; None without ``addresses``."""
    if not addresses:
        return None
    host, port = addresses[0]
    listener = _listener(port)
    if listener is None:
        text = "does not answer: it is another program, or a stopped one"
        command = f"ss -ltnp 'sport = :{port}'  # lists it"
        return Unreachability(f"the program at the rendezvous port {host}:{port} {text}", command)
    pid, command, is_stopped = listener
    text = f"process {pid} ({command}) has the rendezvous port {host}:{port} and does not answer:"
    if is_stopped:
        return Unreachability(
            f"{text} it is stopped, as by Ctrl-Z; continue it (`fg`), or end it", f"kill -CONT {pid}"
        )
    return Unreachability(f"{text} it is another program, or one of zstate that hangs", f"ps -fp {pid}")


def _listener(port: int) -> tuple[int, str, bool] | None:
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
