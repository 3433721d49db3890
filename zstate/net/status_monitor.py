"""Readers of the status that writers publish once a second (``zstate.net.status``)."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable

from zstate._util.bounded import BoundedDict
from zstate.errors import InvalidInput, MessageError
from zstate.net.session import Session
from zstate.net.status import PERIOD_S
from zstate.net.streams import StreamSubscriber, call_for_each
from zstate.wire.identity import WriterId
from zstate.wire.keys import STATUS
from zstate.wire.messages import Status
from zstate.wire.native import decode
from zstate.wire.protocol import SerializedSample

MAX_STATUS_BYTES = 65_536

_RECENT_S = 3.0 * PERIOD_S
"""Publishers whose last status is older are gone, frozen or unreachable."""


class StatusSubscriber(StreamSubscriber):
    """Calls ``callback(robot, status)`` with the status of each publisher of ``robot`` ("*": of all robots).

    Called once a second, from one thread, starting within a second. A process that is frozen or gone
    publishes no status: check the age of its last one. ``refused`` counts invalid ones by reason.
    """

    def __init__(self, session: Session, robot: str, callback: Callable[[str, Status], None]) -> None:
        self.refused: Counter[str] = Counter()

        def on_sample(sample: SerializedSample) -> None:
            try:
                name, status = _decode_status(sample)
            except (MessageError, InvalidInput) as error:
                self.refused[getattr(error, "reason", "foreign")] += 1
            else:
                callback(name, status)

        super().__init__(session, STATUS.expression(robot), lambda samples: call_for_each(samples, on_sample))


class StatusMonitor(StatusSubscriber):
    """The newest status of each publisher of ``robot`` ("*": of all robots)."""

    def __init__(self, session: Session, robot: str) -> None:
        self._newest: BoundedDict[tuple[str, int], tuple[Status, float]] = BoundedDict()
        super().__init__(session, robot, self._on_status)

    def _on_status(self, robot: str, status: Status) -> None:
        self._newest[robot, status.session] = status, time.monotonic()

    def recent(self, robot: str) -> list[Status]:
        """Those of ``robot`` received in the last 3 s, sorted by program."""
        since = time.monotonic() - _RECENT_S
        newest = self._newest.copy().items()
        found = [status for (name, _), (status, at) in newest if name == robot and at >= since]
        return sorted(found, key=lambda status: (status.program, status.host, status.pid, status.session))


def _decode_status(sample: SerializedSample) -> tuple[str, Status]:
    """The robot and its writer's status. Raises MessageError, or InvalidInput for a key of no writer."""
    if len(sample.payload) > MAX_STATUS_BYTES:
        text = f"a Status of {len(sample.payload)} bytes, more than {MAX_STATUS_BYTES}"
        raise MessageError(text, reason="too large")
    robot, identity = STATUS.parse(sample.key)
    status = decode(sample.payload, sample.encoding, Status)
    if status.session != WriterId.parse(identity).session:
        raise MessageError(f"the Status of another writer on {sample.key!r}", reason="foreign")
    if not math.isfinite(status.rate_hz):
        raise MessageError(f"a Status with the rate {status.rate_hz}", reason="malformed")
    return robot, status
