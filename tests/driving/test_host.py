"""A driver host and its commander: real sessions, and processes that are killed."""

from __future__ import annotations

import itertools
import json
import math
import re
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress

import numpy as np
import pytest
from helpers.manual_cdr import rosbags_numbers
from helpers.processes import DEADLINE_S, Child, repeated, take, until
from helpers.raw_ros_nodes import COMMANDS, RosNode, RosPublisher, announced_publisher, attachment
from helpers.robots import RRBOT, SampleCollector, wait_for_reader

from zstate import JointReading, StatePublisher, load_model
from zstate.driving import Commander, DriverHost, Limits, SimulatedDriver, stop
from zstate.driving.driver import Setpoint, StopMode
from zstate.driving.errors import DriverFault, MotionRefused
from zstate.driving.messages import DriverState, JointCommand, Release
from zstate.driving.stops import stops_file, wait_for_state
from zstate.errors import InvalidInput, SecondWriter, Unreachable
from zstate.net.presence import announce, confirmed_tokens, local_writer
from zstate.net.session import Session
from zstate.net.streams import KeyPublisher
from zstate.nodes.listener import TransformListener
from zstate.sources import JointStateListener
from zstate.wire.keys import RELEASE, WRITER_TOKEN
from zstate.wire.messages import order_digest, to_block
from zstate.wire.native import encode, encoding_of

LIMITS = Limits.of(RRBOT, velocity=2.0, acceleration=math.inf)
ELBOW = order_digest(("elbow",))
RATE_HZ = 200.0
STEP = 2.0 / RATE_HZ
"""The longest step of a tick at the velocity limit [rad]."""


class RecordingDriver(SimulatedDriver):
    """A mirror that keeps every call, with its instant on the monotonic clock."""

    def __init__(self, start: list[float] | None = None) -> None:
        super().__init__(RRBOT, "mirror", start=None if start is None else np.array(start))
        self.calls: list[tuple[str, int, object]] = []
        self.failures: list[Exception] = []
        """Of the next calls of ``read``."""
        self.write_failures: list[Exception] = []
        self.stop_failures: list[BaseException] = []

    def _keep(self, name: str, value: object = None) -> None:
        self.calls.append((name, time.monotonic_ns(), value))

    def read(self, stamp: int) -> JointReading:
        if self.failures:
            raise self.failures.pop()
        return super().read(stamp)

    def write(self, setpoint) -> None:
        if self.write_failures:
            raise self.write_failures.pop()
        self._keep("write", setpoint.positions)
        super().write(setpoint)

    def stop(self, how) -> None:
        self._keep("stop", how)
        if self.stop_failures:
            raise self.stop_failures.pop()
        super().stop(how)

    @property
    def has_torque(self) -> bool:
        return self._target is not None

    def stops(self) -> list[object]:
        return [value for name, _, value in list(self.calls) if name == "stop"]

    def written(self) -> np.ndarray:
        return np.array([value for name, _, value in list(self.calls) if name == "write"]).reshape(-1, 2)


@contextmanager
def running(session: Session, driver: SimulatedDriver, **options: object) -> Iterator[DriverHost]:
    """A host whose loop runs in a thread; its exception is raised at the end."""
    failure: list[BaseException] = []
    options = {"rate_hz": RATE_HZ, "limits": LIMITS, **options}
    with DriverHost(session, driver, RRBOT, "arm", **options) as host:

        def run() -> None:
            try:
                host.run()
            except BaseException as error:
                failure.append(error)

        thread = threading.Thread(target=run)
        thread.start()
        try:
            until(lambda: host.state != "off" or failure)
            yield host
        finally:
            host.close()
            thread.join()
    if failure:
        raise failure[0]


def send_until(commander: Commander, positions: dict[str, float], condition) -> None:
    def sent() -> bool:
        commander.send(positions)
        return bool(condition())

    until(sent)


def received(listener: TransformListener) -> list[float]:
    """The newest joint positions that a listener has."""
    return listener.buffer.joint_positions("arm")[0].tolist()


def test_a_commanded_joint_reaches_its_position_in_steps_within_the_velocity_limit(sessions):
    driver = RecordingDriver([0.5, -0.5])
    with (
        running(sessions[0], driver) as host,
        Commander(sessions[1], "arm") as arm,
        TransformListener(sessions[1], "arm") as listener,
    ):
        assert arm.wait_for_driver().state == "ready"
        assert driver.written().size == 0
        send_until(arm, {"elbow": 0.2}, lambda: driver.written().size and driver.written()[-1, 1] == 0.2)
        assert host.state == "active"
        until(lambda: received(listener) == [0.5, 0.2])
        until(lambda: arm.driver is not None and arm.driver.state == "active")
    written = driver.written()
    # The first setpoint is what was measured, and the shoulder was not commanded.
    assert written[0].tolist() == [0.5, -0.5]
    assert np.abs(np.diff(written, axis=0)).max() <= STEP * (1 + 1e-9)
    assert (written[:, 0] == 0.5).all()
    assert driver.calls[-1][0] == "stop"


def state_of(session: Session) -> DriverState:
    found = wait_for_state(session, "arm", lambda state: state.state == "holding", DEADLINE_S)
    assert found is not None
    return found


COMMANDER = """
    import time
    from zstate import connect
    from zstate.driving import Commander
    with connect() as session, Commander(session, "arm", program="teleop") as arm:
        arm.wait_for_driver()
        print("commanding", flush=True)
        while True:
            arm.send({"shoulder": 100.0})
            time.sleep(0.01)
"""


# A death is told by the token of the commander's session, long before 2 s have passed.
@pytest.mark.parametrize(
    ("end", "ttl_s", "reason"),
    [(Child.kill, 2.0, "{} has ended"), (Child.freeze, 0.2, r"nothing from {} for [0-9.]+ m?s")],
)
def test_a_dead_or_frozen_commander_leaves_the_joints_held_within_ttl_and_one_tick(
    sessions, spawn, end: Callable[[Child], None], ttl_s: float, reason: str
):
    driver = RecordingDriver()
    with running(sessions[0], driver, ttl_s=ttl_s) as host:
        killed = spawn(COMMANDER)
        killed.line()
        until(lambda: len(driver.written()) > 20)
        end(killed)
        dead_at = time.monotonic_ns()
        until(lambda: host.state == "holding")
        until(lambda: len(driver.written()) and (driver.written()[-5:] == driver.written()[-1]).all())
        report = host.report()
        name = re.escape(f"teleop@{socket.gethostname()} pid {killed.process.pid}")
        assert re.fullmatch(reason.format(name), state_of(sessions[1]).reason)
    writes = [(at, value) for name, at, value in driver.calls if name == "write"]
    moved = [at for (at, one), (_, before) in zip(writes[1:], writes, strict=False) if (one != before).any()]
    # Counted from arrival, which is not after the death; the last motion is in the tick of the expiry.
    worst_tick_ns = report.lateness_us.max * 1e3 + 1e9 / RATE_HZ
    assert moved[-1] - dead_at <= ttl_s * 1e9 + worst_tick_ns
    assert writes[-1][0] > moved[-1], "the position is held by further writes"


def test_setpoints_are_published_while_they_are_read(sessions):
    driver = RecordingDriver()
    with running(sessions[0], driver) as host, Commander(sessions[1], "arm") as arm:
        send_until(arm, {"elbow": 0.2}, lambda: len(driver.written()) > 5)
        setpoints: list[JointReading] = []
        with JointStateListener(
            sessions[1], "arm", RRBOT, stream="joint_setpoints", on_reading=setpoints.append
        ):
            send_until(arm, {"elbow": 0.2}, lambda: setpoints)
            send_until(arm, {"shoulder": 50.0}, lambda: setpoints[-1].positions[0] > 20 * STEP)
        host.close()
    written = driver.written()
    rows = [int((written == one.positions).all(axis=1).argmax()) for one in setpoints]
    assert rows[0] > 5, "those before the reader were not published"
    for row, one in zip(rows, setpoints, strict=True):
        assert (written[row] == one.positions).all()
        if one.velocities[0]:
            way = written[row] - written[row - 1]
            step_s = way[0] / one.velocities[0]
            assert 0.0 < step_s <= (1 + 1e-9) / RATE_HZ
            assert way == pytest.approx(step_s * one.velocities)


def test_on_silence_relax_switches_the_torque_off(sessions):
    driver = RecordingDriver()
    with running(sessions[0], driver, ttl_s=0.05, on_silence="relax"), Commander(sessions[1], "arm") as arm:
        arm.wait_for_driver()
        send_until(arm, {"elbow": 0.4}, lambda: len(driver.written()))
        until(lambda: ("stop", "relax") in [(name, value) for name, _, value in driver.calls])
        until(lambda: arm.wait_for_driver().state == "ready")


