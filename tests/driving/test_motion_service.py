"""Motions of a driver over the network: real sessions, and processes that are killed."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress

import numpy as np
import pytest
from helpers.access_routers import join, router_with_users
from helpers.manual_cdr import rosbags_trajectory
from helpers.processes import DEADLINE_S, Child, take, until
from helpers.raw_ros_nodes import COMMANDS, TRAJECTORY, RosPublisher, announced_publisher, tokens
from helpers.robots import RRBOT, wait_for_reader

from zstate.driving import Commander, DriverHost, Limits, Motion, SimulatedDriver, stop
from zstate.driving.errors import MotionRefused, MotionTimeout
from zstate.driving.messages import JointCommand, JointTrajectory, MotionCancel, MotionReply
from zstate.driving.stops import wait_for_state
from zstate.driving.trajectory import Trajectory
from zstate.errors import InvalidInput
from zstate.fleet.acl import AclRoles
from zstate.net.presence import local_writer
from zstate.net.queryable import query
from zstate.net.session import Session
from zstate.net.streams import KeyPublisher
from zstate.net.writer import WireWriter
from zstate.wire.messages import order_digest, to_block
from zstate.wire.native import decode, encode, encoding_of
from zstate.wire.registry import get_wire

RATE_HZ = 200.0
ACCELERATION = 20.0
LIMITS = Limits.of(RRBOT, velocity=2.0, acceleration=ACCELERATION)
STEP = 2.0 / RATE_HZ
"""The longest step of a tick at the velocity limit [rad]."""

TTL_S = 5.0
"""Long enough for renewals of a busy machine; a test of silence sets its own."""


class Written(SimulatedDriver):
    """A mirror that keeps its setpoints; a joint that is ``stuck`` does not move."""

    stuck = False

    def __init__(self) -> None:
        super().__init__(RRBOT, "mirror")
        self.setpoints: list[np.ndarray] = []
        self.velocities: list[np.ndarray] = []
        self.written_at: list[int] = []
        """On the monotonic clock [ns]."""

    def write(self, setpoint) -> None:
        self.written_at.append(time.monotonic_ns())
        self.setpoints.append(setpoint.positions)
        self.velocities.append(setpoint.velocities)
        if not self.stuck:
            super().write(setpoint)

    @property
    def path(self) -> np.ndarray:
        return np.array([np.zeros(2), *self.setpoints])

    def assert_steps_within_limits(self) -> None:
        assert np.abs(np.diff(self.path, axis=0)).max() <= STEP * (1 + 1e-9)

    def assert_follows(self, planned: Trajectory, joints: list[int]) -> None:
        """Each setpoint of the motion is on the path, at most one period after the one before.

        A step of t seconds after one of a period T needs a change of velocity of A (T + t) / 2 on a path with
        the acceleration A, and may have a t. On a busy machine a tick may come right after the last one; then
        the joint is behind the path by up to (A T / 2)^2 / 4 a.
        """
        ways, velocities = np.diff(self.path, axis=0), np.array(self.velocities)
        rows = np.flatnonzero(velocities.any(axis=1))  # without those before and after it
        assert len(rows) > 0.9 * RATE_HZ * planned.duration_s
        fastest = np.abs(velocities[rows]).argmax(axis=1)
        steps_s = ways[rows, fastest] / velocities[rows, fastest]
        assert steps_s.min() > 0.0
        assert steps_s.max() <= (1 + 1e-6) / RATE_HZ
        times = np.minimum(np.cumsum(steps_s), planned.duration_s)
        assert times[-1] == planned.duration_s
        written = self.path[1 + rows][:, joints]
        on_path, _, accelerations = planned.sample(times)
        behind = (np.abs(accelerations).max() / RATE_HZ / 2) ** 2 / (4 * ACCELERATION)
        assert np.abs(written - on_path).max() < 1e-9 + behind


@contextmanager
def hosted(session: Session, driver: SimulatedDriver, **options: object) -> Iterator[DriverHost]:
    """A host of robot "arm" whose loop runs in a thread."""
    settings = {"rate_hz": RATE_HZ, "limits": LIMITS, "ttl_s": TTL_S, **options}
    with DriverHost(session, driver, RRBOT, "arm", **settings) as host:
        thread = threading.Thread(target=host.run)
        thread.start()
        try:
            until(lambda: host.state != "off")
            yield host
        finally:
            host.close()
            thread.join()


@contextmanager
def arm_of(sessions, driver: Written, **options: object) -> Iterator[Commander]:
    """A commander of a hosted ``driver``, whose steps are checked at the end."""
    with hosted(sessions[0], driver, **options), Commander(sessions[1], "arm") as arm:
        arm.wait_for_driver(DEADLINE_S)
        yield arm
    driver.assert_steps_within_limits()


def wait_until_under_way(motion: Motion) -> None:
    until(lambda: 0.0 < motion.progress < 1.0)


def test_a_motion_follows_its_trajectory_and_reaches_the_last_point(sessions):
    driver = Written()
    # The motion has at most 7.5 rad/s^2. After late ticks, of which a busy machine has several in a row,
    # shorter steps may change the velocity by what the acceleration limit permits in that step only.
    ample = Limits.of(RRBOT, velocity=2.0, acceleration=1000.0)
    with arm_of(sessions, driver, limits=ample) as arm:
        motion = arm.move({"elbow": [0.2, 0.1]}, [0.4, 0.8])
        assert motion.wait(DEADLINE_S).name == "reached"
        assert motion.progress == 1.0
        assert np.abs(driver.setpoints[-1] - [0.0, 0.1]).max() < 1e-9
    planned = Trajectory(("elbow",), [[0.0], [0.2], [0.1]], [0.0, 0.4, 0.8])
    driver.assert_follows(planned, [1])


def test_a_motion_without_times_takes_a_second_or_as_long_as_the_limits_need(sessions):
    driver = Written()
    slow = Limits.of(RRBOT, velocity=0.5, acceleration=50.0)
    with arm_of(sessions, driver, limits=slow) as arm:
        assert arm.move({"elbow": 0.05}).wait(DEADLINE_S).name == "reached"
        quick = len(driver.setpoints)
        assert arm.move({"elbow": [0.75]}).wait(DEADLINE_S).name == "reached"
        assert driver.setpoints[-1][1] == pytest.approx(0.75)
        assert len(driver.setpoints) - quick > 0.7 / 0.5 * RATE_HZ, "at 0.5 rad/s"
        with pytest.raises(
            InvalidInput, match=r"one position for each joint, and 'elbow' has 2; give the time"
        ):
            arm.move({"elbow": [0.1, 0.2]})


def test_times_that_are_no_list_are_refused_with_an_example(sessions):
    with Commander(sessions[0], "arm") as arm:
        with pytest.raises(InvalidInput, match=r"such as times_s=\[2\.0\] for one point; got 2\.0"):
            arm.move({"elbow": 1.0}, times_s=2.0)
        with pytest.raises(InvalidInput, match="points have a number for each of the 2 times; 'elbow' has"):
            arm.move({"elbow": [1.0]}, [1.0, 2.0])


def test_points_that_are_not_by_joint_or_no_lists_are_refused_with_an_example(sessions):
    with Commander(sessions[0], "arm") as arm:
        for times in (None, [2.0]):
            with pytest.raises(InvalidInput, match=r"points are given by joint, such as .*, not as list"):
                arm.move([0.1, 0.2], times)
        with pytest.raises(InvalidInput, match="velocities are given by joint"):
            arm.move({"elbow": [0.1]}, [1.0], velocities=[0.0])
        with pytest.raises(InvalidInput, match=r"1 times; 'elbow' is one number, not a list: \[1\.0\]"):
            arm.move({"elbow": 1.0}, times_s=[2.0])


def test_a_motion_that_exceeds_limits_is_refused_with_every_finding_or_stretched(sessions):
    driver = Written()
    narrow = Limits(RRBOT.joint_names, [-1.0, -1.0], [1.0, 1.0], [2.0, 2.0], [20.0, 20.0])
    with arm_of(sessions, driver, limits=narrow) as arm:
        with pytest.raises(MotionRefused, match="outside -1 to 1") as refused:
            arm.move({"shoulder": [0.9], "elbow": [1.5]}, [0.1])
        texts = refused.value.findings
        assert [("shoulder" in text, "elbow" in text) for text in texts] == [
            *((False, True), (True, False), (False, True), (True, False), (False, True))
        ], "a position of the elbow, and velocities and accelerations of both"
        assert not driver.setpoints
        # From rest to rest by d in T, the greatest velocity is 1.5 d / T: that is 2 rad/s for T = 0.675 s.
        motion = arm.move({"shoulder": [0.9]}, [0.1], stretch=True)
        assert motion.wait(DEADLINE_S).name == "reached"
        written = driver.path[:, 0]
        assert len(np.flatnonzero(np.diff(written))) >= 0.67 * RATE_HZ


def test_each_end_of_a_motion_is_an_outcome_and_no_step_is_too_long(sessions):
    driver = Written()
    with arm_of(sessions, driver) as arm:
        first = arm.move({"shoulder": [2.0], "elbow": [1.0]}, [5.0])
        wait_until_under_way(first)
        second = arm.move({"elbow": [-1.0]}, [5.0])
        assert first.wait(DEADLINE_S).name == "replaced"
        wait_until_under_way(second)
        arm.send({"shoulder": 0.0})
        assert second.outcome is None, "a command for another joint"
        arm.send({"elbow": 0.0})
        outcome = second.wait(DEADLINE_S)
        assert outcome.name == "replaced"
        assert "by a command of" in outcome.reason
        third = arm.move({"elbow": [1.0]}, [5.0])
        wait_until_under_way(third)
        third.cancel()
        assert third.wait(DEADLINE_S).name == "cancelled"
        count = len(driver.setpoints)
        until(lambda: len(driver.setpoints) > count + 60)
        assert (driver.path[-20:] == driver.path[-1]).all(), "at rest"
        fourth = arm.move({"elbow": [1.0]}, [5.0])
        wait_until_under_way(fourth)
        stop(sessions[0], "arm", "door open", timeout_s=DEADLINE_S)
        outcome = fourth.wait(DEADLINE_S)
        assert outcome.name == "stopped"
        assert "door open" in outcome.reason
        with pytest.raises(MotionRefused, match="door open"):
            arm.move({"elbow": [1.0]}, [5.0])
        arm.release(DEADLINE_S)
        fifth = arm.move({"elbow": [1.0]}, [5.0])
        wait_until_under_way(fifth)
        with pytest.raises(MotionTimeout, match=r"has not ended within 0\.01 s"):
            fifth.wait(0.01)


class Gated(Written):
    """A mirror whose writes wait for ``gate``."""

    def __init__(self) -> None:
        super().__init__()
        self.gate, self.is_waiting = threading.Event(), threading.Event()
        self.gate.set()

    def write(self, setpoint) -> None:
        if not self.gate.is_set():
            self.is_waiting.set()
            assert self.gate.wait(DEADLINE_S)
        super().write(setpoint)


def test_a_cancellation_that_a_blocked_driver_delays_is_repeated_until_it_is_carried_out(sessions):
    driver = Gated()
    with hosted(sessions[0], driver) as host, Commander(sessions[1], "arm") as arm:
        motion = arm.move({"elbow": [1.0]}, [20.0])
        wait_until_under_way(motion)
        driver.gate.clear()
        assert driver.is_waiting.wait(DEADLINE_S)
        cancelling = threading.Thread(target=motion.cancel)
        cancelling.start()
        until(lambda: host.report().refused.get("no tick"))
        assert cancelling.is_alive()
        driver.gate.set()
        cancelling.join()
        assert motion.wait(DEADLINE_S).name == "cancelled"


def test_a_request_whose_commander_has_gone_moves_nothing(sessions):
    driver = Written()
    request = JointTrajectory(time.time_ns(), 3, 7, ("elbow",), to_block([0.2]), to_block([0.1]))
    with hosted(sessions[0], driver, ttl_s=0.3), announced(sessions[1]):
        until(
            lambda: [one.findings for one in replies_to(sessions[1], "zstate/arm/@motion", request)] == [()]
        )
        ended = wait_for_state(sessions[1], "arm", lambda state: len(state.outcomes) > 0, DEADLINE_S)
    assert ended is not None
    assert ended.outcomes[0].name == "aborted"
    assert driver.setpoints
    assert not np.any(driver.setpoints)


@contextmanager
def announced(session: Session, number: int = 7) -> Iterator[None]:
    """The token of a commander whose session is ``number``."""
    writer = WireWriter(session, get_wire("native"), "arm", local_writer(number))
    with writer:
        writer.open_stream("joint_commands")
        yield


HOST = """
    from zstate import connect, load_model
    from zstate.driving import DriverHost, SimulatedDriver
    model = load_model("rrbot")
    with connect() as session, DriverHost(session, SimulatedDriver(model), model, "arm", ttl_s=0.5) as host:
        print("open", flush=True)
        host.run()
