"""ControlLoop, stepped with a manual clock: no setpoint is far from where the joints are."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from helpers.processes import SteppingClock
from helpers.robots import RRBOT

from zstate import JointReading
from zstate._util.refusals import Refusals
from zstate.clock import MONOTONIC, ManualClock
from zstate.driving import Limits, SimulatedDriver
from zstate.driving.commands import NO_COLUMNS, NO_POSITIONS, Command
from zstate.driving.control_loop import ControlLoop
from zstate.driving.driver import Setpoint, StopMode
from zstate.driving.errors import DriverFault
from zstate.driving.messages import JointTrajectory, MotionCancel, Release
from zstate.driving.motion_service import plan
from zstate.driving.setpoint_limiter import JointRate
from zstate.driving.stops import StopRegister
from zstate.driving.stops_file import ActiveStop
from zstate.driving.supervised_driver import FollowingCheck, SupervisedDriver
from zstate.errors import InvalidInput, MessageError
from zstate.net.presence import local_writer
from zstate.rate import Rate
from zstate.wire.messages import to_block

LIMITS = Limits(RRBOT.joint_names, [-1.0, -2.0], [1.0, 2.0], [2.0, 0.5], [50.0, np.inf])
PERIOD_NS = 2_000_000
TTL_NS = 20_000_000
MS_NS = 1_000_000
EXACT = 1e-9  # rounding, in units of the bound
AT_ZERO = np.array([0], dtype=np.intp), np.zeros(1)


class Joints(SimulatedDriver):
    """A mirror that keeps the longest step, in units of what the velocity limits allow in a tick."""

    def __init__(self) -> None:
        super().__init__(RRBOT, "mirror")
        self.allowed_s = 0.0
        """For how long joints may move at the next ``write``."""
        self.longest = 0.0
        self.writes = 0
        self.failing: set[str] = set()
        """The methods of which the next call fails."""

    @property
    def positions(self) -> np.ndarray:
        """Where the joints are, or are to be: the simulation moves them at the next ``read``."""
        return self._joints.positions if self._target is None else self._target.positions

    def read(self, stamp: int) -> JointReading:
        self._fail("read")
        return super().read(stamp)

    def write(self, setpoint: Setpoint) -> None:
        step = np.abs(setpoint.positions - self.positions) / LIMITS.velocity
        self.longest = max(self.longest, step.max() / self.allowed_s if step.any() else 0.0)
        self.writes += 1
        self._fail("write")
        super().write(setpoint)

    def stop(self, how: StopMode) -> None:
        self._fail("stop")
        super().stop(how)

    def sag(self, way: np.ndarray) -> None:
        self._joints.positions += way

    def _fail(self, method: str) -> None:
        if method in self.failing:
            self.failing.remove(method)
            raise OSError(method)


class Bench:
    """A control loop with everything that happens to it: commanders, motions, stops, faults and restarts."""

    def __init__(self, generator: np.random.Generator) -> None:
        self.random = generator
        self.clock = ManualClock(10**9, MONOTONIC)
        self.ahead_ns = 0
        """Of the system clock ahead of ``clock``."""
        self.driver = Joints()
        self.stops = StopRegister(local_writer(99))
        self.refusals = Refusals()
        self.outcomes: Counter[str] = Counter()
        self.waiting: list[Command] = []
        self.session, self.seq = 1, 0
        self.loop = self.opened()

    def opened(self) -> ControlLoop:
        """A loop of a host that has just opened, and obeys the stops that are latched."""

        def receive() -> list[Command]:
            waiting, self.waiting = self.waiting, []
            return waiting

        loop = ControlLoop(
            "arm",
            SupervisedDriver(self.driver, "arm"),
            self.stops,
            limits=LIMITS,
            following=FollowingCheck(LIMITS, 0.2, TTL_NS),
            ttl_ns=TTL_NS,
            on_silence="relax" if self.random.random() < 0.3 else "hold",
            faults_allowed=3,
            refusals=self.refusals,
            receive=receive,
            publish=lambda *_: None,
            publish_setpoint=lambda _: None,
            name_of=str,
            on_change=lambda: None,
            clock=self.clock,
        )
        loop.start()
        return loop

    def tick(self) -> None:
        """A tick after about a period, in which joints may move for the duration of it."""
        elapsed = round(PERIOD_NS * self.random.uniform(0.5, 1.5))
        self.clock.set(self.clock.now() + elapsed)
        self.driver.allowed_s = elapsed * 1e-9
        before, is_stopped = self.driver.writes, bool(self.stops.current.stops)
        with suppress(DriverFault):
            self.loop.tick(self.clock.now() + self.ahead_ns, lambda _since, _now: elapsed * 1e-9)
            self.renew()
        assert not (is_stopped and self.driver.writes > before), "a setpoint after a stop"
        if self.loop.state.name == "fault":
            self.restart()

    def renew(self) -> None:
        underway = self.loop.motions.underway[0]
        if underway is not None and underway[0] == self.session:
            self.seq += 1
            head = (self.session, self.seq, NO_COLUMNS, NO_POSITIONS)
            self.waiting.append(Command(*head, self.clock.now(), self.clock.now() + TTL_NS, underway[1]))

    def command(self, session: int | None = None) -> None:
        self.seq += 1
        columns = self.random.permutation(2)[: self.random.integers(1, 3)]
        positions = self.random.uniform(1.2 * LIMITS.lower, 1.2 * LIMITS.upper)[columns]
        now = self.clock.now()
        deadline = now + round(TTL_NS * self.random.uniform(0.1, 1.0))
        self.waiting.append(Command(session or self.session, self.seq, columns, positions, now, deadline))

    def take_over(self) -> None:
        """Another commander, often before the commands of the first have expired."""
        self.session += 1
        self.command()

    def second_commander(self) -> None:
        self.command(self.session + 1000)

    def motion(self) -> None:
        """A motion in place of the last one, near or far; its start may be later."""
        self.seq += 1
        count = int(self.random.integers(1, 5))
        times = np.cumsum(self.random.uniform(0.001, 0.1, count))
        way = self.random.choice([0.01, 1.0]) * self.random.uniform(-1.0, 1.0, (count, 2))
        points = np.clip(self.driver.positions + way, LIMITS.lower, LIMITS.upper)
        start = self.clock.now() + round(1e7) if self.random.random() < 0.2 else None
        names = RRBOT.joint_names
        blocks = to_block(times), to_block(points)
        request = JointTrajectory(
            self.clock.now(), self.seq, self.session, names, *blocks, start=start, stretch=True
        )
        with suppress(MessageError, InvalidInput):
            planned = plan(request, LIMITS, self.loop.present(), self.clock.now())
            if not planned.findings:
                self.loop.motions.start(planned, self.clock.now())

    def cancel(self) -> None:
        underway = self.loop.motions.underway[0]
        if underway is not None:
            self.loop.motions.cancel(MotionCancel(0, 0, underway[0], underway[1]))

    def stop(self) -> None:
        self.seq += 1
        how = "relax" if self.random.random() < 0.5 else "hold"
        self.stops.add(ActiveStop(int(self.random.integers(200, 210)), self.seq, how, "", "desk"))

    def release(self) -> None:
        self.seq += 1
        latched = tuple((one.session, one.seq) for one in self.stops.current.stops)
        self.stops.release(Release(0, self.seq, self.session, latched))

    def pause(self) -> None:
        """A time in which commands expire; motions are renewed."""
        for _ in range(25):
            self.tick()

    def fail(self) -> None:
        self.driver.failing.add(str(self.random.choice(["read", "write", "stop"])))

    def restart(self) -> None:
        """The loop of the same host runs again, or that of a new one; joints without power sag."""
        self.keep_outcomes()
        self.loop.finish()
        if self.random.random() < 0.5:
            self.loop.start()
        else:
            with suppress(OSError):
                self.driver.close()
            self.driver.sag(self.random.normal(0.0, 0.05, 2))
            self.loop = self.opened()

    def keep_outcomes(self) -> None:
        self.outcomes.update(one.name for one in self.loop.motions.outcomes)


@pytest.mark.parametrize("count", [1_000, pytest.param(10_000, marks=pytest.mark.soak)])
@pytest.mark.long
def test_take_overs_replacements_stops_faults_and_restarts_never_step_above_the_limits(count: int):
    bench = Bench(np.random.default_rng(19))
    events: list[Callable[[], None]] = [
        *[bench.command] * 6,
        *[bench.motion] * 6,
        *[bench.release] * 3,
        *(bench.take_over, bench.second_commander, bench.cancel, bench.stop, bench.pause),
        *(bench.fail, bench.restart),
    ]
    happened: Counter[str] = Counter()
    states: Counter[str] = Counter()
    for number in bench.random.integers(0, len(events), count):
        events[number]()
        happened[events[number].__name__] += 1
        for _ in range(bench.random.integers(1, 6)):
            bench.tick()
            states[bench.loop.state.name] += 1
    bench.keep_outcomes()
    assert 1.0 - EXACT < bench.driver.longest <= 1.0 + EXACT
    # It is no empty claim: joints have moved in each state, and each kind of end was seen.
    assert min(happened[name] for name in ("take_over", "motion", "stop", "restart")) > count / 25
    assert set(states) >= {"ready", "active", "holding", "stopped"}
    assert states["active"] > count
    assert set(bench.outcomes) == {"reached", "aborted", "replaced", "cancelled", "stopped"}
    assert set(bench.refusals.counts) >= {"second commander", "stopped", "not released", "outside limits"}


def test_a_driver_that_repeats_its_last_reading_is_stopped():
    bench = Bench(np.random.default_rng(0))
    first = bench.driver.read(bench.clock.now())
    readings = [replace(first, stamp=number) for number in range(1, 5)]
    bench.driver.read = lambda _: readings[0] if len(readings) == 1 else readings.pop(0)
    while bench.driver.writes < 20 and bench.loop.state.name != "stopped":
        bench.waiting.append(
            Command(1, bench.clock.now(), *AT_ZERO, bench.clock.now(), bench.clock.now() + TTL_NS)
        )
        bench.tick()
    assert "there is no new reading of the joints" in bench.loop.state.reason


class Scripted(Joints):
    """Joints whose next readings after ``enable`` are those of ``glitches``: offsets from where they are.

    ``setpoints`` are all that were written.
    """

    def __init__(self, glitches: list[list[float] | None] | None = None) -> None:
        super().__init__()
        self.glitches = glitches or []
        self.setpoints: list[Setpoint] = []
        self.stops: list[str] = []

    @property
    def is_enabled(self) -> bool:
        return self._is_enabled

    def read(self, stamp: int) -> JointReading | None:
        reading = super().read(stamp)
        if not (self.is_enabled and self.glitches):
            return reading
        glitch = self.glitches.pop(0)
        return None if glitch is None else replace(reading, positions=reading.positions + glitch)

    def write(self, setpoint: Setpoint) -> None:
        self.setpoints.append(setpoint)
        super().write(setpoint)

    def stop(self, how: StopMode) -> None:
        self.stops.append(how)
        super().stop(how)


def scripted(driver: Scripted, start: tuple[float, float] = (0.0, 0.0)) -> Bench:
    """A bench with ``driver``, which has been read twice at ``start``."""
    bench = Bench(np.random.default_rng(0))
    driver.sag(np.array(start))
    bench.driver = driver
    bench.loop = bench.opened()
    for _ in range(2):
        bench.tick()
    return bench


def drive(bench: Bench, ticks: int, rates: dict[int, JointRate] | None = None) -> None:
    """Ticks with a command each: the shoulder to 0.2 rad, or ``rates``."""
    columns, positions = (AT_ZERO[0], np.array([0.2])) if rates is None else (NO_COLUMNS, NO_POSITIONS)
    for _ in range(ticks):
        bench.seq += 1
        now = bench.clock.now()
        bench.waiting.append(Command(1, bench.seq, columns, positions, now, now + TTL_NS, rates=rates or {}))
        bench.tick()


@pytest.mark.parametrize("glitch", [0.12, 2.9, 50.0, -1e300])
def test_one_wrong_reading_after_enabling_is_a_failure_of_the_driver_and_no_setpoint(glitch: float):
    driver = Scripted([[0.0, glitch]])
    bench = scripted(driver)
    drive(bench, 10)
    assert bench.loop.state.name == "active"
    assert bench.loop.faults == 1
    assert driver.setpoints[0].positions.tolist() == [0.0, 0.0]
    assert driver.longest <= 1.0 + EXACT


def test_joints_that_sag_when_their_brakes_open_start_from_two_readings_that_agree():
    driver = Scripted([[0.0, -0.15], [0.0, -0.151], [0.0, -0.151]])
    bench = scripted(driver)
    drive(bench, 4)
    assert driver.setpoints[0].positions.tolist() == [0.0, -0.151]
    assert bench.loop.faults == 1


def test_readings_that_never_agree_stop_the_driver_before_a_joint_has_moved():
    driver = Scripted([[0.0, 0.3 * number] for number in range(1, 20)])
    bench = scripted(driver)
    loop = bench.loop
    drive(bench, 10)
    assert not driver.setpoints
    assert "hold" in driver.stops
    assert "'elbow' at 0.9 rad" in loop.state.reason
    assert "two readings disagree" in loop.state.reason


def test_one_wrong_reading_in_mode_velocity_is_no_setpoint_of_mode_position():
    driver = Scripted()
    bench = scripted(driver)
    drive(bench, 30, {0: JointRate("velocity", 0.5)})
    assert driver.setpoints[-1].modes[0] == "velocity"
    driver.glitches.append([-0.7, 0.0])
    drive(bench, 20)
    assert driver.setpoints[-1].modes[0] == "position"
    assert bench.loop.faults == 1
    ways = np.diff([one.positions for one in driver.setpoints], axis=0) / LIMITS.velocity
    assert np.abs(ways).max() <= 1.5e-9 * PERIOD_NS


@pytest.mark.parametrize("glitches", [[None] * 30, [[0.0, 0.3], None, [0.0, -0.3], None] * 8])
def test_joints_with_power_and_without_two_readings_are_stopped_after_the_ttl(
    glitches: list[list[float] | None],
):
    driver = Scripted(glitches)
    bench = scripted(driver)
    drive(bench, 1)
    assert driver.is_enabled
    since = bench.clock.now()
    while bench.loop.state.name == "ready":
        drive(bench, 1)
    assert bench.clock.now() - since < TTL_NS + 4 * PERIOD_NS
    assert bench.loop.state.name == "stopped"
    assert "the joints have power, and there are no two readings" in bench.loop.state.reason
    assert not driver.setpoints


def test_a_host_that_is_late_after_enabling_does_not_stop_a_sound_driver():
    driver = Scripted()
    bench = scripted(driver)
    drive(bench, 1)
    assert driver.is_enabled
    bench.clock.set(bench.clock.now() + 2 * TTL_NS)
    drive(bench, 5)
    assert (bench.loop.state.name, bench.loop.faults) == ("active", 0)


def test_a_joint_a_little_outside_its_limits_moves_inwards():
    driver = Scripted()
    bench = scripted(driver, (1.3, 0.0))
    drive(bench, 20)
    assert driver.setpoints[0].positions.tolist() == [1.3, 0.0]
    assert driver.setpoints[-1].positions[0] < 1.3


def test_a_joint_that_is_read_far_outside_its_limits_is_not_enabled():
    driver = Scripted()
    bench = scripted(driver, (1.4, 0.0))
    drive(bench, 20)
    assert (driver.setpoints, driver.is_enabled) == ([], False)
    assert bench.refusals.counts == {"outside limits": 20}
    assert "'shoulder' is measured at 1.4 rad, 0.4 rad outside -1 to 1: too far" in str(bench.refusals.newest)
    with pytest.raises(MessageError, match="too far to be moved"):
        bench.loop.present()


def test_a_joint_that_is_read_far_outside_its_limits_once_it_has_power_is_stopped():
    driver = Scripted([[1.5, 0.0]] * 20)
    bench = scripted(driver)
    drive(bench, 6)
    assert (driver.setpoints, bench.loop.state.name) == ([], "stopped")
    assert "0.5 rad outside -1 to 1" in bench.loop.state.reason


def test_the_stamp_of_a_setpoint_is_the_instant_of_its_writing_by_the_system_clock():
    bench = Bench(np.random.default_rng(0))

    class Slow(Scripted):
        def read(self, stamp: int) -> JointReading | None:
            bench.clock.set(bench.clock.now() + MS_NS)
            return super().read(stamp)

    bench.driver = driver = Slow()
    bench.loop = bench.opened()
    bench.ahead_ns = 10**18 + 1
    drive(bench, 10)
    assert driver.setpoints[-1].stamp == bench.clock.now() + bench.ahead_ns


def test_commands_from_before_a_release_are_those_of_its_commander_with_lower_numbers():
    bench = scripted(Scripted())
    latched = ActiveStop(200, 0, "hold", "", "desk")
    bench.stops.add(latched)
    bench.tick()
    bench.stops.release(Release(0, 9, 1, (latched.id,)))
    bench.tick()
    accepted: list[tuple[int, int]] = []
    for session, seq in ((1, 8), (2, 0), (1, 10)):
        now = bench.clock.now()
        bench.waiting.append(Command(session, seq, *AT_ZERO, now, now))  # makes way for the next commander
        bench.tick()
        accepted += [(session, seq)] if bench.loop.targets.session == session else []
    assert accepted == [(2, 0), (1, 10)]
    assert bench.refusals.counts == {"old": 1}


def test_no_joint_is_faster_than_its_limit_after_a_late_tick():
    # Every fifth tick is late by 0.49 periods; the next one is on time.
    clock = SteppingClock(0, lateness=dict.fromkeys(range(0, 200, 5), round(0.49 * PERIOD_NS)))
    rate = Rate(1e9 / PERIOD_NS, clock, threading.Event(), 0.2, catch_up=False)
    driver = Scripted()
    bench = Bench(np.random.default_rng(0))
    bench.driver, bench.clock = driver, clock
    driver.allowed_s = 1.0
    bench.loop = bench.opened()
    target = AT_ZERO[0], np.array([0.9])
    for seq, _ in enumerate(rate):
        now = clock.now()
        bench.waiting.append(Command(1, seq, *target, now, now + TTL_NS))
        bench.loop.tick(now, rate.step_s)
    assert len(driver.setpoints) > 80
    stamps = np.array([one.stamp for one in driver.setpoints]) * 1e-9
    speeds = np.diff([one.positions[0] for one in driver.setpoints]) / np.diff(stamps)
    assert speeds.max() == pytest.approx(LIMITS.velocity[0])


@pytest.mark.parametrize("ttl_ns", [6 * MS_NS, 14 * MS_NS])
def test_a_command_moves_joints_until_its_own_ttl_ends(ttl_ns: int):
    bench = scripted(Scripted())
    drive(bench, 10)
    bench.seq += 1
    now = bench.clock.now()
    bench.waiting.append(Command(1, bench.seq, AT_ZERO[0], np.array([0.2]), now, now + ttl_ns))
    assert bench.loop.state.name == "active"
    for instant, is_active in ((now + ttl_ns - 1, True), (now + ttl_ns, False)):
        bench.clock.set(instant)
        bench.driver.allowed_s = 1.0
        bench.loop.tick(instant, lambda _since, _now: 0.002)
        assert (bench.loop.state.name == "active") == is_active


def test_the_outcomes_of_the_last_sixteen_motions_are_kept():
    bench = scripted(Scripted())
    drive(bench, 10)
    for seq in range(100, 118):  # each but the last is replaced by the next
        now = bench.clock.now()
        request = JointTrajectory(now, seq, 1, ("elbow",), to_block([5.0]), to_block([0.1]))
        bench.loop.motions.start(plan(request, LIMITS, bench.loop.present(), now), now)
    assert [one.seq for one in bench.loop.motions.outcomes] == list(range(101, 117))
