"""Motions at the host of a driver: requests, their checks, and the one motion that is under way.

A request of an announced commander is planned in a thread of its own: a trajectory from the present setpoint,
or from the measured joints if none is written, which is checked against the limits in closed form. The
control loop adopts it at its next tick. A cancellation does not wait for a plan.

The time of a motion advances at each tick that writes a setpoint, by the time since the last one, and by one
period at most. A tick that was missed or late delays the motion; no step becomes longer by it. A motion is
valid for the host's ttl, unless its commander renews it: then the joints brake, as they do after commands. It
rests until its commander is known to be alive, by a first renewal or by an earlier command that is valid. A
request that has not started a second after its sending is refused: its caller may have given up.

A ROS node does not renew what it sends: its motion is valid while the node is announced, by its liveliness
token. As in ros2_control, points that are due already are left out, and a trajectory without points ends the
motion.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from zstate._util.bounded import BoundedDict
from zstate._util.closeable import Closeable
from zstate._util.refusals import Refusals
from zstate.checks import Floats
from zstate.driving.commands import NO_COLUMNS, NO_POSITIONS, Command, Targets
from zstate.driving.limits import Limits
from zstate.driving.loop_calls import LoopCalls
from zstate.driving.messages import (
    MOTION_POINTS,
    JointTrajectory,
    Mode,
    MotionCancel,
    MotionOutcome,
    MotionReply,
    OutcomeName,
    without_past,
)
from zstate.driving.trajectory import Trajectory
from zstate.driving.transit import REQUEST_TTL_NS, CommandAges, check_waited
from zstate.errors import InvalidInput, MessageError, format_duration
from zstate.net.queryable import Reply
from zstate.net.request_queryable import RequestAnswer, RequestQueryable
from zstate.net.session import Session
from zstate.net.streams import StreamSubscriber
from zstate.wire.keys import MOTION
from zstate.wire.messages import from_block
from zstate.wire.native import decode, encode, encoding_of
from zstate.wire.protocol import SerializedSample

if TYPE_CHECKING:
    from zstate.driving.ros2 import Ros2Controller


_Findings: TypeAlias = tuple[str, ...]

_NAMES_BYTES = 64_000
_MOST_PLANS = 8
"""Requests that wait for their plan. More get no reply, and are repeated by their commanders."""
_MOST_OUTCOMES = 16
_MAX_REASON_LENGTH = 300
_MOST_FINDINGS = 400
_MAX_FINDING_LENGTH = 500
"""Readers refuse large messages; the names in a finding come from the request."""


class Present(NamedTuple):
    """The joints of a driver now, from which a motion starts: (n,) each.

    ``resting`` is where they come to rest if they brake. ``stops`` is another object after each stop and each
    release.
    """

    positions: Floats
    velocities: Floats
    resting: Floats
    stops: object


class PlannedMotion(NamedTuple):
    """A motion that may be driven if it has no ``findings``.

    ``time_s`` of it have passed at ``planned_at`` [ns, monotonic]; negative until its start.
    """

    request: JointTrajectory
    columns: NDArray[np.intp]
    trajectory: Trajectory
    present: Present
    time_s: float
    planned_at: int
    findings: tuple[str, ...]


def plan(request: JointTrajectory, limits: Limits, present: Present, stamp: int) -> PlannedMotion:
    """The motion of ``request`` from the ``present`` joints, at the stamp ``stamp`` [ns].

    One that starts later rests until then. Raises InvalidInput for a request that is no motion at all.
    """
    planned_at = time.monotonic_ns()
    if len(request.names) > len(limits.joint_names):
        raise InvalidInput(
            f"a motion of {len(request.names)} joints, where the driver has {len(limits.joint_names)}: "
            f"{', '.join(limits.joint_names)}"
        )
    part = limits.part(request.names)
    columns = np.array([limits.joint_names.index(name) for name in request.names], dtype=np.intp)
    wait_s = 0.0 if request.start is None else (request.start - stamp) * 1e-9
    times = from_block(request.times) + min(wait_s, 0.0)
    if not times[0] > 0.0:
        raise InvalidInput(
            f"the first point is due {-times[0]:.6g} s before the motion can start: it starts at the present "
            "joints, so give the first point a time above zero, or a later start"
        )
    start = (present.resting if wait_s > 0.0 else present.positions)[columns]
    velocities = (np.zeros(len(limits.joint_names)) if wait_s > 0.0 else present.velocities)[columns]
    points = _after(start, request.points)
    at = np.concatenate([[0.0], times])
    if request.velocities is None:
        if request.accelerations is not None:
            raise InvalidInput("accelerations at the points need velocities as well")
        trajectory = Trajectory(request.names, points, at, start_velocities=velocities)
    else:
        rates = _after(velocities, request.velocities)
        changes = (
            None if request.accelerations is None else _after(np.zeros(len(columns)), request.accelerations)
        )
        trajectory = Trajectory(request.names, points, at, rates, changes)
    allowed = part.containing(start)
    if request.stretch:
        trajectory = trajectory.stretched(allowed)
    time_s, findings = -max(wait_s, 0.0), trajectory.findings(allowed)
    return PlannedMotion(request, columns, trajectory, present, time_s, planned_at, findings)


def _after(first: Floats, block: bytes) -> Floats:
    """The rows of ``block`` after the row ``first``."""
    return np.vstack([first, from_block(block).reshape(-1, len(first))])


@dataclass(slots=True)
class _Underway:
    """The motion under way. ``planned`` is what was written last, at ``written_at`` [ns, monotonic].

    Its time is zero at ``start_at`` [ns, monotonic]. It rests until ``is_renewed``.
    """

    request: JointTrajectory
    columns: NDArray[np.intp]
    trajectory: Trajectory
    time_s: float
    start_at: int
    renewed_at: int
    deadline: int
    is_renewed: bool
    next_time_s: float = 0.0
    next_positions: Floats | None = None
    planned: Floats | None = None
    written_at: int = 0

    @property
    def progress(self) -> float:
        return min(max(self.time_s / self.trajectory.duration_s, 0.0), 1.0)


class MotionExecutor:
    """Makes one motion at a time of the joints of ``limits``, whose targets are ``targets``.

    ``present()`` returns the joints now, for any thread; it raises MessageError if that is not known.
    ``check(session, seq, now)`` raises MessageError if that message of a commander may not move the robot
    now; ``name_of`` is its program; ``on_change`` is called when a motion has started or ended: these three,
    and all methods without another note, are for the thread of the loop.
    """

    def __init__(
        self,
        targets: Targets,
        *,
        limits: Limits,
        modes: Collection[Mode],
        ttl_ns: int,
        present: Callable[[], Present],
        check: Callable[[int, int, int], None],
        name_of: Callable[[int], str],
        on_change: Callable[[], object],
    ) -> None:
        self.limits = limits
        self.modes = modes
        self.ttl_ns = ttl_ns
        self.present = present
        self._targets = targets
        self._check, self._name_of, self._on_change = check, name_of, on_change
        self._nodes: set[int] = set()
        """The sessions of announced ROS nodes."""
        self.calls = LoopCalls()
        """What the loop is to do at its next tick for requests, which are answered by other threads."""
        self._motion: _Underway | None = None
        self._newest: BoundedDict[int, int] = BoundedDict()
        """The number of the last motion that was started, by session."""
        self.outcomes: tuple[MotionOutcome, ...] = ()
        """Those of the last motions, newest last; a new tuple after each. May be read from any thread."""

    def set_announced(self, session: int, alive: bool) -> None:
        """The ROS node of ``session`` is announced, or not any more; for any thread."""
        (self._nodes.add if alive else self._nodes.discard)(session)

    @property
    def nodes(self) -> tuple[int, ...]:
        """The sessions of announced ROS nodes, one for each of their publishers; for any thread."""
        return tuple(self._nodes)

    @property
    def underway(self) -> tuple[tuple[int, int] | None, float]:
        """Session and number of the motion under way, and its progress; for any thread."""
        motion = self._motion
        if motion is None:
            return None, 0.0
        return (motion.request.session, motion.request.seq), motion.progress

    def renew(self, command: Command) -> None:
        """Keep the motion of ``command`` valid; does nothing if it has ended."""
        motion = self._motion
        if motion is None or (command.session, command.motion) != (
            motion.request.session,
            motion.request.seq,
        ):
            return
        self._renew(motion, command)

    def _renew(self, motion: _Underway, command: Command) -> None:
        motion.renewed_at, motion.deadline, motion.is_renewed = command.arrived, command.deadline, True
        self._targets.renew(command, motion.columns)

    def replace(self, command: Command) -> None:
        """End a motion of the joints of ``command``, whose targets are new."""
        if self._motion is not None and np.isin(command.joints, self._motion.columns).any():
            self.finish("replaced", f"by a command of {self._name_of(command.session)}")

    def supervise(self, now: int, measured: Floats, measured_at: int) -> None:
        """End a motion that has no commander any more, that has left its path, or reached its goal."""
        motion = self._motion
        if motion is None:
            return
        if motion.request.session in self._nodes:
            self._renew(motion, self._renewal(motion.request, now))
        if motion.deadline <= now:
            silence = format_duration(now - motion.renewed_at)
            name = self._name_of(motion.request.session)
            self.finish("aborted", f"nothing from {name} for {silence}")
        elif motion.planned is not None and measured_at > motion.written_at:
            self._compare(motion, measured[motion.columns] - motion.planned)

    def _renewal(self, request: JointTrajectory, now: int) -> Command:
        """What a commander sends to keep the motion of ``request`` valid."""
        deadline = now + self.ttl_ns
        head = (request.session, request.seq, NO_COLUMNS, NO_POSITIONS)
        return Command(*head, now, deadline, request.seq)

    def next_target(self, resting: Floats, dt_s: float, now: int) -> tuple[Floats, Floats | None]:
        """Positions and velocities at the end of the next step of ``dt_s``; ``resting`` are other joints'."""
        motion = self._motion
        if motion is None:
            return resting, None
        if motion.time_s < 0.0:  # by the clock: ticks that are missed before the start do not delay it
            motion.time_s = min(0.0, (now - motion.start_at) * 1e-9)
        if not motion.is_renewed:
            motion.next_time_s = motion.time_s
            return resting, None
        motion.next_time_s = motion.time_s + dt_s
        at, rates, _ = motion.trajectory.sample(motion.next_time_s)
        motion.next_positions = at
        positions, velocities = resting.copy(), np.zeros(len(resting))
        positions[motion.columns], velocities[motion.columns] = at, rates
        return positions, velocities

    def written(self, now: int) -> None:
        """The setpoint of ``next_target`` has been written at ``now``."""
        motion = self._motion
        if motion is not None:
            motion.time_s, motion.planned, motion.written_at = motion.next_time_s, motion.next_positions, now

    def finish(self, name: OutcomeName, reason: str, positions: Floats | None = None) -> None:
        """End the motion, if any. Its joints brake, or stay at ``positions`` while they are commanded."""
        motion, self._motion = self._motion, None
        if motion is None:
            return
        with suppress(MessageError):  # nothing moves while the joints are not known
            at = self.present().resting[motion.columns] if positions is None else positions
            self._targets.place(motion.columns, at)
        request = motion.request
        outcome = MotionOutcome(request.session, request.seq, name, reason[:_MAX_REASON_LENGTH])
        self.outcomes = (*self.outcomes, outcome)[-_MOST_OUTCOMES:]
        self._on_change()

    def start(self, planned: PlannedMotion, now: int) -> None:
        """Make the motion ``planned`` in place of the last one. Raises MessageError if it must not start."""
        request = planned.request
        if self.is_known(request):
            return
        self.check_request(request, now)
        present = self.present()
        if present.stops is not planned.present.stops:
            text = "a stop or its release arrived together with the motion; send it again"
            raise MessageError(text, reason="stopped")
        self.finish("replaced", f"by a motion of {self._name_of(request.session)}")
        is_timed = planned.time_s < 0.0 or planned.present.velocities.any()
        passed_s = (now - planned.planned_at) * 1e-9 if is_timed else 0.0
        time_s = planned.time_s + passed_s
        start_at = now - round(time_s * 1e9)
        deadline = now + self.ttl_ns
        is_alive = self._targets.session == request.session and self._targets.is_live(now)
        at = present.resting[planned.columns]
        self._targets.accept(Command(request.session, request.seq, planned.columns, at, now, deadline))
        head = (request, planned.columns, planned.trajectory)
        self._motion = _Underway(*head, time_s, start_at, now, deadline, is_alive)
        self._newest[request.session] = request.seq
        self._on_change()

    def check_request(self, request: JointTrajectory, now: int) -> None:
        """Raise MessageError if ``request`` must not move the robot at ``now``."""
        self._check(request.session, request.seq, now)
        if request.seq <= self._newest.get(request.session, -1):
            raise MessageError(f"the motion {request.seq} comes after a newer one", reason="old")

    def is_known(self, request: JointTrajectory) -> bool:
        """Whether ``request`` is repeated, as without a reply; for any thread."""
        ended = {(outcome.session, outcome.seq) for outcome in self.outcomes}
        return (request.session, request.seq) in {*ended, self.underway[0]}

    def cancel_of(self, session: int) -> None:
        if self._motion is not None and self._motion.request.session == session:
            self.finish("cancelled", f"by {self._name_of(session)}")

    def cancel(self, cancel: MotionCancel) -> None:
        if self.underway[0] == (cancel.session, cancel.motion):
            self.finish("cancelled", f"by {self._name_of(cancel.session)}")

    def _compare(self, motion: _Underway, deviations: Floats) -> None:
        """End ``motion`` if the joints are too far from its path, or, in time, near enough to its goal."""
        errors = np.abs(deviations)
        row = int(errors.argmax())
        request, late_s = motion.request, motion.time_s - motion.trajectory.duration_s
        name = request.names[row]
        text = f"{name!r} is {errors[row]:.3g} {self.limits.units[motion.columns[row]]} from its"
        if errors[row] > request.path_tolerance:
            self.finish("aborted", f"{text} path, more than path_tolerance={request.path_tolerance:g}")
        elif late_s >= 0.0 and errors[row] <= request.goal_tolerance:
            self.finish("reached", "", motion.planned)
        elif late_s > request.goal_time:
            tolerance = f"goal_tolerance={request.goal_tolerance:g}"
            self.finish(
                "aborted", f"{text} goal {request.goal_time:g} s after the end, more than {tolerance}"
            )


