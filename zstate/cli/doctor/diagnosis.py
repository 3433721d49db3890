"""The checks of `zstate doctor` in order, each reported as soon as it is done, and their text and JSON."""

from __future__ import annotations

import shlex
import shutil
import textwrap
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from difflib import get_close_matches
from importlib import import_module
from typing import TYPE_CHECKING, Any

import click

from zstate.cli.doctor.check import Check, broken, first_broken, ok, warning
from zstate.cli.doctor.network_checks import (
    access_check,
    connect_options,
    find_elsewhere,
    installation_check,
    network_check,
    refused_check,
    with_options,
)
from zstate.cli.output.console import colored, count_text, is_terminal
from zstate.cli.output.wire_text import RosMessages, is_ros, messages_for, publish_command_for
from zstate.cli.session import SessionOptions, open_session
from zstate.cli.waiting import ConditionWaiter
from zstate.errors import ZStateError
from zstate.net.config import ROUTER_ENDPOINT
from zstate.wire.keys import ANY

if TYPE_CHECKING:
    from zstate.buffer.frame_tree import FrameInfo
    from zstate.net.presence import RobotInfo
    from zstate.net.session import Session

_GROUP = 50
"""The number of robots probed at the same time: each takes eight threads."""

_MAX_TIMEOUTS = 5
"""The number of timeouts after which no more robots are examined. In a large fleet, silent robots take one
timeout for each group of them."""

_COLORS = {"ok": "green", "warning": "yellow", "broken": "red", "skipped": None}
_STATE, _NAME, _MIN_TEXT = 7, 12, 20  # widths


def diagnosis(network: SessionOptions, robot: str, wire: str, timeout_s: float) -> Iterator[Check]:
    """The links to ``robot``, or to every robot for "*".

    Ends at the first broken link that all robots share.
    """
    yield installation_check()
    with ExitStack() as opened:
        try:
            session = opened.enter_context(open_session(network, (wire,)))
        except ZStateError as error:
            yield refused_check(error, network)
            return
        except click.UsageError:
            raise
        except click.ClickException as error:
            yield broken("network", error.format_message(), "zstate router --ros2")
            return
        yield from _after_connecting(session, network, robot, wire, timeout_s)


def effective_network(network: SessionOptions, wire: str) -> SessionOptions:
    """The options that ``open_session`` uses, with its default on a ROS wire."""
    if is_ros(wire) and not network.is_explicit:
        return SessionOptions("client", (ROUTER_ENDPOINT,))
    return network


def _after_connecting(
    session: Session, network: SessionOptions, robot: str, wire: str, timeout_s: float
) -> Iterator[Check]:
    from zstate.net.presence import discover

    robots = discover(session, wire=wire)
    # After discovery: this check counts the links that discovery had time to establish.
    check = network_check(session, effective_network(network, wire))
    yield check
    if check.state == "broken":
        return
    access = None if robot == ANY else access_check(session, network, robot)
    if access is not None:
        yield access
    selected = [info for info in robots if robot in (ANY, info.name)]
    if is_ros(wire) and messages_for(wire).robot:
        selected = list(robots)  # at most one, which has no name in ROS
    if not selected:
        yield _missing_robot_check(session, network, robot, robots, wire)
        return
    names = ", ".join(repr(info.name) for info in robots)
    yield ok("robots", messages_for(wire).announced(robots) if is_ros(wire) else f"{names} announced")
    for found in _robots_checks(session, selected, robots, wire, timeout_s, model_name=robot):
        yield replace(found, next=with_same_options(found.next, network, wire)) if found.next else found


def _robots_checks(
    session: Session,
    selected: Sequence[RobotInfo],
    robots: Sequence[RobotInfo],
    wire: str,
    timeout_s: float,
    *,
    model_name: str,
) -> Iterator[Check]:
    from zstate.cli.doctor.clock_checks import domains_check
    from zstate.cli.doctor.robot_checks import robot_checks, shared_roots_checks, static_roots
    from zstate.cli.doctor.robot_probe import RobotProbe, wait_for_probes
    from zstate.cli.doctor.ros_checks import ros_checks
    from zstate.net.clock_offset import measure_offsets

    messages = messages_for(wire)
    offsets = measure_offsets(session, ANY) if wire == "native" else ()
    tops: list[FrameInfo] = []
    clocks: dict[str, str] = {}
    deadline = time.monotonic() + _MAX_TIMEOUTS * timeout_s
    for first in range(0, len(selected), _GROUP):
        if time.monotonic() > deadline:
            text = (
                f"{len(selected) - first} of {len(selected)} robots were not examined within "
                f"{_MAX_TIMEOUTS * timeout_s:g} s; name one robot, or raise --timeout"
            )
            yield warning("robots", text, f"zstate doctor {selected[first].name}")
            break
        with ExitStack() as opened:
            waiter, probes = ConditionWaiter(), list[RobotProbe]()
            for info in selected[first : first + _GROUP]:
                probes.append(opened.enter_context(RobotProbe(session, info, wire, robots, waiter.notify)))
            if wire == "native":
                for probe in probes:
                    probe.offsets = tuple(one for one in offsets if one.robot == probe.info.name)
                    probe.find_unresponsive()
            wait_for_probes(probes, waiter, timeout_s)
            for probe in probes:
                if probe.description is not None:
                    clocks[probe.info.name] = probe.description.clock
                if isinstance(messages, RosMessages):
                    checks = ros_checks(probe, session, messages, model_name)
                else:
                    checks = robot_checks(probe, session)
                for check in checks:
                    yield check.for_robot(probe.info.name)
                tops += static_roots(probe)
    if wire == "native":
        yield from shared_roots_checks(tops)
    different = domains_check(clocks)
    if different is not None:
        yield different