def test_a_second_commander_is_refused_with_the_name_of_the_first(sessions):
    with Commander(sessions[0], "arm", program="teleop"):
        until(lambda: confirmed_tokens(sessions[1], WRITER_TOKEN.expression("arm")))
        with pytest.raises(
            SecondWriter, match=r"'teleop@.*already writes joint_commands.*one commander at a time"
        ):
            Commander(sessions[1], "arm")


def test_commands_of_another_session_are_refused_while_the_first_are_valid(sessions):
    driver = RecordingDriver()
    with running(sessions[0], driver, ttl_s=10.0) as host, Commander(sessions[1], "arm") as arm:
        arm.wait_for_driver()
        with raw_commands(sessions) as put:
            until(lambda: arm.send({"elbow": 0.1}, ttl_s=10.0) or host.state == "active")

            def both() -> bool:
                arm.send({"elbow": 0.1}, ttl_s=10.0)
                put(command(elbow=-1.0))
                return host.report().refused.get("second commander", 0) > 0

            until(both)
    assert driver.written()[:, 1].min() >= 0.0


@contextmanager
def raw_commands(sessions: tuple[Session, Session]) -> Iterator:
    """``put`` for commands of the announced sessions 7 and 8, which the session of the host knows."""
    host, session = sessions
    key, known = "zstate/arm/joint_commands", set[str]()
    keys = [
        WRITER_TOKEN.key("arm", "joint_commands", local_writer(number, "raw").identity) for number in (7, 8)
    ]
    # A command may overtake the token of its session.
    watched = host.zenoh.liveliness().declare_subscriber(
        "zstate/arm/@writer/**", lambda token: known.add(str(token.key_expr))
    )
    with ExitStack() as opened:
        for token in keys:
            opened.enter_context(announce(session, token))
        publisher = opened.enter_context(KeyPublisher(session, key, encoding_of(JointCommand)))
        wait_for_reader(session, key)
        until(lambda: known.issuperset(keys))
        watched.undeclare()
        yield publisher.put


def command(seq: int = 0, ttl: int = 0, session: int = 7, age_s: float = 0.0, **positions: float) -> bytes:
    names = tuple(positions)
    block = to_block(list(positions.values()))
    head = (time.time_ns() - round(age_s * 1e9), seq, session, order_digest(names))
    return encode(JointCommand(*head, block, names=names, ttl=ttl))


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (command(elbow=float("nan")), "not finite"),
        (command(elbow=float("inf")), "not finite"),
        (command(elbw=0.0), "unknown joint"),
        (command(elbow=0.0, ttl=10**10), "ttl"),
        (encode(JointCommand(0, 0, 7, ELBOW, to_block([0.0]))), "no names"),
        (
            encode(JointCommand(0, 0, 7, ELBOW, None, None, to_block([1.0]), names=("elbow",))),
            "mode",
        ),
        (
            encode(JointCommand(0, 0, 7, ELBOW, to_block([1.0]), to_block([1.0]), names=("elbow",))),
            "mode",
        ),
        (encode(JointCommand(0, 0, 7, ELBOW, None, to_block([np.nan]), names=("elbow",))), "not finite"),
        (encode(JointCommand(0, 0, 7, ELBOW, None, to_block([np.inf]), names=("elbow",))), "not finite"),
        (encode(JointCommand(0, 0, 7, ELBOW, names=("elbow",))), "not finite"),
        (
            encode(
                JointCommand(0, 0, 7, order_digest(("elbow",) * 2), to_block([0, 1]), names=("elbow",) * 2)
            ),
            "repeated joint",
        ),
        (command(elbow=0.0)[:-3], "truncated"),
        (command(**{f"joint_{number}": 0.0 for number in range(100)}), "too large"),
        (b"\xff\x00garbage", "malformed"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",  # stamps differ at each collection
)
def test_a_bad_command_is_refused_counted_and_moves_nothing(sessions, payload: bytes, reason: str):
    driver = RecordingDriver()
    with running(sessions[0], driver) as host, raw_commands(sessions) as put:
        put(payload)
        until(lambda: host.report().refused == {reason: 1})
        numbers = iter(range(10**6))

        def is_moved() -> int:  # one command may expire before a thread runs again
            put(command(next(numbers), elbow=0.1))
            return len(driver.written())

        until(is_moved)
    assert driver.written().min() >= 0.0


def test_positions_outside_limits_are_refused_and_counted(sessions):
    narrow = Limits(RRBOT.joint_names, [-1.0, -0.5], [1.0, 0.5], [2.0, 2.0], [np.inf, np.inf])
    driver = RecordingDriver()
    with (
        DriverHost(sessions[0], driver, RRBOT, "arm", rate_hz=RATE_HZ, limits=narrow) as host,
        raw_commands(sessions) as put,
    ):
        put(command(elbow=0.6))
        put(command(1, elbow=0.6, shoulder=0.1))
        host.run(seconds=0.2)
        assert host.report().refused == {"outside limits": 2}
    assert driver.written().size == 0


def test_an_old_command_is_refused(sessions):
    driver = RecordingDriver()
    with running(sessions[0], driver) as host, raw_commands(sessions) as put:
        put(command(5, elbow=0.1))
        put(command(5, elbow=0.2))
        put(command(4, elbow=0.2))
        until(lambda: host.report().refused == {"old": 2} and len(driver.written()))
    assert driver.written()[:, 1].max() <= 0.1


def test_a_command_that_was_sent_earlier_than_its_ttl_moves_nothing(sessions):
    """As one that waited before a slow link, or for the end of a cut: in order, and after silence."""
    driver = RecordingDriver()
    with running(sessions[0], driver) as host, raw_commands(sessions) as put:
        put(command(0, elbow=0.1))
        until(lambda: host.state == "active")
        until(lambda: host.state == "holding")
        rests = driver.written()[-1]
        for number in range(1, 101):
            put(command(number, shoulder=50.0, elbow=1.0, age_s=10.0 - 0.01 * number))
            until(lambda number=number: host.report().refused == {"late": number})
        state = wait_for_state(sessions[1], "arm", lambda one: one.refused == {"late": 100}, DEADLINE_S)
        assert state is not None
        assert "it has waited for" in state.last_refusal
        assert state.received == (7, 100)
        assert (driver.written()[-1] == rests).all()
        put(command(101, elbow=0.2))
        until(lambda: host.state == "active")


def test_commands_of_a_session_that_is_not_announced_are_refused_like_its_motions(sessions):
    driver = RecordingDriver()
    with running(sessions[0], driver) as host, raw_commands(sessions) as put:
        numbers = iter(range(10**6))

        def is_refused() -> bool:
            put(command(next(numbers), session=9, shoulder=50.0))
            return host.report().refused.get("no claim", 0) > 50

        until(is_refused)
        assert set(host.report().refused) - {"overrun"} == {"no claim"}
        until(lambda: is_refused() and host.state == "holding")
        written = len(driver.written())
        until(lambda: is_refused() and len(driver.written()) > written + 20)
        assert (driver.written()[written:] == driver.written()[-1]).all()


def test_a_commander_that_has_closed_moves_nothing_by_what_arrives_later(sessions):
    driver = RecordingDriver()
    with running(sessions[0], driver) as host:
        numbers = iter(range(10**6))
        with KeyPublisher(sessions[1], "zstate/arm/joint_commands", encoding_of(JointCommand)) as publisher:
            with raw_commands(sessions) as put:

                def is_moved() -> bool:
                    put(command(next(numbers), shoulder=50.0))
                    return host.state == "active"

                until(is_moved)

            def is_refused() -> bool:
                publisher.put(command(next(numbers), shoulder=50.0))
                return bool(host.report().refused.get("no claim"))

            until(is_refused)
            assert set(host.report().refused) - {"overrun"} == {"no claim"}  # a busy loop takes many at once
            until(lambda: is_refused() and host.state == "holding")


def test_a_stop_is_latched_and_released_by_the_commander(sessions):
    driver = RecordingDriver()
    with running(sessions[0], driver) as host, Commander(sessions[1], "arm") as arm:
        arm.wait_for_driver()
        send_until(arm, {"shoulder": 50.0}, lambda: len(driver.written()) > 5)
        confirmed = stop(sessions[1], "arm", "door open")
        assert confirmed.state == "stopped"
        assert "door open" in confirmed.reason
        before = len(driver.written())
        assert driver.calls[-1][0] == "stop"
        send_until(arm, {"shoulder": 50.0}, lambda: host.report().refused.get("stopped"))
        assert len(driver.written()) == before
        assert arm.release().state == "ready"
        stopped_at = driver.written()[-1]
        send_until(arm, {"shoulder": 50.0}, lambda: len(driver.written()) > before)
        assert np.abs(driver.written()[before] - stopped_at).max() <= STEP * (1 + 1e-9)


