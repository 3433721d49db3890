"""Several router processes: one that dies, and a robot's router that joins the fleet's."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest
from helpers.processes import DEADLINE_S, Child, find_free_port, until
from helpers.robots import RRBOT, UPRIGHT

from zstate import StatePublisher, StaticPublisher, Transform, TransformListener, connect, discover
from zstate.net.session import Session

pytestmark = pytest.mark.processes

Spawn = Callable[..., Child]


def endpoint() -> str:
    return f"tcp/127.0.0.1:{find_free_port()}"


def router(spawn: Spawn, listen: str, *options: str) -> Child:
    child = spawn("from zstate.cli.main import main; main()", "router", "--listen", listen, *options)
    child.line()
    return child


def client(*endpoints: str) -> Session:
    return connect(mode="client", endpoints=endpoints)


def publish_and_check(publisher: StatePublisher, listener: TransformListener, after: int = 0) -> bool:
    """Whether the listener has a sample stamped later than ``after``."""
    publisher.publish([0.1, 0.2])
    if not listener.buffer.can_lookup("base", "lower"):
        return False
    return listener.buffer.latest("base", "lower") > after


def test_clients_use_the_next_router_when_one_is_killed(spawn: Spawn):
    first, second = endpoint(), endpoint()
    dying = router(spawn, first)
    router(spawn, second, "--connect", first)
    with (
        client(first, second) as writer,
        client(first, second) as reader,
        StatePublisher(writer, RRBOT, "r1") as publisher,
        TransformListener(reader, "r1") as listener,
    ):
        until(lambda: publish_and_check(publisher, listener))
        dying.kill()
        killed_at = time.time_ns()
        until(lambda: publish_and_check(publisher, listener, after=killed_at))
        # A new session finds everything behind the second router.
        with client(first, second) as late, TransformListener(late, "r1") as newcomer:
            assert [info.name for info in discover(late)] == ["r1"]
            until(lambda: publish_and_check(publisher, newcomer))


def test_readers_and_writers_at_different_routers_reconnect_when_one_is_killed(spawn: Spawn):
    first, second = endpoint(), endpoint()
    dying = router(spawn, first)
    router(spawn, second, "--connect", first)
    with (
        client(first, second) as writer,
        client(second) as reader,
        StatePublisher(writer, RRBOT, "r1") as publisher,
        TransformListener(reader, "r1") as listener,
    ):
        until(lambda: publish_and_check(publisher, listener))
        dying.kill()
        killed_at = time.time_ns()
        until(lambda: publish_and_check(publisher, listener, after=killed_at))


def test_robot_router_and_fleet_router_forward_both_ways(spawn: Spawn):
    fleet, site = endpoint(), endpoint()
    # The robot starts before its fleet can be reached.
    router(spawn, site, "--connect", fleet)
    with (
        client(site) as robot,
        StatePublisher(robot, RRBOT, "r1") as publisher,
        StaticPublisher(robot, "r1", "mount") as mount,
    ):
        mount.set(Transform("base", "camera", (0.0, 0.0, 1.0), UPRIGHT))
        router(spawn, fleet)
        with (
            client(fleet) as hall,
            StaticPublisher(hall, "fleet", "map") as places,
            TransformListener(hall, "r1") as above,
            TransformListener(robot, "*", follow="tf") as below,
        ):
            places.set(Transform("map", "dock", (1.0, 2.0, 0.0), UPRIGHT))
            until(lambda: publish_and_check(publisher, above))
            assert above.buffer.wait("base", "camera", timeout_s=DEADLINE_S).kind == "static"
            assert below.buffer.wait("map", "dock", timeout_s=DEADLINE_S).kind == "static"
            for session in (hall, robot):
                until(lambda there=session: [info.name for info in discover(there)] == ["fleet", "r1"])


def test_streams_resume_when_the_fleet_router_returns(spawn: Spawn):
    fleet, site = endpoint(), endpoint()
    dying = router(spawn, fleet)
    router(spawn, site, "--connect", fleet)
    with client(site) as robot, StatePublisher(robot, RRBOT, "r1") as publisher:
        dying.kill()
        # The robot's own programs are not affected.
        with client(site) as local, TransformListener(local, "r1") as listener:
            until(lambda: publish_and_check(publisher, listener))
        router(spawn, fleet)
        with client(fleet) as hall, TransformListener(hall, "r1") as listener:
            until(lambda: publish_and_check(publisher, listener))
