"""Random histories of a control loop on a manual clock, and what must hold at each setpoint.

    python tests/driving/loop_fuzz.py [SEEDS] [TICKS]

Runs SEEDS histories (200) of TICKS ticks each (5000), and ends with a non-zero exit at the first violation,
with its seed. No processes, no network and no sleep.
"""

from __future__ import annotations

import logging
import math
import sys
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from zstate import JointReading
from zstate._util.refusals import Refusals
from zstate.clock import MONOTONIC, ManualClock
from zstate.driving import Limits
from zstate.driving.commands import NO_COLUMNS, NO_POSITIONS, Command
from zstate.driving.control_loop import ControlLoop
from zstate.driving.driver import Setpoint, StopMode
from zstate.driving.errors import DriverFault
from zstate.driving.messages import JointTrajectory, Mode, MotionCancel, Release
from zstate.driving.motion_service import plan
from zstate.driving.setpoint_limiter import JointRate
from zstate.driving.stops import StopRegister
from zstate.driving.stops_file import ActiveStop
from zstate.driving.supervised_driver import FollowingCheck, SupervisedDriver
from zstate.driving.transit import CommandAdmission, CommandAges
from zstate.errors import InvalidInput, MessageError
from zstate.net.presence import local_writer
from zstate.rate import Rate
from zstate.wire.messages import to_block

Floats = NDArray[np.float64]

FOLLOWING = 0.2
ROUNDING = 1e-7
SESSIONS = (1, 2, 3, 4, 5)
HOST = 99
GRACE_NS = 500_000_000
NODE = 77
"""A ROS node, whose motions are valid while it is announced."""

_ALL_MODES: tuple[Mode, ...] = ("position", "velocity", "effort")
_MODES: tuple[frozenset[Mode], ...] = (
    frozenset({"position"}),
    frozenset({"velocity"}),
    frozenset({"effort"}),
    frozenset({"position", "velocity"}),
    frozenset(_ALL_MODES),
)
_WATCHDOG_S = 0.1
"""A device stops a joint in mode "velocity" or "effort" by itself so long after the last setpoint."""


class Violation(AssertionError):
    """A setpoint that must not be, or an exception that must not arise."""


class Plant:
    """A driver whose joints follow, turn or are pushed, and whose calls fail, lie and take time."""

    def __init__(self, fuzz: Fuzz) -> None:
        self._fuzz = fuzz
        self.joint_names = fuzz.limits.joint_names
        self.modes = fuzz.modes
        self.positions = fuzz.start_positions()
        self.velocities = np.zeros(len(self.joint_names))
        self.setpoint: Setpoint | None = None
        self._moved_at = fuzz.clock.now()
        self._written_at = 0
        self.next_reading = ""
        """What is wrong with the next reading."""
        self.failing: set[str] = set()
        self.unread = np.zeros(len(self.positions))
        """How far the joints were pushed since they were read."""

    def open(self) -> None: ...

    def close(self) -> None: ...

    def enable(self, on: bool) -> None:
        self._fail("enable")
        if on and self._fuzz.random.random() < 0.2:
            self.next_reading = "wrong"
        if on and self._fuzz.random.random() < 0.3:
            sag = self._fuzz.random.choice([0.02, 0.3])
            self.positions = self.positions - sag * self._fuzz.random.random(len(self.positions))

    def read(self, stamp: int) -> JointReading | None:
        self._fuzz.spend(0.2)
        self._fail("read")
        self._advance()
        kind, self.next_reading = self.next_reading, ""
        positions = self.positions.copy()
        row = int(self._fuzz.random.integers(len(positions)))
        if kind == "none":
            return None
        if kind == "wrong":
            # Above what two readings may differ, and never the same twice.
            way = self._fuzz.random.choice([1.0, 10.0, 1e5]) * self._fuzz.random.uniform(5.0, 9.0)
            positions[row] += way * self._fuzz.random.choice([-1.0, 1.0])
        elif kind == "nan":
            positions[row] = self._fuzz.random.choice([math.nan, math.inf, -math.inf, 1e300])
        elif kind == "shape":
            positions = positions[:-1]
        else:
            self.unread[:] = 0.0
        velocities = self.velocities.copy() if self._fuzz.has_velocities else None
        return JointReading(positions, velocities, None, stamp if self._fuzz.has_stamps else None)

    def write(self, setpoint: Setpoint) -> None:
        self._advance()
        self._fuzz.check(setpoint, self.positions)
        self._fail("write")
        self.setpoint, self._written_at = setpoint, self._fuzz.clock.now()
        self._fuzz.keep(setpoint)

    def stop(self, how: StopMode) -> None:
        self._advance()
        self._fuzz.on_stop()
        self.setpoint = None
        self.velocities[:] = 0.0
        self._fail("stop")

    def _advance(self) -> None:
        """Move the joints until now."""
        now = self._fuzz.clock.now()
        end = min(now, self._written_at + round(_WATCHDOG_S * 1e9))
        dt_s = max(0.0, (end - self._moved_at) * 1e-9)
        self._moved_at = now
        setpoint = self.setpoint
        if setpoint is None:
            return
        for row, mode in enumerate(setpoint.modes):
            if mode == "position":
                self.positions[row], self.velocities[row] = setpoint.positions[row], setpoint.velocities[row]
                continue
            if mode == "velocity":
                self.velocities[row] = setpoint.velocities[row] if now == end else 0.0
            else:
                assert setpoint.efforts is not None
                pushed = 0.9 * self.velocities[row] + 0.5 * setpoint.efforts[row] * dt_s
                self.velocities[row] = pushed if now == end else 0.0
            self.positions[row] += self.velocities[row] * dt_s

    def _fail(self, method: str) -> None:
        if method in self.failing:
            self.failing.remove(method)
            raise OSError(method)


