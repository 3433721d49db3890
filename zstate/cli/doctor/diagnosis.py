"""Diagnosis: the checks of `zstate doctor` in order, each reported as soon as it is done, and their text."""

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
    find_elsewhere,
    installation_check,
    network_check,
    refused_check,
    with_options,
)
from zstate.cli.output.console import colored, count_text, is_terminal
from zstate.cli.output.wire_text import RosWords, is_ros, messages_for, publish_command_for
from zstate.cli.session import SessionOptions, open_session
from zstate.cli.waiting import ConditionWaiter
from zstate.errors import ZStateError
from zstate.net.config import ROUTER_ENDPOINT
from zstate.wire.keys import ANY

if TYPE_CHECKING:
    from zstate.buffer.frame_tree import FrameInfo
    from zstate.net.presence import RobotInfo
    from zstate.net.session import Session

_AT_ONCE = 50
"""So many robots are listened to at once: each takes eight threads."""

_TIMEOUTS = 5
"""After so many timeouts no more robots are examined: of a large fleet, those that are silent take one for
each group of them."""


_COLORS = {"ok": "green", "warning": "yellow", "broken": "red", "skipped": None}
_STATE, _NAME, _MIN_TEXT = 7, 12, 20  # widths


def diagnosis(network: SessionOptions, robot: str, wire: str, timeout_s: float) -> Iterator[Check]:
    """The links to ``robot``, or to every robot for "*".

    What is behind a broken link of all robots is not looked at.
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
    return (
        SessionOptions("client", (ROUTER_ENDPOINT,)) if is_ros(wire) and not network.is_explicit else network
    )


def _after_connecting(
    session: Session, network: SessionOptions, robot: str, wire: str, timeout_s: float
) -> Iterator[Check]:
    from zstate.net.presence import discover

    robots = discover(session, wire=wire)
    check = network_check(session, effective_network(network, wire))  # later than the others, whom it counts
    yield check
    if check.state == "broken":
        return
    access = None if robot == ANY else access_check(session, network, robot)
    if access is not None:
        yield access
    wanted = [info for info in robots if robot in (ANY, info.name)]
    if is_ros(wire) and messages_for(wire).robot:
        wanted = list(robots)  # there is one at most, and ROS has no name for it
    if not wanted:
        yield _absent_check(session, network, robot, robots, wire)
        return
    names = ", ".join(repr(info.name) for info in robots)
    yield ok("robots", messages_for(wire).announced(robots) if is_ros(wire) else f"{names} announced")
    for found in _of_robots(session, wanted, robots, wire, timeout_s, called=robot):
        yield replace(found, next=with_same_options(found.next, network, wire)) if found.next else found


def _of_robots(
    session: Session,
    wanted: Sequence[RobotInfo],
    robots: Sequence[RobotInfo],
    wire: str,
    timeout_s: float,
    *,
    called: str,
) -> Iterator[Check]:
    from zstate.cli.doctor.clock_checks import domains_check
    from zstate.cli.doctor.ear import Ear, listen
    from zstate.cli.doctor.robot_checks import robot_checks, shared_roots_checks, static_roots
    from zstate.cli.doctor.ros_checks import ros_checks
    from zstate.net.clock_offset import measure_offsets

    words = messages_for(wire)
    offsets = measure_offsets(session, ANY) if wire == "native" else ()
    tops: list[FrameInfo] = []
    clocks: dict[str, str] = {}
    deadline = time.monotonic() + _TIMEOUTS * timeout_s
    for first in range(0, len(wanted), _AT_ONCE):
        if time.monotonic() > deadline:
            text = (
                f"{len(wanted) - first} of {len(wanted)} robots were not examined within "
                f"{_TIMEOUTS * timeout_s:g} s; name one, or give more --timeout"
            )
            yield warning("robots", text, f"zstate doctor {wanted[first].name}")
            break
        with ExitStack() as listening:
            some = wanted[first : first + _AT_ONCE]
            waiter = ConditionWaiter()
            ears = [listening.enter_context(Ear(session, info, wire, robots, waiter.notify)) for info in some]
            if wire == "native":
                for ear in ears:
                    ear.offsets = tuple(one for one in offsets if one.robot == ear.info.name)
                    ear.ask()
            listen(ears, waiter, timeout_s)
            for ear in ears:
                if ear.description is not None:
                    clocks[ear.info.name] = ear.description.clock
                if isinstance(words, RosWords):
                    checks = ros_checks(ear, session, words, called)
                else:
                    checks = robot_checks(ear, session)
                for check in checks:
                    yield check.of(ear.info.name)
                tops += static_roots(ear)
    if wire == "native":
        yield from shared_roots_checks(tops)
    different = domains_check(clocks)
    if different is not None:
        yield different


def _absent_check(
    session: Session, network: SessionOptions, robot: str, robots: tuple[RobotInfo, ...], wire: str
) -> Check:
    names = [info.name for info in robots]
    near = get_close_matches(robot, names, n=1)
    what = "no robot is announced" if robot == ANY else f"nobody announces the robot {robot!r}"
    if is_ros(wire) and not names:
        text = messages_for(wire).announced(robots).partition(";")[0]
        then = f"zstate ls --wire {wire}{_connecting(network)}  # are the domain and the router right?"
        return broken("robots", text, then)
    if names:
        text = f"{what}; announced: {', '.join(map(repr, names))}"
        then = f"zstate doctor {(near or names)[0]}"
        return broken("robots", text, with_same_options(then, network, wire))
    for options, others in find_elsewhere(network) if wire == "native" else ():
        found = next((name for name in others if name == robot), others[0])
        text = f"{what} here; {with_options(options)}: {', '.join(map(repr, others))}"
        return broken("robots", text, f"zstate doctor {found}{options}")
    if wire == "native" and session.zenoh.info.routers_zid() and _has_ros(session):
        text = f"{what} on the native wire; ROS 2 nodes are behind this router, too"
        return broken("robots", text, f"zstate doctor --wire ros2{_connecting(network)}")
    if session.probe is not None:
        what += f", or the router shows none to {session.probe.identity}"
    text = f"{what}: its publisher is not running" if robot != ANY else what
    return broken("robots", text, f"{_start(robot)}{_connecting(network)}")


def _has_ros(session: Session) -> bool:
    from zstate.net.presence import discover

    return bool(discover(session, 0.3, wire="ros2"))


def _start(robot: str) -> str:
    """What would put ``robot`` there."""
    if robot == ANY:
        from zstate.model.catalog import example_name

        return f"zstate publish {example_name()} --source sine"
    command = publish_command_for("publish", robot)
    return command if "FILE" in command else f"{command} --source sine"


def _connecting(network: SessionOptions) -> str:
    return "".join(f" --connect {endpoint}" for endpoint in network.connect)


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
