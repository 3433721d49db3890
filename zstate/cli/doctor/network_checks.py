"""The links that all robots share: this installation, and the way to the others."""

from __future__ import annotations

import platform
from collections.abc import Iterator
from contextlib import ExitStack
from importlib import metadata

from zstate import __version__
from zstate.cli.doctor.check import Check, broken, ok, warning
from zstate.cli.output.console import count_text
from zstate.cli.session import SessionOptions
from zstate.cli.waiting import ConditionWaiter
from zstate.errors import AccessDenied, Unreachable, ZStateError
from zstate.extension import VARIABLE, kernel
from zstate.net.config import ROUTER_ENDPOINT
from zstate.net.presence import announce, connections, discover
from zstate.net.rendezvous import lobby_key, rendezvous_addresses, silent_addresses
from zstate.net.security.connection_check import (
    accepts_tcp,
    check_all_tcp,
    check_endpoints,
    check_rendezvous,
    check_tcp,
)
from zstate.net.session import Session, connect

_MET_WITHIN_S = 1.0

_DIFFERENTLY = {
    "TLS demanded": "--certs DIR --identity NAME",
    "certificate demanded": "--certs DIR --identity NAME",
    "wrong CA": "--certs DIR --identity NAME",
    "user demanded": "--user NAME",
}


def installation_check() -> Check:
    """What runs here."""
    zenoh = metadata.version("eclipse-zenoh")
    text = f"zstate {__version__}, kernel {kernel}, Zenoh {zenoh}, Python {platform.python_version()}"
    if kernel == "c" or kernel.reason.startswith(VARIABLE):
        return ok("zstate", text)
    return warning(
        "zstate",
        f"{text}: {kernel.reason}; lookups give the same answers and take longer",
        "pip install --force-reinstall --no-deps zstate",
    )


def refused_check(error: ZStateError, network: SessionOptions) -> Check:
    """There is no session, and ``error`` says why."""
    if isinstance(error, Unreachable) and error.endpoints:
        text, then = check_all_tcp(error.endpoints)
        for options, robots in find_elsewhere(network):
            text += f"; {with_options(options)}: {', '.join(map(repr, robots))}"
        return broken("network", text, then or f"zstate config{_options(network)}")
    if isinstance(error, AccessDenied):
        endpoint = error.endpoint
        if error.reason in ("TLS demanded", "no TLS there"):
            protocol = "tls/" if error.reason == "TLS demanded" else "tcp/"
            endpoint = protocol + endpoint.partition("/")[2]
        options = " ".join(filter(None, (f"--connect {endpoint}", _DIFFERENTLY.get(error.reason))))
        known = error.reason in _DIFFERENTLY or endpoint != error.endpoint
        return broken("network", str(error), f"zstate doctor {options}" if known else "zstate config")
    return broken("network", str(error), f"zstate config{_options(network)}")


def network_check(session: Session, network: SessionOptions) -> Check:
    """Whom the session has links to."""
    if not network.is_explicit:
        return _host_check(session)
    met = connections(session)
    parts = [count_text(number, kind) for kind, number in met.sessions.items() if number]
    links = ", ".join(sorted({str(link.dst) for link in session.zenoh.info.links()}))
    text = f"{network.joins_as}, linked to {' and '.join(parts) or 'nobody'}{f' ({links})' if links else ''}"
    for endpoint in network.connect if network.joins_as != "client" else ():
        why = check_tcp(endpoint)
        if why is not None:
            text = f"nothing answers at {endpoint!r} ({why.text}); a peer goes on trying"
            return broken("network", text, why.next)
        answers = check_endpoints([endpoint], network.credentials)
        if answers.are_refusals and not parts:
            return broken("network", str(answers.error), f"zstate config{_options(network)}")
    return ok("network", text)


def _host_check(session: Session) -> Check:
    addresses = [f"{host}:{port}" for host, port in rendezvous_addresses()]
    met = _met_at(session, len(addresses))
    if met == 0:
        count = connections(session).sessions["peer"] - 1
        return ok("network", f"programs of this host, which meet at {addresses[0]}: {count} besides this one")
    silent = check_rendezvous(silent_addresses())
    if silent is None:
        return broken(
            "network", f"programs of this host meet at {addresses[0]}, and none of them is found", ""
        )
    if met is None:
        return broken("network", silent.text, silent.next)
    return warning("network", f"{silent.text}; the others meet at {addresses[met]} meanwhile", silent.next)


def _met_at(session: Session, count: int) -> int | None:
    """Number of the first rendezvous address with a lobby; None if none is seen within 1 s."""
    waiter = ConditionWaiter()
    with ExitStack() as opened:
        publishers = [session.zenoh.declare_publisher(lobby_key(number)) for number in range(count)]
        for publisher in publishers:
            opened.callback(session.release, publisher)
            opened.callback(session.release, publisher.declare_matching_listener(waiter.notify))

        def met() -> list[int]:
            # The stub of zenoh says bool; it is an object that is always true.
            return [number for number, one in enumerate(publishers) if one.matching_status.matching]  # pyright: ignore

        waiter.wait_for(met, _MET_WITHIN_S)
        return next(iter(met()), None)


def access_check(session: Session, network: SessionOptions, robot: str) -> Check | None:
    """Whether whoever is called like ``robot`` may write as it; None for others, and where nobody asks."""
    from zstate.net.security.write_permission import check_may_write

    credentials = network.credentials
    if session.probe is None or credentials is None or robot not in _names(network):
        return None
    # Among the keys of its writers, and none that a reader could take for a writer's.
    token = f"zstate/{robot}/@writer/doctor/{session.zid}"
    with announce(session, token):
        try:
            check_may_write(session, robot, token)
        except AccessDenied as error:
            return broken("access", str(error), f"zstate acl --robot {robot}")
    return ok("access", f"the router lets {credentials.identity} write as {robot!r}")


def _names(network: SessionOptions) -> set[str]:
    from pathlib import Path

    credentials = network.credentials
    if credentials is None:
        return set()
    certificate = Path(credentials.certificate).stem if credentials.certificate else ""
    return {credentials.user or "", certificate} - {""}


def find_elsewhere(network: SessionOptions) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Options with which other robots than now would be seen, and which."""
    router = SessionOptions("client", (ROUTER_ENDPOINT,))
    others = [("", SessionOptions())] if network.is_explicit else []
    if ROUTER_ENDPOINT not in network.connect and accepts_tcp(ROUTER_ENDPOINT):
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
    """Where robots are seen with ``options`` as ``elsewhere`` gives them."""
    return f"with{options}" if options else "without --connect, among the programs of this host"


def _options(network: SessionOptions) -> str:
    return "".join(f" --connect {endpoint}" for endpoint in network.connect)