class Fuzz:
    """A control loop with random limits, modes, commanders and faults. Each ``tick`` checks its setpoints.

    Commands go to the loop through the admission of a host. Each is sent and waits on its way, up to seconds.
    """

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.random = random = np.random.default_rng(seed)
        self.clock = ManualClock(10**9, MONOTONIC)
        self.modes = _MODES[seed % len(_MODES)]
        count = int(random.integers(1, 4))
        lower, upper = -random.uniform(0.3, 3.0, count), random.uniform(0.3, 3.0, count)
        is_continuous = random.random(count) < 0.2
        lower[is_continuous], upper[is_continuous] = -np.inf, np.inf
        velocity = random.choice([0.3, 2.0, 6.0], count)
        acceleration = np.where(
            random.random(count) < 0.2, np.inf, velocity / random.choice([0.02, 0.2, 1.0], count)
        )
        names = tuple(f"j{number}" for number in range(count))
        self.limits = Limits(names, lower, upper, velocity, acceleration, effort=np.full(count, 5.0))
        self.period_ns = int(random.choice([1_000_000, 5_000_000, 20_000_000]))
        rate = Rate(1e9 / self.period_ns, self.clock, threading.Event(), catch_up=False)
        self.step_s = self._device_step_s if random.random() < 0.25 else rate.step_s
        self.ttl_ns = int(random.choice([20, 250, 1000])) * 1_000_000
        self.on_silence: StopMode = "relax" if random.random() < 0.3 else "hold"
        self.has_velocities, self.has_stamps = random.random() < 0.5, random.random() < 0.7
        self.stops = StopRegister(local_writer(HOST))
        self.refusals = Refusals()
        self.waiting: list[Command] = []
        self.session, self.seq = SESSIONS[0], 0
        self.nodes: set[int] = set()
        self.valid_until = 0
        """No command that was sent is valid later, and no motion."""
        self.admission = CommandAdmission(CommandAges(HOST, self.ttl_ns))
        self.announced = set(SESSIONS)
        self.unannounced: dict[int, int] = {}
        self.shortest: dict[int, int] = {}
        """The shortest way of a command that was announced, by session [ns]."""
        for session in SESSIONS:
            self.admission.set_announced(session, True, self.clock.now())
        self.happened: Counter[str] = Counter()
        self.last: Setpoint | None = None
        """Of the present run of setpoints, which ends with a stop of the driver."""
        self.last_at = 0
        self.is_stopped = False
        """Whether a stop was latched before this tick."""
        self.violation = ""
        self.driver = Plant(self)
        self.loop = self.opened()

    def start_positions(self) -> Floats:
        lower, upper = np.maximum(self.limits.lower, -3.0), np.minimum(self.limits.upper, 3.0)
        widths = upper - lower
        outside = self.random.choice([0.0, 0.0, 0.1])
        return self.random.uniform(lower - outside * widths, upper + outside * widths)

    def opened(self) -> ControlLoop:
        def receive() -> list[Command]:
            waiting, self.waiting = self.waiting, []
            return waiting

        loop = ControlLoop(
            "arm",
            SupervisedDriver(self.driver, "arm"),
            self.stops,
            limits=self.limits,
            following=FollowingCheck(self.limits, FOLLOWING, max(self.ttl_ns, 3 * self.period_ns)),
            ttl_ns=self.ttl_ns,
            on_silence=self.on_silence,
            faults_allowed=3,
            refusals=self.refusals,
            receive=receive,
            publish=self._published,
            publish_setpoint=lambda _: None,
            name_of=str,
            on_change=lambda: None,
            clock=self.clock,
        )
        loop.start()
        return loop

    def _published(self, positions: Floats, *_: object) -> None:
        self._require(bool(np.isfinite(positions).all()), f"published {positions}")

    def spend(self, periods: float) -> None:
        """Time in a call of the driver."""
        elapsed = int(self.random.uniform(0.0, periods) * self.period_ns)
        self.clock.set(self.clock.now() + 1 + elapsed)

    def _device_step_s(self, since: int, now: int) -> float:
        """As at the pace of a device."""
        return min(max(now - since, 1), 2.0 * self.period_ns, 5e7) * 1e-9

    # What happens

    def tick(self) -> None:
        self.spend(1.6)
        self.is_stopped = bool(self.stops.current.stops)
        underway = self.loop.motions.underway[0]
        if underway is not None and underway[0] in self.nodes:  # the loop renews it in this tick
            self.valid_until = self.clock.now() + self.period_ns + self.ttl_ns
        try:
            self.loop.tick(self.clock.now(), self.step_s)
        except DriverFault:
            self.happened["fault"] += 1
            self.restart()
        if self.violation:
            raise Violation(self.violation)
        self.renew()
        self.happened[self.loop.state.name] += 1

    def arriving(self, command: Command) -> None:
        """``command``, which was given just now, is received after it has waited."""
        ttl, kind, session = command.deadline - command.arrived, self.random.random(), command.session
        way = self.random.uniform(0.0, 2e6 if kind < 0.85 else 2.0 * self.ttl_ns if kind < 0.95 else 1e10)
        now, sent = self.clock.now(), self.clock.now() - round(way)
        echo = (HOST, max(0, sent))
        way = now - echo[1]
        since = now
        if session not in self.announced:
            since = self.unannounced.setdefault(session, now)
        is_claimed = session in self.announced or now - since <= GRACE_NS
        least = min(way, self.shortest.get(session, way))
        if is_claimed:  # a driver measures no way of others
            self.shortest[session] = least
        due = echo[1] + ttl + (least if least < self.ttl_ns else 0)
        if is_claimed:  # the truth, whatever the admission says
            self.valid_until = max(self.valid_until, due)
        try:
            deadline = self.admission.deadline((sent, command.seq, session), ttl, now, echo)
        except MessageError as error:
            self.happened[f"not admitted: {error.reason}"] += 1
            return
        self._require(is_claimed, f"session {session} moves joints and is not announced")
        self._require(deadline <= due, f"a command of session {session} moves joints after its ttl")
        self.waiting.append(replace(command, deadline=deadline))

    def renew(self) -> None:
        underway = self.loop.motions.underway[0]
        if underway is not None and underway[0] == self.session:
            self.seq += 1
            now = self.clock.now()
            head = (self.session, self.seq, NO_COLUMNS, NO_POSITIONS)
            self.arriving(Command(*head, now, now + self.ttl_ns, underway[1]))

    def command(self, session: int | None = None) -> None:
        self.seq += 1
        random, count = self.random, len(self.limits.joint_names)
        modes = sorted(self.modes)
        columns: list[int] = []
        positions: list[float] = []
        rates: dict[int, JointRate] = {}
        for column in random.permutation(count)[: random.integers(1, count + 1)].tolist():
            mode = modes[int(random.integers(len(modes)))]
            if mode == "position":
                columns.append(column)
                lower = max(self.limits.lower[column], -3.0)
                upper = min(self.limits.upper[column], 3.0)
                odd = random.random() < 0.02
                positions.append(random.choice([1e308, -1e12]) if odd else 1.1 * random.uniform(lower, upper))
            elif mode == "velocity":
                rates[column] = JointRate(mode, random.uniform(-1.5, 1.5) * self.limits.velocity[column])
            else:
                rates[column] = JointRate(mode, random.uniform(-8.0, 8.0))
        now = self.clock.now()
        deadline = now + round(self.ttl_ns * random.uniform(0.1, 1.0))
        head = (session or self.session, self.seq, np.array(columns, dtype=np.intp), np.array(positions))
        self.arriving(Command(*head, now, deadline, rates=rates))

    def burst(self) -> None:
        """The same targets for some ticks, so that joints arrive, or are at their limits."""
        for _ in range(int(self.random.integers(5, 60))):
            if not self.waiting:
                self.command()
            self.tick()

    def take_over(self) -> None:
        self.session = int(self.random.choice(SESSIONS))
        if self.random.random() < 0.8:
            self.announce(self.session, alive=True)
        self.command()

    def second_commander(self) -> None:
        self.command(int(self.random.choice(SESSIONS)))

    def token(self) -> None:
        self.announce(int(self.random.choice(SESSIONS)), alive=bool(self.random.random() < 0.5))

    def announce(self, session: int, *, alive: bool) -> None:
        now = self.clock.now()
        if alive:
            self.announced.add(session)
            self.unannounced.pop(session, None)
        elif session in self.announced:
            self.announced.remove(session)
            self.unannounced[session] = now
        self.admission.set_announced(session, alive, now)
        self.loop.targets.set_announced(session, alive, now)

    def node(self) -> None:
        """The ROS node is announced, or has ended."""
        is_alive = NODE not in self.nodes
        (self.nodes.add if is_alive else self.nodes.discard)(NODE)
        self.loop.motions.set_announced(NODE, is_alive)

    def motion(self) -> None:
        if "position" not in self.modes:
            return
        self.seq += 1
        random, names = self.random, self.limits.joint_names
        count = int(random.integers(1, 5))
        times = np.cumsum(random.uniform(0.001, 0.5, count))
        way = random.choice([0.01, 1.0]) * random.uniform(-1.0, 1.0, (count, len(names)))
        points = np.clip(self.driver.positions + way, self.limits.lower, self.limits.upper)
        start = self.clock.now() + round(1e7) if random.random() < 0.2 else None
        session = NODE if NODE in self.nodes and random.random() < 0.3 else self.session
        blocks = to_block(times), to_block(points)
        request = JointTrajectory(
            self.clock.now(),
            self.seq,
            session,
            names,
            *blocks,
            start=start,
            stretch=bool(random.random() < 0.8),
        )
        now = self.clock.now()
        with suppress(MessageError, InvalidInput):
            planned = plan(request, self.limits, self.loop.present(), now)._replace(planned_at=now)
            if not planned.findings:
                self.loop.motions.start(planned, now)
                self.valid_until = max(self.valid_until, now + self.ttl_ns)

    def cancel(self) -> None:
        underway = self.loop.motions.underway[0]
        if underway is not None:
            self.loop.motions.cancel(MotionCancel(0, 0, underway[0], underway[1]))

    def stop(self) -> None:
        self.seq += 1
        how: StopMode = "relax" if self.random.random() < 0.5 else "hold"
        self.stops.add(ActiveStop(int(self.random.integers(200, 210)), self.seq, how, "", "desk"))

    def release(self) -> None:
        self.seq += 1
        latched = tuple((one.session, one.seq) for one in self.stops.current.stops)
        self.stops.release(Release(0, self.seq, self.session, latched))

    def silence(self) -> None:
        """A time in which commands expire."""
        for _ in range(int(self.random.integers(5, 80))):
            self.spend(1.0)
            self.tick()

    def pause(self) -> None:
        """The host is frozen."""
        self.clock.set(self.clock.now() + int(10 ** self.random.uniform(6, math.log10(30e9))))

    def fail(self) -> None:
        self.driver.failing.add(str(self.random.choice(["enable", "read", "write", "stop"])))

    def lie(self) -> None:
        self.driver.next_reading = str(self.random.choice(["none", "wrong", "wrong", "nan", "shape"]))

    def push(self) -> None:
        """A hand moves the joints."""
        way = self.random.normal(0.0, 0.1, len(self.driver.positions))
        self.driver.positions = self.driver.positions + way
        self.driver.unread += np.abs(way)

    def restart(self) -> None:
        """The loop of the same host runs again, or that of a new one."""
        self.loop.finish()
        if self.random.random() < 0.5:
            self.loop.start()
        else:
            self.loop = self.opened()
            for node in self.nodes:
                self.loop.motions.set_announced(node, True)

    def on_stop(self) -> None:
        self.last = None

    # What must hold

    def check(self, setpoint: Setpoint, actual: Floats) -> None:
        """Whether ``setpoint`` may be written to joints that are at ``actual``."""
        now = self.clock.now()
        self._require(not self.is_stopped, "a setpoint while a stop is latched")
        numbers = [setpoint.positions, setpoint.velocities, setpoint.efforts]
        finite = all(np.isfinite(one).all() for one in numbers if one is not None)
        self._require(finite, f"a setpoint that is not finite: {setpoint}")
        self._require(self.modes.issuperset(setpoint.modes), f"modes {setpoint.modes}")
        is_silent = self.valid_until <= now
        if self.last is None:
            self._require(not is_silent, "a first setpoint without a command")
        for row in range(len(actual)):
            self._check_joint(row, setpoint, float(actual[row]), now, is_silent=is_silent)

    def _check_joint(self, row: int, setpoint: Setpoint, actual: float, now: int, *, is_silent: bool) -> None:
        limits, last, mode = self.limits, self.last, setpoint.modes[row]
        most, change = float(limits.velocity[row]), float(limits.acceleration[row])
        position, velocity = float(setpoint.positions[row]), float(setpoint.velocities[row])
        if mode == "effort":
            assert setpoint.efforts is not None
            self._require(abs(setpoint.efforts[row]) <= limits.effort[row], "an effort above its limit")
            return
        self._require(abs(velocity) <= most * (1 + ROUNDING), f"joint {row} at {velocity}, above {most}")
        if last is None:
            self._require(velocity == 0.0, "a first setpoint that moves")
            if mode == "position":
                # Half of following_error is what a wrong reading may hide; the rest is what moved since.
                off = abs(position - actual)
                self._require(
                    off <= 0.5 * FOLLOWING + most * 0.06 + ROUNDING, f"joint {row} starts {off} away"
                )
            return
        dt_s = (now - self.last_at) * 1e-9
        before = last.modes[row]
        if before != "effort":
            was = float(last.velocities[row])
            steepest = change * dt_s + ROUNDING * most
            if before == mode:
                self._require(
                    abs(velocity - was) <= steepest, f"joint {row} from {was} to {velocity} in {dt_s} s"
                )
            if is_silent:
                self._require(abs(velocity) <= abs(was) + ROUNDING, f"joint {row} speeds up in silence")
        if mode == "position" == before:
            from_ = float(last.positions[row])
            way = position - from_
            self._require(
                abs(way) <= most * dt_s * (1 + ROUNDING) + 1e-12, f"joint {row} by {way} in {dt_s} s"
            )
            lower, upper = min(limits.lower[row], from_), max(limits.upper[row], from_)
            is_inside = lower - 1e-9 <= position <= upper + 1e-9
            self._require(is_inside, f"joint {row} outwards to {position}, from {from_}")
        elif mode == "position":
            off = abs(position - actual) - float(self.driver.unread[row])
            self._require(off <= 0.5 * FOLLOWING + most * 0.06, f"joint {row} in mode position {off} away")

    def keep(self, setpoint: Setpoint) -> None:
        self.last, self.last_at = setpoint, self.clock.now()
        self.happened["write"] += 1

    def _require(self, is_so: bool, text: str) -> None:
        if not is_so and not self.violation:  # not raised here: it would be one more failure of the driver
            self.violation = f"seed {self.seed}: {text}; state {self.loop.state}"


