"""Diagnosis: the links of the chain in their order, each as soon as it is known."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from difflib import get_close_matches
from typing import TYPE_CHECKING

import click

from zstate.cli.doctor.check import Check, broken, ok, warning
from zstate.cli.doctor.network_checks import (
    access_check,
    elsewhere,
    installation_check,
    network_check,
    refused_check,
    with_options,
)
from zstate.cli.doctor.next_command import looking_there
from zstate.cli.network import Network, open_session
from zstate.cli.waiting import ConditionWaiter
from zstate.cli.words import RosWords, is_ros, words_of, writing
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


def diagnosis(network: Network, robot: str, wire: str, timeout_s: float) -> Iterator[Check]:
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
        yield from _behind(session, network, robot, wire, timeout_s)


def joined(network: Network, wire: str) -> Network:
    """How ``open_session`` joins, where ``network`` may say nothing."""
    return Network("client", (ROUTER_ENDPOINT,)) if is_ros(wire) and not network.is_given else network


def _behind(session: Session, network: Network, robot: str, wire: str, timeout_s: float) -> Iterator[Check]:
    from zstate.net.presence import discover

    robots = discover(session, wire=wire)
    check = network_check(session, joined(network, wire))  # later than the others, whom it counts
    yield check
    if check.state == "broken":
        return
    access = None if robot == ANY else access_check(session, network, robot)
    if access is not None:
        yield access
    wanted = [info for info in robots if robot in (ANY, info.name)]
    if is_ros(wire) and words_of(wire).robot:
        wanted = list(robots)  # there is one at most, and ROS has no name for it
    if not wanted:
        yield _absent_check(session, network, robot, robots, wire)
        return
    names = ", ".join(repr(info.name) for info in robots)
    yield ok("robots", words_of(wire).announced(robots) if is_ros(wire) else f"{names} announced")
    for found in _of_robots(session, wanted, robots, wire, timeout_s, called=robot):
        yield replace(found, next=looking_there(found.next, network, wire)) if found.next else found


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

    words = words_of(wire)
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
    session: Session, network: Network, robot: str, robots: tuple[RobotInfo, ...], wire: str
) -> Check:
    names = [info.name for info in robots]
    near = get_close_matches(robot, names, n=1)
    what = "no robot is announced" if robot == ANY else f"nobody announces the robot {robot!r}"
    if is_ros(wire) and not names:
        text = words_of(wire).announced(robots).partition(";")[0]
        then = f"zstate ls --wire {wire}{_connecting(network)}  # are the domain and the router right?"
        return broken("robots", text, then)
    if names:
        text = f"{what}; announced: {', '.join(map(repr, names))}"
        then = f"zstate doctor {(near or names)[0]}"
        return broken("robots", text, looking_there(then, network, wire))
    for options, others in elsewhere(network) if wire == "native" else ():
        found = next((name for name in others if name == robot), others[0])
        text = f"{what} here; {with_options(options)}: {', '.join(map(repr, others))}"
        return broken("robots", text, f"zstate doctor {found}{options}")
    if wire == "native" and session.zenoh.info.routers_zid() and _has_ros(session):
        text = f"{what} on the native wire; ROS 2 nodes are behind this router, too"
        return broken("robots", text, f"zstate doctor --wire ros2{_connecting(network)}")
    if session.twin is not None:
        what += f", or the router shows none to {session.twin.identity}"
    text = f"{what}: its publisher is not running" if robot != ANY else what
    return broken("robots", text, f"{_start(robot)}{_connecting(network)}")


def _has_ros(session: Session) -> bool:
    from zstate.net.presence import discover

    return bool(discover(session, 0.3, wire="ros2"))


def _start(robot: str) -> str:
    """What would put ``robot`` there."""
    if robot == ANY:
        from zstate.model.known import example_name

        return f"zstate publish {example_name()} --source sine"
    command = writing("publish", robot)
    return command if "FILE" in command else f"{command} --source sine"


def _connecting(network: Network) -> str:
    return "".join(f" --connect {endpoint}" for endpoint in network.connect)
