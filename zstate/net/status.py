"""Status: how writers do, said once a second to those who ask, on the native wire."""

from __future__ import annotations

import math
import threading
import time
from collections import Counter
from collections.abc import Callable

import zenoh

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe
from zstate.errors import Closed, InvalidInput, MessageError
from zstate.net.session import Session
from zstate.net.streams import StreamPublisher, StreamSubscriber, call_for_each
from zstate.wire.identity import WriterId
from zstate.wire.keys import parse_status_key, status_expression, status_key
from zstate.wire.messages import Status
from zstate.wire.native import ENCODINGS, decode, encode
from zstate.wire.protocol import SerializedSample

PERIOD_S = 1.0
JOIN_WITHIN_S = 0.5
MAX_STATUS_BYTES = 65_536
"""A longer status is refused."""


class StatusPublisher(Closeable):
    """Asks ``status()`` once a second, from a thread of its own, and says it while somebody reads it.

    So it goes on when what it tells of stands still, and ends with the process.
    """

    def __init__(self, session: Session, robot: str, identity: str, status: Callable[[], Status]) -> None:
        self._session = session
        self._status = status
        self._stop = fork_safe(threading.Event())
        self._publisher = StreamPublisher(session, status_key(robot, identity), ENCODINGS[Status])
        self._thread = threading.Thread(target=self._run, name="zstate status", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Say no more. A second call does nothing."""
        self._stop.set()
        self._publisher.close()
        if threading.current_thread() is not self._thread:
            self._thread.join(JOIN_WITHIN_S)

    def _run(self) -> None:
        due = time.monotonic() + PERIOD_S
        while not self._stop.wait(max(0.0, due - time.monotonic())):
            try:
                self._publish()
            except (Closed, zenoh.ZError):
                return
            # After a pause (a suspended laptop) one status is enough.
            due = max(due + PERIOD_S, time.monotonic())

    def _publish(self) -> None:
        self._session.check()
        status = self._status()
        if self._publisher.has_readers:
            self._publisher.put(encode(status))


class StatusSubscriber(Closeable):
    """Hears every status of ``robot`` ("*": of all robots); ``refused`` counts what was none, by reason."""

    def __init__(self, session: Session, robot: str, callback: Callable[[str, Status], None]) -> None:
        self.refused: Counter[str] = Counter()
        self._callback = callback
        self._subscriber = StreamSubscriber(session, status_expression(robot), self._on_status)

    def _on_status(self, arrivals: list[SerializedSample]) -> None:
        call_for_each(arrivals, self._decode_status)

    def _decode_status(self, arrival: SerializedSample) -> None:
        try:
            robot, status = _status_in(arrival)
        except (MessageError, InvalidInput) as error:
            self.refused[getattr(error, "reason", "foreign")] += 1
        else:
            self._callback(robot, status)

    def close(self) -> None:
        """Stop within a second. A second call does nothing."""
        self._subscriber.close()


def _status_in(arrival: SerializedSample) -> tuple[str, Status]:
    """The robot and its writer's status. Raises MessageError, or InvalidInput for a key of no writer."""
    if len(arrival.payload) > MAX_STATUS_BYTES:
        text = f"a Status of {len(arrival.payload)} bytes, more than {MAX_STATUS_BYTES}"
        raise MessageError(text, reason="too large")
    robot, identity = parse_status_key(arrival.key)
    status = decode(arrival.payload, arrival.encoding, Status)
    if status.session != WriterId.parse(identity).session:
        raise MessageError(f"the Status of another writer on {arrival.key!r}", reason="foreign")
    if not math.isfinite(status.rate_hz):
        raise MessageError(f"a Status with the rate {status.rate_hz}", reason="malformed")
    return robot, status


def watch_status(session: Session, robot: str, callback: Callable[[str, Status], None]) -> StatusSubscriber:
    """Call ``callback(robot, status)`` with what each publisher of ``robot`` says of itself, once a second.

    They begin within a second. It is called from one thread. A process that is frozen or gone says
    nothing: look at the age of what it said last. Said on the native wire alone; ROS's diagnostics are
    not among the messages that zstate speaks.
    """
    return StatusSubscriber(session, robot, callback)
