"""Checks of the links that all robots share: this installation, and the connection to other processes."""

from __future__ import annotations

import platform
from collections.abc import Iterator
from contextlib import ExitStack
from importlib import metadata
from pathlib import Path

from zstate import __version__
from zstate.cli.doctor.check import Check, broken, ok, warning
from zstate.cli.output.console import count_text
from zstate.cli.session import SessionOptions
from zstate.cli.waiting import ConditionWaiter
from zstate.errors import AccessDenied, Unreachable, ZStateError
from zstate.extension import VARIABLE, kernel
from zstate.net.config import ROUTER_ENDPOINT
from zstate.net.presence import announce, connections, discover
from zstate.net.rendezvous import rendezvous_addresses, rendezvous_key, silent_addresses
from zstate.net.security.connection_check import (
    check_all_tcp,
    check_connections,
    check_rendezvous,
    check_tcp,
)
from zstate.net.session import Session, connect

_RENDEZVOUS_WITHIN_S = 1.0

_CERTIFICATE = "--certs DIR --identity NAME"
_MISSING_OPTIONS = {
    "TLS demanded": _CERTIFICATE,
    "certificate demanded": _CERTIFICATE,
    "wrong CA": _CERTIFICATE,
    "user demanded": "--user NAME",
}


def installation_check() -> Check:
    """The versions in use."""
    zenoh = metadata.version("eclipse-zenoh")
    text = f"zstate {__version__}, kernel {kernel}, Zenoh {zenoh}, Python {platform.python_version()}"
    if kernel == "c" or kernel.reason.startswith(VARIABLE):
        return ok("zstate", text)
    return warning(
        "zstate",
        f"{text}: {kernel.reason}; lookups return the same results and take longer",
        "pip install --force-reinstall --no-deps zstate",
    )


def refused_check(error: ZStateError, network: SessionOptions) -> Check:
    """The check of a network that no session could join, because of ``error``."""
    config = f"zstate config{connect_options(network)}"
    if isinstance(error, Unreachable) and error.endpoints:
        text, then = check_all_tcp(error.endpoints)
        for options, robots in find_elsewhere(network):
            text += f"; {with_options(options)}: {', '.join(map(repr, robots))}"
        return broken("network", text, then or config)
    if isinstance(error, AccessDenied):
        endpoint, missing = error.endpoint, _MISSING_OPTIONS.get(error.reason)
        if error.reason in ("TLS demanded", "no TLS there"):
            protocol = "tls/" if error.reason == "TLS demanded" else "tcp/"
            endpoint = protocol + endpoint.partition("/")[2]
        options = " ".join(filter(None, (f"--connect {endpoint}", missing)))
        is_solvable = missing is not None or endpoint != error.endpoint
        return broken("network", str(error), f"zstate doctor {options}" if is_solvable else "zstate config")
    return broken("network", str(error), config)


def network_check(session: Session, network: SessionOptions) -> Check:
    """The processes that the session has links to."""
    if not network.is_explicit:
        return _rendezvous_check(session)
    counts = connections(session).sessions
    parts = [count_text(number, kind) for kind, number in counts.items() if number]
    links = ", ".join(sorted({str(link.dst) for link in session.zenoh.info.links()}))
    joined = f"{' and '.join(parts) or 'no session'}{f' ({links})' if links else ''}"
    for endpoint in network.connect if network.joins_as != "client" else ():
        reason = check_tcp(endpoint)
        if reason is not None:
            text = f"nothing answers at {endpoint!r} ({reason.text}); a peer keeps trying"
            return broken("network", text, reason.next)
        replies = check_connections([endpoint], network.credentials)
        if replies.is_denied and not parts:
            return broken("network", str(replies.error), f"zstate config{connect_options(network)}")
    return ok("network", f"{network.joins_as}, linked to {joined}")


def _rendezvous_check(session: Session) -> Check:
    addresses = [f"{host}:{port}" for host, port in rendezvous_addresses()]
    number = _rendezvous_number(session, len(addresses))
    if number == 0:
        count = connections(session).sessions["peer"] - 1
        return ok("network", f"programs of this host, which meet at {addresses[0]}: {count} besides this one")
    silent = check_rendezvous(silent_addresses())
    if silent is None:
        text = f"programs of this host meet at {addresses[0]}, and none of them is found"
        return broken("network", text, "")
    if number is None:
        return broken("network", silent.text, silent.next)
    return warning("network", f"{silent.text}; the others meet at {addresses[number]}", silent.next)


def _rendezvous_number(session: Session, count: int) -> int | None:
    """The number of the first of ``count`` rendezvous addresses with a peer; None if none is found in 1 s."""
    waiter = ConditionWaiter()
    with ExitStack() as opened:
        publishers = [session.zenoh.declare_publisher(rendezvous_key(number)) for number in range(count)]
        for publisher in publishers:
            opened.callback(session.release, publisher)
            opened.callback(session.release, publisher.declare_matching_listener(waiter.notify))

        def found() -> list[int]:
            # Zenoh's stub declares a bool; it is an object that is always true.
            return [number for number, one in enumerate(publishers) if one.matching_status.matching]  # pyright: ignore

        waiter.wait_for(found, _RENDEZVOUS_WITHIN_S)
        return next(iter(found()), None)


def access_check(session: Session, network: SessionOptions, robot: str) -> Check | None:
    """Whether an identity named ``robot`` may write as that robot; None for other identities."""
    from zstate.net.writer import check_may_write

    credentials = network.credentials
    if session.probe is None or credentials is None:
        return None
    if robot not in (credentials.user, Path(credentials.certificate or "").stem):
        return None
    # A key below those of its writers that no reader takes for a writer.
    token = f"zstate/{robot}/@writer/doctor/{session.zid}"
    with announce(session, token):
        try:
            check_may_write(session, robot, token)
        except AccessDenied as error:
            return broken("access", str(error), f"zstate acl --robot {robot}")
    return ok("access", f"the router lets {credentials.identity} write as {robot!r}")


def find_elsewhere(network: SessionOptions) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Other options with which robots are announced, and their names."""
    router = SessionOptions("client", (ROUTER_ENDPOINT,))
    others = [("", SessionOptions())] if network.is_explicit else []
    if ROUTER_ENDPOINT not in network.connect and check_tcp(ROUTER_ENDPOINT) is None:
        others.append((f" --connect {ROUTER_ENDPOINT}", router))
    for options, other in others:
        try:
            with connect(mode=other.joins_as, endpoints=other.connect, timeout_s=1.0) as session:
                robots = discover(session, 0.4)
                ros = discover(session, 0.4, wire="ros2") if other is router and not robots else ()
        except ZStateError:
            continue
        if robots:
            yield options, tuple(info.name for info in robots)
        elif ros:
            yield f"{options} --wire ros2", tuple(info.name for info in ros)


def with_options(options: str) -> str:
    """Description of ``options`` as ``find_elsewhere`` returns them."""
    return f"with{options}" if options else "without --connect, among the programs of this host"


def connect_options(network: SessionOptions) -> str:
    """The endpoints as options of a command."""
    return "".join(f" --connect {endpoint}" for endpoint in network.connect)
