"""ClockPublisher: simulated time, for everybody."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from contextlib import ExitStack

from zstate.clock import check_stamp
from zstate.closing import Closing
from zstate.errors import Closed
from zstate.locks import new_lock
from zstate.net.outlets import Outlets
from zstate.net.presence import writer_here
from zstate.net.session import Session
from zstate.net.wires import wire_named, wire_names
from zstate.wire.messages import Clock
from zstate.wire.ros2.topics import SHARED


class ClockPublisher(Closing):
    """Says what time it is in a simulation or a replay: on zstate/clock, and on /clock of a ROS wire.

    Times that go back are another start of the clock, and need another publisher. A context manager;
    safe from any thread.
    """

    def __init__(self, session: Session, wires: str | Sequence[str] = ("native",)) -> None:
        self._session_id = secrets.randbits(32)
        self._seq = 0
        self._lock = new_lock()
        writer = writer_here(self._session_id)
        with ExitStack() as opening:
            # The time is no robot's; on a ROS wire it stands where nobody in particular does.
            outlets = [
                opening.enter_context(Outlets(session, wire_named(wire), SHARED, writer))
                for wire in wire_names(wires)
            ]
            self._outlets = [out.stream("clock") for out in outlets]
            self._opened = opening.pop_all()
        self._is_open = True

    def publish(self, stamp: int) -> None:
        """It is ``stamp`` [ns] now. Raises InvalidInput for what a wire cannot say, and Closed."""
        with self._lock:
            if not self._is_open:
                raise Closed("the clock's publisher is closed")
            clock = Clock(check_stamp(stamp), self._seq, self._session_id)
            said = [(outlet, outlet.encode(clock)) for outlet in self._outlets]
            self._seq += 1
            for outlet, payload in said:
                outlet.put(payload)

    def close(self) -> None:
        """Say no more. A second call does nothing."""
        with self._lock:
            self._is_open = False
            self._opened.close()
