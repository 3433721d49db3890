"""The checks of `zstate doctor` in order; those of the links that all robots share are in this file."""

from __future__ import annotations

import platform
import shlex
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from difflib import get_close_matches
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

import click

from zstate import __version__
from zstate.cli.commands import load_command
from zstate.cli.doctor.check import Check, broken, ok, warning
from zstate.cli.output.console import count_text
from zstate.cli.output.wire_text import OTHER_HOSTS, RosMessages, is_ros, messages_for, publish_command_for
from zstate.cli.session import SessionOptions, open_session
from zstate.cli.waiting import ConditionWaiter
from zstate.errors import AccessDenied, Unreachable, ZStateError
from zstate.extension import VARIABLE, kernel
from zstate.model.pinocchio_solver import select_engine
from zstate.net.config import ROUTER_ENDPOINT
from zstate.net.discovery import RobotInfo, connections, discover
from zstate.net.presence import announce
from zstate.net.rendezvous import rendezvous_addresses, rendezvous_key, silent_addresses
from zstate.net.security.connection_check import check_all_tcp, check_connections, check_rendezvous, check_tcp
from zstate.net.session import Session
from zstate.wire.keys import ANY

if TYPE_CHECKING:
    from zstate.buffer.frame_tree import FrameInfo

_RENDEZVOUS_WITHIN_S = 1.0

_CERTIFICATE = "--certs DIR --identity NAME"
_MISSING_OPTIONS = {
    "TLS demanded": _CERTIFICATE,
    "certificate demanded": _CERTIFICATE,
    "wrong CA": _CERTIFICATE,
    "user demanded": "--user NAME",
}


def diagnosis(network: SessionOptions, robot: str, wire: str, timeout_s: float) -> Iterator[Check]:
    """The links to ``robot``, or to every robot for "*".

    Ends at the first broken link that all robots share.
    """
    yield _installation_check()
    with ExitStack() as opened:
        try:
            session = opened.enter_context(open_session(network, (wire,)))
        except ZStateError as error:
            yield _refused_check(error, network)
            return
        except click.UsageError:
            raise
        except click.ClickException as error:
            yield broken("network", error.format_message(), "zstate router --ros2")
            return
        incomplete: Unreachable | None = None
        robots: tuple[RobotInfo, ...] = ()
        try:
            robots = discover(session, wire=wire)
        except Unreachable as error:
            incomplete = error
        # After discovery: this check counts the links that discovery had time to establish.
        check = _network_check(session, network.for_wires((wire,)))
        yield check
        if check.state == "broken":
            return
        if access := _access_check(session, network, robot):
            yield access
        if incomplete:
            yield broken("robots", str(incomplete), "zstate doctor")
            return
        selected = [info for info in robots if robot in (ANY, info.name)]
        if is_ros(wire) and messages_for(wire).robot:
            selected = list(robots)  # at most one, which has no name in ROS
        if not selected:
            yield _missing_robot_check(session, network, robot, robots, wire)
            return
        names = ", ".join(repr(info.name) for info in robots)
        yield ok("robots", messages_for(wire).announced(robots) if is_ros(wire) else f"{names} announced")
        for found in _robots_checks(session, selected, robots, wire, timeout_s, model_name=robot):
            yield replace(found, next=with_same_options(found.next, network, wire))


def with_same_options(command: str, network: SessionOptions, wire: str) -> str:
    """``command`` with the wire and endpoints of doctor, if it accepts them and sets none of its own."""
    text, mark, comment = command.partition("  #")
    program, *words = text.split() or [""]
    if program != "zstate":
        return command
    parameters = load_command(words[0]).params
    accepted = {option for parameter in parameters for option in parameter.opts}
    wires = ("--wire", wire) if wire != "native" else ()
    endpoints = tuple(word for endpoint in network.connect for word in ("--connect", endpoint))
    for group in (wires, endpoints):
        if group and group[0] in accepted and group[0] not in words:
            text += f" {shlex.join(group)}"
    return text + mark + comment


