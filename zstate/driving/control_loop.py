"""The decisions of a control loop at each tick; without network, threads and a clock of its own.

States: "off" before and after the loop; "ready" reads and publishes, and writes nothing; "active" while
commands are valid; "holding" after they have expired; "stopped" until all stops are released; "fault" after
too many failures in a row, which ends the loop. Not a safety-rated channel.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from typing import Literal, NamedTuple, Protocol, TypeAlias

import numpy as np

from zstate._util.bounded import BoundedDict
from zstate._util.refusals import Refusals
from zstate.checks import Floats
from zstate.clock import Clock, MonotonicClock
from zstate.driving.commands import Command, Targets
from zstate.driving.driver import Setpoint, StopMode
from zstate.driving.errors import DriverFault
from zstate.driving.limits import Limits
from zstate.driving.motion_service import MotionExecutor, Present
from zstate.driving.readings import Readings
from zstate.driving.setpoint_limiter import Limited, SetpointLimiter
from zstate.driving.stops import LatchedStops, StopRegister
from zstate.driving.supervised_driver import FollowingCheck, SupervisedDriver
from zstate.errors import Closed, InvalidInput, MessageError, SecondWriter, format_duration
from zstate.sources import JointReading

_LOG = logging.getLogger("zstate")

StateName = Literal["off", "ready", "active", "holding", "stopped", "fault"]

NO_READING = "no two readings that agree have arrived yet"
"""The reason of "ready" until the joints are known."""

_LEAST_TICKS = 5
"""A host that is late has had too few ticks for two readings: that is no fault of the driver."""

StepDuration: TypeAlias = "Callable[[int, int], float]"
"""For how long joints move at ``now`` that moved last at ``since`` [ns]: in s."""


class LoopState(NamedTuple):
    """The state of a control loop, and the reason for it."""

    name: StateName
    reason: str = ""


class Publish(Protocol):
    """Publishes a reading: (n,) each, in the order of the driver's joints. Raises Closed and SecondWriter."""

    def __call__(
        self, positions: Floats, velocities: Floats | None, efforts: Floats | None, stamp: int, /
    ) -> object: ...