def test_a_stop_is_released_at_once_after_it_by_the_same_program(sessions):
    with running(sessions[0], RecordingDriver()), Commander(sessions[1], "arm") as arm:
        arm.wait_for_driver(DEADLINE_S)
        for _ in range(20):  # the state may reach the commander later than the sender of the stop
            stop(sessions[0], "arm", timeout_s=DEADLINE_S)
            state = arm.release(DEADLINE_S)
            assert (state.state, state.stops) == ("ready", ())


def test_a_commander_that_did_not_release_the_stop_does_not_move_the_robot_by_a_release(sessions):
    driver = RecordingDriver()
    with (
        running(sessions[0], driver) as host,
        Commander(sessions[1], "arm") as arm,
        raw_commands(sessions) as put,
    ):
        numbers = iter(range(10**6))

        def send(condition) -> None:
            def sent() -> bool:
                put(command(next(numbers), shoulder=50.0))
                return bool(condition())

            until(sent)

        send(lambda: host.state == "active")
        stop(sessions[1], "arm")
        send(lambda: host.report().refused.get("stopped"))
        written = len(driver.written())
        assert arm.release().state == "ready"
        send(lambda: host.report().refused.get("not released", 0) > 3)
        assert len(driver.written()) == written


HOST = """
    import sys
    from zstate import connect, load_model
    from zstate.driving import DriverHost, SimulatedDriver
    model = load_model("rrbot")
    with connect() as session, DriverHost(session, SimulatedDriver(model), model, "arm") as host:
        print("open", flush=True)
        host.run()
"""

STOPPER = """
    from zstate import connect
    from zstate.driving import stop
    with connect() as session:
        print(stop(session, "arm", "from a third process").state, flush=True)
"""


def test_a_restarted_host_obeys_a_stop_whose_program_has_ended(sessions, spawn):
    first = spawn(HOST)
    first.line()
    stopper = spawn(STOPPER)
    assert stopper.line() == "stopped"
    stopper.wait()
    first.kill()
    second = spawn(HOST)
    second.line()
    with Commander(sessions[1], "arm") as arm:
        until(lambda: arm.driver is not None and arm.driver.state == "stopped")
        assert "from a third process" in arm.wait_for_driver().reason
        until_stopped = arm.wait_for_driver().refused.get("stopped", 0)
        send_until(
            arm, {"elbow": 1.0}, lambda: arm.wait_for_driver().refused.get("stopped", 0) > until_stopped
        )
        assert arm.release().state == "ready"
    second.kill()
    third = spawn(HOST)
    third.line()
    with Commander(sessions[1], "arm") as arm:
        until(lambda: arm.driver is not None and arm.driver.state == "ready")


def test_a_stop_before_the_host_starts_is_obeyed_from_its_sender(sessions, tmp_path):
    with pytest.raises(TimeoutError, match="no driver of 'arm' has confirmed"):
        stop(sessions[1], "arm", "not yet", timeout_s=0.05)
    driver = RecordingDriver()
    with running(sessions[0], driver) as host:
        until(lambda: host.state == "stopped")


def test_a_bad_reading_is_counted_and_the_loop_goes_on(sessions):
    driver = RecordingDriver()
    with running(sessions[0], driver) as host:
        for count in (1, 2):
            driver.failures.append(OSError("bad checksum"))
            until(lambda count=count: host.report().faults == count)
        assert host.state == "ready"


def test_a_driver_that_keeps_failing_is_stopped_and_the_stop_outlives_the_host(sessions):
    driver = RecordingDriver()
    with (
        pytest.raises(DriverFault, match=r"3 ticks in a row.*unplugged"),
        running(sessions[0], driver) as host,
    ):
        driver.failures += [OSError("unplugged")] * 1000
        until(lambda: host.state == "fault")
        assert host.report().faults == 3
    assert ("stop", "hold") in [(name, value) for name, _, value in driver.calls]
    with running(sessions[0], RecordingDriver()) as host:
        until(lambda: host.state == "stopped")


def test_the_first_failure_of_a_tick_is_reported_as_the_cause(sessions):
    driver = RecordingDriver()
    with (
        pytest.raises(DriverFault, match="unplugged"),
        running(sessions[0], driver, ttl_s=10.0) as host,
        Commander(sessions[1], "arm") as arm,
    ):
        arm.wait_for_driver()
        send_until(arm, {"elbow": 0.1}, lambda: host.state == "active")
        driver.failures += [OSError("unplugged")] * 1000
        driver.write_failures += [OSError("busy")] * 1000
        until(lambda: host.state == "fault")


def test_no_writes_follow_each_other_at_once_after_a_read_that_blocked(sessions):
    class SlowOnce(RecordingDriver):
        is_slow = False

        def read(self, stamp: int) -> JointReading:
            if self.is_slow:
                self.is_slow = False
                take(20 / RATE_HZ)
            return super().read(stamp)

    driver = SlowOnce()
    with running(sessions[0], driver) as host, Commander(sessions[1], "arm") as arm:
        arm.wait_for_driver()
        send_until(arm, {"shoulder": 9.0}, lambda: len(driver.written()) > 3)
        driver.is_slow = True
        send_until(arm, {"shoulder": 9.0}, lambda: host.report().rate.skipped >= 18)
        written = len(driver.written())
        send_until(arm, {"shoulder": 9.0}, lambda: len(driver.written()) > written + 20)
    assert np.abs(np.diff(driver.written()[:, 0])).max() <= STEP * (1 + 1e-9)


def test_a_part_of_the_robot_is_driven_beside_a_publisher_of_the_rest(sessions):
    class Elbow(RecordingDriver):
        def __init__(self) -> None:
            super().__init__()
            self.joint_names = ("elbow",)

        def read(self, stamp: int) -> JointReading:
            return JointReading(super().read(stamp).positions[1:])

        def write(self, setpoint) -> None:
            self._target = setpoint
            self._keep("write", [0.0, setpoint.positions[0]])

    limits = Limits.of(RRBOT, ["elbow"], velocity=2.0)
    with DriverHost(sessions[0], Elbow(), RRBOT, "arm", limits=limits) as host:
        report = host.run(seconds=0.1)
        assert report.rate is not None
        assert report.rate.ticks + report.rate.skipped == 10


@pytest.mark.parametrize("rates", [(np.array([3.0, 4.0]), np.array([5.0, 6.0])), (None, None)])
def test_readings_are_published_in_the_order_of_the_model(sessions, rates):
    class Reversed(RecordingDriver):
        def __init__(self) -> None:
            super().__init__()
            self.joint_names = RRBOT.joint_names[::-1]

        def read(self, stamp: int) -> JointReading:
            return JointReading(np.array([1.0, 2.0]), *rates)

    readings: list[JointReading] = []
    with (
        JointStateListener(sessions[1], "arm", RRBOT, on_reading=readings.append),
        running(sessions[0], Reversed(), limits=Limits.of(RRBOT, RRBOT.joint_names[::-1], velocity=2.0)),
    ):
        until(lambda: readings)
    found = readings[-1]
    assert found.positions.tolist() == [2.0, 1.0]
    for published, read in zip((found.velocities, found.efforts), rates, strict=True):
        assert published is None if read is None else published.tolist() == read[::-1].tolist()


def test_one_robot_has_one_host(sessions):
    with StatePublisher(sessions[0], RRBOT, "arm"):
        # A session that has just connected may discover the first later than it opens.
        until(lambda: confirmed_tokens(sessions[1], WRITER_TOKEN.expression("arm")))
        with pytest.raises(SecondWriter):
            DriverHost(sessions[1], RecordingDriver(), RRBOT, "arm", limits=LIMITS)


def test_two_hosts_do_not_share_a_robot_by_its_joints(sessions):
    def part(joint: str) -> RecordingDriver:
        driver = RecordingDriver()
        driver.joint_names = (joint,)
        return driver

    limits = Limits.of(RRBOT, ["elbow"])
    with (
        DriverHost(sessions[0], part("elbow"), RRBOT, "arm", limits=limits, program="left"),
    ):
        assert wait_for_state(sessions[1], "arm", lambda state: state.joint_names == ("elbow",), 10)
        with pytest.raises(SecondWriter, match=r"'left@.*' already drives elbow of 'arm'"):
            DriverHost(sessions[1], part("shoulder"), RRBOT, "arm")


