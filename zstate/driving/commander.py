"""The one program that commands a robot's driver: by setpoints, and by motions through timed points."""

from __future__ import annotations

import logging
import math
import secrets
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from typing import NamedTuple

from numpy.typing import ArrayLike

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe, fork_safe_lock
from zstate.checks import real_numbers
from zstate.driving.commands import check_named
from zstate.driving.driver_state import SILENT_S, cached_state
from zstate.driving.errors import MotionRefused
from zstate.driving.messages import (
    GOAL_TIME_S,
    GOAL_TOLERANCE,
    PATH_TOLERANCE,
    DriverState,
    JointCommand,
    JointTrajectory,
    Mode,
    MotionCancel,
    MotionReply,
    Release,
    StopIds,
    state_text,
    with_echo,
)
from zstate.driving.motion import Motion, Points, check_by_joint, rows_block
from zstate.driving.transit import REQUEST_TTL_NS, CommandWindow, DriverClock
from zstate.errors import Closed, InvalidInput, MessageError, Unreachable, ZStateError, format_duration
from zstate.net.latched import LatchedSubscriber
from zstate.net.ownership import WriterClaim
from zstate.net.presence import local_writer
from zstate.net.queryable import check_timeout, query
from zstate.net.session import Session
from zstate.net.streams import KeyPublisher
from zstate.net.writer import WireWriter
from zstate.wire.identity import Announcement
from zstate.wire.keys import MOTION, RELEASE, check_robot, stream_key
from zstate.wire.messages import order_digest, to_block
from zstate.wire.native import decode, encode, encoding_of
from zstate.wire.protocol import SerializedSample
from zstate.wire.registry import get_wire

_LOG = logging.getLogger("zstate")

_RELEASE_PERIOD_S = 0.1

_SILENT_TTLS = 10
_SHORTEST_SILENCE_S = 1.0
"""A motion ends for its commander without a state of the driver for that many ttls, and that long."""

_REPLY_WITHIN_S = 5.0
_REQUEST_PERIOD_S = 0.05
"""A session that has just connected has not discovered the queryable of the driver yet."""

_SECONDS = 1.0
"""A motion without times takes so long, or longer."""

_LONGEST_UNSENT_NS = 250_000_000
"""A command for a driver that is not known yet waits for so long, unless it has a ttl of its own."""

_MODES: tuple[Mode, ...] = ("position", "velocity", "effort")


class _Unsent(NamedTuple):
    """A command that was given at ``stamp`` [ns], at the monotonic instant ``given_at``."""

    stamp: int
    given_at: int
    names: tuple[str, ...]
    blocks: tuple[bytes | None, ...] = (None, None, None)
    ttl: int = 0
    motion: int | None = None