class ControlLoop:
    """Reads ``driver``, obeys ``stops``, and moves the joints of ``limits`` to where commands ask for.

    ``DriverHost`` describes the rules. It has one thread, which calls ``start``, then ``tick`` again and
    again, then ``finish``; attributes and ``present`` may be read from any. Each tick takes the commands of
    ``receive()``, oldest first; instants are those of ``clock``, and monotonic. ``publish`` and
    ``publish_setpoint`` are called with what was read and written, ``on_change`` after each change of
    ``state`` or of a motion; ``name_of(session)`` is the program of a commander.
    """

    def __init__(
        self,
        robot: str,
        driver: SupervisedDriver,
        stops: StopRegister,
        *,
        limits: Limits,
        following: FollowingCheck,
        ttl_ns: int,
        on_silence: StopMode,
        faults_allowed: int,
        refusals: Refusals,
        receive: Callable[[], Iterable[Command]],
        publish: Publish,
        publish_setpoint: Callable[[Setpoint], object],
        name_of: Callable[[int], str],
        on_change: Callable[[], object],
        clock: Clock | None = None,
    ) -> None:
        self._robot = robot
        self._driver = driver
        self._stops = stops
        self._limits = limits
        self._limiter = SetpointLimiter(limits, driver.modes)
        self._following = following
        self._readings = Readings(limits, following.most, following.oldest_ns)
        self._ttl_ns = ttl_ns
        self._on_silence: StopMode = on_silence
        self._faults_allowed = faults_allowed
        self._refusals = refusals
        self._receive = receive
        self._publish, self._publish_setpoint = publish, publish_setpoint
        self._name_of, self._on_change = name_of, on_change
        self._now = (clock or MonotonicClock()).now
        self._inside = np.clip(0.0, limits.lower, limits.upper)
        """Any positions inside the limits."""
        self.state = LoopState("off", "the loop does not run yet")
        self.faults = 0
        self.targets = Targets(len(limits.joint_names))
        self.motions = MotionExecutor(
            self.targets,
            limits=limits,
            modes=driver.modes,
            ttl_ns=ttl_ns,
            present=self.present,
            check=self._check_commander,
            name_of=name_of,
            on_change=on_change,
        )
        self.setpoint: Limited | None = None
        """The last one that was written since the joints were enabled; None otherwise."""
        self.obeyed = LatchedStops()
        """The stops for which the driver has stopped."""
        self._barred: BoundedDict[int, None] = BoundedDict()
        """Sessions that have commanded a stopped robot: a release by another does not move it for them."""
        self._measured: Floats | None = None
        self._measured_at = 0
        self._moved_at = 0
        """When the last setpoint was made: steps are no longer than the time since then."""
        self._enabled_at = 0
        self._powered_ticks = 0
        """Since the joints have power, without a setpoint."""
        self._read_stamp: int | None = None
        """The stamp of the last reading, if the driver gives stamps."""
        self._offset = 0
        """How far the system clock was ahead of ``clock`` at the last tick [ns]."""
        self._faults_in_row = 0

    def start(self) -> None:
        """Become ready, or obey stops that are still latched once more."""
        latched = self._stops.current
        self.obeyed = LatchedStops((), latched.arrived - len(latched.stops))
        if not latched.stops:  # the last one may have been released since the last loop
            self._barred.pop(self._stops.released_by[0], None)
            self._change("ready", NO_READING if self._measured is None else "")

    def tick(self, stamp: int, step_s: StepDuration) -> None:
        """Read the joints at ``stamp`` [ns], the present instant of the system clock, and write a setpoint.

        Raises DriverFault after too many failures of the driver, and what ``publish`` raises.
        """
        self._offset = stamp - self._now()
        failures = [self._read(stamp)]
        now = self._now()
        self._check_following(now)
        failures.append(self._obey_stops(now))
        self._accept_commands(now)
        if self._measured is not None:
            self.motions.supervise(now, self._measured, self._measured_at)
        has_new_stop = self._stops.current is not self.obeyed  # obeyed in the next tick
        if self.state.name != "stopped" and not has_new_stop:
            failures.append(self._advance(now, step_s, is_fresh=not any(failures)))
        self._count_fault(next(filter(None, failures), None))

    def finish(self) -> None:
        """Stop the driver as after silence, unless it is stopped already. No tick follows."""
        if self._driver.needs_stop:
            self._stop_driver(self._on_silence)
        self._driver.repeat_stop()
        self.motions.finish("aborted", self.state.reason or "the driver host has ended")
        self.targets.clear()
        if self.state.name != "fault":
            self._change("off", "the loop has ended")

    def _read(self, stamp: int) -> Exception | None:
        """Read the joints and publish them. Returns what failed; the last state stays then."""
        reading = self._driver.read(stamp)
        if reading is None or isinstance(reading, Exception):
            return reading
        try:
            self._check_and_publish(reading, stamp)
        except (Closed, SecondWriter):
            raise
        except Exception as error:  # what a driver returns may be anything
            return error
        return None

    def _check_and_publish(self, reading: JointReading, stamp: int) -> None:
        if reading.stamp is not None and reading.stamp == self._read_stamp:
            return  # a driver that repeats its last reading has lost its device
        vector = self._limits.vector
        positions = self._readings.vector(reading.positions)
        velocities = reading.velocities
        if velocities is not None:
            velocities = vector(velocities, "measured velocities")
        efforts = reading.efforts
        if efforts is not None:
            efforts = vector(efforts, "measured efforts")
        now = self._now()
        doubt = self._readings.add(positions, now)
        self._read_stamp = reading.stamp
        if doubt and self._moves_by_readings(now):
            self._limiter.doubt()
            raise InvalidInput(doubt)
        self._publish(positions, velocities, efforts, stamp if reading.stamp is None else reading.stamp)
        self._measured, self._measured_at = positions, now
        if not self._readings.is_confirmed:
            return
        self._limiter.observe(positions, velocities, now)
        if self.state.reason == NO_READING:
            self._change("ready", "")

    def _moves_by_readings(self, now: int) -> bool:
        """Whether the next setpoint is where a joint is measured, so that a wrong reading would be a jump."""
        if self.setpoint is None:
            return self._driver.is_enabled or self.targets.is_live(now)
        return not self._limiter.has_positions_only

    def _check_following(self, now: int) -> None:
        """Stop if a joint does not follow its setpoints, or is not measured any more."""
        if self._driver.is_enabled and self.setpoint is None:
            self._powered_ticks += 1
            known_at = self._measured_at if self._readings.is_confirmed else 0
            waited_ns = now - max(self._enabled_at, known_at)
            if waited_ns > self._following.oldest_ns and self._powered_ticks >= _LEAST_TICKS:
                reason = "the joints have power, and there are no two readings of them that agree"
                self._stop_and_latch(f"{reason} for {format_duration(waited_ns)}")
        elif self._measured is not None:
            reason = self._following.deviation(self._measured, self._measured_at, now)
            if reason:
                self._stop_and_latch(reason)

    def _obey_stops(self, now: int) -> Exception | None:
        """Stop if there is a new stop; become ready when the last one is released. Returns what failed.

        A stop is confirmed, by its number in the state, once the driver has stopped.
        """
        latched = self._stops.current
        if latched is self.obeyed:
            return None
        reason = "; ".join(dict.fromkeys(map(str, latched.stops)))
        if latched.newest is not None and latched.arrived != self.obeyed.arrived:
            reason = reason or f"{latched.newest}, and released already"
            self._bar_active()
            self.motions.finish("stopped", reason)
            self.targets.clear()
            hows = {one.how for one in (*latched.stops, latched.newest)}
            failure = self._stop_driver("relax" if "relax" in hows else "hold")
            if failure is not None:
                self._change("stopped", f"the driver has not stopped yet: {failure!r}; {reason}")
                return failure
        self.obeyed = latched  # before the state that is published with it
        if reason:
            self._change("stopped", reason)
        if not latched.stops and self.state.name == "stopped":
            self._accept_commands(now)  # those from before the release are refused
            releaser, _ = self._stops.released_by
            self._barred.pop(releaser, None)
            self._change("ready", f"released by {self._name_of(releaser)}")
        return None

    def _bar_active(self) -> None:
        """Bar the active commander. A ROS node has a session for each of its publishers: bar them all."""
        active = self.targets.session
        name = self._name_of(active)
        for session in (active, *(node for node in self.motions.nodes if self._name_of(node) == name)):
            self._barred[session] = None

    def _accept_commands(self, now: int) -> None:
        for command in self._receive():
            self._accept(command, now)
        self.motions.calls.run_waiting(now)

    def _accept(self, command: Command, now: int) -> None:
        """Take the targets of ``command``, or count the reason against it."""
        try:
            self._check_commander(command.session, command.seq, now)
            self.targets.check_order(command)
            if command.motion is not None:
                self.motions.renew(command)
                return
            self._check_limits(command)
        except MessageError as error:
            self._refusals.count(error.reason, error)
        else:
            self.motions.replace(command)
            self.targets.accept(command)

    def _check_commander(self, session: int, seq: int, now: int) -> None:
        """Raise MessageError while stopped, and for a commander that has not released the stop itself.

        And while the targets of another one that is not gone are valid at ``now``, and for a message ``seq``
        from before the release: releases travel on another key, and may overtake it.
        """
        if self.state.name == "stopped":
            self._barred[session] = None
            raise MessageError(self.state.reason, reason="stopped")
        releaser, release = self._stops.released_by
        if session == releaser:
            self._barred.pop(session, None)  # also by a release after that of another
        if session in self._barred:
            mend = (
                "start that node again" if session in self.motions.nodes else "release with it, or reopen it"
            )
            text = f"it came from a commander that did not release the last stop; {mend}"
            raise MessageError(text, reason="not released")
        if session == releaser and seq < release:
            raise MessageError(f"the command {seq} was sent before the release of the stop", reason="old")
        self.targets.check_session(session, now, self._name_of)

    def _check_limits(self, command: Command) -> None:
        """Raise MessageError unless the limiter accepts the positions of ``command``."""
        if self.setpoint is None and self._measured is not None and self._readings.is_confirmed:
            self._check_not_far_outside(self._measured)
            self._limiter.start(self._measured)
        try:
            self._limiter.check(self.targets.merged(command, self._inside))
            self._limiter.check_rates(command.rates)
        except InvalidInput as error:
            raise MessageError(str(error), reason="outside limits") from None

    def _check_not_far_outside(self, measured: Floats) -> None:
        if text := self._readings.outside_text(measured):
            raise MessageError(text, reason="outside limits")

    def _advance(self, now: int, step_s: StepDuration, *, is_fresh: bool) -> Exception | None:
        """Enable the joints, or write the next setpoint. Returns what failed."""
        is_live = self.targets.is_live(now)
        if self.setpoint is None:
            if self._driver.is_stopping or (self._driver.needs_stop and not is_live):
                return self._stop_driver(self._on_silence)
            is_known = self._readings.is_confirmed and now - self._measured_at < self._ttl_ns
            if not is_live or not is_fresh or not is_known:
                return None
            return self._start(now) if self._driver.is_enabled else self._enable()
        if not is_live and self.state.name == "active":
            reason = self._silence_text(now)
            if self._on_silence == "relax":
                failure = self._stop_driver("relax")
                self._change("ready", reason)
                return failure
            self._change("holding", reason)
        elif is_live and self.state.name == "holding":
            self.targets.start(now, self._resting())
            self._change("active", "")
        dt_s = step_s(self._moved_at, now)
        self._moved_at = now
        return self._move(now, dt_s)

    def _enable(self) -> Exception | None:
        """Switch on power and brakes.

        Joints may sag by that, so the first setpoint waits for the next reading.
        """
        self._measured_at = 0
        failure = self._driver.enable()
        self._enabled_at = self._now()
        self._powered_ticks = 0
        return failure

    def _start(self, now: int) -> Exception | None:
        """Write the measured joints as the first setpoint after a change of state.

        The first step follows at the next tick, and takes the time since then.
        """
        assert self._measured is not None
        if text := self._readings.outside_text(self._measured):
            self._stop_and_latch(text)
            return None
        self._moved_at = now
        self.targets.start(now, self._measured)
        failure = self._write(self._limiter.start(self._measured))
        if failure is None:
            self._change("active", "")
        return failure

    def _move(self, now: int, dt_s: float) -> Exception | None:
        """Write the next setpoint on the way to the targets, or to rest. Where that fails, nothing moves."""
        if self.state.name == "holding":
            limited = self._limiter.brake(dt_s)
        else:
            target = self.targets.current(now, self._resting)
            target, velocities = self.motions.next_target(target, dt_s, now)
            limited = self._limiter.step(target, dt_s, velocities, self.targets.rates)
        for text in limited.braked:
            self._refusals.count("braked", text)
        failure = self._write(limited)
        if failure is None:
            self.motions.written(self._now())
        elif self.setpoint is not None:
            self._limiter.resume(self.setpoint, dt_s)
        return failure

    def _write(self, limited: Limited) -> Exception | None:
        """Write ``limited`` as the setpoint, and publish it. Returns what failed."""
        setpoint = Setpoint(self._now() + self._offset, *limited[:2], limited.efforts, limited.modes)
        failure = self._driver.write(setpoint)
        if failure is None:
            self.setpoint = limited
            self._following.written(limited, self._now())
            self._publish_setpoint(setpoint)
        return failure

    def _resting(self) -> Floats:
        """Where the joints come to rest if they brake from the last setpoint."""
        return self.present().resting

    def present(self) -> Present:
        """The joints now, for any thread. Raises MessageError if they are not known, or the loop is off."""
        setpoint, measured, stops = self.setpoint, self._measured, self._stops.current
        if setpoint is not None:
            positions, velocities = setpoint.positions, setpoint.velocities
            resting = positions + velocities * np.abs(velocities) / (2.0 * self._limits.acceleration)
            return Present(positions, velocities, resting, stops)
        if measured is None or not self._readings.is_confirmed or self.state.name in ("off", "fault"):
            reason = self.state.reason or NO_READING
            text = f"the driver is {self.state.name}, and its joints are not known: {reason}"
            raise MessageError(text, reason="not ready")
        self._check_not_far_outside(measured)
        return Present(measured, np.zeros(len(measured)), measured, stops)

    def _count_fault(self, fault: Exception | None) -> None:
        if fault is None:
            self._faults_in_row = 0
            return
        self.faults += 1
        self._faults_in_row += 1
        if self.faults == 1:
            _LOG.warning("the driver of %r failed: %r; further failures are counted", self._robot, fault)
        if self._faults_in_row < self._faults_allowed:
            return
        reason = f"the driver failed in {self._faults_in_row} ticks in a row; the last one: {fault!r}"
        self._stop_and_latch(reason)
        self._change("fault", reason)
        raise DriverFault(
            f"{self._robot!r} is stopped: {reason}; repair it, restart, then release the "
            f"stop: `zstate stop {self._robot} --release`",
            robot=self._robot,
        ) from fault

    def _stop_and_latch(self, reason: str) -> None:
        """Stop as after silence, until a commander releases that."""
        self._stop_driver(self._on_silence)
        self._stops.latch(reason, self._on_silence)

    def _stop_driver(self, how: StopMode) -> Exception | None:
        """Stop the hardware. The next setpoint starts from the measured joints. Returns what failed."""
        self.setpoint = None
        self._following.stopped()
        return self._driver.stop(how)

    def _change(self, name: StateName, reason: str) -> None:
        self.state = LoopState(name, reason)
        self._on_change()

    def _silence_text(self, now: int) -> str:
        commander = self.targets.session
        name = self._name_of(commander)
        if self.targets.is_gone(commander, now):
            return f"{name} has ended"
        return f"nothing from {name} for {format_duration(now - self.targets.arrived)}"