def test_unusable_arguments_are_refused_together(sessions):
    with pytest.raises(InvalidInput, match=r"on_silence.*faults_allowed"):
        DriverHost(sessions[0], RecordingDriver(), RRBOT, limits=LIMITS, on_silence="fall", faults_allowed=0)


def test_a_commander_checks_what_it_sends(sessions):
    with running(sessions[0], RecordingDriver()), Commander(sessions[1], "arm") as arm:
        arm.wait_for_driver()
        with pytest.raises(InvalidInput, match="no joint 'elbw'; it has shoulder, elbow"):
            arm.send({"elbw": 0.0})
        with pytest.raises(InvalidInput, match="must be finite; not so: 'elbow'"):
            arm.send({"elbow": float("nan")})
        with pytest.raises(InvalidInput, match="at least one joint"):
            arm.send({})
        with pytest.raises(InvalidInput, match=r"a ttl of 1\.0 s is longer than 250\.0 ms"):
            arm.send({"elbow": 0.0}, ttl_s=1.0)
        with pytest.raises(InvalidInput, match=r"by joint, such as \{'elbow': 0\.4\}, not as list"):
            arm.send([0.1, 0.2])
        with pytest.raises(InvalidInput, match="a position of a joint is a number: could not convert"):
            arm.send({"elbow": "fast"})


# What a commander knows of a driver that does not obey


def test_a_commander_says_why_its_commands_are_refused(sessions):
    narrow = Limits(RRBOT.joint_names, [-1.0, -0.5], [1.0, 0.5], [2.0, 2.0], [np.inf, np.inf])
    with running(sessions[0], RecordingDriver(), limits=narrow), Commander(sessions[1], "arm") as arm:
        arm.wait_for_driver(DEADLINE_S)
        assert arm.problem == ""
        send_until(arm, {"elbow": 9.0}, lambda: arm.problem)
        assert re.match("the driver of 'arm' refuses commands: .*'elbow'.* 9", arm.problem), arm.problem
        send_until(arm, {"elbow": 0.1}, lambda: arm.problem == "")
        stop(sessions[0], "arm", "door open")
        send_until(arm, {"elbow": 0.1}, lambda: arm.problem.startswith("stopped by"))
        assert "door open" in arm.problem


def test_nothing_is_sent_to_a_silent_driver_and_the_newest_once_it_is_back(sessions, caplog):
    key = "zstate/arm/joint_commands"
    with Commander(sessions[1], "arm") as arm, closing(SampleCollector(sessions[0], key)) as sent:
        wait_for_reader(sessions[1], key)
        assert arm.problem == "the driver of 'arm' is silent: nothing is sent until it publishes its state"
        for number in range(100):
            arm.send({"elbow": 0.001 * number}, ttl_s=0.2)
        send_until(arm, {"shoulder": 0.1}, lambda: caplog.records)
        assert [record.message for record in caplog.records] == [arm.problem]
        assert sent.arrivals == []
        driver = RecordingDriver()
        with running(sessions[0], driver):
            send_until(arm, {"elbow": 0.2}, lambda: driver.written().size and driver.written()[-1, 1] == 0.2)
            send_until(arm, {"elbow": 0.2}, lambda: arm.problem == "")
        until(lambda: arm.driver is None)
        count = len(sent.arrivals)
        arm.send({"elbow": 0.3})
        assert arm.problem
        assert len(sent.arrivals) == count


def test_a_commander_of_a_fast_link_is_not_held_back(sessions):
    """At about 1 kHz, where the driver confirms commands ten times a second."""
    key = "zstate/arm/joint_commands"
    with (
        running(sessions[0], RecordingDriver()),
        Commander(sessions[1], "arm") as arm,
        closing(SampleCollector(sessions[0], key)) as sent,
    ):
        arm.wait_for_driver(DEADLINE_S)
        wait_for_reader(sessions[1], key)
        pause = threading.Event()

        def has_sent_a_thousand() -> bool:
            expected = len(sent.arrivals) + 1000
            for number in range(1000):
                arm.send({"elbow": 1e-6 * number})
                pause.wait(1e-4)
            with suppress(AssertionError):
                until(lambda: len(sent.arrivals) == expected, 1.0)
            return len(sent.arrivals) == expected

        until(has_sent_a_thousand, 60.0)  # not while a busy machine delays the states of the driver


def test_a_command_that_is_sent_before_the_first_state_of_the_driver_arrives_moves_the_joint(sessions):
    driver = RecordingDriver()
    with running(sessions[0], driver, ttl_s=10.0), Commander(sessions[1], "arm") as arm:
        arm.send({"elbow": 0.1}, ttl_s=10.0)
        until(lambda: driver.written().size and driver.written()[-1, 1] == 0.1)


def test_the_age_of_a_command_in_the_states_of_its_driver_is_counted_from_its_arrival(sessions):
    with running(sessions[0], RecordingDriver()), Commander(sessions[1], "arm") as arm:
        arm.wait_for_driver(DEADLINE_S)
        sent_at = time.monotonic_ns()
        arm.send({"elbow": 0.1})

        def next_state(after: int) -> DriverState:
            found = wait_for_state(
                sessions[1], "arm", lambda one: one.commander and one.instant > after, DEADLINE_S
            )
            assert found is not None
            return found

        taken = next_state(after=0)  # perhaps built while the command is taken
        first = next_state(after=taken.instant)
        second = next_state(after=first.instant)
        arrived = [one.instant - one.command_age for one in (first, second)]
        assert sent_at < arrived[0] == arrived[1] < time.monotonic_ns()


def test_waiting_for_a_driver_returns_the_state_that_ended_the_wait(sessions):
    """The state may be half a second old in the next moment."""

    class Flickering(Commander):
        looks = 0

        @property
        def driver(self) -> DriverState | None:
            self.looks += 1
            return super().driver if self.looks == 1 else None

    with running(sessions[0], RecordingDriver()), Flickering(sessions[1], "arm") as arm:
        until(lambda: arm._state)
        arm.looks = 0
        assert arm.wait_for_driver().joint_names == RRBOT.joint_names


# Stops that a driver, a second run or a new commander could have undone


def test_a_second_run_obeys_a_stop_that_is_still_latched(sessions):
    driver = RecordingDriver()
    with (
        DriverHost(sessions[0], driver, RRBOT, "arm", rate_hz=RATE_HZ, limits=LIMITS) as host,
        raw_commands(sessions) as put,
    ):
        with suppress(Unreachable):  # unless the host, which is off, publishes its state within that
            stop(sessions[1], "arm", "door open", timeout_s=0.05)
        host.run(seconds=0.1)
        put(command(elbow=1.0))
        host.run(seconds=0.1)
        assert host.report().refused == {"stopped": 1}
    assert driver.written().size == 0


def test_joints_of_an_expired_commander_come_to_rest_when_another_one_takes_over(sessions):
    driver = RecordingDriver()
    with running(sessions[0], driver) as host, raw_commands(sessions) as put:
        first, other = iter(range(10**6)), iter(range(10**6))

        def is_active() -> bool:  # a command may expire before a late tick
            put(command(next(first), shoulder=3.0, ttl=50_000_000))
            return host.state == "active"

        until(is_active)

        def taken_over() -> bool:
            # Sent all the time, so that it takes over in the tick in which the first command expires.
            put(command(next(other), session=8, elbow=0.1))
            return bool(driver.written()[-1, 1] == 0.1)

        until(taken_over)
        resting = driver.written()[-1, 0]
        count = len(driver.written())
        until(lambda: taken_over() and len(driver.written()) > count + 20)
    assert driver.written()[-1, 0] == resting < 3.0


@pytest.mark.parametrize("faults", [2, 40])
def test_setpoints_that_could_not_be_written_do_not_add_up_to_a_longer_step(sessions, faults: int):
    driver = RecordingDriver([0.0, 0.0])
    with running(sessions[0], driver, faults_allowed=50) as host, Commander(sessions[1], "arm") as arm:
        arm.wait_for_driver()
        send_until(arm, {"shoulder": 9.0}, lambda: len(driver.written()) > 3)
        driver.write_failures += [OSError("bus off")] * faults
        send_until(arm, {"shoulder": 9.0}, lambda: host.report().faults == faults)
        written = len(driver.written())
        send_until(arm, {"shoulder": 9.0}, lambda: len(driver.written()) > written + 3)
    assert np.abs(np.diff(driver.written(), axis=0)).max() <= STEP * (1 + 1e-9)


