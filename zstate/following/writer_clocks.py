"""WriterClocks: how far the clocks of the writers that are followed are ahead, for the errors of a buffer."""

from __future__ import annotations

from collections.abc import Callable

from zstate.buffer.buffer import TransformBuffer
from zstate.clock import SYSTEM, ClockOffset
from zstate.closing import Closing
from zstate.net.clock_offset import OffsetMeter
from zstate.net.session import Session
from zstate.wire.writer import Announced, Writer


class WriterClocks(Closing):
    """Lets ``buffer`` know of the clock of each writer of the native wire, as they come and go."""

    def __init__(self, session: Session, buffer: TransformBuffer) -> None:
        self._offsets = buffer.clock_offsets
        self._is_wanted = buffer.clock.domain == SYSTEM
        self._meter = OffsetMeter(session, buffer.clock)
        self._ours: dict[Writer, Callable[[], ClockOffset | None]] = {}

    def note(self, announced: Announced, *, alive: bool) -> None:
        """A writer has come or gone."""
        writer = announced.writer
        if not alive:
            gone = self._ours.pop(writer, None)
            if gone is not None and self._offsets.get(str(writer)) is gone:
                del self._offsets[str(writer)]
        elif self._is_wanted and writer not in self._ours:
            self._ours[writer] = self._offsets[str(writer)] = self._meter.follow(announced.robot, writer)

    def close(self) -> None:
        """Measure no more; what is known stays. A second call does nothing."""
        self._meter.close()
