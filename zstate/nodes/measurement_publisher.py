"""Base of the publishers of measurements: of one sensor, under its name."""

from __future__ import annotations

from collections.abc import Sequence

from zstate.clock import Clock
from zstate.errors import InvalidInput
from zstate.net.session import Session
from zstate.nodes.sample_publisher import SamplePublisher
from zstate.stream_registry import is_named
from zstate.streams import StampedMessage, StreamName
from zstate.wire.keys import check_writer
from zstate.wire.measurements import renumbered


class MeasurementPublisher(SamplePublisher):
    """Base of the publishers of one ``sensor`` on ``stream``, which is the writer's name there.

    On a stream without names ``sensor`` is empty.

    Under congestion messages are dropped, and joining listeners receive none from the past. On the native
    wire each sensor has one writer.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        stream: StreamName,
        sensor: str,
        *,
        wires: str | Sequence[str],
        clock: Clock | None,
        program: str,
    ) -> None:
        super().__init__(session, robot, wires, clock, program)
        if not is_named(stream) and sensor:
            raise InvalidInput(f"the writers of {stream} have no names; got {sensor!r}")
        self.sensor = check_writer(sensor) if is_named(stream) else ""
        out = self._out
        out.title = f"the {stream} publisher {self.sensor!r}"
        with out.opening():
            out.own([out.announcement(stream, self.sensor)])
            for wire in out.open_wires():
                out.open_stream(wire, stream, self.sensor)
            out.report_status(lambda: self.stats)

    def _send(self, message: StampedMessage) -> None:
        """Publish ``message`` as the next one of this session. Raises SecondWriter and Closed."""
        out = self._out
        with out.lock:
            out.check()
            out.send(renumbered(message, out.seq, out.session_id))

    def __repr__(self) -> str:
        closed = ", closed" if self._out.is_closed else ""
        return f"<{type(self).__name__} {self.sensor!r} of {self.robot!r}: {self._sent} messages{closed}>"