def test_a_first_setpoint_that_could_not_be_written_starts_again_from_the_measured_joints(sessions):
    driver = RecordingDriver([0.5, -0.5])
    driver.write_failures += [OSError("bus off")] * 20
    with running(sessions[0], driver, faults_allowed=50), Commander(sessions[1], "arm") as arm:
        arm.wait_for_driver()
        send_until(arm, {"shoulder": 9.0}, lambda: len(driver.written()) > 3)
    assert np.abs(driver.written()[0] - [0.5, -0.5]).max() <= STEP * (1 + 1e-9)


def test_joints_without_a_velocity_limit_are_refused_by_name(sessions, tmp_path):
    path = tmp_path / "one.urdf"
    path.write_text(
        '<robot name="one"><link name="a"/><link name="b"/><joint name="wheel" type="continuous">'
        '<parent link="a"/><child link="b"/><axis xyz="0 0 1"/></joint></robot>'
    )
    model = load_model(path)
    with pytest.raises(InvalidInput, match=r"the velocity of 'wheel' has no limit.*velocity=\.\.\."):
        DriverHost(sessions[0], SimulatedDriver(model), model)


def test_relaxed_joints_stay_without_torque_while_stopped(sessions):
    driver = RecordingDriver()
    with pytest.raises(DriverFault), running(sessions[0], driver) as host:
        stop(sessions[1], "arm", "hand inside", how="relax")
        assert not driver.has_torque
        stop(sessions[0], "arm", "again", how="hold")
        assert not driver.has_torque
        driver.failures += [OSError("unplugged")] * 3
        until(lambda: host.state == "fault")
        assert not driver.has_torque


def test_joints_relaxed_on_silence_get_no_torque_by_a_stop_or_after_a_restart(sessions):
    driver = RecordingDriver()
    options = {"ttl_s": 0.05, "on_silence": "relax"}
    with pytest.raises(DriverFault), running(sessions[0], driver, **options) as host:
        with Commander(sessions[1], "arm") as arm:
            arm.wait_for_driver()
            send_until(arm, {"elbow": 0.4}, lambda: len(driver.written()))
        until(lambda: not driver.has_torque)
        driver.failures += [OSError("unplugged")] * 3
        until(lambda: host.state == "fault")
    again = RecordingDriver()
    with running(sessions[0], again, **options) as host:
        until(lambda: host.state == "stopped")
        assert again.stops() == ["relax"]


def test_a_stop_that_the_driver_failed_to_carry_out_is_repeated_before_it_is_confirmed(sessions):
    driver = RecordingDriver()
    with running(sessions[0], driver, faults_allowed=50) as host, Commander(sessions[1], "arm") as arm:
        arm.wait_for_driver()
        send_until(arm, {"shoulder": 9.0}, lambda: len(driver.written()) > 3)
        driver.stop_failures += [OSError("servo 6 did not answer")] * 5
        assert stop(sessions[1], "arm", how="relax").state == "stopped"
        assert not driver.has_torque
        _, *repeated = driver.stops()  # after the one of enable
        assert set(repeated) == {"relax"}
        assert len(repeated) >= 6, "a busy machine sends the stop once more"
        assert host.report().faults == 5


def test_a_stop_is_confirmed_when_the_driver_has_stopped(sessions):
    class Slow(RecordingDriver):
        is_stopping, may_stop = threading.Event(), threading.Event()

        def stop(self, how: StopMode) -> None:
            self.is_stopping.set()
            assert self.may_stop.wait(DEADLINE_S)
            super().stop(how)

    driver = Slow()
    with running(sessions[0], driver), ThreadPoolExecutor(1) as pool:
        asked = pool.submit(stop, sessions[1], "arm", timeout_s=DEADLINE_S)
        assert driver.is_stopping.wait(DEADLINE_S)
        # A confirmation before the stop would have arrived before the replies to these queries.
        for _ in range(5):
            found = wait_for_state(sessions[1], "arm", lambda _: True, DEADLINE_S)
            assert found is not None
            assert found.state != "stopped"
        assert not asked.done()
        driver.may_stop.set()
        assert asked.result(DEADLINE_S).state == "stopped"


def test_an_enable_that_failed_half_way_is_followed_by_a_stop_after_silence(sessions):
    class Half(RecordingDriver):
        def enable(self, on: bool) -> None:
            super().enable(on)
            self.calls.clear()
            if on:
                take(0.06)
                raise OSError("servo 6 did not answer")

    driver = Half()
    with (
        running(sessions[0], driver, on_silence="relax", ttl_s=0.05) as host,
        raw_commands(sessions) as put,
    ):
        put(command(elbow=0.1))
        until(lambda: driver.stops() == ["relax"])
        assert host.state == "ready"
        assert not driver.has_torque


def test_an_interrupted_stop_is_repeated_when_the_loop_ends(sessions):
    driver = RecordingDriver()
    with (
        DriverHost(
            sessions[0], driver, RRBOT, "arm", rate_hz=RATE_HZ, limits=LIMITS, on_silence="relax"
        ) as host,
        raw_commands(sessions) as put,
    ):
        enable = driver.enable

        def enable_once(on: bool) -> None:
            enable(on)
            driver.stop_failures.append(KeyboardInterrupt())

        driver.enable = enable_once
        put(command(elbow=0.1))
        with pytest.raises(KeyboardInterrupt):
            host.run()
        driver.enable = enable
        assert not driver.has_torque


@pytest.mark.parametrize(
    "reading",
    [
        JointReading(np.array([0.1])),
        JointReading(np.array([0.1, 0.2, 0.3])),
        JointReading(np.array([0.1, 0.2]), np.zeros(3)),
        JointReading(0.1),
        JointReading(["a", "b"]),
        [0.1, 0.2],
    ],
)
def test_a_reading_that_no_joints_have_is_counted_and_not_published(sessions, reading: JointReading):
    class Wrong(RecordingDriver):
        def read(self, stamp: int) -> JointReading:
            return reading

    with (
        running(sessions[0], Wrong(), faults_allowed=10**6) as host,
        TransformListener(sessions[1], "arm") as listener,
    ):
        until(lambda: host.report().faults > 10)
        assert host.state == "ready"
        assert listener.stats.received == 0


def test_power_and_brakes_are_switched_off_before_the_driver_is_closed(sessions):
    calls: list[object] = []

    class Closing(RecordingDriver):
        def enable(self, on: bool) -> None:
            calls.append(on)
            raise OSError("unplugged")

        def close(self) -> None:
            calls.append("close")

    with running(sessions[0], Closing()):
        pass
    assert calls == [False, "close"]


def test_a_release_while_the_loop_is_off_lets_its_commander_move_the_robot(sessions):
    driver = RecordingDriver()
    with (
        DriverHost(sessions[0], driver, RRBOT, "arm", rate_hz=RATE_HZ, limits=LIMITS) as host,
        Commander(sessions[1], "arm") as arm,
    ):
        arm.wait_for_driver()
        stop(sessions[1], "arm")
        with repeated(lambda: arm.send({"elbow": 0.1})):
            host.run(seconds=0.3)
            assert host.report().refused.get("stopped")
        arm.release()
        with repeated(lambda: arm.send({"elbow": 0.1})):
            until(lambda: (host.run(seconds=0.1), driver.written().size)[1])


# Ends of the program

REPORTING_HOST = """
    import os, signal, sys, threading
    from zstate import connect, load_model
    from zstate.driving import DriverHost, Limits, SimulatedDriver

    class Reporting(SimulatedDriver):
        def write(self, setpoint):
            super().write(setpoint)
            if not self.is_moving:
                self.is_moving = True
                print("moving", flush=True)

        def stop(self, how):
            super().stop(how)
            if self.is_moving:
                print("stop", how, flush=True)

        def close(self):
            on_close()
            print("close", os.getpid() == first, flush=True)

    Reporting.is_moving = False
    first = os.getpid()
    on_close = lambda: None
    model = load_model("rrbot")
    session = connect()
    host = DriverHost(session, Reporting(model), model, "arm", limits=Limits.of(model, velocity=2.0))
    print("open", flush=True)
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_that_ends_the_program_stops_and_closes_the_driver_first(
    sessions, spawn, number: signal.Signals
):
    child = spawn(REPORTING_HOST + "    host.run()\n")
    assert child.line() == "open"
    with Commander(sessions[1], "arm") as arm, repeated(lambda: arm.send({"shoulder": 9.0})):
        assert child.line() == "moving"
        child.process.send_signal(number)
        assert child.line() == "stop hold"
        lines = [child.line(), child.line()]
    assert lines == ["stop relax", "close True"]  # relax is the one of enable(False)
    assert child.process.wait(DEADLINE_S) == -number


def test_the_loop_waits_for_no_lock_that_ctrl_c_could_leave_held(sessions, monkeypatch: pytest.MonkeyPatch):
    """Condition.wait is Python, and KeyboardInterrupt at some of its steps would hang ``close``."""
    waits: list[float | None] = []
    wait = threading.Condition.wait

    def watched(condition: threading.Condition, timeout: float | None = None) -> bool:
        if threading.current_thread() is threading.main_thread():
            waits.append(timeout)
        return wait(condition, timeout)

    with DriverHost(sessions[0], RecordingDriver(), RRBOT, "arm", rate_hz=RATE_HZ, limits=LIMITS) as host:
        monkeypatch.setattr(threading.Condition, "wait", watched)
        assert host.run(seconds=0.1).rate.ticks > 0
        monkeypatch.undo()
    assert waits == []


def test_close_in_a_handler_of_a_signal_during_close_does_not_wait_for_itself(spawn):
    child = spawn(
        REPORTING_HOST
        + """
    signal.signal(signal.SIGTERM, lambda *_: host.close())
    on_close = lambda: signal.raise_signal(signal.SIGTERM)
    host.run(seconds=0.1)
    host.close()
    print("closed", flush=True)
