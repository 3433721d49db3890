"""Stops on the network: which programs may send them, and what becomes of files that are damaged."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np
import pytest
from helpers.access_routers import join, router_with_users
from helpers.processes import DEADLINE_S, repeated, until
from helpers.robots import RRBOT, put, wait_for_reader
from msgspec.structs import replace

from zstate import JointReading
from zstate._util.refusals import Refusals
from zstate.driving import Commander, DriverHost, SimulatedDriver, stop
from zstate.driving.driver import StopMode
from zstate.driving.driver_state import DriverStatePublisher
from zstate.driving.messages import DriverState, Release, Stop, StopIds, stop_text
from zstate.driving.stops import StopLatch, StopRegister
from zstate.driving.stops_file import ActiveStop, stops_file, write_stops
from zstate.errors import AccessDenied, ConfigError, SecondWriter, Unreachable
from zstate.fleet.acl import AclRoles
from zstate.net.latched import LatchedPublisher, LatchedSubscriber
from zstate.net.presence import local_writer
from zstate.net.session import Session, connect
from zstate.net.streams import KeyPublisher, StreamSubscriber
from zstate.wire.identity import WriterId
from zstate.wire.keys import RELAX, RELEASE, STOP, stream_key
from zstate.wire.native import decode, encode, encoding_of
from zstate.wire.protocol import SerializedSample

HOST = local_writer(7)


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
    with StopLatch(sessions[0], "arm", HOST, Refusals()) as latch:
        latch.latch("the driver failed", "relax")
    with StopLatch(sessions[0], "arm", HOST, Refusals()) as latch:
        assert [(one.reason, one.how) for one in latch.latched] == [("the driver failed", "relax")]


def test_a_late_release_of_a_hosts_first_stop_does_not_end_its_second(sessions):
    commander = local_writer(8)
    key = RELEASE.key("arm", commander.identity)
    with (
        StopLatch(sessions[0], "arm", HOST, Refusals()) as latch,
        KeyPublisher(sessions[1], key, encoding_of(Release)) as releases,
    ):
        wait_for_reader(sessions[1], key)
        latch.latch("first")
        other = latch.latched[0]
        first = encode(Release(0, 0, commander.session, ((other.session, other.seq),)))
        releases.put(first)
        until(lambda: not latch.latched)
        latch.latch("second")
        latch.add(ActiveStop(9, 0, "hold", "of another session", "desk"))
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


def test_a_stop_that_is_not_confirmed_is_sent_again_after_a_quarter_of_a_second_and_twice_as_long(sessions):
    received: list[Stop] = []

    def receive(sample: SerializedSample) -> None:
        received.append(decode(sample.payload, sample.encoding, Stop))

    with LatchedSubscriber(sessions[0], (STOP.expression("arm"), RELAX.expression("arm")), receive):
        with pytest.raises(Unreachable):
            stop(sessions[1], "arm", timeout_s=3.0)
        with pytest.raises(Unreachable):
            stop(sessions[1], "arm", "the end", timeout_s=0.01)
        until(lambda: received and received[-1].reason == "the end")
    # At 0, 0.25, 0.75 and 1.75 s: the next pause is longer than what is left.
    assert [one.reason for one in received] == [""] * 4 + ["the end"]
    assert len({one.seq for one in received}) == 2  # a release of one of the four ends all


def test_parallel_stops_of_one_session_are_all_confirmed(sessions):
    may_read = threading.Event()
    may_read.set()

    class Slow(SimulatedDriver):
        def read(self, stamp: int) -> JointReading:
            assert may_read.wait(DEADLINE_S)
            return super().read(stamp)

    sent: list[str] = []
    states: list[str] = []

    def on_stop(sample: SerializedSample) -> None:
        sent.append(decode(sample.payload, sample.encoding, Stop).reason)

    def stop_it(reason: str) -> None:
        states.append(stop(sessions[1], "arm", reason, timeout_s=DEADLINE_S).state)

    with hosted(sessions[0], Slow(RRBOT)), Commander(sessions[1], "arm") as arm, ExitStack() as joined:
        arm.wait_for_driver()
        expressions = STOP.expression("arm"), RELAX.expression("arm")
        joined.enter_context(LatchedSubscriber(sessions[0], expressions, on_stop))
        may_read.clear()
        # No tick while both are sent: the driver obeys them together.
        for reason in ("first", "second"):
            thread = threading.Thread(target=stop_it, args=(reason,))
            thread.start()
            joined.callback(thread.join)
            until(lambda reason=reason: reason in sent)
        may_read.set()
    assert states == ["stopped", "stopped"]


def test_hosts_on_two_networks_do_not_share_the_file_of_stops(sessions):
    with StopLatch(sessions[0], "arm", HOST, Refusals()) as first:
        with pytest.raises(SecondWriter, match=rf"pid {os.getpid()}' already hosts a driver of 'arm'"):
            StopLatch(sessions[1], "arm", HOST, Refusals())
        first.latch("door open")
    with StopLatch(sessions[1], "arm", HOST, Refusals()) as second:
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
    write_stops(path, [ActiveStop(1 + n, 0, "hold", f"{n:x<1000}", "desk") for n in range(256)], {})
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
    others = [ActiveStop(100 + n, 0, "hold", "", "desk") for n in range(255)]
    write_stops(stops_file("arm"), [relaxed, *others], {})
    with StopLatch(sessions[0], "arm", HOST, Refusals()) as latch:
        latch.latch("one more")
        (substitute,) = (one for one in latch.latched if one.how == "relax")
        assert "hand inside" in substitute.reason
        assert latch.latched[-1].reason == "one more"


def test_a_release_returns_once_the_driver_is_no_longer_stopped(sessions):
    stopped = DriverState(0, 5, "host", "stopped", "", ("elbow",), 10**8, stops=((7, 0),))
    without_stops = DriverState(0, 5, "host", "stopped", "", ("elbow",), 10**8)
    ready = DriverState(0, 5, "host", "ready", "", ("elbow",), 10**8)
    present = [stopped]
    states: list[str] = []
    with (
        LatchedPublisher(sessions[0], stream_key("arm", "driver"), encoding_of(DriverState)) as values,
        repeated(lambda: values.set(encode(present[-1]))),
        Commander(sessions[1], "arm") as arm,
    ):
        until(lambda: arm.wait_for_driver().stops)
        releasing = threading.Thread(target=lambda: states.append(arm.release(DEADLINE_S).state))
        on_release = StreamSubscriber(
            sessions[0], RELEASE.expression("arm"), lambda _: present.append(without_stops)
        )
        with on_release:
            releasing.start()
            until(lambda: not arm.wait_for_driver().stops)
        present.append(ready)
        releasing.join()
    assert states == ["ready"]


# What other programs do to a stop


@contextmanager
def forger(session: Session, key: str) -> Iterator[Callable[[Stop | bytes], None]]:
    """Sends stops on the key of another program."""
    with LatchedPublisher(session, key, encoding_of(Stop)) as values:
        yield lambda one: values.set(one if isinstance(one, bytes) else encode(one))


def key_of(stopped: DriverState) -> tuple[str, int, int]:
    """A key with the session of the only stop of ``stopped``, its session and its number."""
    ((session, seq),) = stopped.stops
    return STOP.key("arm", WriterId("operator", "desk", 1, 1, session).identity), session, seq


def stops_in_file() -> list[dict[str, Any]]:
    return json.loads(stops_file("arm").read_text())["stops"]


@pytest.mark.parametrize("ahead", [1, 2**62])
def test_a_stop_forged_by_another_program_masks_no_later_one_of_the_program_that_it_names(sessions, ahead):
    with ExitStack() as opened:
        opened.enter_context(hosted(sessions[0]))
        arm = opened.enter_context(Commander(sessions[1], "arm"))
        key, session, seq = key_of(stop(sessions[1], "arm", "first"))
        assert not arm.release().stops
        forge = opened.enter_context(forger(sessions[1], key))
        forge(Stop(0, seq + ahead, session, "hold", "forged"))
        until(lambda: (session, seq + ahead) in arm.wait_for_driver().stops)
        assert not arm.release().stops
        stopped = stop(sessions[1], "arm", "second", timeout_s=DEADLINE_S)
        assert stopped.state == "stopped"
        assert "second" in stopped.reason
    with hosted(sessions[0]), Commander(sessions[1], "arm") as arm:
        until(lambda: "second" in arm.wait_for_driver().reason)
        assert not arm.release().stops
        assert "third" in stop(sessions[1], "arm", "third", timeout_s=DEADLINE_S).reason


def test_a_forged_stop_and_its_release_do_not_end_the_stop_of_the_program_that_it_names(sessions):
    with hosted(sessions[0]), Commander(sessions[1], "arm") as arm:
        key, session, seq = key_of(stop(sessions[1], "arm", "hand inside"))
        with forger(sessions[1], key) as forge:
            forge(Stop(0, seq + 1, session, "hold", "a test, ignore it"))
            until(lambda: len(arm.wait_for_driver().stops) == 2)
        state = arm.wait_for_driver()
        assert "hand inside" in state.reason
        assert "a test" in state.reason
        release = Release(0, 0, local_writer(8).session, ((session, seq + 1),))
        releases = KeyPublisher(
            sessions[1], RELEASE.key("arm", local_writer(8).identity), encoding_of(Release)
        )
        with releases, repeated(lambda: releases.put(encode(release))):
            until(lambda: arm.wait_for_driver().stops == ((session, seq),))
        assert arm.wait_for_driver().state == "stopped"


def test_numbers_of_stops_cannot_be_foreseen(sessions):
    with hosted(sessions[0]), Commander(sessions[1], "arm") as arm:
        numbers: list[int] = []
        for _ in range(3):
            ((_, seq),) = stop(sessions[1], "arm").stops
            numbers.append(seq)
            arm.release()
    steps = np.diff(numbers)
    assert steps.min() > 0
    assert len(set(steps.tolist())) == 2


@pytest.mark.parametrize("seq", [0, 2**63 - 1, 2**63, 2**64 - 1])
def test_a_stop_in_the_name_of_the_host_does_not_end_its_reports(sessions, seq):
    class Silent(SimulatedDriver):
        is_silent = False

        def read(self, stamp: int) -> JointReading | None:
            reading = super().read(stamp)
            return None if self.is_silent else reading

    driver = Silent(RRBOT)
    with hosted(sessions[0], driver) as host, Commander(sessions[1], "arm") as arm:
        own = arm.wait_for_driver().session
        key = STOP.key("arm", WriterId("drive", "desk", 1, 1, own).identity)
        with forger(sessions[1], key) as forge:
            forge(Stop(0, seq, own, "hold", "forged"))
            refused = "foreign" if seq < 2**63 else "malformed"
            until(lambda: host.report().refused.get(refused) == 1)
        with repeated(lambda: arm.send({"elbow": 0.1})):
            until(lambda: host.state == "active")
            driver.is_silent = True
            until(lambda: arm.wait_for_driver().state == "stopped")
        assert [session for session, _ in arm.wait_for_driver().stops] == [own]
        assert "no new reading" in arm.wait_for_driver().reason
    with hosted(sessions[0]), Commander(sessions[1], "arm") as arm:
        assert "no new reading" in arm.wait_for_driver().reason


def test_a_state_that_cannot_be_encoded_is_published_without_what_cannot(sessions):
    good = DriverState(1, 5, "host", "active", "", ("elbow",), 10**8, ticks=7)
    bad = replace(good, state="fault", reason="\udcff lost", stops=((5, 2**64),))
    present = [good]
    received: list[DriverState] = []

    def on_state(sample: SerializedSample) -> None:
        received.append(decode(sample.payload, sample.encoding, DriverState))

    with (
        DriverStatePublisher(sessions[0], "arm", lambda: present[-1]) as publisher,
        LatchedSubscriber(sessions[1], stream_key("arm", "driver"), on_state),
    ):
        for state in (bad, good):
            present.append(state)
            publisher.notify()
            until(lambda state=state: bool(received) and received[-1].state == state.state)
    fault = next(state for state in received if state.state == "fault")
    assert (fault.reason, fault.stops, fault.ticks) == ("\\udcff lost", (), 7)


def test_a_damaged_file_is_kept_beside_the_next_one(sessions, caplog):
    path = stops_file("arm")
    path.parent.mkdir(parents=True)
    path.write_text('{"stops": [], "released": [[7, 18446744073709551616]]}')
    with hosted(sessions[0]), Commander(sessions[1], "arm") as arm:
        assert str(path.with_suffix(".damaged")) in arm.wait_for_driver().reason
        assert "are not known" in caplog.text
        assert arm.release().state == "ready"
    assert "18446744073709551616" in path.with_suffix(".damaged").read_text()
    assert json.loads(path.read_text())["stops"] == []


def test_a_flood_of_one_program_displaces_only_its_own_stops_and_none_without_a_substitute():
    register = StopRegister(HOST)
    register.add(ActiveStop(1, 5, "hold", "honest", "desk"))
    register.add(ActiveStop(2, 0, "relax", "first of many", "flood"))
    for number in range(1, 1000):
        register.add(ActiveStop(2, number, "hold", str(number), "flood"))
    kept = register.current.stops
    assert (1, 5) in [one.id for one in kept]
    assert len(kept) < 20
    (substitute,) = (one for one in kept if one.session == HOST.session)
    assert substitute.how == "relax"
    seen = tuple(one.id for one in kept)
    register.add(ActiveStop(2, 1000, "hold", "after the release was sent", "flood"))
    register.release(Release(0, 0, 8, seen))
    assert len(register.current.stops) == 2  # that stop, and a substitute for what it has displaced
    register.release(Release(0, 1, 8, tuple(one.id for one in register.current.stops)))
    assert register.current.stops == ()
    register.add(ActiveStop(1, 5, "hold", "from a cache", "desk"))
    assert register.current.stops == ()


def kept_with(stops: Iterable[tuple[int, int]]) -> tuple[list[tuple[int, int]], int]:
    """The stops that are kept of those of ``stops``, by session and number, and how many are of the host."""
    register = StopRegister(HOST)
    for session, number in stops:
        register.add(ActiveStop(session, number, "hold", str(number), "desk"))
    kept = [one.id for one in register.current.stops]
    others = [one for one in kept if one[0] != HOST.session]
    return others, len(kept) - len(others)


def test_a_stop_is_confirmed_after_it_is_kept_for_the_next_host():
    register = StopRegister(HOST)
    register.add(ActiveStop(1, 5, "hold", "door open", "desk"))
    assert [one.id for one in register.current.stops] == [(1, 5)]  # obeyed at once
    assert register.current.ids == ()
    register.save()
    assert register.current.ids == ((1, 5),)


def test_eight_stops_of_a_program_are_kept_and_one_of_the_host_stands_for_the_oldest_of_more():
    numbers = [(1, number) for number in range(9)]
    assert kept_with(numbers[:8]) == (numbers[:8], 0)
    assert kept_with(numbers) == (numbers[1:], 1)


def test_256_stops_are_kept_one_of_which_stands_for_the_oldest_of_more():
    numbers = [(1000 + session, 0) for session in range(257)]
    assert kept_with(numbers[:255]) == (numbers[:255], 0)
    assert kept_with(numbers[:256]) == (numbers[1:256], 1)
    assert kept_with(numbers) == (numbers[2:], 1)


def is_forgotten(register: StopRegister, session: int, number: int) -> bool:
    """Whether a stop that was released stops once more."""
    register.add(ActiveStop(session, number, "hold", "from a cache", "desk"))
    return (session, number) in [one.id for one in register.current.stops]


def test_the_last_32_releases_of_a_program_are_remembered():
    register = StopRegister(HOST)
    for number in range(33):
        register.add(ActiveStop(1, number, "hold", "", "desk"))
        register.release(Release(0, number, 8, ((1, number),)))
    assert not is_forgotten(register, 1, 1)
    assert is_forgotten(register, 1, 0)


def test_releases_of_256_programs_are_remembered():
    register = StopRegister(HOST)
    for session in range(1000, 1257):
        register.add(ActiveStop(session, 0, "hold", "", "desk"))
        register.release(Release(0, session, 8, ((session, 0),)))
    assert not is_forgotten(register, 1001, 0)
    assert is_forgotten(register, 1000, 0)


def test_a_stop_that_is_repeated_replaces_the_last_one_and_an_earlier_release_does_not_end_it():
    register = StopRegister(HOST)
    register.add(ActiveStop(1, 0, "hold", "door open", "desk"))
    for number in range(1, 100):
        register.add(ActiveStop(1, number, "hold", "door open", "desk"))
        register.release(Release(0, number, 8, ((1, number - 1),)))
        assert [one.id for one in register.current.stops] == [(1, number)]


@pytest.mark.parametrize("released", [0, 1])
def test_a_stop_that_arrives_again_after_its_release_or_that_of_its_successor_is_ignored(released: int):
    register = StopRegister(HOST)
    stops = [ActiveStop(1, number, "hold", "door open", "desk") for number in (0, 1)]
    for one in stops[: released + 1]:
        register.add(one)
    register.release(Release(0, 0, 8, ((1, released),)))
    for one in stops[: released + 1]:
        register.add(one)
    assert register.current.stops == ()


def test_stops_of_many_programs_are_bounded_and_a_release_ends_those_that_it_names():
    register = StopRegister(HOST)
    for session in range(1000, 2000):
        register.add(ActiveStop(session, 0, "hold", "", "flood"))
        assert len(register.current.stops) <= 256
    register.release(Release(0, 0, 8, tuple(one.id for one in register.current.stops)))
    assert register.current.stops == ()
    # The release of the first is forgotten: it stops once more, and can be released once more.
    register.add(ActiveStop(1000, 0, "hold", "from a cache", "desk"))
    register.release(Release(0, 1, 8, ((1000, 0),)))
    assert register.current.stops == ()


def test_a_stop_that_many_others_displace_is_reported_as_obeyed_until_its_release():
    register = StopRegister(HOST)
    register.add(ActiveStop(1, 5, "relax", "honest", "desk"))
    for session in range(1000, 1400):
        register.add(ActiveStop(session, 0, "hold", "", "flood"))
    register.save()
    seen = register.current
    assert (1, 5) not in [one.id for one in seen.stops]
    assert (1, 5) in seen.ids
    assert len(seen.ids) == len(set(seen.ids)) <= 512
    assert "relax" in [one.how for one in seen.stops]
    register.add(ActiveStop(2000, 0, "hold", "displaces another one after the release was sent", "flood"))
    register.release(Release(0, 0, 8, seen.ids))
    left = register.current
    assert set(left.ids).isdisjoint(seen.ids)
    assert len(left.stops) == 2
    register.release(Release(0, 1, 8, left.ids))
    assert register.current.ids == ()


def test_a_stop_that_others_displace_within_one_tick_is_confirmed(sessions):
    may_read = threading.Event()
    may_read.set()

    class Slow(SimulatedDriver):
        def read(self, stamp: int) -> JointReading:
            assert may_read.wait(DEADLINE_S)
            return super().read(stamp)

    honest = local_writer(1)
    with (
        hosted(sessions[0], Slow(RRBOT)) as host,
        Commander(sessions[1], "arm") as arm,
        ExitStack() as opened,
    ):
        arm.wait_for_driver()
        opened.callback(may_read.set)
        send = opened.enter_context(forger(sessions[1], STOP.key("arm", honest.identity)))
        may_read.clear()
        send(Stop(0, 3, honest.session, "hold", "honest"))
        until(lambda: any(one.session == honest.session for one in host._stops.latched))
        for session in range(1000, 1400):
            put_stop(sessions[1], session, 0)
        until(lambda: host._stops.current.arrived == 401)
        may_read.set()
        until(lambda: host._stops.current.ids == host._stops.current.kept().ids)
        until(lambda: arm.wait_for_driver().stops == host._stops.current.ids)
        assert arm.wait_for_driver().state == "stopped"
        assert (honest.session, 3) in arm.wait_for_driver().stops
        assert arm.release(DEADLINE_S).state == "ready"


def put_stop(session: Session, number: int, seq: int) -> None:
    """A stop of the session with that number, which is not cached for late joiners."""
    payload = encode(Stop(0, seq, number, "hold", f"flood {seq}"))
    key = STOP.key("arm", WriterId("flood", "desk", 1, 1, number).identity)
    put(session, key, payload, encoding_of(Stop))


@pytest.mark.parametrize("kind", ["rising", "distinct"])
def test_a_flood_of_stops_of_hundreds_of_sessions_leaves_an_honest_one_confirmed(sessions, kind):
    """Of 400 sessions that count up, or of new sessions all the time.

    At most 500 are on their way, half of what waits at the host: beyond that any may be lost, to be repeated.
    """
    has_ended, sent = threading.Event(), 0

    def flood(host: DriverHost) -> None:
        nonlocal sent

        def may_go_on() -> bool:
            return has_ended.is_set() or sent - host._stops.current.arrived < 500

        while not has_ended.is_set():
            put_stop(sessions[1], 1000 + (sent % 400 if kind == "rising" else sent), sent)
            sent += 1
            until(may_go_on)

    with hosted(sessions[0]) as host, connect() as third, Commander(third, "arm") as arm:
        thread = threading.Thread(target=flood, args=(host,))
        thread.start()
        try:
            until(lambda: "further stops" in host._loop.state.reason)
            for number in range(3):
                before = sent
                assert stop(third, "arm", f"honest {number}", timeout_s=DEADLINE_S).state == "stopped"
                until(lambda before=before: sent > before + 400)
        finally:
            has_ended.set()
            thread.join()
        until(lambda: not arm.release(DEADLINE_S).stops and host.state == "ready")


def test_many_stops_that_arrive_together_are_written_to_the_file_at_once(sessions, monkeypatch):
    is_held, written = threading.Event(), []
    may_write = threading.Event()
    may_write.set()
    fsync = os.fsync

    def slow(number: int) -> None:
        written.append(number)
        is_held.set()
        assert may_write.wait(DEADLINE_S)
        fsync(number)

    monkeypatch.setattr(os, "fsync", slow)
    writer = local_writer(99)
    with (
        StopLatch(sessions[0], "arm", HOST, Refusals()) as latch,
        forger(sessions[1], STOP.key("arm", writer.identity)) as send,
    ):
        send(Stop(0, 0, writer.session, "hold", ""))
        until(lambda: latch.latched)
        may_write.clear()
        is_held.clear()
        send(Stop(0, 1, writer.session, "hold", ""))
        assert is_held.wait(DEADLINE_S)
        written.clear()
        for number in range(2, 1002):
            send(Stop(0, number, writer.session, "hold", ""))
        may_write.set()
        until(lambda: any(one.seq == 1001 for one in latch.latched))
        until(lambda: "1001" in stops_file("arm").read_text())
    assert len(written) < 200


# Stops with and without torque, behind a router with access control


FLEET = AclRoles(("arm", "r2"), ("desk",), operators=("pendant",), placers=("site",), commanders=("teleop",))


def test_every_name_may_hold_a_driver_and_reads_that_it_has_stopped_and_only_commanders_drop_the_load(
    tmp_path,
):
    with router_with_users(tmp_path, FLEET, FLEET.identities) as endpoint, ExitStack() as opened:
        users = {name: opened.enter_context(join(endpoint, name)) for name in FLEET.identities}
        driver = StoppedDriver()
        opened.enter_context(hosted(users["arm"], driver))
        arm = opened.enter_context(Commander(users["teleop"], "arm"))
        arm.wait_for_driver(DEADLINE_S)
        for name in ("desk", "r2", "site"):
            assert stop(users[name], "arm", name, timeout_s=DEADLINE_S).state == "stopped"
            with pytest.raises(Unreachable, match=r"holds its joints, .* 0\.5 s that their torque is off"):
                stop(users[name], "arm", name, how="relax", timeout_s=0.5)
            payload = encode(Stop(0, 0, 9, "relax", name))
            put(users[name], RELAX.key("arm", local_writer(9).identity), payload, encoding_of(Stop))
        assert set(driver.hows) == {"hold"}
        assert not arm.release(DEADLINE_S).stops
        for name in ("teleop", "pendant"):
            assert stop(users[name], "arm", name, how="relax", timeout_s=DEADLINE_S).state == "stopped"
        assert driver.hows[-1] == "relax"


def test_a_stop_that_asks_for_relax_on_the_key_of_all_programs_holds(sessions):
    driver, writer = StoppedDriver(), local_writer(9)
    with hosted(sessions[0], driver) as host, forger(sessions[1], STOP.key("arm", writer.identity)) as send:
        send(Stop(0, 3, writer.session, "relax", "drop it"))
        until(lambda: host.state == "stopped")
        assert driver.hows == ["hold"]
        assert host.report().refused == {"relax": 1}


def test_a_driver_without_torque_stays_so_until_that_stop_is_released(sessions):
    driver = StoppedDriver()
    with hosted(sessions[0], driver), Commander(sessions[1], "arm") as arm:
        relaxed = stop(sessions[1], "arm", "hand inside", how="relax")
        until(lambda: len(stops_in_file()) == 2)
        held = {(one["session"], one["seq"]) for one in stops_in_file() if one["how"] == "hold"}
        until(lambda: held <= set(arm.wait_for_driver().stops))
        key = RELEASE.key("arm", local_writer(8).identity)
        with KeyPublisher(sessions[1], key, encoding_of(Release)) as releases:
            message = encode(Release(0, 0, local_writer(8).session, tuple(held)))
            with repeated(lambda: releases.put(message)):
                until(lambda: not held & set(arm.wait_for_driver().stops))
        driver.hows.clear()
        stop(sessions[0], "arm", "another")
        until(lambda: driver.hows)
        assert set(driver.hows) == {"relax"}
        assert set(arm.wait_for_driver().stops) & set(relaxed.stops)


# Texts


@pytest.mark.parametrize(
    "reason", ["x" * 1001, "x" * 500_000, "\udcff.urdf", "a\nb" * 600, ValueError("bus")]
)
def test_a_stop_never_fails_because_of_its_text(sessions, reason):
    with hosted(sessions[0]), Commander(sessions[1], "arm"):
        state = stop(sessions[1], "arm", reason, timeout_s=DEADLINE_S)
        assert state.state == "stopped"
        assert str(reason)[:1].replace("\udcff", "\\udcff") in state.reason


def test_the_reason_of_a_stop_is_cut_after_1000_characters():
    assert stop_text("x" * 1000) == "x" * 1000
    assert stop_text("x" * 1001) == "x" * 997 + "..."


@pytest.mark.parametrize(
    "text", [b"\xda\x03\xe9" + b"x" * 1001, b"\xdb\0\x03\0\0" + b"x" * 0x30000, b"\xa2\xffx"]
)
def test_a_driver_obeys_a_stop_of_another_writer_whatever_its_text_is(sessions, text):
    writer = local_writer(9)
    payload = encode(Stop(0, 3, writer.session, "hold", ""))[:-1] + text
    with hosted(sessions[0]) as host, forger(sessions[1], STOP.key("arm", writer.identity)) as send:
        send(payload)
        until(lambda: host.state == "stopped")
        until(stops_in_file)
        (reason,) = (one["reason"] for one in stops_in_file())
        assert "x" in reason
        assert len(reason) <= 1000


# Releases


def test_a_commander_that_was_stopped_may_move_again_by_a_release_after_that_of_another(sessions):
    with hosted(sessions[0]) as host, Commander(sessions[1], "arm") as arm:
        arm.wait_for_driver()
        with repeated(lambda: arm.send({"elbow": 0.1})):
            until(lambda: host.state == "active")
            state = stop(sessions[1], "arm")
            release_as(local_writer(8), sessions[1], host, state.stops)
            assert not arm.release().stops
            until(lambda: host.state == "active")


def test_a_release_of_stops_that_another_released_a_moment_before_counts(sessions, monkeypatch):
    with hosted(sessions[0]) as host, Commander(sessions[1], "arm") as arm:
        arm.wait_for_driver()
        with repeated(lambda: arm.send({"elbow": 0.1})):
            until(lambda: host.state == "active")
            stopped = stop(sessions[1], "arm")
            until(lambda: host.report().refused.get("stopped"))
            release_as(local_writer(8), sessions[1], host, stopped.stops)
            # The driver's state from before that is still in its cache.
            monkeypatch.setattr("zstate.driving.commander.cached_state", lambda *_: stopped)
            assert not arm.release(DEADLINE_S).stops
            until(lambda: host.state == "active")


def release_as(releaser: WriterId, session: Session, host: DriverHost, stops: StopIds) -> None:
    """Release ``stops`` as another program, until commands of the first one are refused for that."""
    key = RELEASE.key("arm", releaser.identity)
    message = encode(Release(0, 0, releaser.session, stops))
    with (
        KeyPublisher(session, key, encoding_of(Release)) as releases,
        repeated(lambda: releases.put(message)),
    ):
        until(lambda: host.report().refused.get("not released"))


def test_a_release_in_the_name_of_another_program_is_refused(sessions):
    with hosted(sessions[0]) as host, Commander(sessions[1], "arm"):
        stopped = stop(sessions[1], "arm")
        key = RELEASE.key("arm", local_writer(8).identity)
        releases = KeyPublisher(sessions[1], key, encoding_of(Release))
        with releases, repeated(lambda: releases.put(encode(Release(0, 0, 9, stopped.stops)))):
            until(lambda: host.report().refused.get("foreign"))
        assert host.state == "stopped"