def _installation_check() -> Check:
    """The versions in use, and what computes lookups and the transforms of publishers."""
    zenoh, engine = metadata.version("eclipse-zenoh"), select_engine()
    python = platform.python_version()
    text = f"zstate {__version__}, kernel {kernel}, {engine.name}, Zenoh {zenoh}, Python {python}"
    if kernel != "c" and not kernel.reason.startswith(VARIABLE):
        text += f": {kernel.reason}; lookups return the same results and take longer"
        return warning("zstate", text, "pip install --force-reinstall --no-deps zstate")
    if engine.reason:
        return warning("zstate", f"{text}: {engine.reason}", engine.command)
    return ok("zstate", text)


def _refused_check(error: ZStateError, network: SessionOptions) -> Check:
    """The check of a network that no session could join, because of ``error``."""
    then = f"zstate config{_connect_options(network)}"
    if isinstance(error, Unreachable) and error.endpoints:
        text, next_command = check_all_tcp(error.endpoints)
        others = [f"; {where}: {', '.join(map(repr, names))}" for _, where, names in _find_elsewhere(network)]
        return broken("network", "".join((text, *others)), next_command or then)
    if isinstance(error, AccessDenied):
        endpoint, missing = error.endpoint, _MISSING_OPTIONS.get(error.reason)
        if error.reason in ("TLS demanded", "no TLS there"):
            protocol = "tls/" if error.reason == "TLS demanded" else "tcp/"
            endpoint = protocol + endpoint.partition("/")[2]
        options = " ".join(filter(None, (f"--connect {endpoint}", missing)))
        is_solvable = missing is not None or endpoint != error.endpoint
        then = f"zstate doctor {options}" if is_solvable else "zstate config"
    return broken("network", str(error), then)


def _network_check(session: Session, network: SessionOptions) -> Check:
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
            return broken("network", str(replies.error), f"zstate config{_connect_options(network)}")
    return ok("network", f"{network.joins_as}, linked to {joined}")


def _rendezvous_check(session: Session) -> Check:
    """Whether a rendezvous address has a peer; waits up to 1 s for one."""
    addresses = [f"{host}:{port}" for host, port in rendezvous_addresses()]
    waiter = ConditionWaiter()
    with ExitStack() as opened:
        publishers = [session.zenoh.declare_publisher(rendezvous_key(n)) for n in range(len(addresses))]
        for publisher in publishers:
            opened.callback(session.release, publisher)
            opened.callback(session.release, publisher.declare_matching_listener(waiter.notify))

        def found() -> list[str]:
            # Zenoh's stub declares a bool; it is an object that is always true.
            pairs = zip(addresses, publishers, strict=True)
            return [address for address, one in pairs if one.matching_status.matching]  # pyright: ignore

        waiter.wait_for(found, _RENDEZVOUS_WITHIN_S)
        address = next(iter(found()), None)
    if address == addresses[0]:
        count = connections(session).sessions["peer"] - 1
        return ok("network", f"programs of this host, which meet at {address}: {count} besides this one")
    silent = check_rendezvous(silent_addresses())
    if silent is None:
        text = f"programs of this host meet at {addresses[0]}, and none of them is found"
        return broken("network", text, "")
    if address is None:
        return broken("network", silent.text, silent.next)
    return warning("network", f"{silent.text}; the others meet at {address}", silent.next)


def _access_check(session: Session, network: SessionOptions, robot: str) -> Check | None:
    """Whether an identity named ``robot`` may write as that robot; None for other identities."""
    from zstate.net.security.write_permission import check_may_write

    credentials = network.credentials
    if robot == ANY or session.probe is None or credentials is None:
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


