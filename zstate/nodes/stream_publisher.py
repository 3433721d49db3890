"""Publisher of any stream of measurements, also of those that other packages bring."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from zstate.clock import Clock, check_stamp
from zstate.errors import InvalidInput
from zstate.net.session import Session
from zstate.nodes.measurement_publisher import MeasurementPublisher
from zstate.stream_registry import find_stream, stream_named
from zstate.streams import Stream
from zstate.wire.measurements import new_message


class StreamPublisher(MeasurementPublisher):
    """Publishes the messages of one writer on ``stream``, a row or its name.

    - ``robot``: the robot that the writer belongs to.
    - ``name``: that of the sensor or program on a stream whose writers have names; empty on others.
    - ``wires``: what it publishes on, "native", "ros2" with options, or several.
    - ``clock``: gives the stamps of messages without one; default: the system's.
    - ``program``: the writer's name for others; default: the script's name.

    On the native wire one writer has a name: SecondWriter, which names the first one, is raised if another
    writer publishes, or by ``publish`` if both opened at once, which closes the later one. Under congestion
    messages are dropped, and joining listeners receive none from the past.

    Raises InvalidInput for a stream that no installed package brings, that is no measurement (joints, edges
    and drivers have publishers of their own), or that one of ``wires`` does not carry. A context manager;
    safe from any thread.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        stream: Stream | str,
        name: str = "",
        wires: str | Sequence[str] = ("native",),
        *,
        clock: Clock | None = None,
        program: str = "",
    ) -> None:
        self._row = checked_stream(stream)
        if self._row.group != "measurement" or self._row.latched:
            raise InvalidInput(
                f"a StreamPublisher writes measurements; the stream {self._row.name!r} has its own publisher"
            )
        super().__init__(session, robot, self._row.name, name, wires=wires, clock=clock, program=program)

    def publish(self, stamp: int | None = None, **fields: Any) -> None:
        """Publish one message of ``fields`` at ``stamp`` [ns]; default: now. Its number is the next one.

        Raises InvalidInput for fields that the message does not have, that are missing, or of other types;
        SecondWriter; and Closed. If it raises, nothing was sent.
        """
        with self._refusals:
            stamp = self._clock.now() if stamp is None else check_stamp(stamp)
            self._send(new_message(self._row, stamp, fields))


def checked_stream(stream: Stream | str) -> Stream:
    """The row of ``stream``. Raises InvalidInput for one that other programs here do not know."""
    if isinstance(stream, str):
        return stream_named(stream)
    if find_stream(stream.name) is not stream:
        raise InvalidInput(
            f"{stream!r} is not what other programs find: give its package an entry point in the group "
            "'zstate.plugins' that leads to a zstate.plugins.Plugin with this row, and install it"
        )
    return stream
