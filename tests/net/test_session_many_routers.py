"""Several routers: one that dies, and a robot's that joins its fleet's. Each is a process of its own."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest
from helpers.processes import Child, find_free_port, until
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


def publish_and_look(publisher: StatePublisher, listener: TransformListener, after: int = 0) -> bool:
    """Whether the listener has a sample stamped later than ``after``."""
    publisher.publish([0.1, 0.2])
    if not listener.buffer.can_lookup("base", "lower"):
        return False
    return listener.buffer.latest("base", "lower") > after


def test_clients_go_to_the_next_router_when_theirs_is_killed(spawn: Spawn):
    first, second = endpoint(), endpoint()
    dying = router(spawn, first)
    router(spawn, second, "--connect", first)
    with (
        client(first, second) as writer,
        client(first, second) as reader,
        StatePublisher(writer, RRBOT, "r1") as publisher,
        TransformListener(reader, "r1") as listener,
    ):
        until(lambda: publish_and_look(publisher, listener))
        dying.kill()
        killed_at = time.time_ns()
        until(lambda: publish_and_look(publisher, listener, after=killed_at))
        # Somebody who comes now finds it all behind the second one.
        with client(first, second) as late, TransformListener(late, "r1") as newcomer:
            assert [info.name for info in discover(late)] == ["r1"]
            until(lambda: publish_and_look(publisher, newcomer))


def test_readers_and_writers_at_different_routers_meet_again_when_one_is_killed(spawn: Spawn):
    first, second = endpoint(), endpoint()
    dying = router(spawn, first)
    router(spawn, second, "--connect", first)
    with (
        client(first, second) as writer,
        client(second) as reader,
        StatePublisher(writer, RRBOT, "r1") as publisher,
        TransformListener(reader, "r1") as listener,
    ):
        until(lambda: publish_and_look(publisher, listener))
        dying.kill()
        killed_at = time.time_ns()
        until(lambda: publish_and_look(publisher, listener, after=killed_at))


def test_a_robots_router_and_its_fleets_pass_everything_on_both_ways(spawn: Spawn):
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
            until(lambda: publish_and_look(publisher, above))
            assert above.buffer.wait("base", "camera", timeout_s=5.0).kind == "static"
            assert below.buffer.wait("map", "dock", timeout_s=5.0).kind == "static"
            for session in (hall, robot):
                until(lambda there=session: [info.name for info in discover(there)] == ["fleet", "r1"])


def test_what_a_site_misses_while_its_fleet_is_gone_comes_back(spawn: Spawn):
    fleet, site = endpoint(), endpoint()
    dying = router(spawn, fleet)
    router(spawn, site, "--connect", fleet)
    with client(site) as robot, StatePublisher(robot, RRBOT, "r1") as publisher:
        dying.kill()
        # The robot's own programs do not notice.
        with client(site) as beside, TransformListener(beside, "r1") as listener:
            until(lambda: publish_and_look(publisher, listener))
        router(spawn, fleet)
        with client(fleet) as hall, TransformListener(hall, "r1") as listener:
            until(lambda: publish_and_look(publisher, listener))