def _missing_robot_check(
    session: Session, network: SessionOptions, robot: str, robots: Sequence[RobotInfo], wire: str
) -> Check:
    names, options = [info.name for info in robots], _connect_options(network)
    what = "no robot is announced" if robot == ANY else f"robot {robot!r} is not announced"
    if names:
        near = get_close_matches(robot, names, n=1)
        then = with_same_options(f"zstate doctor {(near or names)[0]}", network, wire)
        return broken("robots", f"{what}; announced: {', '.join(map(repr, names))}", then)
    if is_ros(wire):
        text = messages_for(wire).announced(robots).partition(";")[0]
        then = f"zstate ls --wire {wire}{options}  # are the domain and the router right?"
        return broken("robots", text, then)
    for other_options, where, others in _find_elsewhere(network):
        text = f"{what} here; {where}: {', '.join(map(repr, others))}"
        found = robot if robot in others else others[0]
        return broken("robots", text, f"zstate doctor {found}{other_options}")
    if session.zenoh.info.routers_zid() and discover(session, 0.3, wire="ros2"):
        text = f"{what} on the native wire; this router also has ROS 2 nodes"
        return broken("robots", text, f"zstate doctor --wire ros2{options}")
    if session.probe is not None:
        what += f", or the router shows none to {session.probe.identity}"
    if robot == ANY:
        from zstate.model.catalog import example_name

        if not network.is_explicit:
            what += f" on this host; robots of other hosts: {OTHER_HOSTS}"
        return broken("robots", what, f"zstate publish {example_name()} --source sine{options}")
    command = publish_command_for("publish", robot)
    source = "" if "FILE" in command else " --source sine"
    return broken("robots", f"{what}: its publisher is not running", f"{command}{source}{options}")


def _find_elsewhere(network: SessionOptions) -> Iterator[tuple[str, str, list[str]]]:
    """Other options with which robots are announced, their description, and the names of the robots."""
    others: list[tuple[str, str, SessionOptions]] = []
    if network.is_explicit:
        others.append(("", "without --connect, among the programs of this host", SessionOptions()))
    if ROUTER_ENDPOINT not in network.connect and check_tcp(ROUTER_ENDPOINT) is None:
        options = f" --connect {ROUTER_ENDPOINT}"
        others.append((options, f"with{options}", SessionOptions("client", (ROUTER_ENDPOINT,))))
    for options, where, other in others:
        try:
            with other.open(1.0) as session:
                robots, ros = discover(session, 0.4), ""
                if not robots and other.connect:
                    robots, ros = discover(session, 0.4, wire="ros2"), " --wire ros2"
        except ZStateError:
            continue
        if robots:
            yield options + ros, where + ros, [info.name for info in robots]


def _connect_options(network: SessionOptions) -> str:
    """The endpoints as options of a command."""
    return "".join(f" --connect {endpoint}" for endpoint in network.connect)


def _robots_checks(
    session: Session,
    selected: Sequence[RobotInfo],
    robots: Sequence[RobotInfo],
    wire: str,
    timeout_s: float,
    *,
    model_name: str,
) -> Iterator[Check]:
    # Loaded after discovery, so that the first checks appear at once.
    from zstate.cli.doctor.clock_checks import domains_check
    from zstate.cli.doctor.robot_checks import robot_checks, shared_roots_checks, static_roots
    from zstate.cli.doctor.robot_probe import collected_probes
    from zstate.cli.doctor.ros_checks import ros_checks

    messages = messages_for(wire)
    tops: list[FrameInfo] = []
    clocks: dict[str, str] = {}
    with collected_probes(session, selected, robots, wire, timeout_s) as probes:
        for probe in probes:
            if probe.description is not None:
                clocks[probe.info.name] = probe.description.clock
            if isinstance(messages, RosMessages):
                checks = ros_checks(probe, messages, model_name)
            else:
                checks = robot_checks(probe, session)
            for check in checks:
                yield replace(check, robot=probe.info.name)
            tops += static_roots(probe)
        if any(probe.collector.has_overrun for probe in probes):
            text = "more samples arrive than this process takes in: the rates above are too low"
            yield warning("robots", text, f"zstate doctor {selected[0].name}  # one robot")
    if wire == "native":
        yield from shared_roots_checks(tops)
    yield from domains_check(clocks)