def _missing_robot_check(
    session: Session, network: SessionOptions, robot: str, robots: tuple[RobotInfo, ...], wire: str
) -> Check:
    from zstate.net.presence import discover

    names, options = [info.name for info in robots], connect_options(network)
    what = "no robot is announced" if robot == ANY else f"robot {robot!r} is not announced"
    if is_ros(wire) and not names:
        text = messages_for(wire).announced(robots).partition(";")[0]
        return broken(
            "robots", text, f"zstate ls --wire {wire}{options}  # are the domain and the router right?"
        )
    if names:
        near = get_close_matches(robot, names, n=1)
        then = with_same_options(f"zstate doctor {(near or names)[0]}", network, wire)
        return broken("robots", f"{what}; announced: {', '.join(map(repr, names))}", then)
    for other_options, others in find_elsewhere(network) if wire == "native" else ():
        found = next((name for name in others if name == robot), others[0])
        text = f"{what} here; {with_options(other_options)}: {', '.join(map(repr, others))}"
        return broken("robots", text, f"zstate doctor {found}{other_options}")
    if wire == "native" and session.zenoh.info.routers_zid() and discover(session, 0.3, wire="ros2"):
        text = f"{what} on the native wire; this router also has ROS 2 nodes"
        return broken("robots", text, f"zstate doctor --wire ros2{options}")
    if session.probe is not None:
        what += f", or the router shows none to {session.probe.identity}"
    if robot == ANY:
        from zstate.model.catalog import example_name

        return broken("robots", what, f"zstate publish {example_name()} --source sine{options}")
    command = publish_command_for("publish", robot)
    source = "" if "FILE" in command else " --source sine"
    return broken("robots", f"{what}: its publisher is not running", f"{command}{source}{options}")


def with_same_options(command: str, network: SessionOptions, wire: str) -> str:
    """``command`` with the wire and endpoints of doctor, if it accepts them and sets none of its own."""
    text, mark, comment = command.partition("  #")
    program, *words = text.split()
    if program != "zstate":
        return command
    parameters = getattr(import_module(f"zstate.cli.commands.{words[0]}"), f"{words[0]}_command").params
    accepted = {option for parameter in parameters for option in parameter.opts}
    wires = ("--wire", wire) if wire != "native" else ()
    endpoints = tuple(word for endpoint in network.connect for word in ("--connect", endpoint))
    for group in (wires, endpoints):
        if group and group[0] in accepted and group[0] not in words:
            text += f" {shlex.join(group)}"
    return text + mark + comment


def check_text(check: Check) -> str:
    """One check, wrapped at the width of the terminal; on one line if there is no terminal."""
    indent = "  " if check.robot else ""
    state, name = f"{check.state:<{_STATE}}", f"{check.name:<{_NAME}}"
    head = f"{indent}{colored(state, _COLORS[check.state])}  {name}  "
    text = " ".join(check.text.split())
    if not is_terminal():
        return head + text
    column = len(f"{indent}{state}  {name}  ")
    width = max(shutil.get_terminal_size().columns - column, _MIN_TEXT)
    return head + f"\n{' ' * column}".join(textwrap.wrap(text, width, break_on_hyphens=False))


def robot_lines(robot: str, checks: Sequence[Check], *, in_full: bool) -> Iterator[str]:
    """The checks of ``robot``; unless ``in_full`` only those that fail, or one line if all are ok."""
    shown = [check for check in checks if in_full or check.state in ("warning", "broken")]
    if shown:
        yield robot
        yield from map(check_text, shown)
    else:
        moves = [check.text for check in checks if check.name in ("joint_states", "tf")]
        yield check_text(Check(robot, "ok", moves[0] if moves else "sound"))


def conclusion_text(checks: Sequence[Check]) -> str:
    """The first broken check, or the first warning, and the next command."""
    check, text = first_broken(checks), "all is sound"
    if check is not None:
        text = f"first broken link: {check.name}{f' of {check.robot!r}' if check.robot else ''}"
    elif warnings := [one for one in checks if one.state == "warning"]:
        check, text = warnings[0], f"sound, with {count_text(len(warnings), 'warning')}"
    return text + (f"\nnext: {check.next}" if check is not None and check.next else "")


def diagnosis_json(checks: Sequence[Check]) -> dict[str, Any]:
    """All checks as one JSON object."""
    first = first_broken(checks)
    return {
        "sound": first is None,
        "first_broken": None if first is None else asdict(first),
        "checks": [asdict(check) for check in checks],
    }
