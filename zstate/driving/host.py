"""The program that owns a robot's hardware: what its control loop receives and publishes, and its pace.

Not a safety-rated channel.
"""

from __future__ import annotations

import math
import os
import secrets
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from zstate._util.bounded import BoundedDict
from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe
from zstate._util.refusals import Refusals
from zstate.clock import StopEvent
from zstate.driving.commands import CommandReceiver
from zstate.driving.control_loop import ControlLoop, StateName
from zstate.driving.driver import Driver, StopMode
from zstate.driving.driver_state import (
    DriverReport,
    DriverStatePublisher,
    Durations,
    SetpointPublisher,
    check_only_host,
)
from zstate.driving.held_back_signals import held_back_signals
from zstate.driving.limits import Limits
from zstate.driving.messages import DriverState, Mode
from zstate.driving.motion_service import MotionService
from zstate.driving.pace import DevicePace, Realtime, check_pace, control_loop_pace
from zstate.driving.stops import StopLatch
from zstate.driving.supervised_driver import FollowingCheck, SupervisedDriver, check_arguments
from zstate.driving.transit import CommandAdmission, CommandAges
from zstate.errors import Closed
from zstate.model.robot import RobotModel
from zstate.net.at_exit import forked_text
from zstate.net.presence import WriterWatch, announce_reader, local_writer
from zstate.net.queryable import check_timeout
from zstate.net.session import Session
from zstate.nodes.partial_publisher import PartialStatePublisher
from zstate.nodes.publisher import StatePublisher
from zstate.rate import Rate
from zstate.wire.identity import Announcement
from zstate.wire.keys import check_robot
from zstate.wire.registry import as_wire_names, get_wire

if TYPE_CHECKING:
    from zstate.driving.ros2 import Ros2Controller

_RECENT_NS = 1_000_000_000
"""For so long the excess of the newest command is reported."""