class Commander(Closeable):
    """Sends setpoints and motions to the driver of ``robot``; a robot has one commander at a time.

    SecondWriter, which names the first, is raised if another commander is active, and by ``send`` if both
    opened at once. ``problem`` is why the driver does not obey. ``program`` is this commander's name for
    others; default: the script's name. A context manager; safe from any thread. Not a safety-rated channel.
    """

    def __init__(self, session: Session, robot: str, *, program: str = "") -> None:
        self.robot = check_robot(robot)
        identity = local_writer(secrets.randbits(32), program)
        self._session_id = identity.session
        self._session = session
        self._seq = 0
        self._closed = False
        self._motions: list[Motion] = []
        """Those that have not ended."""
        self._is_closing = fork_safe(threading.Event())
        self._lock = fork_safe_lock()
        self._state: tuple[DriverState, float] | None = None
        self._unsent: dict[tuple[frozenset[str], int | None], _Unsent] = {}
        """The newest commands that wait for their turn, by joints and motion, oldest first."""
        self._window, self._driver_clock = CommandWindow(), DriverClock()
        self._refused = (0, 0)
        """The session of the driver's host, and its count of refused commands."""
        self._refused_at = -math.inf
        """When that count has grown [s, monotonic]."""
        self._silent_since = time.monotonic()
        self._has_logged = False
        self._has_changed = fork_safe(threading.Condition())
        with ExitStack() as opening:
            announced = Announcement(self.robot, "joint_commands", identity)
            self._claim = opening.enter_context(WriterClaim(session, [announced]))
            writer = opening.enter_context(WireWriter(session, get_wire("native"), self.robot, identity))
            self._writer = writer.open_stream("joint_commands")
            self._claim.confirm()
            key = RELEASE.key(self.robot, identity.identity)
            self._releases = opening.enter_context(KeyPublisher(session, key, encoding_of(Release)))
            opening.enter_context(
                LatchedSubscriber(session, stream_key(self.robot, "driver"), self._on_state)
            )
            self._opened = opening.pop_all()

    def __repr__(self) -> str:
        closed = ", closed" if self._closed else ""
        return f"<Commander of {self.robot!r}: {self._seq} commands{closed}>"

    @property
    def driver(self) -> DriverState | None:
        """The newest state of the driver; None if none has arrived for half a second."""
        newest = self._state
        if newest is None or time.monotonic() - newest[1] > SILENT_S:
            return None
        return newest[0]

    @property
    def problem(self) -> str:
        """Why the driver does not do what is sent, as far as is known; empty if it does.

        It is silent, and nothing is sent; or stopped, at fault or off; it has refused commands of any program
        within the last half second; or its link carries fewer commands than are sent.
        """
        state = self.driver
        if state is None:
            return f"the driver of {self.robot!r} is silent: nothing is sent until it publishes its state"
        if state.state in ("stopped", "fault", "off"):
            return state_text(state)
        if time.monotonic() - self._refused_at < SILENT_S:
            return f"the driver of {self.robot!r} refuses commands: {state.last_refusal}"
        waiting_ns = self._window.waiting_ns(time.monotonic_ns())
        if waiting_ns > max(state.ttl, SILENT_S * 1e9):
            return (
                f"the driver of {self.robot!r} has not confirmed a command of {format_duration(waiting_ns)} "
                "ago: the link is slow, and newer commands replace those that wait for it"
            )
        return ""

    def wait_for_driver(self, timeout_s: float = 2.0) -> DriverState:
        """The state of the driver, once it is known. Raises Unreachable after ``timeout_s`` [s]."""
        check_timeout(timeout_s)
        with self._has_changed:
            state = self._has_changed.wait_for(lambda: self.driver, timeout_s)
        if state is None:
            raise Unreachable(
                f"no driver of {self.robot!r} has published its state within {timeout_s:g} s; start it "
                "first: `zstate drive`, or a program with a DriverHost",
                endpoints=(),
            )
        return state

    def send(
        self,
        positions: Mapping[str, float] | None = None,
        ttl_s: float | None = None,
        *,
        velocities: Mapping[str, float] | None = None,
        efforts: Mapping[str, float] | None = None,
    ) -> None:
        """Send ``positions`` [rad] or [m], ``velocities`` per s, or ``efforts`` [Nm] or [N]; returns at once.

        They are by joint. Each joint has one of them; others keep their commands. They are valid for
        ``ttl_s`` [s], by default and at most for the driver's own limit: then the driver holds the joints,
        wheels at zero velocity.
        Send again before. The driver refuses positions outside limits, and modes that it does not have, and
        exceeds no limit of position, velocity, acceleration and effort: a joint in mode "velocity" arrives at
        its position limit at rest, one in mode "effort" that leaves its range or exceeds its velocity limit
        is held, see ``SetpointLimiter``. ``problem`` is why it does not obey, ``driver`` has the counts.

        On a link that is slower than the commands, and while the driver is silent, the newest command of the
        same joints waits in place of older ones, for its ttl at most.

        Raises InvalidInput for no joints, for numbers that are not finite, for a joint with several of them,
        and, if the driver's state is known, for an unknown joint, a mode that it does not have, and a ttl
        that is too long; SecondWriter; and Closed. If it raises, nothing was sent.
        """
        numbers: dict[Mode, dict[str, float]] = {}
        for mode, values in zip(_MODES, (positions, velocities, efforts), strict=True):
            if values is not None and (by_joint := _by_joint(values, mode)):
                numbers[mode] = by_joint
        check_named(numbers)
        if ttl_s is not None:
            check_timeout(ttl_s)
        ttl = 0 if ttl_s is None else max(1, round(ttl_s * 1e9))
        names = tuple(name for values in numbers.values() for name in values)
        self._check_against_driver(names, tuple(numbers), ttl)
        blocks = tuple(
            to_block([values.get(name, math.nan) for name in names])
            if (values := numbers.get(mode))
            else None
            for mode in _MODES
        )
        self._offer(names, blocks, ttl)

    def move(
        self,
        points: Points | Mapping[str, float],
        times_s: Sequence[float] | ArrayLike | None = None,
        *,
        velocities: Points | None = None,
        accelerations: Points | None = None,
        start: int | None = None,
        stretch: bool = False,
        path_tolerance: float = PATH_TOLERANCE,
        goal_tolerance: float = GOAL_TOLERANCE,
        goal_time_s: float = GOAL_TIME_S,
    ) -> Motion:
        """Move joints through ``points``, positions [rad] or [m] by joint, at ``times_s`` [s], (T,).

        Without times each joint has one position, at which it arrives after a second, or as much later as the
        limits need. The motion starts at the present joints, at once or at the stamp ``start`` [ns]. Other
        joints rest, or follow ``send``. See ``Trajectory`` for ``velocities`` and ``accelerations``, by joint
        as well. The driver checks the whole motion against its limits before it accepts it; with ``stretch``
        it slows it to fit instead.

        The motion ends as "aborted" if a joint is more than ``path_tolerance`` [rad] or [m] from the path, or
        more than ``goal_tolerance`` from the last point ``goal_time_s`` [s] after its time. This commander
        renews it in a thread, until its end: then, and if that falls silent, the driver does what it does
        after commands. A robot has one motion at a time; a new one, or a ``send`` for one of its joints,
        replaces it.

        Raises MotionRefused with all ``findings``, also if the request has waited for a second on its way;
        InvalidInput for unusable numbers; Unreachable if no driver has replied within 5 s, or a second later
        on a slow link: then it does not start any more; SecondWriter; and Closed.
        """
        if times_s is None:
            points, times_s, stretch = _one_point(points), [_SECONDS], True
        times = real_numbers(times_s, "times_s")
        if times.ndim != 1:
            example = "; such as times_s=[2.0] for one point" if times.ndim == 0 else ""
            raise InvalidInput(f"times_s has one number for each point{example}; got {times_s!r}")
        check_by_joint(points, "points")
        names = tuple(points)
        rates, changes = (
            None if rows is None else rows_block(rows, names, times, what)
            for rows, what in ((velocities, "velocities"), (accelerations, "accelerations"))
        )
        blocks = (to_block(times), rows_block(points, names, times, "points"), rates, changes)
        tolerances = (float(path_tolerance), float(goal_tolerance), float(goal_time_s))
        self._check_against_driver(names, ("position",), 0)
        with self._lock:
            head = self._next_head()
        request = JointTrajectory(*head, names, *blocks, start, stretch, *tolerances)
        reply = self._request(request)
        if reply.findings:
            raise MotionRefused(self.robot, reply.findings)
        return self._started(request.seq, reply)

    def release(self, timeout_s: float = 2.0) -> DriverState:
        """Release the stops that the driver has now, and return its state after that.

        The driver moves again with the next ``send`` of this commander, from where the joints are then, also
        if another one has released the stops already. A stop that arrives at the same time stays. Raises
        Unreachable if the driver has not confirmed it within ``timeout_s`` [s]; SecondWriter; and Closed.
        """
        deadline = time.monotonic() + check_timeout(timeout_s)
        # Not the newest state that has arrived here, which may be from before a stop that is confirmed.
        known = cached_state(self._session, self.robot, timeout_s) or self.wait_for_driver(timeout_s)
        while True:
            self._put_release(known.stops)
            with self._has_changed:
                self._has_changed.wait(_RELEASE_PERIOD_S)
            state = self.wait_for_driver(timeout_s)
            is_new = state.stamp >= known.stamp and not set(known.stops).intersection(state.stops)
            if is_new and (state.stops or state.state != "stopped"):  # not between the two
                if known.stops and not state.stops:
                    # Another one may have released them before; then a release that names none counts.
                    self._put_release(())
                return state
            if time.monotonic() > deadline:
                raise Unreachable(
                    f"the driver of {self.robot!r} has not confirmed the release within {timeout_s:g} s; may "
                    "this program command it (`zstate acl --commander`)?",
                    endpoints=(),
                )

    def _put_release(self, stops: StopIds) -> None:
        with self._lock:
            self._releases.put(encode(Release(*self._next_head(), stops)))

    def close(self) -> None:
        """Send no more; the driver holds once the last command has expired, also during a motion.

        A second call does nothing.
        """
        with self._lock, suppress(ZStateError):
            self._send_unsent(is_last=True)
        with self._lock:
            self._closed = True
        self._is_closing.set()
        self._opened.close()

    def _check(self) -> None:
        """Raise SecondWriter and Closed."""
        if self._closed:
            raise Closed(f"the commander of {self.robot!r} is closed")
        self._claim.check()

    def _next_head(self) -> tuple[int, int, int]:
        """Stamp, number and session of the next message; with the lock. Raises SecondWriter and Closed."""
        self._check()
        self._seq += 1
        return time.time_ns(), self._seq - 1, self._session_id

    def _offer(
        self,
        names: tuple[str, ...] = (),
        blocks: tuple[bytes | None, ...] = (None, None, None),
        ttl: int = 0,
        motion: int | None = None,
    ) -> None:
        """Send a command, or keep it in place of those of its joints that wait.

        Raises SecondWriter and Closed.
        """
        with self._lock:
            self._check()
            joints = frozenset(names)
            for key in [key for key in self._unsent if key[1] == motion and key[0] <= joints]:
                del self._unsent[key]
            command = _Unsent(time.time_ns(), time.monotonic_ns(), names, blocks, ttl, motion)
            self._unsent[joints, motion] = command
            self._send_unsent()

    def _send_unsent(self, *, is_last: bool = False) -> None:
        """Send what waits and is still valid, as much as the link takes, or all; with the lock."""
        state, now = self.driver, time.monotonic_ns()
        if state is None:
            self._log_silence()
        newest = self._state
        longest = _LONGEST_UNSENT_NS if newest is None else newest[0].ttl
        for key, command in list(self._unsent.items()):
            if now - command.given_at >= (command.ttl or longest):
                del self._unsent[key]
            elif state is not None and (is_last or self._window.has_room(now)):
                del self._unsent[key]
                self._write(command, now)

    def _write(self, command: _Unsent, now: int) -> None:
        _, seq, session = self._next_head()
        message = JointCommand(
            *(command.stamp, seq, session, order_digest(command.names)),
            *command.blocks,
            names=command.names,
            ttl=command.ttl,
            motion=command.motion,
            echo=self._driver_clock.at(command.given_at),
        )
        self._window.sent(seq, now)
        self._writer.write(encode(message))

    def _log_silence(self) -> None:
        """Log once for each silence of the driver that nothing is sent; with the lock."""
        if not self._has_logged and time.monotonic() - self._silent_since > SILENT_S:
            self._has_logged = True
            _LOG.warning("%s", self.problem, extra={"event": "silent", "robot": self.robot})

    def _request(self, message: JointTrajectory | MotionCancel) -> MotionReply:
        """The reply of the driver. A request that has not reached it is repeated.

        So is a cancellation that the driver has not carried out. The last one is waited for until the driver
        would refuse it, so that nothing starts after that.
        """
        key, deadline = MOTION.key(self.robot), time.monotonic() + _REPLY_WITHIN_S
        refused = ""
        while (left_s := deadline - time.monotonic()) > 0.0:
            sent = self._with_echo(message)
            timeout_s = left_s + REQUEST_TTL_NS * 1e-9
            for answer in () if sent is None else self._replies(key, sent, timeout_s):
                if not (answer.findings and _is_repeated(sent, answer)):
                    return answer
                refused = "; ".join(answer.findings)
            if self._is_closing.wait(_REQUEST_PERIOD_S):
                raise Closed(f"the commander of {self.robot!r} is closed")
        if refused and isinstance(message, JointTrajectory):
            raise MotionRefused(self.robot, (refused,))
        if refused:
            raise Unreachable(
                f"the driver of {self.robot!r} has not cancelled the motion within {_REPLY_WITHIN_S:g} s: "
                f"{refused}; it brakes when its ttl has passed without a renewal",
                endpoints=(),
            )
        raise Unreachable(
            f"no driver of {self.robot!r} has replied within {_REPLY_WITHIN_S:g} s; is it running, and may "
            "this program command it (`zstate acl --commander`)?",
            endpoints=(),
        )

    def _with_echo(self, message: JointTrajectory | MotionCancel) -> JointTrajectory | MotionCancel | None:
        """``message`` as it is sent now; None for a motion while the driver is not known."""
        if isinstance(message, MotionCancel):
            return message
        with self._lock:
            if not self._driver_clock.session:
                return None
            return with_echo(message, *self._driver_clock.at(time.monotonic_ns()))

    def _replies(
        self, key: str, message: JointTrajectory | MotionCancel, timeout_s: float
    ) -> list[MotionReply]:
        payload, encoding = encode(message), encoding_of(type(message))
        answers: list[MotionReply] = []
        for reply in query(self._session.zenoh, key, timeout_s, payload=payload, encoding=encoding):
            if reply.ok is not None:
                with suppress(MessageError):
                    payload_bytes = reply.ok.payload.to_bytes()
                    answers.append(decode(payload_bytes, str(reply.ok.encoding), MotionReply))
        return answers

    def _started(self, number: int, reply: MotionReply) -> Motion:
        """The motion with that number, which a thread renews until it has ended."""
        motion = Motion(self.robot, (self._session_id, number), reply.session, lambda: self._cancel(number))
        with self._has_changed:
            self._motions.append(motion)
            if self._state is not None and self._state[0].session == reply.session:
                motion.update(self._state[0])
        thread = threading.Thread(
            target=self._renew,
            args=(motion, number, reply.ttl),
            name="zstate motion renewal",
            daemon=True,
        )
        thread.start()
        return motion

    def _renew(self, motion: Motion, number: int, ttl: int) -> None:
        started_at = time.monotonic()
        silent_s = max(_SILENT_TTLS * ttl * 1e-9, _SHORTEST_SILENCE_S)
        with suppress(ZStateError):  # without renewals the motion ends
            while motion.outcome is None and not self._is_closing.is_set():
                if not motion.is_cancelled:
                    self._offer(motion=number)
                self._is_closing.wait(ttl / 3e9)
                state_at = started_at if self._state is None else max(started_at, self._state[1])
                if time.monotonic() - state_at > silent_s:
                    motion.abort(f"the driver is silent for more than {silent_s:g} s")

    def _cancel(self, number: int) -> None:
        with self._lock:
            head = self._next_head()
        self._request(MotionCancel(*head, number))

    def _check_against_driver(self, names: Sequence[str], modes: Sequence[Mode], ttl: int) -> None:
        state = self.driver
        if state is None:
            return
        if other := set(modes).difference(state.modes):
            raise InvalidInput(
                f"the joints of {self.robot!r} are commanded in mode {' or '.join(state.modes)}, which its "
                f"driver has; mode {' and '.join(sorted(other))} is not one of them"
            )
        unknown = [name for name in names if name not in state.joint_names]
        if unknown:
            raise InvalidInput(
                f"the driver of {self.robot!r} has no joint {', '.join(map(repr, unknown))}; it has "
                f"{', '.join(state.joint_names)}"
            )
        if ttl > state.ttl:
            raise InvalidInput(
                f"a ttl of {format_duration(ttl)} is longer than {format_duration(state.ttl)}, which the "
                f"driver of {self.robot!r} grants at most; send again before it ends"
            )

    def _on_state(self, sample: SerializedSample) -> None:
        arrived = time.monotonic_ns()
        with suppress(MessageError):
            state = decode(sample.payload, sample.encoding, DriverState)
            with self._lock:  # first: what is sent once the state is known has its echo
                self._take_confirmation(state, arrived)
            with self._has_changed:
                self._state = (state, time.monotonic())
                for motion in self._motions:
                    motion.update(state)
                self._motions = [motion for motion in self._motions if motion.outcome is None]
                self._has_changed.notify_all()
            with self._lock, suppress(ZStateError):  # the next call raises it
                if self._unsent and not self._closed:
                    self._send_unsent()

    def _take_confirmation(self, state: DriverState, arrived: int) -> None:
        """Take what ``state`` reports of commands; with the lock."""
        self._silent_since, self._has_logged = time.monotonic(), False
        refused, self._refused = self._refused, (state.session, sum(state.refused.values()))
        if refused[0] == state.session and self._refused[1] > refused[1]:
            self._refused_at = time.monotonic()
        if self._driver_clock.session != state.session:
            self._window = CommandWindow()  # a host that has restarted confirms nothing from before
        self._driver_clock.update(state, arrived)
        received = state.received
        confirmed = received[1] if received is not None and received[0] == self._session_id else -1
        self._window.update(confirmed, state.transit_excess or 0, state.ttl, arrived)


