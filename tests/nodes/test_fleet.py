"""What a reader of a fleet costs: bytes over its own link, which do not depend on the machine's speed."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Literal

import pytest
from helpers.link_meter import LinkMeter
from helpers.processes import new_threads, repeated, until
from helpers.robots import RRBOT

from zstate import StatePublisher, TransformBuffer, TransformListener, connect
from zstate.net.latched import HEARTBEAT_S
from zstate.net.session import Session

TICKS = 50


@contextmanager
def fleet(port: int, count: int) -> Iterator[list[StatePublisher]]:
    """A router at ``port`` with ``count`` robots on one link."""
    endpoint = f"tcp/127.0.0.1:{port}"
    with (
        connect(mode="router", listen=endpoint),
        connect(mode="client", endpoints=endpoint) as session,
        ExitStack() as opened,
    ):
        robots = [
            opened.enter_context(StatePublisher(session, RRBOT, f"r{number}", cache_s=0.0))
            for number in range(count)
        ]
        # A new value is announced once more after this time, and readers without it request it again.
        threading.Event().wait(2 * HEARTBEAT_S)
        yield robots


def link_bytes(
    robots: list[StatePublisher], port: int, followed: list[str] | Literal["*"], *, one_listener: bool = True
) -> tuple[int, int]:
    """Bytes to a reader of the robots ``followed``: until it has their models, and for 50 ticks."""
    names = [robot.robot for robot in robots] if followed == "*" else followed
    buffer = TransformBuffer()
    with (
        LinkMeter(port) as meter,
        connect(mode="client", endpoints=meter.endpoint) as session,
        ExitStack() as opened,
    ):
        listeners = [
            opened.enter_context(TransformListener(session, robot, buffer, history_on_join=False))
            for robot in ([followed] if one_listener else followed)
        ]
        until(lambda: all(buffer.can_lookup(f"{name}/world", f"{name}/base") for name in names))
        wait_until_quiet(meter)
        joining = meter.received
        for tick in range(1, TICKS + 1):
            for robot in robots:
                robot.publish([0.1, 0.2])
            until(lambda: sum(one.stats.received for one in listeners) == tick * len(names))  # noqa: B023
        return joining, meter.received - joining


def wait_until_quiet(meter: LinkMeter) -> None:
    """Waits until a fifth of a second passes with less than 200 bytes, which are keep-alives."""
    before, quiet = -1000, threading.Event()
    while meter.received - before >= 200:
        before = meter.received
        quiet.wait(0.2)


@pytest.mark.parametrize("one_listener", [True, False], ids=["one listener", "a listener each"])
def test_reader_of_three_robots_receives_no_more_bytes_if_there_are_ten_times_as_many(
    free_port: int, one_listener: bool
):
    followed = ["r0", "r1", "r2"]
    with fleet(free_port, 3) as robots:
        joining_alone, running_alone = link_bytes(robots, free_port, followed, one_listener=one_listener)
    with fleet(free_port, 30) as robots:
        joining, running = link_bytes(robots, free_port, followed, one_listener=one_listener)
    # Numbers and keys are one digit longer at most; keep-alives depend on the duration.
    assert joining < 1.25 * joining_alone
    assert running < 1.25 * running_alone


@pytest.mark.long
def test_joining_a_fleet_costs_the_same_bytes_for_each_robot_of_forty_as_of_ten(free_port: int):
    with fleet(free_port, 10) as robots:
        joining_ten, running_ten = link_bytes(robots, free_port, "*")
    with fleet(free_port, 40) as robots:
        joining_forty, running_forty = link_bytes(robots, free_port, "*")
    assert joining_forty / 40 < 1.25 * joining_ten / 10
    assert running_forty / 40 < 1.25 * running_ten / 10


def test_listener_of_several_robots_has_no_more_threads_than_of_two(sessions: tuple[Session, Session]):
    def threads(count: int) -> int:
        before = threading.enumerate()
        with TransformListener(sessions[1], [f"r{number}" for number in range(count)]):
            return len(new_threads(before))

    assert threads(20) == threads(2)


@pytest.mark.long
def test_no_sample_is_lost_while_a_listener_joins_a_fleet(free_port: int):
    with (
        fleet(free_port, 150) as robots,
        repeated(lambda: [robot.publish([0.1, 0.2]) for robot in robots]),
        connect(mode="client", endpoints=f"tcp/127.0.0.1:{free_port}") as session,
        TransformListener(session, history_on_join=False) as listener,
    ):
        pairs = [(f"{robot.robot}/world", f"{robot.robot}/base") for robot in robots]
        until(lambda: all(listener.buffer.can_lookup(*pair) for pair in pairs))
        assert (listener.stats.dropped, listener.stats.missed) == (0, 0)