"""
    )
    assert [child.line() for _ in range(3)] == ["open", "close True", "closed"]


def test_a_forked_child_leaves_the_driver_alone(spawn):
    child = spawn(
        REPORTING_HOST
        + """
    with host:
        if os.fork() == 0:
            try:
                host.run()
            except Exception as error:
                print(error, flush=True)
            host.close()
            os._exit(0)
        os.wait()
    print("closed", flush=True)
"""
    )
    assert child.line() == "open"
    assert "belongs to process" in child.line()
    assert [child.line(), child.line()] == ["close True", "closed"]


class Cut(RecordingDriver):
    """Joints that do not move by what is written while ``is_cut``, as without power, or are not read."""

    is_cut = False
    is_silent = False

    def read(self, stamp: int) -> JointReading | None:
        reading = super().read(stamp)
        return None if self.is_silent else reading

    def write(self, setpoint) -> None:
        before = self._target
        super().write(setpoint)
        if self.is_cut:
            self._target = before


def test_joints_that_do_not_follow_are_stopped_and_start_from_where_they_are(sessions):
    driver = Cut([0.0, 0.0])
    with running(sessions[0], driver) as host, Commander(sessions[1], "arm") as arm:
        arm.wait_for_driver()
        send_until(arm, {"shoulder": 9.0}, lambda: len(driver.written()) > 3)
        driver.is_cut = True
        send_until(arm, {"shoulder": 9.0}, lambda: host.state == "stopped")
        until(lambda: arm.wait_for_driver().state == "stopped")
        reason = r"'shoulder' is 0\.\d+ rad from its setpoint, more than following_error=0\.2"
        assert re.search(reason, arm.wait_for_driver().reason)
        measured = driver.read(time.time_ns()).positions
        # The setpoint was one step ahead when the joint was first found to be too far.
        assert np.abs(driver.written()[-1] - measured).max() <= 0.2 + 2 * STEP
        driver.is_cut = False
        arm.release()
        written = len(driver.written())
        send_until(arm, {"shoulder": 9.0}, lambda: len(driver.written()) > written)
        assert np.abs(driver.written()[written] - measured).max() <= STEP * (1 + 1e-9)


def test_joints_without_new_readings_are_stopped(sessions):
    driver = Cut()
    with running(sessions[0], driver) as host, Commander(sessions[1], "arm") as arm:
        arm.wait_for_driver()
        send_until(arm, {"elbow": 0.1}, lambda: len(driver.written()) > 3)
        driver.is_silent = True
        send_until(arm, {"elbow": 0.1}, lambda: host.state == "stopped")
        until(lambda: "no new reading of the joints for" in arm.wait_for_driver().reason)


# Floods, and commands from before a release


def test_a_tick_looks_at_a_bounded_number_of_commands_and_the_others_are_counted(sessions):
    narrow = Limits(RRBOT.joint_names, [-1.0, -0.5], [1.0, 0.5], [2.0, 2.0], [np.inf, np.inf])
    with (
        DriverHost(sessions[0], RecordingDriver(), RRBOT, "arm", rate_hz=RATE_HZ, limits=narrow) as host,
        raw_commands(sessions) as put,
    ):
        for number in range(100):
            put(command(number, elbow=0.6))
        until(lambda: host.report().refused == {"overrun": 68})
        host.run(seconds=2 / RATE_HZ)
        assert host.report().refused == {"overrun": 68, "outside limits": 32}


def test_commands_from_before_a_release_do_not_move_the_robot_after_it(sessions):
    may_read = threading.Event()
    may_read.set()

    class Slow(RecordingDriver):
        def read(self, stamp: int) -> JointReading:
            assert may_read.wait(DEADLINE_S)
            return super().read(stamp)

    driver = Slow()
    with running(sessions[0], driver, ttl_s=10.0) as host, Commander(sessions[1], "arm") as arm:
        arm.wait_for_driver()
        stop(sessions[1], "arm")
        until(lambda: arm.wait_for_driver().state == "stopped")
        may_read.clear()
        # More than wait for a tick: those that are left have arrived, and no tick has seen them.
        send_until(arm, {"shoulder": 9.0}, lambda: host.report().refused.get("overrun"))
        releasing = threading.Thread(target=arm.release, args=(DEADLINE_S,))
        releasing.start()
        until(lambda: not json.loads(stops_file("arm").read_text())["stops"])
        may_read.set()
        releasing.join()
        until(lambda: host.state == "ready")
        ticks = host.report().rate.ticks
        until(lambda: host.report().rate.ticks > ticks + 5)
        assert host.report().refused["stopped"] >= 32
    assert driver.written().size == 0


def test_a_commander_that_has_closed_does_not_keep_the_next_one_waiting(sessions):
    driver = RecordingDriver()

    def move_elbow_to(goal: float) -> None:
        with Commander(sessions[1], "arm") as arm:
            arm.wait_for_driver()
            send_until(
                arm, {"elbow": goal}, lambda: driver.written().size and driver.written()[-1, 1] == goal
            )

    with running(sessions[0], driver, ttl_s=10.0 * DEADLINE_S) as host:
        move_elbow_to(0.1)
        move_elbow_to(-0.1)
        assert host.report().refused.keys() <= {"second commander"}  # until the end of the first is known


def test_a_driver_without_a_reading_yet_is_ready_with_that_reason(sessions):
    class Silent(RecordingDriver):
        is_silent = True

        def read(self, stamp: int) -> JointReading | None:
            return None if self.is_silent else super().read(stamp)

    driver = Silent()
    with running(sessions[0], driver), Commander(sessions[1], "arm") as arm:
        until(lambda: arm.wait_for_driver().reason == "no two readings that agree have arrived yet")
        with pytest.raises(
            MotionRefused, match="joints are not known: no two readings that agree have arrived yet"
        ):
            arm.move({"elbow": [0.1]}, [1.0])
        driver.is_silent = False
        until(lambda: (arm.wait_for_driver().state, arm.wait_for_driver().reason) == ("ready", ""))


def test_a_command_from_before_the_release_that_arrives_after_it_is_refused(sessions):
    driver = RecordingDriver()
    releaser = local_writer(7)  # the session of ``command``
    key = RELEASE.key("arm", releaser.identity)
    numbers = itertools.count()
    with (
        running(sessions[0], driver) as host,
        raw_commands(sessions) as put,
        KeyPublisher(sessions[1], key, encoding_of(Release)) as releases,
    ):
        wait_for_reader(sessions[1], key)
        stopped = stop(sessions[1], "arm", timeout_s=DEADLINE_S)
        releases.put(encode(Release(0, 10**6, 7, stopped.stops)))
        until(lambda: host.state == "ready")
        # Each is newer than the one before, and all are older than the release.
        until(lambda: put(command(next(numbers), elbow=1.0)) or host.report().refused.get("old"))
        put(command(10**6 + 1, elbow=-0.1))
        until(lambda: driver.written().size)
    assert driver.written().max() <= 0.0


def test_a_stop_that_is_released_before_the_next_tick_is_obeyed(sessions):
    may_read = threading.Event()
    may_read.set()

    class Slow(RecordingDriver):
        def read(self, stamp: int) -> JointReading:
            assert may_read.wait(DEADLINE_S)
            return super().read(stamp)

    def stops_in_file() -> list[dict[str, int]]:
        return json.loads(stops_file("arm").read_text())["stops"]

    driver = Slow()
    releaser = local_writer(8)
    key = RELEASE.key("arm", releaser.identity)
    with (
        running(sessions[0], driver, ttl_s=10.0) as host,
        Commander(sessions[1], "arm") as arm,
        KeyPublisher(sessions[1], key, encoding_of(Release)) as releases,
    ):
        arm.wait_for_driver()
        wait_for_reader(sessions[1], key)
        send_until(arm, {"shoulder": 9.0}, lambda: len(driver.written()) > 3)
        may_read.clear()
        with suppress(Unreachable):  # unless the host, which is off, publishes its state within that
            stop(sessions[1], "arm", "door open", timeout_s=0.05)
        until(stops_in_file)
        (stopped,) = stops_in_file()
        ended = ((stopped["session"], stopped["seq"]),)
        releases.put(encode(Release(0, 0, releaser.session, ended)))
        until(lambda: not stops_in_file())
        before = len(driver.stops())
        may_read.set()
        until(lambda: driver.stops()[before:] == ["hold"])
        until(lambda: host.state == "ready")
        written = len(driver.written())
        send_until(arm, {"shoulder": 9.0}, lambda: host.report().refused.get("not released", 0) > 3)
        assert len(driver.written()) == written


# Commands of ROS nodes

ROS = "ros2:domain=0"
CONTROLLED = {"wires": ("native", ROS), "ros2_controller": "forward_position_controller"}


def publish_until(node: RosPublisher, positions: list[float], condition) -> None:
    def is_done() -> bool:
        node.numbers(positions)
        return bool(condition())

    until(is_done)


def test_a_ros_node_commands_all_joints_in_the_order_of_the_driver_until_it_is_silent(sessions):
    driver = RecordingDriver([0.5, -0.5])
    with (
        running(sessions[0], driver, **CONTROLLED) as host,
        announced_publisher(sessions[1], "teleop", COMMANDS) as node,
        JointStateListener(sessions[1], "arm", RRBOT, wire=ROS) as joints,
        Commander(sessions[1], "arm") as arm,
    ):
        publish_until(
            node, [0.4, 0.2], lambda: len(driver.written()) and driver.written()[-1].tolist() == [0.4, 0.2]
        )
        publish_until(node, [0.4, 0.2], lambda: arm.wait_for_driver().commander == "/teleop")
        until(lambda: (reading := joints.read(0)) and reading.positions.tolist() == [0.4, 0.2])
        until(lambda: host.state == "holding")
        until(lambda: "nothing from /teleop for" in arm.wait_for_driver().reason)
    path = np.vstack(([0.5, -0.5], driver.written()))
    assert np.abs(np.diff(path, axis=0)).max() <= STEP * (1 + 1e-9)


def test_of_two_ros_nodes_the_first_commands_until_it_is_silent(sessions):
    driver = RecordingDriver()
    with (
        running(sessions[0], driver, ttl_s=1.5, **CONTROLLED) as host,
        announced_publisher(sessions[1], "first", COMMANDS) as first,
        announced_publisher(sessions[1], "second", COMMANDS) as second,
        Commander(sessions[1], "arm") as arm,
    ):
        arm.wait_for_driver()
        publish_until(first, [0.1, 0.1], lambda: host.state == "active")

        def is_refused(count: int) -> bool:
            first.numbers([0.1, 0.1])
            return host.report().refused.get("second commander", 0) >= count

        for send in (lambda: second.numbers([-1.0, -1.0]), lambda: arm.send({"elbow": -1.0})):
            refused = host.report().refused.get("second commander", 0)
            until(lambda send=send, refused=refused: (send(), is_refused(refused + 1))[1])
        assert driver.written().min() >= 0.0
        publish_until(second, [-0.2, 0.0], lambda: driver.written()[-1].tolist() == [-0.2, 0.0])


def test_bad_commands_of_ros_nodes_are_refused_and_move_nothing(sessions):
    narrow = Limits(RRBOT.joint_names, [-1.0, -0.5], [1.0, 0.5], [2.0, 2.0], [np.inf, np.inf])
    driver = RecordingDriver()
    with (
        running(sessions[0], driver, limits=narrow, **CONTROLLED) as host,
        announced_publisher(sessions[1], "teleop", COMMANDS) as node,
    ):
        for numbers in ([0.1], [0.1, 0.1, 0.1], [], [0.1, np.nan], [np.inf, 0.1], [0.0, 0.6]):
            node.numbers(numbers)
        node.put(rosbags_numbers([0.1, 0.1])[:-1])
        node.put(rosbags_numbers([0.1, 0.1]), None)
        until(lambda: sum(host.report().refused.values()) == 8)
        assert host.report().refused == {
            "joint count": 3,
            "not finite": 2,
            "truncated": 1,
            "no attachment": 1,
            "outside limits": 1,
        }
    assert driver.written().size == 0


def test_a_command_of_a_ros_node_that_was_sent_earlier_than_the_ttl_moves_nothing(sessions):
    driver = RecordingDriver()
    with (
        running(sessions[0], driver, **CONTROLLED) as host,
        announced_publisher(sessions[1], "teleop", COMMANDS) as node,
    ):
        publish_until(node, [0.1, 0.0], lambda: host.state == "active")
        until(lambda: host.state == "holding")
        rests = driver.written()[-1]
        for number in range(1, 21):
            sent = time.time_ns() - 10 * 10**9
            node.put(rosbags_numbers([50.0, 1.0]), attachment(node.seq + number, node.gid, sent))
            until(lambda number=number: host.report().refused == {"late": number})
        assert (driver.written()[-1] == rests).all()
        node.seq += 20
        publish_until(node, [0.2, 0.0], lambda: host.state == "active")


def test_commands_of_a_ros_node_that_is_not_announced_are_refused(sessions):
    with running(sessions[0], RecordingDriver(), **CONTROLLED) as host:
        node = RosNode(sessions[1], "teleop").publisher(COMMANDS).wait_for_reader()
        with closing(node):
            publish_until(node, [0.1, 0.0], lambda: host.report().refused.get("no claim"))
            # A machine that stalls for a tick refuses a command for that as well.
            assert set(host.report().refused) - {"overrun"} == {"no claim"}


def test_a_ros_node_that_commanded_a_stopped_robot_does_not_move_it_after_the_release(sessions):
    driver = RecordingDriver()
    with (
        running(sessions[0], driver, **CONTROLLED) as host,
        announced_publisher(sessions[1], "first", COMMANDS) as first,
        Commander(sessions[1], "arm") as arm,
    ):
        arm.wait_for_driver()
        publish_until(first, [50.0, 0.0], lambda: host.state == "active")
        stop(sessions[1], "arm")
        publish_until(first, [50.0, 0.0], lambda: host.report().refused.get("stopped"))
        written = len(driver.written())
        assert arm.release().state == "ready"
        publish_until(first, [50.0, 0.0], lambda: host.report().refused.get("not released", 0) > 3)
        assert len(driver.written()) == written
        with announced_publisher(sessions[1], "restarted", COMMANDS) as restarted:
            publish_until(restarted, [50.0, 0.0], lambda: len(driver.written()) > written)


def test_a_ros_node_commands_velocities_of_a_velocity_controller(sessions):
    wheels = Wheels()
    with (
        running(sessions[0], wheels, **CONTROLLED, ros2_mode="velocity") as host,
        announced_publisher(sessions[1], "teleop", COMMANDS) as node,
    ):
        wanted = [0.5, -0.5]
        publish_until(
            node, wanted, lambda: wheels.setpoints and wheels.setpoints[-1].velocities.tolist() == wanted
        )
        until(lambda: host.state == "holding" and not wheels.setpoints[-1].velocities.any())
    with pytest.raises(
        InvalidInput, match=r"ros2_mode='position' is none of the driver's modes, \['velocity'\]"
    ):
        DriverHost(sessions[0], Wheels(), RRBOT, "arm", limits=LIMITS, **CONTROLLED)


def test_a_controller_needs_the_wire_of_ros_nodes(sessions):
    with pytest.raises(InvalidInput, match=r"pass wires=\('native', 'ros2'\)"):
        DriverHost(sessions[0], RecordingDriver(), RRBOT, "arm", ros2_controller="arm_controller")


# The pace of the loop


class DevicePaced(RecordingDriver):
    """A mirror whose ``read`` waits for the next of its ``pulses``."""

    def __init__(self) -> None:
        super().__init__()
        self.pulses = threading.Semaphore(0)
        self.silent_reads = 0

    def read(self, stamp: int) -> JointReading | None:
        if self.pulses.acquire(timeout=0.05):
            return super().read(stamp)
        self.silent_reads += 1
        return None


def test_a_device_sets_the_pace_and_no_joint_moves_for_longer_than_the_time_that_passes(sessions):
    driver = DevicePaced()
    with running(sessions[0], driver, rate_hz=None, ttl_s=10.0) as host, Commander(sessions[1], "arm") as arm:
        assert arm.wait_for_driver().state == "ready"

        def pulsed() -> int:
            arm.send({"shoulder": 99.0})
            driver.pulses.release()
            return len(driver.written())

        until(lambda: pulsed() > 50)
        before = len(driver.written())
        silent_before = driver.silent_reads
        until(lambda: driver.silent_reads >= silent_before + 4)
        until(lambda: pulsed() > before)
        report = host.report()
    writes = [(at, value[0]) for name, at, value in driver.calls if name == "write"]
    (first_at, first), (last_at, last) = writes[0], writes[-1]
    # The first setpoint is what was measured, however long the loop has run without one.
    assert first == 0.0 < last <= 2.0 * (last_at - first_at) * 1e-9
    assert report.rate.ticks >= len(writes)
    assert (report.rate.commanded_hz, report.lateness_us.max) == (0.0, 0.0)


def test_a_device_that_returns_at_once_is_refused_as_the_pace_of_the_loop(sessions):
    driver = RecordingDriver()
    with (
        DriverHost(sessions[0], driver, RRBOT, "arm", rate_hz=None, limits=LIMITS) as host,
        pytest.raises(InvalidInput, match=r"returns at once.*pass rate_hz"),
    ):
        host.run(seconds=DEADLINE_S)
    assert host.state == "off"


@pytest.mark.realtime
def test_a_real_time_loop_moves_the_joints_and_ends_with_close(sessions):
    driver = RecordingDriver()
    with (
        running(sessions[0], driver, realtime="spin"),
        Commander(sessions[1], "arm") as arm,
    ):
        send_until(arm, {"elbow": 0.1}, lambda: driver.written().size and driver.written()[-1, 1] == 0.1)


def turned_until(commander: Commander, velocities: dict[str, float], condition) -> None:
    def sent() -> bool:
        commander.send(velocities=velocities)
        return bool(condition())

    until(sent)


def test_a_commanded_velocity_is_reached_by_a_ramp_and_ends_with_the_commands(sessions):
    limits = Limits.of(RRBOT, velocity=2.0, acceleration=8.0)
    setpoints: list[Setpoint] = []
    readings: list[JointReading] = []

    class Wheels(RecordingDriver):
        def write(self, setpoint) -> None:
            setpoints.append(setpoint)
            super().write(setpoint)

    with (
        running(sessions[0], Wheels(), limits=limits, ttl_s=0.2) as host,
        Commander(sessions[1], "arm") as arm,
        JointStateListener(sessions[1], "arm", RRBOT, on_reading=readings.append),
    ):
        assert arm.wait_for_driver().modes == ("position", "velocity")
        turned_until(arm, {"elbow": 1.0}, lambda: setpoints and setpoints[-1].velocities[1] == 1.0)
        turned_until(arm, {"elbow": 1.0}, lambda: readings and readings[-1].velocities[1] == 1.0)
        turned_until(arm, {"elbow": 3.0}, lambda: setpoints[-1].velocities[1] == 2.0)
        limited = ("elbow",)
        turned_until(arm, {"elbow": 3.0}, lambda: arm.driver is not None and arm.driver.limited == limited)
        until(lambda: host.state == "holding")
        until(lambda: setpoints[-1].velocities[1] == 0.0)
        send_until(arm, {"elbow": 0.0}, lambda: setpoints[-1].modes == ("position", "position"))
    velocities = np.array([one.velocities[1] for one in setpoints])
    modes = [one.modes for one in setpoints]
    assert ("position", "velocity") in modes
    assert all(one.modes[0] == "position" and one.positions[0] == 0.0 for one in setpoints)
    assert np.abs(np.diff(velocities)).max() <= 8.0 / RATE_HZ * (1 + 1e-9)
    assert velocities.max() == 2.0


def test_a_commander_that_was_closed_is_the_reason_why_the_joints_are_held(sessions):
    with running(sessions[0], RecordingDriver()) as host:
        with Commander(sessions[1], "arm", program="teleop") as arm:
            arm.wait_for_driver()
            send_until(arm, {"elbow": 0.1}, lambda: host.state == "active")
        until(lambda: host.state == "holding")
        state = wait_for_state(sessions[1], "arm", lambda state: state.state == "holding", DEADLINE_S)
    assert state is not None
    assert re.fullmatch(r"teleop@.* has ended", state.reason)


class Wheels(SimulatedDriver):
    """Takes velocities only."""

    def __init__(self) -> None:
        super().__init__(RRBOT, "mirror")
        self.modes = frozenset({"velocity"})
        self.setpoints: list[Setpoint] = []

    def write(self, setpoint: Setpoint) -> None:
        self.setpoints.append(setpoint)
        super().write(setpoint)


def test_a_driver_without_positions_turns_only_the_joints_that_are_commanded(sessions):
    wheels = Wheels()
    with running(sessions[0], wheels) as host, Commander(sessions[1], "arm") as arm:
        arm.wait_for_driver()
        turned_until(
            arm, {"elbow": 0.5}, lambda: wheels.setpoints and wheels.setpoints[-1].velocities[1] == 0.5
        )
        with pytest.raises(
            InvalidInput, match=r"commanded in mode velocity, .* mode position is not one of them"
        ):
            arm.send({"elbow": 0.5})
        with raw_commands(sessions) as put:
            put(command(elbow=0.5))
            until(lambda: host.report().refused.get("mode"))
            assert str(host.report().refused) == "{'mode': 1}"
        until(lambda: host.state == "holding" and wheels.setpoints[-1].velocities[1] == 0.0)
    assert {one.modes for one in wheels.setpoints} == {("velocity", "velocity")}
    assert all(one.velocities[0] == 0.0 for one in wheels.setpoints)


def test_one_command_moves_joints_in_several_modes(sessions):
    driver = Wheels()
    driver.modes = frozenset({"position", "velocity"})
    with running(sessions[0], driver), Commander(sessions[1], "arm") as arm:
        arm.wait_for_driver()

        def is_there() -> bool:
            arm.send({"shoulder": 0.3}, velocities={"elbow": -0.5})
            return bool(driver.setpoints) and driver.setpoints[-1].positions[0] == 0.3

        until(is_there)
        with pytest.raises(InvalidInput, match="several are given for 'elbow'"):
            arm.send({"elbow": 0.0}, velocities={"elbow": 0.0})
    last = driver.setpoints[-1]
    assert last.modes == ("position", "velocity")
    assert last.velocities[1] == -0.5


class Pushed(Wheels):
    """Takes positions and efforts; a joint in mode effort moves at 1 rad/s."""

    def __init__(self) -> None:
        super().__init__()
        self.modes = frozenset({"position", "effort"})

    def read(self, stamp: int) -> JointReading:
        pushed = [one == "effort" for one in self.setpoints[-1].modes] if self.setpoints else [False] * 2
        self._joints.positions[pushed] += 1.0 / RATE_HZ
        return super().read(stamp)

    def write(self, setpoint: Setpoint) -> None:
        super().write(setpoint)
        self._target = setpoint if "effort" not in setpoint.modes else None


def test_a_joint_that_leaves_its_range_by_an_effort_is_held_with_the_reason(sessions):
    limits = Limits(RRBOT.joint_names, [-0.1, -0.1], [0.1, 0.1], [2.0, 2.0], [20.0, 20.0], effort=5.0)
    driver = Pushed()
    with running(sessions[0], driver, limits=limits) as host, Commander(sessions[1], "arm") as arm:
        arm.wait_for_driver()

        def is_braked() -> bool:
            arm.send(efforts={"elbow": 20.0})
            return arm.driver is not None and "braked" in arm.driver.refused

        until(is_braked)
        assert arm.driver is not None
        text = r"'elbow' in mode effort is at 0\.10\d+ rad, outside -0.1 to 0.1: it is held"
        assert re.match(text, arm.driver.last_refusal)
        until(lambda: is_braked() and driver.setpoints[-1].velocities[1] == 0.0)
        assert host.report().refused == {"braked": 1}
    pushed = [one for one in driver.setpoints if one.modes[1] == "effort"]
    assert max(one.efforts[1] for one in pushed) == 5.0
    # It has left its range by a tick's motion, and brakes from 1 rad/s by 20 rad/s^2 for 25 ms.
    assert driver.setpoints[-1].positions[1] <= 0.1 + 1.0 / RATE_HZ + 0.025