def _is_repeated(sent: JointTrajectory | MotionCancel | None, answer: MotionReply) -> bool:
    """Whether a request that was refused is sent again: a cancellation, or a motion for another host.

    A host that has restarted refuses the echo of the last one, until its own state has arrived here.
    """
    return not (isinstance(sent, JointTrajectory) and sent.echo and sent.echo[0] == answer.session)


def _by_joint(values: Mapping[str, float], mode: Mode) -> dict[str, float]:
    """The numbers of joints. Raises InvalidInput for anything else."""
    check_by_joint(values, "commands")
    try:
        return {name: float(value) for name, value in values.items()}
    except (TypeError, ValueError) as error:
        raise InvalidInput(f"a {mode} of a joint is a number: {error}") from None


def _one_point(points: Points | Mapping[str, float]) -> Points:
    """One position for each joint as points. Raises InvalidInput for several of them."""
    check_by_joint(points, "points")
    columns = {name: real_numbers(values, f"points of {name!r}") for name, values in points.items()}
    if several := [name for name, column in columns.items() if column.size != 1]:
        raise InvalidInput(
            f"a motion without times_s has one position for each joint, and {several[0]!r} has "
            f"{columns[several[0]].size}; give the time of each point in seconds: times_s=[1.0, 2.0]"
        )
    return {name: column.reshape(1) for name, column in columns.items()}
