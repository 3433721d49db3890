"""Simulated time: a publisher, and a clock that follows the published time."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping, Sequence

from zstate._util.bounded import BoundedDict
from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe, fork_safe_lock
from zstate._util.refusals import Refusals
from zstate.clock import SET_BACK_NS, SIMULATED, Clock, MonotonicClock, check_stamp, wait_interruptible
from zstate.errors import Closed, MessageError, NoClock, format_duration
from zstate.net.session import Session
from zstate.net.streams import StreamSubscriber
from zstate.nodes.robot_writer import RobotWriter
from zstate.wire.messages import ClockMessage
from zstate.wire.protocol import SerializedSample
from zstate.wire.registry import get_wire
from zstate.wire.ros2.topics import SHARED

_LOG = logging.getLogger("zstate")

# After this long without a stamp from the newest publisher an older one is followed again.
_SILENT_NS = 2_000_000_000

# A wait cannot be notified by its stop event, so it checks it this often in real time.
_STOP_WITHIN_S = 0.05


class ClockPublisher(Closeable):
    """Publishes simulated time on zstate/clock, or on /clock of a ROS wire.

    Time that goes back is a new start of the clock, and needs a new publisher. A context manager; safe
    from any thread.
    """

    def __init__(self, session: Session, wires: str | Sequence[str] = ("native",)) -> None:
        # Time belongs to no robot; on a ROS wire its topic is that of the shared namespace.
        self._out = out = RobotWriter(session, SHARED, wires)
        out.title = "the clock's publisher"
        with out.opening():
            for wire in out.open_wires():
                out.open_stream(wire, "clock")

    def publish(self, stamp: int) -> None:
        """Publish the time ``stamp`` [ns]. Raises Closed, and InvalidInput if a wire cannot represent it."""
        out = self._out
        with out.lock:
            out.check()
            out.send(ClockMessage(check_stamp(stamp), out.seq, out.session_id))

    def close(self) -> None:
        """Stop publishing. A second call does nothing."""
        self._out.close()


class SimulatedClock(Closeable):
    """The newest time received on ``zstate/clock``, or on ``/clock`` of a ROS wire.

    It stands still between messages, and may jump. The first call of ``now`` waits until a time is
    received, for at most ``timeout_s``. The newest of several publishers is followed; messages of the
    others are counted in ``refused``. A forked process receives nothing: the clock is closed there. A context
    manager; safe from any thread.
    """

    domain = SIMULATED

    def __init__(self, session: Session, wire: str = "native", *, timeout_s: float = 5.0) -> None:
        self.timeout_s = timeout_s
        self.epoch = 0
        """How often the time went back."""
        self._wire = get_wire(wire)
        self._now: int | None = None
        self._session: int | None = None
        self._ended_sessions: BoundedDict[int, None] = BoundedDict()
        self._received_at = 0
        self._real_time: Clock = MonotonicClock()
        self._has_time = fork_safe(threading.Event())
        self._lock = fork_safe_lock()
        self._waits: list[tuple[int, threading.Event]] = []
        self._is_open = True
        self.key = self._wire.expression(SHARED, "clock")
        """The key that it subscribes to."""
        self._refusals = Refusals(self.key)
        self.refused: Mapping[str, int] = self._refusals.counts
        self._subscriber = StreamSubscriber(session, self.key, self._on_samples)
        fork_safe(self)

    def _at_fork_reinit(self) -> None:
        self._is_open = False

    def now(self) -> int:
        """The newest stamp [ns]. Raises NoClock if none is received within ``timeout_s``, and Closed."""
        now = self._now
        return self.wait(self.timeout_s) if now is None or not self._is_open else now

    def wait(self, timeout_s: float | None = None) -> int:
        """The newest stamp [ns], waiting for the first; None waits for ever. Raises NoClock and Closed."""
        if self._is_open and not wait_interruptible(self._has_time, timeout_s):
            text = f"no time was received on {self.key!r} for {timeout_s:g} s"
            raise NoClock(f"{text}; start the simulation or `zstate replay`", waited_s=timeout_s or 0.0)
        now = self._now
        if not self._is_open or now is None:
            last = "before it received a time" if now is None else f"after it received {now} ns"
            raise Closed(f"the simulated clock was closed {last}; open one in this process")
        return now

    def wait_until(self, stamp: int, stop: threading.Event) -> bool:
        """Block until ``stamp``, or until ``stop`` is set or the clock closed. True when it was reached.

        Also true as soon as the time goes back by more than a tenth of a second.
        """
        reached = threading.Event()
        with self._lock:
            if stop.is_set() or not self._is_open:
                return False
            if self._now is not None and self._now >= stamp:
                return True
            self._waits.append((stamp, reached))
        # The message with the time wakes this; the interval is for ``stop`` only.
        while not reached.wait(_STOP_WITHIN_S):
            if stop.is_set():
                with self._lock:
                    self._waits = [wait for wait in self._waits if wait[1] is not reached]
                return False
        return self._is_open and not stop.is_set()

    def close(self) -> None:
        """Unsubscribe, and end all waits. A second call does nothing."""
        self._subscriber.close()
        with self._lock:
            self._is_open = False
            self._wake(lambda _: True)
        self._has_time.set()

    def _on_samples(self, arrivals: list[SerializedSample]) -> None:
        for arrival in arrivals:
            try:
                (message,) = self._wire.decode("clock", arrival, SHARED)
            except MessageError as error:
                self._refusals.count(error.reason, error)
                continue
            assert isinstance(message, ClockMessage)
            if self._follows(message.session):
                self._set(message.stamp)
            else:
                text = f"another publisher of the time is active: {message.session:08x}"
                self._refusals.count("second clock", text)

    def _follows(self, session: int) -> bool:
        """Whether ``session`` is the one to follow: the newest to appear, while it is active."""
        now = self._real_time.now()
        if session in self._ended_sessions and now - self._received_at < _SILENT_NS:
            return False
        if session != self._session:
            if self._session is not None:
                self._ended_sessions[self._session] = None
            self._ended_sessions.pop(session, None)
            self._session = session
        self._received_at = now
        return True

    def _set(self, stamp: int) -> None:
        before = stamp if self._now is None else self._now
        went_back = before - stamp > SET_BACK_NS
        if went_back:
            self.epoch += 1
            if self.epoch == 1:
                text = "the time on %r went back by %s; further jumps are only counted, in epoch"
                _LOG.warning(text, self.key, format_duration(before - stamp))
        with self._lock:
            self._now = stamp
            self._wake(lambda awaited: went_back or awaited <= stamp)
        self._has_time.set()

    def _wake(self, is_due: Callable[[int], bool]) -> None:
        waits, self._waits = self._waits, []
        for wait in waits:
            if is_due(wait[0]):
                wait[1].set()
            else:
                self._waits.append(wait)