def run(seed: int, ticks: int) -> Counter[str]:
    """A history of ``ticks`` ticks, and how often what happened. Raises Violation, or what must not arise."""
    fuzz = Fuzz(seed)
    events: list[Callable[[], None]] = [
        *[fuzz.command] * 10,
        *[fuzz.burst] * 6,
        *[fuzz.motion] * 4,
        *[fuzz.release] * 4,
        *[fuzz.lie] * 3,
        *(fuzz.take_over, fuzz.second_commander, fuzz.token, fuzz.node, fuzz.cancel, fuzz.stop),
        *(fuzz.silence, fuzz.pause, fuzz.fail, fuzz.push, fuzz.restart),
    ]
    done = 0
    while done < ticks:
        event = events[int(fuzz.random.integers(len(events)))]
        event()
        fuzz.happened[event.__name__] += 1
        for _ in range(int(fuzz.random.integers(1, 6))):
            fuzz.tick()
        states = ("ready", "active", "holding", "stopped", "fault")
        done = sum(fuzz.happened[name] for name in states)
    fuzz.happened["tick"] = done
    for reason, count in fuzz.refusals.counts.items():
        fuzz.happened[f"refused: {reason}"] += count
    return fuzz.happened


def run_all(seeds: range, ticks: int) -> Counter[str]:
    """The histories of ``seeds``, and how often what happened in all of them."""
    happened: Counter[str] = Counter()
    with np.errstate(all="raise", under="ignore"):
        for seed in seeds:
            happened.update(run(seed, ticks))
    return happened


if __name__ == "__main__":
    logging.disable(logging.CRITICAL)
    seeds, ticks = (int(text) for text in (*sys.argv[1:3], *("200", "5000")[len(sys.argv) - 1 :]))
    for name, count in sorted(run_all(range(seeds), ticks).items()):
        print(f"{name:24} {count}")
