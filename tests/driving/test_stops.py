"""Stops on the network: which programs may send them, and what becomes of files that are damaged."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest
from helpers.access_routers import join, router_with_users
from helpers.processes import DEADLINE_S, SOON_S, repeated, until
from helpers.robots import RRBOT, wait_for_reader

from zstate import JointReading
from zstate._util.refusals import Refusals
from zstate.driving import Commander, DriverHost, SimulatedDriver, stop
from zstate.driving.driver import StopMode
from zstate.driving.stops import StopLatch
from zstate.driving.stops_file import ActiveStop, stops_file, write_stops
from zstate.errors import AccessDenied, ConfigError, SecondWriter, Unreachable
from zstate.net.latched import LatchedPublisher, LatchedSubscriber
from zstate.net.presence import local_writer
from zstate.net.security.acl import AclRoles
from zstate.net.session import Session
from zstate.net.streams import StreamPublisher, StreamSubscriber
from zstate.wire.keys import driver_key, release_expression, release_key, stop_expression
from zstate.wire.messages import DriverState, Release, Stop
from zstate.wire.native import ENCODINGS, decode, encode
from zstate.wire.protocol import SerializedSample


class StoppedDriver(SimulatedDriver):
    """A simulated driver that keeps how it was stopped."""

    def __init__(self) -> None:
        super().__init__(RRBOT)
        self.hows: list[StopMode] = []

    def stop(self, how: StopMode) -> None:
        super().stop(how)
        self.hows.append(how)


@contextmanager
def hosted(session: Session, driver: SimulatedDriver | None = None) -> Iterator[DriverHost]:
    """A host of robot "arm" whose loop runs."""
    with DriverHost(session, driver or SimulatedDriver(RRBOT), RRBOT, "arm") as host:
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

        def session_of(user: str) -> Session:
            return opened.enter_context(join(endpoint, user))

        robot, desk, teleop = map(session_of, ("arm", "desk", "teleop"))
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
        until(lambda: arm.wait_for_driver().stops == second.stops)
        assert "first" in second.reason
        assert "second" in second.reason
        assert arm.release().state == "ready"
        again = stop(sessions[0], "arm", "again")
        assert len(again.stops) == 1


def test_joints_without_torque_stay_so_when_the_same_session_stops_them_again(sessions):
    driver = StoppedDriver()
    with hosted(sessions[0], driver):
        stop(sessions[1], "arm", "hand inside", how="relax")
        stop(sessions[1], "arm", "again", how="hold")
        assert set(driver.hows) == {"relax"}
    restarted = StoppedDriver()
    with hosted(sessions[0], restarted) as host:
        until(lambda: host.state == "stopped")
        assert set(restarted.hows) == {"relax"}


def test_a_latch_keeps_how_its_host_stopped_for_the_next_one(sessions):
    with StopLatch(sessions[0], "arm", Refusals()) as latch:
        latch.latch("the driver failed", local_writer(7), "relax")
    with StopLatch(sessions[0], "arm", Refusals()) as latch:
        assert [(one.reason, one.how) for one in latch.latched] == [("the driver failed", "relax")]


def test_a_late_release_of_a_hosts_first_stop_does_not_end_its_second(sessions):
    writer, commander = local_writer(7), local_writer(8)
    key = release_key("arm", commander.identity)
    with (
        StopLatch(sessions[0], "arm", Refusals()) as latch,
        StreamPublisher(sessions[1], key, ENCODINGS[Release]) as releases,
    ):
        wait_for_reader(sessions[1], key)
        latch.latch("first", writer)
        other = latch.latched[0]
        first = encode(Release(0, 0, commander.session, ((other.session, other.seq),)))
        releases.put(first)
        until(lambda: not latch.latched)
        latch.latch("second", writer)
        latch.latch("of another session", local_writer(9))
        releases.put(first)
        # Releases of one commander arrive in order: this one proves that the late one has been handled.
        releases.put(encode(Release(0, 1, commander.session, ((9, 0),))))
        until(lambda: len(latch.latched) == 1)
        assert latch.latched[0].reason == "second"


def test_a_stop_is_not_confirmed_before_the_driver_has_stopped(sessions):
    may_stop = threading.Event()

    class Slow(SimulatedDriver):
        def stop(self, how: StopMode) -> None:
            assert may_stop.wait(DEADLINE_S)
            super().stop(how)

    with hosted(sessions[0], Slow(RRBOT)), Commander(sessions[1], "arm") as arm:
        arm.wait_for_driver()
        with pytest.raises(Unreachable):  # the host publishes its state several times within that
            stop(sessions[1], "arm", timeout_s=0.5)
        may_stop.set()
        assert stop(sessions[1], "arm").state == "stopped"


def test_parallel_stops_of_one_session_are_all_confirmed(sessions):
    may_read = threading.Event()
    may_read.set()

    class Slow(SimulatedDriver):
        def read(self, stamp: int) -> JointReading:
            assert may_read.wait(DEADLINE_S)
            return super().read(stamp)

    sent: list[int] = []
    states: list[str] = []

    def on_stop(sample: SerializedSample) -> None:
        sent.append(decode(sample.payload, sample.encoding, Stop).seq)

    def stop_it() -> None:
        states.append(stop(sessions[1], "arm", timeout_s=SOON_S).state)

    with hosted(sessions[0], Slow(RRBOT)), Commander(sessions[1], "arm") as arm, ExitStack() as joined:
        arm.wait_for_driver()
        joined.enter_context(LatchedSubscriber(sessions[0], stop_expression("arm"), on_stop))
        may_read.clear()
        # No tick while both are sent: the driver obeys the second one in place of the first.
        for number in (0, 1):
            thread = threading.Thread(target=stop_it)
            thread.start()
            joined.callback(thread.join)
            until(lambda number=number: number in sent)
        may_read.set()
    assert states == ["stopped", "stopped"]


def test_hosts_on_two_networks_do_not_share_the_file_of_stops(sessions):
    with StopLatch(sessions[0], "arm", Refusals()) as first:
        with pytest.raises(SecondWriter, match=rf"pid {os.getpid()}' already hosts a driver of 'arm'"):
            StopLatch(sessions[1], "arm", Refusals())
        first.latch("door open", local_writer(7))
    with StopLatch(sessions[1], "arm", Refusals()) as second:
        assert [one.reason for one in second.latched] == ["door open"]


def test_a_file_with_fields_of_wrong_types_is_a_stop(sessions):
    path = stops_file("arm")
    path.parent.mkdir(parents=True)
    damaged = {"session": 1, "seq": "0", "how": "hold", "reason": "", "who": ""}
    path.write_text(json.dumps({"stops": [damaged], "released": []}))
    with hosted(sessions[0]), Commander(sessions[1], "arm") as arm:
        assert "cannot be read: '0' is not a number" in arm.wait_for_driver().reason
        assert arm.release().state == "ready"


def test_a_robot_with_many_long_stops_can_be_released(sessions):
    path = stops_file("arm")
    write_stops(path, [ActiveStop(1 + n, 0, "hold", "x" * 1000, "desk") for n in range(256)], {})
    with hosted(sessions[0]), Commander(sessions[1], "arm") as arm:
        state = arm.wait_for_driver()
        assert state.state == "stopped"
        assert len(state.stops) == 256
        assert "more characters" in state.reason
        with repeated(lambda: arm.send({"elbow": 0.1})):
            until(lambda: arm.wait_for_driver().refused.get("stopped"))
        assert "more characters" in arm.wait_for_driver().last_refusal
        assert arm.release().state == "ready"


def test_a_stop_that_displaces_the_oldest_of_too_many_keeps_the_torque_off(sessions):
    relaxed = ActiveStop(1, 0, "relax", "hand inside", "desk")
    others = [ActiveStop(2 + n, 0, "hold", "", "desk") for n in range(255)]
    write_stops(stops_file("arm"), [relaxed, *others], {})
    with StopLatch(sessions[0], "arm", Refusals()) as latch:
        latch.latch("one more", local_writer(1000))
        assert len(latch.latched) == 256
        assert [one.reason for one in latch.latched if one.how == "relax"] == ["one more"]


def test_a_release_returns_once_the_driver_is_no_longer_stopped(sessions):
    stopped = DriverState(0, 5, "host", "stopped", "", ("elbow",), 10**8, stops=((7, 0),))
    without_stops = DriverState(0, 5, "host", "stopped", "", ("elbow",), 10**8)
    ready = DriverState(0, 5, "host", "ready", "", ("elbow",), 10**8)
    present = [stopped]
    states: list[str] = []
    with (
        LatchedPublisher(sessions[0], driver_key("arm"), ENCODINGS[DriverState]) as values,
        repeated(lambda: values.set(encode(present[-1]))),
        Commander(sessions[1], "arm") as arm,
    ):
        until(lambda: arm.wait_for_driver().stops)
        releasing = threading.Thread(target=lambda: states.append(arm.release(DEADLINE_S).state))
        on_release = StreamSubscriber(
            sessions[0], release_expression("arm"), lambda _: present.append(without_stops)
        )
        with on_release:
            releasing.start()
            until(lambda: not arm.wait_for_driver().stops)
        present.append(ready)
        releasing.join()
    assert states == ["ready"]