class MotionService(Closeable):
    """Takes requests for motions of the driver of ``robot``, for ``executor``.

    ROS nodes send their motions to the ``controller``, if there is one. ``refusals`` counts the others by
    reason.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        host_session: int,
        executor: MotionExecutor,
        refusals: Refusals,
        *,
        ages: CommandAges,
        controller: Ros2Controller | None = None,
    ) -> None:
        self._host_session = host_session
        self._executor = executor
        self._ages = ages
        self._refusals = refusals
        self._most_bytes = 8 * MOTION_POINTS * (1 + 3 * len(executor.limits.joint_names)) + _NAMES_BYTES
        self._commanders: set[int] = set()
        """The sessions of announced commanders."""
        self._planner = ThreadPoolExecutor(1, "zstate planner")
        self._places = threading.BoundedSemaphore(_MOST_PLANS)
        with ExitStack() as opening:
            opening.callback(self._planner.shutdown, wait=False, cancel_futures=True)
            opening.enter_context(RequestQueryable(session, MOTION.key(robot), self._answer))
            if controller is not None:
                on_samples = partial(self._on_ros_samples, controller)
                opening.enter_context(StreamSubscriber(session, controller.trajectories, on_samples))
            self._opened = opening.pop_all()

    def close(self) -> None:
        """Take no further requests."""
        self._opened.close()

    def set_commander(self, session: int, alive: bool) -> None:
        """The commander of ``session`` is announced, or not any more; for any thread."""
        (self._commanders.add if alive else self._commanders.discard)(session)

    # Requests, in the threads of the queryable, of the planner and of the subscriber

    def _answer(self, payload: bytes, encoding: str) -> RequestAnswer:
        """The reply to a request; a cancellation does not wait for the plan of another one."""
        if encoding == encoding_of(MotionCancel):
            return self._reply(self._counted(lambda: self._cancel(payload)) or ())
        if not self._places.acquire(blocking=False):
            self._refusals.count("overrun", f"{_MOST_PLANS} motions wait to be planned")
            return None
        planned = self._planner.submit(self._plan_and_reply, payload, encoding, time.monotonic_ns())
        planned.add_done_callback(lambda _: self._places.release())
        return planned

    def _plan_and_reply(self, payload: bytes, encoding: str, arrived: int) -> Reply | None:
        """The reply to a request for a motion; None if it is not from a commander that is announced."""
        findings = self._counted(lambda: self._take(payload, encoding, arrived))
        return None if findings is None else self._reply(findings)

    def _reply(self, findings: _Findings) -> Reply:
        texts = tuple(text[:_MAX_FINDING_LENGTH] for text in findings[:_MOST_FINDINGS])
        reply = MotionReply(self._host_session, self._executor.ttl_ns, texts)
        return Reply(encode(reply), encoding_of(MotionReply))

    def _on_ros_samples(self, controller: Ros2Controller, samples: list[SerializedSample]) -> None:
        for sample in samples:
            self._counted(lambda sample=sample: self._take_from_ros(controller, sample))

    def _counted(self, take: Callable[[], _Findings | None]) -> _Findings | None:
        """The findings of ``take()``, which are counted, or its error as one."""
        try:
            findings = take()
        except (MessageError, InvalidInput) as error:
            findings = (str(error),)
            self._refusals.count(getattr(error, "reason", "motion"), error)
        else:
            if findings:
                self._refusals.count("motion", "; ".join(findings))
        return findings

    def _cancel(self, payload: bytes) -> _Findings:
        cancel = decode(payload, encoding_of(MotionCancel), MotionCancel)
        self._executor.calls.call(lambda _: self._executor.cancel(cancel))
        return ()

    def _take(self, payload: bytes, encoding: str, arrived: int) -> _Findings | None:
        """Hand the request to the loop, or return the findings; None if its commander is not announced.

        The token of a new commander may arrive after its request, which is repeated without a reply. Raises
        MessageError and InvalidInput.
        """
        if len(payload) > self._most_bytes:
            text = f"a request of {len(payload)} bytes, where motions of this driver take {self._most_bytes}"
            raise MessageError(text, reason="too large")
        request = decode(payload, encoding, JointTrajectory)
        if request.session not in self._commanders:
            text = f"a motion of session {request.session:x}, which is not announced as a commander"
            self._refusals.count("no claim", text)
            return None
        return self._plan_and_start(request, request.stamp, arrived)

    def _take_from_ros(self, controller: Ros2Controller, sample: SerializedSample) -> _Findings:
        """The same for a message of a ROS node."""
        session, sent, request = controller.decode_trajectory(sample)
        if request is None:
            self._executor.calls.call(lambda _: self._executor.cancel_of(session))
            return ()
        arrived = time.monotonic_ns()
        return self._plan_and_start(without_past(request, time.time_ns()), sent, arrived)

    def _plan_and_start(self, request: JointTrajectory, sent: int, arrived: int) -> _Findings:
        """Plan and start what was ``sent`` [ns, clock of its sender], and ``arrived`` [ns, monotonic]."""
        if self._executor.is_known(request):
            return ()
        excess = self._ages.excess(request.session, sent, arrived, request.echo)

        def start(now: int) -> None:
            check_in_time(now)
            self._executor.start(planned, now)

        def check_in_time(now: int) -> None:
            waited = excess + max(0, now - arrived)
            check_waited(waited, REQUEST_TTL_NS, has_echo=request.echo is not None)

        check_in_time(arrived)
        if "position" not in (modes := self._executor.modes):
            has = " and ".join(sorted(modes))
            raise MessageError(f"a motion needs mode position; this driver has mode {has}", reason="mode")
        self._check_in_loop(request)  # first: to plan takes time from the control loop
        planned = plan(request, self._executor.limits, self._executor.present(), time.time_ns())
        if not planned.findings:
            self._executor.calls.call(start)
        return planned.findings

    def _check_in_loop(self, request: JointTrajectory) -> None:
        """Raise MessageError if ``request`` must not start now, or if the joints are not known."""
        try:
            self._executor.calls.call(lambda now: self._executor.check_request(request, now))
        except MessageError:
            self._executor.present()  # its reason is the better one
            raise
