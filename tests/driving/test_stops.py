"""Stops on the network: which programs may send them, and what becomes of files that are damaged."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest
from helpers.access_routers import router_with_users
from helpers.processes import repeated, until
from helpers.robots import RRBOT

from zstate.driving import Commander, DriverHost, SimulatedDriver, stop
from zstate.driving.stops import stops_file
from zstate.errors import AccessDenied, ConfigError
from zstate.net.security.acl import AclRoles
from zstate.net.session import Session, connect


@contextmanager
def hosted(session: Session) -> Iterator[DriverHost]:
    """A host of robot "arm" whose loop runs."""
    with DriverHost(session, SimulatedDriver(RRBOT), RRBOT, "arm") as host:
        thread = threading.Thread(target=host.run)
        thread.start()
        try:
            yield host
        finally:
            host.close()
            thread.join()


def test_every_name_may_stop_and_only_a_commander_may_release(tmp_path):
    fleet = AclRoles(("arm",), viewers=("desk",), commanders=("teleop",))
    with router_with_users(tmp_path, fleet, fleet.identities) as endpoint, ExitStack() as opened:

        def join(user: str) -> Session:
            settings = {
                "mode": "client",
                "connect": {"endpoints": [endpoint], "timeout_ms": 5000},
                "scouting": {"multicast": {"enabled": False}},
                "transport": {"auth": {"usrpwd": {"user": user, "password": "secret"}}},
            }
            return opened.enter_context(connect(settings))

        robot, desk, teleop = map(join, ("arm", "desk", "teleop"))
        host = opened.enter_context(hosted(robot))
        assert "seen smoke" in stop(desk, "arm", "seen smoke").reason
        with pytest.raises(AccessDenied):
            Commander(desk, "arm")
        with Commander(teleop, "arm") as arm:
            assert arm.wait_for_driver().state == "stopped"
            assert arm.release().state == "ready"
            with repeated(lambda: arm.send({"elbow": 0.1})):
                until(lambda: host.state == "active")


def test_a_file_that_cannot_be_read_is_a_stop_until_it_is_released(sessions):
    path = stops_file("arm")
    path.parent.mkdir(parents=True)
    path.write_text("{")
    with hosted(sessions[0]), Commander(sessions[1], "arm") as arm:
        assert "cannot be read" in arm.wait_for_driver().reason
        assert arm.release().state == "ready"
    with hosted(sessions[0]), Commander(sessions[1], "arm") as arm:
        assert arm.wait_for_driver().state == "ready"


def test_a_host_that_cannot_keep_stops_does_not_start(sessions):
    path = stops_file("arm")
    path.parent.parent.mkdir(parents=True)
    path.parent.write_text("a file in place of the folder")
    with pytest.raises(ConfigError, match="set XDG_STATE_HOME"):
        DriverHost(sessions[0], SimulatedDriver(RRBOT), RRBOT, "arm")


def test_a_second_stop_keeps_the_robot_stopped_when_the_first_is_released(sessions):
    with hosted(sessions[0]), Commander(sessions[1], "arm") as arm:
        first = stop(sessions[0], "arm", "first")
        second = stop(sessions[1], "arm", "second")
        assert set(first.stops) < set(second.stops)
        assert "first" in second.reason
        assert "second" in second.reason
        assert arm.release().state == "ready"
        again = stop(sessions[0], "arm", "again")
        assert len(again.stops) == 1