"""


def test_a_motion_of_a_killed_host_ends_for_its_commander(sessions, spawn):
    host = spawn(HOST)
    assert host.line() == "open"
    with Commander(sessions[1], "arm") as arm:
        arm.wait_for_driver(DEADLINE_S)
        motion = arm.move({"elbow": [1.0]}, [60.0])
        host.kill()
        assert motion.wait(DEADLINE_S) == ("aborted", "the driver is silent for more than 5 s")


def test_a_joint_that_does_not_follow_ends_the_motion(sessions):
    driver = Written()
    with arm_of(sessions, driver, following_error=10.0) as arm:
        driver.stuck = True
        outcome = arm.move({"elbow": [1.0]}, [2.0], path_tolerance=0.05).wait(DEADLINE_S)
        assert outcome.name == "aborted"
        assert "'elbow' is 0.05" in outcome.reason
        assert outcome.reason.endswith("rad from its path, more than path_tolerance=0.05")
        outcome = arm.move({"elbow": [0.1]}, [0.2], goal_tolerance=0.01, goal_time_s=0.1).wait(DEADLINE_S)
        assert outcome.name == "aborted"
        assert "from its goal 0.1 s after the end, more than goal_tolerance=0.01" in outcome.reason


MOVER = """
    from zstate import connect
    from zstate.driving import Commander
    with connect() as session, Commander(session, "arm", program="teleop") as arm:
        arm.wait_for_driver(15.0)
        motion = arm.move({"elbow": [3.0]}, [60.0])
        print("moving", flush=True)
        motion.wait(60.0)
