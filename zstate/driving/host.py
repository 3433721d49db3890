"""The control loop of the program that owns a robot's hardware.

States: "off" before and after ``run``; "ready" reads and publishes, and writes nothing; "active" while
commands are valid; "holding" after they have expired; "stopped" until all stops are released; "fault" after
too many failures in a row, which ends the loop. Not a safety-rated channel.
"""

from __future__ import annotations

import logging
import math
import os
import secrets
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zstate._util.bounded import BoundedDict
from zstate._util.closeable import Closeable, held_back_signals
from zstate._util.fork_safe import fork_safe
from zstate._util.refusals import Refusals
from zstate.driving.commands import Command, CommandReceiver, Targets
from zstate.driving.driver import Driver, Setpoint, StopMode
from zstate.driving.driver_state import (
    DriverReport,
    DriverStatePublisher,
    Durations,
    SetpointPublisher,
    check_only_host,
)
from zstate.driving.limits import Limits
from zstate.driving.motion_service import MotionService, Present
from zstate.driving.setpoint_limiter import Limited, SetpointLimiter
from zstate.driving.stops import LatchedStops, StopLatch
from zstate.driving.supervised_driver import FollowingCheck, SupervisedDriver, check_arguments
from zstate.errors import (
    Closed,
    DriverFault,
    InvalidInput,
    MessageError,
    SecondWriter,
    format_duration,
)
from zstate.model.robot import RobotModel
from zstate.net.at_exit import forked_text
from zstate.net.presence import WriterWatch, announce_reader, local_writer
from zstate.net.queryable import check_timeout
from zstate.net.session import Session
from zstate.nodes.partial_publisher import PartialStatePublisher
from zstate.nodes.publisher import StatePublisher
from zstate.rate import DevicePace, Rate, Realtime, check_pace, control_loop_pace
from zstate.sources import JointReading
from zstate.wire.identity import Announcement
from zstate.wire.keys import check_robot
from zstate.wire.messages import DriverState
from zstate.wire.registry import as_wire_names, get_controller, get_wire

if TYPE_CHECKING:
    from zstate.wire.ros2.wire import Ros2Controller

_LOG = logging.getLogger("zstate")

StateName = Literal["off", "ready", "active", "holding", "stopped", "fault"]


class _State(NamedTuple):
    name: StateName
    reason: str = ""


