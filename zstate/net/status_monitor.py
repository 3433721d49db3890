"""Readers of the status that writers publish once a second (``zstate.net.status``)."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Container
from dataclasses import dataclass

from zstate._util.bounded import BoundedDict
from zstate._util.fork_safe import fork_safe_lock
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


@dataclass(frozen=True, slots=True)
class WriterState:
    """The newest status of a publisher of ``robot``, received ``age_s`` ago."""

    robot: str
    status: Status
    age_s: float


class StatusMonitor(StatusSubscriber):
    """The newest status of each publisher of ``robot`` ("*": of all robots)."""

    def __init__(self, session: Session, robot: str) -> None:
        self._newest: BoundedDict[tuple[str, int], tuple[Status, float]] = BoundedDict()
        self._lock = fork_safe_lock()
        super().__init__(session, robot, self._on_status)

    def _on_status(self, robot: str, status: Status) -> None:
        with self._lock:
            self._newest[robot, status.session] = status, time.monotonic()

    def states(self) -> tuple[WriterState, ...]:
        """All of them, sorted by robot and program."""
        with self._lock:
            newest = list(self._newest.items())
        now = time.monotonic()
        states = [WriterState(robot, status, now - at) for (robot, _), (status, at) in newest]
        return tuple(sorted(states, key=lambda state: (state.robot, *_program(state.status))))

    def recent(self, robot: str) -> list[Status]:
        """Those of ``robot`` received in the last 3 s, sorted by program."""
        return [one.status for one in self.states() if one.robot == robot and one.age_s <= _RECENT_S]

    def keep(self, publishers: Container[tuple[str, int]]) -> None:
        """Forget all publishers but these (robot, session)."""
        with self._lock:
            for key in [key for key in self._newest if key not in publishers]:
                del self._newest[key]


def _program(status: Status) -> tuple[str, str, int, int]:
    return status.program, status.host, status.pid, status.session


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