"""


@pytest.mark.parametrize("end", [Child.kill, Child.freeze])
def test_a_motion_of_a_dead_or_frozen_commander_is_braked_and_held(
    sessions, spawn, end: Callable[[Child], None]
):
    driver = Written()
    with hosted(sessions[0], driver, ttl_s=0.5) as host:
        mover = spawn(MOVER)
        assert mover.line() == "moving"
        until(lambda: len(driver.setpoints) > RATE_HZ)  # twice as long as without renewals
        end(mover)
        dead_at = time.monotonic_ns()
        until(lambda: host.state == "holding")
        until(lambda: len(driver.path) > 5 and (driver.path[-5:] == driver.path[-1]).all())
        # At less than 0.1 rad/s the joint stops in the tick in which the last renewal expires.
        moved = np.flatnonzero(np.diff(driver.path[:, 1]))[-1]
        worst_tick_ns = host.report().lateness_us.max * 1e3 + 1e9 / RATE_HZ
        assert driver.written_at[moved] - dead_at <= 0.5e9 + worst_tick_ns
        mover.kill()
        with Commander(sessions[1], "arm") as late:
            (outcome,) = late.wait_for_driver(DEADLINE_S).outcomes
            assert outcome.name == "aborted"
            assert "nothing from teleop@" in outcome.reason
    driver.assert_steps_within_limits()


class Slow(Written):
    """A mirror that takes at least four periods of the loop for a setpoint."""

    def write(self, setpoint) -> None:
        super().write(setpoint)
        take(4.0 / RATE_HZ)


def test_a_motion_starts_at_its_stamp_also_if_ticks_are_missed_and_not_in_the_past(sessions):
    driver = Slow()
    with arm_of(sessions, driver) as arm:
        with pytest.raises(MotionRefused, match="the first point is due"):
            arm.move({"elbow": [0.2]}, [0.3], start=time.time_ns() - 10**9)
        with pytest.raises(MotionRefused, match="give the first point a time above zero"):
            arm.move({"elbow": [0.2]}, [0.0])
        start = time.monotonic_ns() + 10**9
        motion = arm.move({"elbow": [0.1]}, [0.2], start=time.time_ns() + 10**9)
        assert motion.wait(DEADLINE_S).name == "reached"
    resting = int(np.flatnonzero(driver.path[:, 1])[0]) - 1
    # A setpoint is that of the end of its step: the first that moves is at most one period early.
    assert driver.written_at[resting] > start - 1e9 / RATE_HZ - 1e6
    # One second has 200 periods, and at most 40 setpoints of which each takes five of them.
    assert resting < 0.5 * RATE_HZ


def test_a_request_of_another_session_is_refused_while_a_motion_is_valid(sessions):
    driver = Written()
    with arm_of(sessions, driver) as arm:
        motion = arm.move({"elbow": [1.0]}, [5.0])
        # It is not even planned, which would find that there is no such joint.
        request = JointTrajectory(time.time_ns(), 0, 7, ("elbw",), to_block([1.0]), to_block([0.0]))
        replies: list[MotionReply] = []
        with announced(sessions[1]):
            until(lambda: replies.extend(replies_to(sessions[1], "zstate/arm/@motion", request)) or replies)
        assert ", while commands of " in replies[0].findings[0]
        cancel = MotionCancel(0, 0, 7, 0)
        assert replies_to(sessions[1], "zstate/arm/@motion", cancel)[0].findings == ()
        wait_until_under_way(motion)


def test_a_request_of_a_program_that_is_not_announced_as_a_commander_is_not_planned(sessions):
    request = JointTrajectory(time.time_ns(), 0, 7, ("elbw",), to_block([1.0]), to_block([0.0]))
    with hosted(sessions[0], Written()) as host:

        def is_refused() -> bool:
            assert replies_to(sessions[1], "zstate/arm/@motion", request) == []
            return host.report().refused.get("no claim", 0) > 0

        until(is_refused)
        assert set(host.report().refused) == {"no claim"}


def has_joints(replies: list[MotionReply]) -> bool:
    """Whether a driver has answered whose joints are known: it answers before it has two readings."""
    return any("its joints are not known" not in " ".join(reply.findings) for reply in replies)


def test_a_request_for_more_than_the_joints_of_the_driver_is_refused(sessions):
    with hosted(sessions[0], Written()), announced(sessions[1]):
        for count, text in (
            (3, "a motion of 3 joints, where the driver has 2: shoulder, elbow"),
            (70_000, "bytes, where motions of this driver take 624000"),  # 64 kB more than the longest
        ):
            names = tuple(f"joint_{number}" for number in range(count))
            request = JointTrajectory(time.time_ns(), 0, 7, names, to_block([1.0]), to_block([0.0] * count))
            found: list[MotionReply] = []

            def is_answered(request=request, found=found) -> bool:
                found[:] = replies_to(sessions[1], "zstate/arm/@motion", request)
                return has_joints(found)

            until(is_answered)
            assert text in found[0].findings[0]


def test_a_motion_has_10000_points_with_velocities_and_accelerations_of_all_joints(sessions):
    times, zeros = np.arange(1, 10_001) * 1e-3, np.zeros((10_000, 2))
    blocks = to_block(times), *[to_block(zeros)] * 3
    request = JointTrajectory(time.time_ns(), 0, 7, RRBOT.joint_names, *blocks)
    assert sum(map(len, blocks)) == 624_000 - 64_000
    with hosted(sessions[0], Written()), announced(sessions[1]):
        found: list[MotionReply] = []

        def is_answered() -> bool:
            found[:] = replies_to(sessions[1], "zstate/arm/@motion", request)
            return has_joints(found)

        until(is_answered)
        assert found[0].findings == ()


def test_a_repeated_request_is_the_same_motion_and_an_older_one_is_refused(sessions):
    request = JointTrajectory(time.time_ns(), 3, 7, ("elbow",), to_block([0.2]), to_block([0.1]))
    renewal = encode(JointCommand(time.time_ns(), 4, 7, order_digest(()), names=(), motion=3))
    key = "zstate/arm/joint_commands"
    driver = Written()
    with (
        hosted(sessions[0], driver),
        announced(sessions[1]),
        KeyPublisher(sessions[1], key, encoding_of(JointCommand)) as commands,
    ):
        wait_for_reader(sessions[1], key)

        def findings() -> list[tuple[str, ...]]:
            return [reply.findings for reply in replies_to(sessions[1], "zstate/arm/@motion", request)]

        until(lambda: findings() == [()])
        commands.put(renewal)
        reached = wait_for_state(sessions[1], "arm", lambda state: len(state.outcomes) > 0, DEADLINE_S)
        assert reached is not None
        assert [outcome.name for outcome in reached.outcomes] == ["reached"]
        count = len(driver.setpoints)
        assert findings() == [()]
        until(lambda: len(driver.setpoints) > count + 10)
        still = wait_for_state(sessions[1], "arm", lambda state: state.ticks > reached.ticks, DEADLINE_S)
        assert still is not None
        assert (still.motion, still.outcomes) == (None, reached.outcomes)
        older = JointTrajectory(time.time_ns(), 2, 7, ("elbow",), to_block([0.2]), to_block([0.0]))
        (reply,) = replies_to(sessions[1], "zstate/arm/@motion", older)
        assert reply.findings == ("the motion 2 comes after a newer one",)


def test_a_motion_request_that_has_waited_for_a_second_is_refused_while_its_commander_is_alive(sessions):
    """As on a slow link: the caller has given up, and its later commands are valid."""
    driver = Written()
    with hosted(sessions[0], driver), announced(sessions[1]):
        state = wait_for_state(sessions[1], "arm", lambda state: state.state == "ready", DEADLINE_S)
        assert state is not None

        def answer(number: int, instant: int) -> tuple[str, ...]:
            request = JointTrajectory(
                *(time.time_ns(), number, 7, ("elbow",), to_block([0.2]), to_block([0.1])),
                echo=(state.session, instant),
            )
            replies: list[MotionReply] = []
            until(lambda: replies.extend(replies_to(sessions[1], "zstate/arm/@motion", request)) or replies)
            return replies[0].findings

        assert answer(3, state.instant) == ()
        (finding,) = answer(4, state.instant - 1_000_000_000)
        assert "it has waited for 1" in finding
        assert "is valid for 1.0 s" in finding
        (finding,) = answer(5, 1 << 62)
        assert "ahead of the driver's own clock" in finding


def replies_to(session: Session, selector: str, message: JointTrajectory | MotionCancel) -> list[MotionReply]:
    payload, encoding = encode(message), encoding_of(type(message))
    found = query(session.zenoh, selector, DEADLINE_S, payload=payload, encoding=encoding)
    answers = [reply.ok for reply in found if reply.ok is not None]
    kind = encoding_of(MotionReply)
    return [decode(one.payload.to_bytes(), kind, MotionReply) for one in answers if str(one.encoding) == kind]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (({}, [1.0]), "at least one"),
        (({"elbow": [0.1, 0.2]}, [1.0]), r"'elbow' has shape \(2,\)"),
        (({"elbw": [0.1]}, [1.0]), "no joint 'elbw'"),
    ],
)
def test_a_motion_is_checked_before_it_is_sent(sessions, arguments, text: str):
    with hosted(sessions[0], Written()), Commander(sessions[1], "arm") as arm:
        arm.wait_for_driver(DEADLINE_S)
        with pytest.raises(InvalidInput, match=text):
            arm.move(*arguments)


def test_only_commanders_may_request_motions(tmp_path):
    fleet = AclRoles(("arm",), viewers=("desk",), commanders=("teleop",))
    with router_with_users(tmp_path, fleet, fleet.identities) as endpoint, ExitStack() as opened:

        def session_of(user: str) -> Session:
            return opened.enter_context(join(endpoint, user))

        driver = Written()
        opened.enter_context(hosted(session_of("arm"), driver))
        arm = opened.enter_context(Commander(session_of("teleop"), "arm"))
        assert arm.move({"elbow": [0.1]}, [0.2]).wait(DEADLINE_S).name == "reached"
        request = JointTrajectory(time.time_ns(), 0, 7, ("elbow",), to_block([1.0]), to_block([0.0]))
        desk = session_of("desk")
        for selector in ("zstate/arm/@motion", "zstate/*/@motion", "zstate/**"):
            assert replies_to(desk, selector, request) == []


@pytest.mark.long
def test_random_motions_commands_stops_and_takeovers_make_no_step_too_long(sessions):
    driver = Written()
    random = np.random.default_rng(7)
    with hosted(sessions[0], driver, ttl_s=0.3) as host, ExitStack() as opened:
        arm = opened.enter_context(Commander(sessions[1], "arm"))
        arm.wait_for_driver(DEADLINE_S)
        motions: list[Motion] = []
        for action in random.integers(0, 8, 60).tolist():
            target = random.uniform(-2.0, 2.0, 2)
            if action < 4:
                names = [("elbow",), ("shoulder",), ("shoulder", "elbow")][int(random.integers(3))]
                points = {name: [value, 0.0] for name, value in zip(names, target, strict=False)}
                times = [random.uniform(0.2, 2.0), 3.0]
                with suppress(MotionRefused):  # from a high speed
                    motions.append(arm.move(points, times, stretch=True))
            elif action == 4:
                arm.send({"elbow": target[0]})
            elif action == 5 and motions:
                motions[-1].cancel()
            elif action == 6:
                stop(sessions[0], "arm", timeout_s=DEADLINE_S)
                arm.release(DEADLINE_S)
            elif action == 7:
                arm.close()
                arm = opened.enter_context(Commander(sessions[1], "arm"))
                until(lambda: host.state != "active")
                arm.wait_for_driver(DEADLINE_S)
            count = len(driver.setpoints) + int(random.integers(1, 30))
            until(lambda count=count: len(driver.setpoints) >= count or host.state != "active")
    assert motions
    assert np.ptp(driver.path, axis=0).min() > 0.0
    driver.assert_steps_within_limits()


# Trajectories of ROS nodes

CONTROLLED = {"wires": ("native", "ros2:domain=0"), "ros2_controller": "forward_position_controller"}


@contextmanager
def planner_of(sessions) -> Iterator[RosPublisher]:
    """A ROS node that publishes trajectories, whose token has arrived at the host."""
    with announced_publisher(sessions[1], "planner", TRAJECTORY) as planner:
        until(lambda: planner.token in tokens(sessions[0]))
        yield planner


def outcome_of(arm: Commander) -> tuple[str, str]:
    """How the first motion has ended."""
    until(lambda: arm.wait_for_driver(DEADLINE_S).outcomes)
    outcome = arm.wait_for_driver(DEADLINE_S).outcomes[0]
    return outcome.name, outcome.reason


def test_a_trajectory_of_a_ros_node_is_made_while_the_node_is_announced(sessions):
    driver = Written()
    with arm_of(sessions, driver, ttl_s=0.5, **CONTROLLED) as arm, planner_of(sessions) as planner:
        # As from MoveIt, the first point is where the joints are, at the start.
        path = (0.0, ([0.0, 0.0],)), (0.5, ([0.1, 0.2],)), (1.5, ([0.3, 0.1],))
        planner.put(rosbags_trajectory(0, RRBOT.joint_names, *path))
        assert outcome_of(arm) == ("reached", "")
        assert arm.wait_for_driver(DEADLINE_S).commander == "/planner"
    planned = Trajectory(RRBOT.joint_names, [[0, 0], [0.1, 0.2], [0.3, 0.1]], [0.0, 0.5, 1.5])
    driver.assert_follows(planned, [0, 1])


def test_a_trajectory_ends_with_its_ros_node_or_by_one_without_points(sessions):
    path = (20.0, ([1.0],))
    for is_closed in (True, False):
        driver = Written()
        with arm_of(sessions, driver, ttl_s=0.5, **CONTROLLED) as arm:
            with planner_of(sessions) as planner:
                planner.put(rosbags_trajectory(0, ["elbow"], path))
                until(lambda driver=driver: len(driver.setpoints) > 5)
                if not is_closed:
                    planner.put(rosbags_trajectory(0, []))
                    assert outcome_of(arm) == ("cancelled", "by /planner")
            if is_closed:
                name, reason = outcome_of(arm)
                assert name == "aborted"
                assert reason.startswith("nothing from /planner for ")


def test_after_a_stop_no_publisher_of_the_active_ros_node_moves_the_robot(sessions):
    driver = Written()
    with (
        hosted(sessions[0], driver, ttl_s=1.0, **CONTROLLED) as host,
        announced_publisher(sessions[1], "planner", COMMANDS) as commands,
        planner_of(sessions) as planner,
        Commander(sessions[1], "arm") as arm,
    ):

        def published(condition) -> bool:
            commands.numbers([0.0, 0.0])
            return bool(condition())

        until(lambda: published(lambda: arm.wait_for_driver(DEADLINE_S).commander == "/planner"))
        until(lambda: host.state == "holding")
        planner.put(rosbags_trajectory(0, RRBOT.joint_names, (60.0, ([1.0, 1.0],))))
        until(lambda: np.any(driver.path))
        stop(sessions[0], "arm", timeout_s=DEADLINE_S)
        arm.release(DEADLINE_S)
        written = len(driver.setpoints)
        until(lambda: published(lambda: host.report().refused.get("not released")))
        assert len(driver.setpoints) == written


def test_trajectories_of_ros_nodes_are_checked_as_all_motions_are(sessions):
    driver = Written()
    with (
        hosted(sessions[0], driver, **CONTROLLED) as host,
        Commander(sessions[1], "arm") as arm,
        planner_of(sessions) as planner,
    ):
        past = time.time_ns() - 10**10
        for payload in (
            rosbags_trajectory(0, ["elbow"], (0.01, ([1.0],))),
            rosbags_trajectory(0, ["elbw"], (1.0, ([0.1],))),
            rosbags_trajectory(past, ["elbow"], (1.0, ([0.1],)), (2.0, ([0.2],))),
            rosbags_trajectory(0, ["elbow"], (1.0, ([np.nan],))),
        ):
            refused = host.report().refused.get("motion", 0)
            planner.put(payload)
            until(lambda refused=refused: host.report().refused.get("motion", 0) == refused + 1)
        arm.send({"elbow": 0.0})
        until(lambda: driver.setpoints)
        planner.put(rosbags_trajectory(0, ["elbow"], (1.0, ([0.1],))))
        until(lambda: host.report().refused.get("second commander") == 1)
        assert not np.any(driver.setpoints)


def test_a_velocity_replaces_the_motion_of_its_joint(sessions):
    driver = Written()
    # A joint turns on while a tick is late: its steps are not those of the clock.
    with hosted(sessions[0], driver), Commander(sessions[1], "arm") as arm:
        arm.wait_for_driver(DEADLINE_S)
        motion = arm.move({"elbow": [1.0]}, [3.0])
        until(lambda: driver.path[-1, 1] > 0.05)
        arm.send(velocities={"elbow": -0.5})
        assert motion.wait(DEADLINE_S).name == "replaced"
        until(lambda: driver.path[-1, 1] < 0.0)


def test_a_driver_without_positions_refuses_motions(sessions):
    driver = Written()
    driver.modes = frozenset({"velocity"})
    with hosted(sessions[0], driver), Commander(sessions[1], "arm") as arm:
        arm.wait_for_driver(DEADLINE_S)
        with pytest.raises(InvalidInput, match="mode position is not one of them"):
            arm.move({"elbow": [1.0]}, [3.0])
        request = JointTrajectory(time.time_ns(), 0, 7, ("elbow",), to_block([1.0]), to_block([1.0]))
        answers: list[MotionReply] = []
        with announced(sessions[1]):
            until(lambda: answers.extend(replies_to(sessions[1], "zstate/arm/@motion", request)) or answers)
        assert answers[0].findings == ("a motion needs mode position; this driver has mode velocity",)
    assert not driver.setpoints