class DriverHost(Closeable):
    """Owns ``driver``, publishes its joints as the state of ``robot``, and writes what a ``Commander`` sends.

    ``rate_hz`` is that of the loop; with None the device sets its pace by ``driver.read``, which blocks until
    there is a new reading. Commands and stops wait for it, too: without a reading it returns None after some
    milliseconds. ``realtime`` "fifo" and "spin" are described in ``zstate.rate.control_loop_pace``.

    A command is valid for its own ttl or for ``ttl_s`` [s], which is also the longest that is granted,
    counted from its sending: one that a slow link delivers later is refused, see ``zstate.driving.transit``.
    When the last one has expired, ``on_silence`` "hold"
    brakes the joints and keeps writing that position, "relax" switches their torque off. ``limits`` are those
    of the model by default: positions outside them are refused, and faster motion is slowed; a
    ``Commander.move`` that is too fast is refused. The first setpoint after any change of state is at the
    measured joints, or at the last setpoint where one was written, so that no step is longer than a tick's
    motion at the velocity limits. ``zstate.driving.readings`` has the rules for the readings that count.
    Joints may be commanded in all ``driver.modes``; ``SetpointLimiter`` has the rules for velocities and
    efforts, and for their ends.

    A call of the driver that raises is counted, and the loop continues. After ``faults_allowed`` ticks in a
    row with such a failure the driver is stopped as after silence, and ``run`` raises DriverFault. It is
    stopped, too, when a joint is further than ``following_error`` [rad] or [m] from its setpoint, such as
    without power, when one in mode "velocity" does not move as far as that within a second, when it has power
    and there are no two readings that agree for ``ttl_s``, or no new reading for as long. These stops, like
    those of ``zstate.driving.stop``, are latched: a restarted host stays stopped until a commander releases
    them, see ``zstate.driving.stops``.

    ``wires`` are those on which the joint states are published. With ``ros2_controller``, the name of a
    controller, ROS nodes on the wire "ros2" may command the joints as well, as in ros2_control: by
    ``<ros2_controller>/commands`` (std_msgs/Float64MultiArray), positions, or what ``ros2_mode`` names, of
    all joints in the order of ``driver.joint_names``, each valid for ``ttl_s``; and by
    ``<ros2_controller>/joint_trajectory`` (trajectory_msgs/JointTrajectory), a motion that is valid while its
    publisher is announced: the motion of a node that is frozen or cut off goes on until Zenoh closes the
    link, after 10 s by default and 60 s with the router ``rmw_zenohd``. A ROS node owns nothing: the first
    that sends is the commander until it is silent, and the others are refused. It cannot release a stop.

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
        ros2_mode: Mode = "position",
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
        limits = limits or Limits.of(model, names)
        check_arguments(
            *(driver, limits, names),
            on_silence=on_silence,
            faults_allowed=faults_allowed,
            ros2_mode=ros2_mode if ros2_controller else None,
        )
        oldest_ns = max(self._ttl_ns, round(faults_allowed * 1e9 / (rate_hz or math.inf)))
        following = FollowingCheck(limits, following_error, oldest_ns)
        self._writer = local_writer(secrets.randbits(32), program)
        self._refusals = Refusals(f"command for {self.robot!r}")
        self._programs: BoundedDict[int, str] = BoundedDict()
        """Announced commanders by session."""
        self._lateness = Durations()
        self._rate: Rate | DevicePace | None = None
        self._stop = fork_safe(StopEvent())
        self._is_ending = False
        self._running = fork_safe(threading.RLock())
        """Held by ``run`` and ``close``; a handler of a signal may call ``close`` inside both."""
        self._runner: threading.Thread | None = None
        """The thread inside ``run`` or ``close``."""
        self._pid = os.getpid()
        with ExitStack() as opening:
            check_only_host(session, self.robot)
            self._publisher, self._order = self._open_publisher(session, model, opening)
            self._stops = opening.enter_context(StopLatch(session, self.robot, self._writer, self._refusals))
            setpoints = SetpointPublisher(session, self.robot, names, self._writer)
            opening.enter_context(setpoints)
            controller = None
            if ros2_controller:
                from zstate.driving.ros2 import get_controller  # noqa: PLC0415 - loads the ROS wire

                controller = get_controller(self._wires, self.robot, ros2_controller)
            ages = CommandAges(self._writer.session, self._ttl_ns)
            self._admission = CommandAdmission(ages)
            commands = CommandReceiver(
                *(session, self.robot, names, self._ttl_ns, self._refusals),
                admission=self._admission,
                modes=driver.modes,
                controller=controller,
                ros2_mode=ros2_mode,
            )
            opening.enter_context(commands)
            self._loop = ControlLoop(
                self.robot,
                self._driver,
                self._stops,
                limits=limits,
                following=following,
                ttl_ns=self._ttl_ns,
                on_silence=on_silence,
                faults_allowed=faults_allowed,
                refusals=self._refusals,
                receive=commands.drain,
                publish=self._publish,
                publish_setpoint=setpoints.publish,
                name_of=self._name_of,
                on_change=self._notify,
            )
            self._open_requests(session, ages, controller, opening)
            opening.callback(driver.close)
            driver.open()
            opening.callback(self._driver.disable)
            self._states = opening.enter_context(
                DriverStatePublisher(session, self.robot, self._driver_state)
            )
            self._opened = opening.pop_all()

    def __repr__(self) -> str:
        return f"<DriverHost of {self.robot!r}: {self.state}, {self._driver.written} setpoints>"

    def _open_publisher(
        self, session: Session, model: RobotModel, opening: ExitStack
    ) -> tuple[StatePublisher | PartialStatePublisher, NDArray[np.intp] | None]:
        """The publisher of the driver's joints, and their columns in its order; None if that is the same."""
        wires, program = self._wires, self._writer.program
        if set(self._names) == set(model.joint_names):
            order = [self._names.index(name) for name in model.joint_names]
            publisher = StatePublisher(session, model, self.robot, wires, program=program)
        else:
            order = list(range(len(self._names)))
            publisher = PartialStatePublisher(session, model, self._names, self.robot, wires, program=program)
        is_same = order == list(range(len(order)))
        return opening.enter_context(publisher), None if is_same else np.array(order, dtype=np.intp)

    def _open_requests(
        self, session: Session, ages: CommandAges, controller: Ros2Controller | None, opening: ExitStack
    ) -> None:
        """Receive motions, and watch their senders and those of commands."""
        program = self._writer.program
        for token in announce_reader(session, get_wire("native"), self.robot, ["joint_commands"], program):
            opening.enter_context(token)
        requests = MotionService(
            session,
            self.robot,
            self._writer.session,
            self._loop.motions,
            self._refusals,
            ages=ages,
            controller=controller,
        )
        opening.enter_context(requests)
        opening.enter_context(WriterWatch(session, self.robot, partial(self._on_writer, requests)))
        if controller is not None:
            opening.enter_context(WriterWatch(session, self.robot, self._on_node, controller))

    @property
    def state(self) -> StateName:
        """The present state."""
        return self._loop.state.name

    def report(self) -> DriverReport:
        """The figures until now."""
        return DriverReport(
            None if self._rate is None else self._rate.report(),
            self._lateness.spread(),
            self._driver.reading.spread(),
            self._driver.writing.spread(),
            self._driver.written,
            self._loop.faults,
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
                self._run_ticks(seconds, arrived)
            finally:
                self._loop.finish()
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

    def _run_ticks(self, seconds: float | None, signals: list[int]) -> None:
        with self._pace(self._stop, seconds) as rate:
            self._rate = rate
            self._loop.start()
            try:
                for _ in rate:
                    if self._is_ending or signals:
                        return
                    self._lateness.add(rate.lateness_ns)
                    self._loop.tick(time.time_ns(), rate.step_s)
            except Closed:
                if not self._stop.is_set():
                    raise

    def _publish(
        self,
        positions: NDArray[np.float64],
        velocities: NDArray[np.float64] | None,
        efforts: NDArray[np.float64] | None,
        stamp: int,
    ) -> None:
        order = self._order
        if order is not None:
            positions = positions[order]
            velocities = None if velocities is None else velocities[order]
            efforts = None if efforts is None else efforts[order]
        self._publisher.publish(positions, velocities, efforts, stamp)

    # The state for others, in the thread of the state publisher

    def _notify(self) -> None:
        self._states.notify()

    def _driver_state(self) -> DriverState:
        loop = self._loop
        state, targets, setpoint = loop.state, loop.targets, loop.setpoint
        rate = None if self._rate is None else self._rate.report()
        obeyed = self._stops.current if state.name in ("off", "fault") else loop.obeyed
        motion, progress = loop.motions.underway
        received, now = self._admission.newest, time.monotonic_ns()
        excess = received.excess if received and now - received.arrived < _RECENT_NS else None
        return DriverState(
            time.time_ns(),
            self._writer.session,
            str(self._writer),
            state.name,
            state.reason,
            self._names,
            self._ttl_ns,
            self._name_of(targets.session) if targets.session else "",
            max(0, now - targets.arrived) if targets.session else None,
            setpoint.limited if setpoint is not None else (),
            0.0 if rate is None else rate.rate_hz,
            0 if rate is None else rate.ticks,
            0 if rate is None else rate.skipped,
            loop.faults,
            dict(self._refusals.counts),
            str(self._refusals.newest),
            obeyed.ids,
            motion,
            progress,
            loop.motions.outcomes,
            tuple(sorted(self._driver.modes)),
            now,
            None if received is None else received[:2],
            excess,
        )

    def _name_of(self, session: int) -> str:
        return self._programs.get(session) or f"session {session:x}"

    def _on_writer(self, requests: MotionService, announced: Announcement, alive: bool) -> None:
        if announced.stream == "joint_commands":
            self._keep_name(announced, alive)
            requests.set_commander(announced.writer.session, alive)

    def _on_node(self, announced: Announcement, alive: bool) -> None:
        self._keep_name(announced, alive)
        self._loop.motions.set_announced(announced.writer.session, alive)

    def _keep_name(self, announced: Announcement, alive: bool) -> None:
        session = announced.writer.session
        if alive:  # also for messages about a commander that has gone
            self._programs[session] = str(announced.writer)
        now = time.monotonic_ns()
        self._admission.set_announced(session, alive, now)
        self._loop.targets.set_announced(session, alive, now)