class DriverHost(Closeable):
    """Owns ``driver``, publishes its joints as the state of ``robot``, and writes what a ``Commander`` sends.

    ``rate_hz`` is that of the loop; with None the device sets its pace by ``driver.read``, which blocks until
    there is a new reading. Commands and stops wait for it, too: without a reading it returns None after some
    milliseconds. ``realtime`` "fifo" and "spin" are described in ``zstate.rate.control_loop_pace``.

    A command is valid for its own ttl or for ``ttl_s`` [s], which is also the longest that is granted,
    counted from its arrival on the monotonic clock. When the last one has expired, ``on_silence`` "hold"
    brakes the joints and keeps writing that position, "relax" switches their torque off. ``limits`` are those
    of the model by default: positions outside them are refused, and faster motion is slowed; a
    ``Commander.move`` that is too fast is refused. The first setpoint after any change of state is at the
    measured joints, or at the last setpoint where one was written, so that no step is longer than a tick's
    motion at the velocity limits.

    A call of the driver that raises is counted, and the loop continues. After ``faults_allowed`` ticks in a
    row with such a failure the driver is stopped as after silence, and ``run`` raises DriverFault. It is
    stopped, too, when a joint is further than ``following_error`` [rad] or [m] from its setpoint, such as
    without power, or when there is no new reading for ``ttl_s``. These stops, like those of
    ``zstate.driving.stop``, are latched: a restarted host stays stopped until a commander releases them, see
    ``zstate.driving.stops``.

    ``wires`` are those on which the joint states are published. With ``ros2_controller``, the name of a
    controller, ROS nodes on the wire "ros2" may command the joints as well, as in ros2_control: by
    ``<ros2_controller>/commands`` (std_msgs/Float64MultiArray), positions of all joints in the order of
    ``driver.joint_names``, each valid for ``ttl_s``; and by ``<ros2_controller>/joint_trajectory``
    (trajectory_msgs/JointTrajectory), a motion that is valid while its publisher is announced: the motion of
    a node that is frozen or cut off goes on until Zenoh closes the link, after 10 s by default and 60 s with
    the router ``rmw_zenohd``. A ROS node owns nothing: the first that sends is the commander until it is
    silent, and the others are refused. It cannot release a stop.

    A robot has one host. Raises InvalidInput for unusable arguments, SecondWriter if another program hosts a
    driver of the robot or publishes these joints, and what ``driver.open`` raises. A context manager. Not a
    safety-rated channel: a stop waits for the calls of the driver, and is lost with the network.
    """

    def __init__(
        self,
        session: Session,
        driver: Driver,
        model: RobotModel,
        robot: str | None = None,
        *,
        rate_hz: float | None = 100.0,
        ttl_s: float = 0.25,
        limits: Limits | None = None,
        on_silence: StopMode = "hold",
        faults_allowed: int = 3,
        following_error: float = 0.2,
        wires: str | Sequence[str] = ("native",),
        ros2_controller: str = "",
        realtime: Realtime | None = None,
        program: str = "",
    ) -> None:
        self.robot = check_robot(robot or model.name)
        self._wires = as_wire_names(wires)
        self._driver = SupervisedDriver(driver, self.robot)
        check_pace(rate_hz, realtime)
        self._pace = partial(control_loop_pace, rate_hz, realtime)
        self._ttl_ns = round(check_timeout(ttl_s) * 1e9)
        self._names = names = model.part(driver.joint_names).joint_names
        self._limits = limits = limits or Limits.of(model, names)
        check_arguments(driver, limits, names, on_silence, faults_allowed)
        self._limiter = SetpointLimiter(limits)
        self._on_silence: StopMode = on_silence
        self._faults_allowed = faults_allowed
        oldest_ns = max(self._ttl_ns, round(faults_allowed * 1e9 / (rate_hz or math.inf)))
        self._following = FollowingCheck(limits, following_error, oldest_ns)
        self._writer = local_writer(secrets.randbits(32), program)
        self._refusals = Refusals(f"command for {self.robot!r}")
        self._targets = Targets(len(names))
        self._programs: BoundedDict[int, str] = BoundedDict()
        """Announced commanders by session."""
        self._state = _State("off", "the loop does not run yet")
        self._measured: NDArray[np.float64] | None = None
        self._measured_at = self._wrote_at = 0
        self._setpoint: Limited | None = None
        """The last one that was written since the joints were enabled; None otherwise."""
        self._obeyed = LatchedStops()
        self._barred: BoundedDict[int, None] = BoundedDict()
        """Sessions that have commanded a stopped robot: a release by another does not move it for them."""
        self._faults = self._faults_in_row = 0
        self._lateness = Durations()
        self._rate: Rate | DevicePace | None = None
        self._stop = fork_safe(threading.Event())
        self._is_ending = False
        self._running = fork_safe(threading.RLock())
        """Held by ``run`` and ``close``; a handler of a signal may call ``close`` inside both."""
        self._runner: threading.Thread | None = None
        """The thread inside ``run`` or ``close``."""
        self._pid = os.getpid()
        with ExitStack() as opening:
            check_only_host(session, self.robot)
            self._publisher, self._order = self._open_publisher(session, model, opening)
            self._stops = opening.enter_context(StopLatch(session, self.robot, self._refusals))
            self._commands, self._motions = self._open_inputs(session, ros2_controller, opening)
            self._setpoints = opening.enter_context(
                SetpointPublisher(session, self.robot, names, self._writer)
            )
            opening.callback(driver.close)
            driver.open()
            opening.callback(self._driver.disable)
            self._states = opening.enter_context(
                DriverStatePublisher(session, self.robot, self._driver_state)
            )
            self._opened = opening.pop_all()

    def __repr__(self) -> str:
        return f"<DriverHost of {self.robot!r}: {self._state.name}, {self._driver.written} setpoints>"

    def _open_publisher(
        self, session: Session, model: RobotModel, opening: ExitStack
    ) -> tuple[StatePublisher | PartialStatePublisher, NDArray[np.intp] | slice]:
        """The publisher of the driver's joints, and their columns in its order."""
        wires, program = self._wires, self._writer.program
        if set(self._names) == set(model.joint_names):
            order = [self._names.index(name) for name in model.joint_names]
            publisher = StatePublisher(session, model, self.robot, wires, program=program)
        else:
            order = list(range(len(self._names)))
            publisher = PartialStatePublisher(session, model, self._names, self.robot, wires, program=program)
        is_same = order == list(range(len(order)))
        return opening.enter_context(publisher), slice(None) if is_same else np.array(order, dtype=np.intp)

    def _open_inputs(
        self, session: Session, ros2_controller: str, opening: ExitStack
    ) -> tuple[CommandReceiver, MotionService]:
        """What receives commands and motions, whose senders are watched for their names."""
        controller = get_controller(self._wires, self.robot, ros2_controller) if ros2_controller else None
        commands = CommandReceiver(
            session, self.robot, self._names, self._ttl_ns, self._refusals, controller=controller
        )
        opening.enter_context(commands)
        program = self._writer.program
        for token in announce_reader(session, get_wire("native"), self.robot, ["joint_commands"], program):
            opening.enter_context(token)
        motions = opening.enter_context(self._open_motions(session, controller))
        opening.enter_context(WriterWatch(session, self.robot, self._on_writer))
        if controller is not None:
            on_node = partial(self._on_node, motions)
            opening.enter_context(WriterWatch(session, self.robot, on_node, controller))
        return commands, motions

    def _open_motions(self, session: Session, controller: Ros2Controller | None) -> MotionService:
        return MotionService(
            session,
            self.robot,
            self._writer.session,
            self._targets,
            limits=self._limits,
            ttl_ns=self._ttl_ns,
            refusals=self._refusals,
            present=self._present,
            check=self._check_commander,
            name_of=self._name_of,
            on_change=self._notify,
            controller=controller,
        )

    @property
    def state(self) -> StateName:
        """The present state."""
        return self._state.name

    def report(self) -> DriverReport:
        """The figures until now."""
        return DriverReport(
            None if self._rate is None else self._rate.report(),
            self._lateness.spread(),
            self._driver.reading.spread(),
            self._driver.writing.spread(),
            self._driver.written,
            self._faults,
            dict(self._refusals.counts),
        )

    def run(self, *, seconds: float | None = None) -> DriverReport:
        """Run the loop for ``seconds``, or until ``close()``. Ticks that are missed are not made up for.

        If it ends while the joints are commanded or held, the driver is stopped as after silence. In the main
        thread of a program that does not handle SIGTERM and SIGHUP, they end the loop and close this host
        before they end the process. Raises DriverFault, SecondWriter, Closed, and InvalidInput if the system
        refuses ``realtime``, or if a device that sets the pace returns at once before any joint moves.
        """
        if os.getpid() != self._pid:
            raise Closed(forked_text(f"this driver host belongs to process {self._pid}"))
        with self._running, held_back_signals(self.close) as arrived:
            self._runner = threading.current_thread()
            try:
                self._loop(seconds, arrived)
            finally:
                self._end()
                self._runner = None
        return self.report()

    def close(self) -> None:
        """End the loop, stop the driver, and disconnect it. A second call does nothing.

        From inside the loop, such as in a handler of a signal, only the loop ends: close again after ``run``.
        Does nothing in a forked process.
        """
        if os.getpid() != self._pid:
            return
        self._is_ending = True
        if self._runner is threading.current_thread():
            return
        self._stop.set()
        with self._running:
            self._runner = threading.current_thread()
            try:
                self._opened.close()
            finally:
                self._runner = None

    def _loop(self, seconds: float | None, signals: list[int]) -> None:
        latched = self._stops.current
        # Stops that are still latched are obeyed once more.
        self._obeyed = LatchedStops((), latched.arrived - len(latched.stops))
        if not latched.stops:  # the last one may have been released since the last loop
            self._barred.pop(self._stops.released_by[0], None)
        with self._pace(self._stop, seconds) as rate:
            self._rate = rate
            if not latched.stops:
                self._change("ready", "")
            try:
                for _ in rate:
                    if self._is_ending or signals:
                        return
                    self._lateness.add(rate.lateness_ns)
                    self._tick()
            except Closed:
                if not self._stop.is_set():
                    raise

    # One tick, in the thread of run()

    def _tick(self) -> None:
        failures = [self._read()]
        now = time.monotonic_ns()
        if self._measured is not None:
            reason = self._following.deviation(self._measured, self._measured_at, now)
            if reason:
                self._stop_and_latch(reason)
        failures.append(self._obey_stops(now))
        self._accept_commands(now)
        if self._measured is not None:
            self._motions.supervise(now, self._measured, self._measured_at)
        has_new_stop = self._stops.current is not self._obeyed  # obeyed in the next tick
        if self._state.name != "stopped" and not has_new_stop:
            failures.append(self._advance(now, is_fresh=not any(failures)))
        self._count_fault(next(filter(None, failures), None))

    def _read(self) -> Exception | None:
        """Read the joints and publish them. Returns what failed; the last state stays then."""
        stamp = time.time_ns()
        reading = self._driver.read(stamp)
        if reading is None or isinstance(reading, Exception):
            return reading
        try:
            self._publish(reading, stamp)
        except (Closed, SecondWriter):
            raise
        except Exception as error:  # what a driver returns may be anything
            return error
        return None

    def _publish(self, reading: JointReading, stamp: int) -> None:
        positions = self._limits.vector(reading.positions, "measured positions")
        velocities, efforts = (
            None if values is None else self._limits.vector(values, f"measured {kind}")[self._order]
            for kind, values in (("velocities", reading.velocities), ("efforts", reading.efforts))
        )
        instant = stamp if reading.stamp is None else reading.stamp
        self._publisher.publish(positions[self._order], velocities, efforts, instant)
        self._measured, self._measured_at = positions, time.monotonic_ns()

    def _obey_stops(self, now: int) -> Exception | None:
        """Stop if there is a new stop; become ready when the last one is released. Returns what failed.

        A stop is confirmed, by its number in the state, once the driver has stopped.
        """
        latched = self._stops.current
        if latched is self._obeyed:
            return None
        reason = "; ".join(map(str, latched.stops))
        if latched.newest is not None and latched.arrived != self._obeyed.arrived:
            reason = reason or f"{latched.newest}, and released already"
            self._bar_active()
            self._motions.finish("stopped", reason)
            self._targets.clear()
            hows = {one.how for one in (*latched.stops, latched.newest)}
            failure = self._stop_driver("relax" if "relax" in hows else "hold")
            if failure is not None:
                self._change("stopped", f"the driver has not stopped yet: {failure!r}; {reason}")
                return failure
        if reason:
            self._change("stopped", reason)
        if not latched.stops and self._state.name == "stopped":
            self._accept_commands(now)  # those from before the release are refused
            releaser, _ = self._stops.released_by
            self._barred.pop(releaser, None)
            self._change("ready", f"released by {self._name_of(releaser)}")
        self._obeyed = latched
        return None

    def _bar_active(self) -> None:
        """Bar the active commander. A ROS node has a session for each of its publishers: bar them all."""
        active = self._targets.session
        name = self._name_of(active)
        for session in (active, *(node for node in self._motions.nodes if self._name_of(node) == name)):
            self._barred[session] = None

    def _accept_commands(self, now: int) -> None:
        for command in self._commands.drain():
            self._accept(command, now)
        self._motions.adopt(now)

    def _accept(self, command: Command, now: int) -> None:
        """Take the targets of ``command``, or count the reason against it."""
        try:
            self._check_commander(command.session, command.seq, now)
            self._targets.check_order(command)
            if command.motion is not None:
                self._motions.renew(command)
                return
            self._check_limits(command)
        except MessageError as error:
            self._refusals.count(error.reason, error)
        else:
            self._motions.replace(command)
            self._targets.accept(command)

    def _check_commander(self, session: int, seq: int, now: int) -> None:
        """Raise MessageError while stopped, and for a commander that has not released the stop itself.

        And for another one than that whose targets are valid at ``now``, and for a message ``seq`` from
        before the release: releases travel on another key, and may overtake it.
        """
        if self._state.name == "stopped":
            self._barred[session] = None
            raise MessageError(self._state.reason, reason="stopped")
        if session in self._barred:
            text = (
                "it came from a commander that did not release the last stop; release with it, or reopen it"
            )
            raise MessageError(text, reason="not released")
        releaser, release = self._stops.released_by
        if session == releaser and seq < release:
            raise MessageError(f"the command {seq} was sent before the release of the stop", reason="old")
        self._targets.check_session(session, now)

    def _check_limits(self, command: Command) -> None:
        """Raise MessageError unless the limiter accepts the positions of ``command``."""
        inside = np.clip(np.zeros(len(self._names)), self._limits.lower, self._limits.upper)
        if self._setpoint is None and self._measured is not None:
            self._limiter.start(self._measured)
        try:
            self._limiter.check(self._targets.merged(command, inside))
        except InvalidInput as error:
            raise MessageError(str(error), reason="outside limits") from None

    def _advance(self, now: int, *, is_fresh: bool) -> Exception | None:
        """Enable the joints, or write the next setpoint. Returns what failed."""
        is_live = self._targets.is_live(now)
        if self._setpoint is None:
            if self._driver.is_stopping or (self._driver.needs_stop and not is_live):
                return self._stop_driver(self._on_silence)
            is_known = self._measured is not None and now - self._measured_at < self._ttl_ns
            if not is_live or not is_fresh or not is_known:
                return None
            return self._start(now) if self._driver.is_enabled else self._enable()
        if not is_live and self._state.name == "active":
            reason = f"nothing from {self._name_of(self._targets.session)} for {self._silence(now)}"
            if self._on_silence == "relax":
                failure = self._stop_driver("relax")
                self._change("ready", reason)
                return failure
            self._change("holding", reason)
        elif is_live and self._state.name == "holding":
            self._targets.start(now, self._resting())
            self._change("active", "")
        return self._move(now)

    def _enable(self) -> Exception | None:
        """Switch on power and brakes.

        Joints may sag by that, so the first setpoint waits for the next reading.
        """
        self._measured_at = 0
        return self._driver.enable()

    def _start(self, now: int) -> Exception | None:
        """Write the measured joints as the first setpoint after a change of state.

        The first step follows at the next tick, and takes the time since then.
        """
        assert self._measured is not None
        self._limiter.start(self._measured)
        self._targets.start(now, self._measured)
        failure = self._write(Limited(self._measured.copy(), np.zeros(len(self._measured)), ()))
        if failure is None:
            self._change("active", "")
        return failure

    def _move(self, now: int) -> Exception | None:
        """Write the next setpoint on the way to the targets, or to rest. Where that fails, nothing moves."""
        assert self._rate is not None, "the loop runs"
        dt_s = self._rate.step_s(self._wrote_at, now)
        if self._state.name == "holding":
            limited = self._limiter.brake(dt_s)
        else:
            target = self._targets.current(now, self._resting)
            target, velocities = self._motions.next_target(target, dt_s, now)
            limited = self._limiter.step(target, dt_s, velocities)
        failure = self._write(limited)
        if failure is None:
            self._motions.written(time.monotonic_ns())
        elif self._setpoint is not None:
            self._limiter.start(self._setpoint.positions, self._setpoint.velocities)
        return failure

    def _write(self, limited: Limited) -> Exception | None:
        """Write ``limited`` as the setpoint, and publish it. Returns what failed."""
        setpoint = Setpoint(time.time_ns(), limited.positions, limited.velocities)
        self._wrote_at = time.monotonic_ns()
        failure = self._driver.write(setpoint)
        if failure is None:
            self._setpoint = limited
            self._following.written(limited.positions, time.monotonic_ns())
            self._setpoints.publish(setpoint)
        return failure

    def _resting(self) -> NDArray[np.float64]:
        """Where the joints come to rest if they brake from the last setpoint."""
        return self._present().resting

    def _present(self) -> Present:
        """The joints now, for any thread. Raises MessageError if they are not known, or the loop is off."""
        setpoint, measured, stops = self._setpoint, self._measured, self._stops.current
        if setpoint is not None:
            positions, velocities, _ = setpoint
            resting = positions + velocities * np.abs(velocities) / (2.0 * self._limits.acceleration)
            return Present(positions, velocities, resting, stops)
        if measured is None or self._state.name in ("off", "fault"):
            reason = self._state.reason or "no reading has arrived yet"
            text = f"the driver is {self._state.name}, and its joints are not known: {reason}"
            raise MessageError(text, reason="not ready")
        return Present(measured, np.zeros(len(measured)), measured, stops)

    def _count_fault(self, fault: Exception | None) -> None:
        if fault is None:
            self._faults_in_row = 0
            return
        self._faults += 1
        self._faults_in_row += 1
        if self._faults == 1:
            _LOG.warning("the driver of %r failed: %r; further failures are counted", self.robot, fault)
        if self._faults_in_row < self._faults_allowed:
            return
        reason = f"the driver failed in {self._faults_in_row} ticks in a row; the last one: {fault!r}"
        self._stop_and_latch(reason)
        self._change("fault", reason)
        raise DriverFault(
            f"{self.robot!r} is stopped: {reason}; mend it, restart, then release the "
            f"stop: `zstate stop {self.robot} --release`",
            robot=self.robot,
        ) from fault

    def _stop_and_latch(self, reason: str) -> None:
        """Stop as after silence, until a commander releases that."""
        self._stop_driver(self._on_silence)
        self._stops.latch(reason, self._writer, how=self._on_silence)

    def _stop_driver(self, how: StopMode) -> Exception | None:
        """Stop the hardware. The next setpoint starts from the measured joints. Returns what failed."""
        self._setpoint = None
        self._following.stopped()
        return self._driver.stop(how)

    def _end(self) -> None:
        if self._driver.needs_stop:
            self._stop_driver(self._on_silence)
        self._driver.repeat_stop()
        self._motions.finish("aborted", self._state.reason or "the driver host has ended")
        self._targets.clear()
        if self._state.name != "fault":
            self._change("off", "the loop has ended")

    # The state for others, in the thread of the state publisher

    def _change(self, name: StateName, reason: str) -> None:
        self._state = _State(name, reason)
        self._notify()

    def _notify(self) -> None:
        self._states.notify()

    def _driver_state(self) -> DriverState:
        state, targets, setpoint = self._state, self._targets, self._setpoint
        rate = None if self._rate is None else self._rate.report()
        obeyed = self._stops.current if state.name in ("off", "fault") else self._obeyed
        motion, progress = self._motions.underway
        return DriverState(
            time.time_ns(),
            self._writer.session,
            str(self._writer),
            state.name,
            state.reason,
            self._names,
            self._ttl_ns,
            self._name_of(targets.session) if targets.session else "",
            max(0, time.monotonic_ns() - targets.arrived) if targets.session else None,
            setpoint.limited if setpoint is not None else (),
            0.0 if rate is None else rate.rate_hz,
            0 if rate is None else rate.ticks,
            0 if rate is None else rate.skipped,
            self._faults,
            dict(self._refusals.counts),
            str(self._refusals.newest),
            tuple((one.session, one.seq) for one in obeyed.stops),
            motion,
            progress,
            self._motions.outcomes,
        )

    def _silence(self, now: int) -> str:
        return format_duration(now - self._targets.arrived)

    def _name_of(self, session: int) -> str:
        return self._programs.get(session) or f"session {session:x}"

    def _on_writer(self, announced: Announcement, alive: bool) -> None:
        if alive and announced.stream == "joint_commands":
            self._programs[announced.writer.session] = str(announced.writer)

    def _on_node(self, motions: MotionService, announced: Announcement, alive: bool) -> None:
        self._on_writer(announced, alive)
        motions.set_announced(announced.writer.session, alive)
