"""SimulatedClock: the time that a simulation or a replay tells."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

from zstate.clock import SIMULATED, wait_in_slices
from zstate.closing import Closing
from zstate.errors import Closed, MessageError, NoClock, duration_text
from zstate.locks import new_lock
from zstate.net.session import Session
from zstate.net.streams import StreamSubscriber
from zstate.net.wires import wire_named
from zstate.wire.messages import Clock
from zstate.wire.ros2.topics import SHARED
from zstate.wire.wire import Arrival

_LOG = logging.getLogger("zstate")

SET_BACK_NS = 100_000_000
"""A step back by more ends waits; whoever waits through a smaller one waits a little longer."""

# Of two that tell the time the older one may go on when the newer has been silent for so long.
_SILENT_S = 2.0

# The event that ends a wait cannot notify it, so it is looked at this often in real time.
_STOP_WITHIN_S = 0.05


class SimulatedClock(Closing):
    """The newest time heard on ``zstate/clock``, or on ``/clock`` of a ROS wire.

    It stands still while nothing new is said, and may jump. The first call of ``now`` waits until
    somebody tells the time, for at most ``timeout_s``. Of several that do the newest is followed, the
    others are counted in ``refused``. A context manager; safe from any thread.
    """

    domain = SIMULATED

    def __init__(self, session: Session, wire: str = "native", *, timeout_s: float = 5.0) -> None:
        self.timeout_s = timeout_s
        self.epoch = 0
        """How often the time went back."""
        self.refused: dict[str, int] = {}
        self._wire = wire_named(wire)
        self._now: int | None = None
        self._session: int | None = None
        self._ended_sessions: set[int] = set()
        self._heard_s = 0.0
        self._has_begun = threading.Event()
        self._lock = new_lock()
        self._waits: list[tuple[int, threading.Event]] = []
        self._is_open = True
        self.key = self._wire.expression(SHARED, "clock")
        """Where it listens."""
        self._subscriber = StreamSubscriber(session, self.key, self._take)

    def now(self) -> int:
        """The newest stamp [ns]. Raises NoClock when none has come within ``timeout_s``, and Closed."""
        now = self._now
        return self.wait(self.timeout_s) if now is None else now

    def wait(self, timeout_s: float | None = None) -> int:
        """The time, once somebody tells it: None waits for ever. Raises NoClock and Closed."""
        if not wait_in_slices(self._has_begun, timeout_s):
            raise NoClock(
                f"nobody has told the time on {self.key!r} for {timeout_s:g} s; is the simulation or "
                "`zstate replay` running?",
                waited_s=timeout_s or 0.0,
            )
        if self._now is None:
            raise Closed("the simulated clock was closed before it heard the time")
        return self._now

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
        # Woken by the message that brings the time; the look in between is at ``stop`` only.
        while not reached.wait(_STOP_WITHIN_S):
            if stop.is_set():
                with self._lock:
                    self._waits = [wait for wait in self._waits if wait[1] is not reached]
                return False
        return self._is_open and not stop.is_set()

    def close(self) -> None:
        """Hear no more; waits end. A second call does nothing."""
        self._subscriber.close()
        with self._lock:
            self._is_open = False
            self._wake(lambda _: True)
        self._has_begun.set()

    def _take(self, arrivals: list[Arrival]) -> None:
        for arrival in arrivals:
            try:
                (told,) = self._wire.decode("clock", arrival, SHARED)
            except MessageError as error:
                self._refuse(error.reason, str(error))
                continue
            assert isinstance(told, Clock)
            if self._follows(told.session):
                self._tell(told.stamp)
            else:
                self._refuse("second clock", f"somebody else tells the time, too: {told.session:08x}")

    def _follows(self, session: int) -> bool:
        """Whether a time counts: of those who tell it the newest to appear, as long as it speaks."""
        now_s = time.monotonic()
        if session in self._ended_sessions and now_s - self._heard_s < _SILENT_S:
            return False
        if session != self._session:
            if self._session is not None:
                self._ended_sessions.add(self._session)
            self._ended_sessions.discard(session)
            self._session = session
        self._heard_s = now_s
        return True

    def _tell(self, stamp: int) -> None:
        before = stamp if self._now is None else self._now
        went_back = before - stamp > SET_BACK_NS
        if went_back:
            self.epoch += 1
            if self.epoch == 1:
                text = "the time told on %r went back by %s; further jumps are only counted, in epoch"
                _LOG.warning(text, self.key, duration_text(before - stamp))
        with self._lock:
            self._now = stamp
            self._wake(lambda awaited: went_back or awaited <= stamp)
        self._has_begun.set()

    def _wake(self, is_due: Callable[[int], bool]) -> None:
        waits, self._waits = self._waits, []
        for wait in waits:
            if is_due(wait[0]):
                wait[1].set()
            else:
                self._waits.append(wait)

    def _refuse(self, reason: str, text: str) -> None:
        self.refused[reason] = self.refused.get(reason, 0) + 1
        if self.refused[reason] == 1:
            _LOG.warning("%s refused (%s): %s; further ones are only counted", self.key, reason, text)
