"""What a driver host reports: state, setpoints, figures of its control loop; and a listener of its state."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from zstate._util.bounded import BoundedDict
from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe, fork_safe_lock
from zstate.driving.driver import Setpoint
from zstate.driving.messages import DriverState, state_text, with_encodable_fields, with_short_texts
from zstate.errors import Closed, InvalidInput, MessageError, SecondWriter, format_duration, printable
from zstate.net.latched import LatchedPublisher, LatchedSubscriber, cached_values
from zstate.net.ownership import wait_for_discovery
from zstate.net.session import Session
from zstate.net.writer import WireWriter
from zstate.rate import RateReport
from zstate.wire.identity import WriterId
from zstate.wire.keys import robot_from_key, stream_expression, stream_key
from zstate.wire.messages import JointState, order_digest, to_block
from zstate.wire.native import decode, encode, encoding_of
from zstate.wire.protocol import SerializedSample
from zstate.wire.registry import get_wire

_LOG = logging.getLogger("zstate")

PERIOD_S = 0.1
SILENT_S = 5 * PERIOD_S
"""A driver that has not published its state for so long is gone or frozen."""

JOIN_WITHIN_S = 0.5
_CACHES_WITHIN_S = 0.5

_MOST_DURATIONS = 60_000


class Spread(NamedTuple):
    """Median, 99th and 99.9th percentile, and maximum of durations [us]; zero without any."""

    p50: float
    p99: float
    p999: float
    max: float


class Durations:
    """The last minute, at 1 kHz, of a kind of duration; the maximum of all. For one thread."""

    def __init__(self) -> None:
        self._newest: deque[int] = deque(maxlen=_MOST_DURATIONS)
        self._max = 0

    def add(self, duration_ns: int) -> None:
        self._newest.append(duration_ns)
        self._max = max(self._max, duration_ns)

    def spread(self) -> Spread:
        if not self._newest:
            return Spread(0.0, 0.0, 0.0, 0.0)
        p50, p99, p999 = (np.percentile(np.array(self._newest), (50, 99, 99.9)) / 1e3).tolist()
        return Spread(p50, p99, p999, self._max / 1e3)


@dataclass(frozen=True, slots=True)
class DriverReport:
    """The figures of a driver host since it opened; ``rate`` and ``lateness_us`` of its last ``run``.

    ``lateness_us`` is how long ticks began after their deadlines, zero if a device sets the pace; ``read_us``
    and ``write_us`` are what the driver's own calls took. ``written`` counts the setpoints that were written,
    ``faults`` the calls that raised, ``refused`` commands by reason.
    """

    rate: RateReport | None
    lateness_us: Spread
    read_us: Spread
    write_us: Spread
    written: int
    faults: int
    refused: Mapping[str, int]


class DriverStatePublisher(Closeable):
    """Publishes what ``build()`` returns, latched: after each ``notify`` and ten times a second.

    Long texts are cut. A state that cannot be encoded is published without the fields that cannot, and logged
    once: readers must learn of a fault. It has a thread of its own, because a latched value waits for the
    network and a control loop must not.
    """

    def __init__(self, session: Session, robot: str, build: Callable[[], DriverState]) -> None:
        self._build = build
        self._latched = LatchedPublisher(session, stream_key(robot, "driver"), encoding_of(DriverState))
        self._has_changed = fork_safe(threading.Event())
        self._closed = False
        self._has_failed = False
        self._publish()
        self._thread = threading.Thread(target=self._run, name="zstate driver state", daemon=True)
        self._thread.start()

    def notify(self) -> None:
        """Publish the state now. Does not wait."""
        self._has_changed.set()

    def close(self) -> None:
        self._closed = True
        self._has_changed.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(JOIN_WITHIN_S)
        self._latched.close()

    def _run(self) -> None:
        with suppress(Closed):
            while True:
                self._has_changed.wait(PERIOD_S)
                self._has_changed.clear()
                is_last = self._closed  # that state is published, too: "off", or "fault"
                try:
                    self._publish()
                except Closed:
                    raise
                except Exception as error:
                    self._log_once(error)
                if is_last:
                    return

    def _publish(self) -> None:
        state = with_short_texts(self._build())
        try:
            payload = encode(state)
        except Exception as error:  # a reader that receives no state takes this host for dead
            self._log_once(error)
            payload = encode(with_encodable_fields(state))
        self._latched.set(payload)

    def _log_once(self, error: Exception) -> None:
        if not self._has_failed:
            self._has_failed = True
            _LOG.error("the state of a driver cannot be published as it is: %r; logged once", error)


class SetpointPublisher(Closeable):
    """Publishes the setpoints of ``joint_names`` that ``writer`` writes to hardware, while they are read.

    They are joint states with names: positions, the velocities of the step, and efforts while a joint is in
    mode "effort". For one thread.
    """

    def __init__(self, session: Session, robot: str, joint_names: tuple[str, ...], writer: WriterId) -> None:
        self._names = joint_names
        self._order = order_digest(joint_names)
        self._session_id = writer.session
        self._seq = 0
        with ExitStack() as opening:
            wire_writer = opening.enter_context(WireWriter(session, get_wire("native"), robot, writer))
            self._stream = wire_writer.open_stream("joint_setpoints")
            _ = self._stream.has_readers  # the first call declares a listener: not in a tick
            self._opened = opening.pop_all()

    def publish(self, setpoint: Setpoint) -> None:
        """Publish ``setpoint`` if it has a reader. Raises Closed."""
        if not self._stream.has_readers:
            return
        head = (setpoint.stamp, self._seq, self._session_id, self._order)
        efforts = None if setpoint.efforts is None else to_block(setpoint.efforts)
        blocks = to_block(setpoint.positions), to_block(setpoint.velocities), efforts
        self._stream.write(encode(JointState(*head, *blocks, names=self._names)))
        self._seq += 1

    def close(self) -> None:
        self._opened.close()


def check_only_host(session: Session, robot: str) -> None:
    """Raise SecondWriter if a driver of ``robot`` is hosted already."""
    wait_for_discovery(session)
    other = cached_state(session, robot, _CACHES_WITHIN_S)
    if other is not None:
        first = WriterId(other.program, "", 0, 0, other.session)
        raise SecondWriter(
            f"{other.program!r} already drives {', '.join(other.joint_names)} of {robot!r}; a robot has "
            "one driver host: stop the first, or give one driver all joints",
            robot=robot,
            stream="driver",
            first=first,
        )


def cached_state(session: Session, robot: str, timeout_s: float) -> DriverState | None:
    """The state that the driver of ``robot`` has published last; None if none replies within ``timeout_s``.

    What a subscriber receives first may be older: a sample that is still under way.
    """
    for value in cached_values(session, stream_key(robot, "driver"), timeout_s):
        with suppress(MessageError):
            return decode(value.payload, value.encoding, DriverState)
    return None


class ReceivedState(NamedTuple):
    """The newest state of a driver, and the time since it arrived [s]."""

    state: DriverState
    age_s: float

    @property
    def is_live(self) -> bool:
        """Whether the driver publishes its state."""
        return self.age_s < SILENT_S

    @property
    def last_motion(self) -> str:
        """How the last motion has ended, and why; empty without any."""
        if not self.state.outcomes:
            return ""
        newest = self.state.outcomes[-1]
        return f"{newest.name}: {printable(newest.reason)}" if newest.reason else newest.name

    def __str__(self) -> str:
        state, text = self.state, state_text(self.state)
        if state.state == "active" and state.motion is not None:
            text += f", motion {state.progress:.0%} done"
        if self.is_live or state.state == "off":  # it has been closed
            return text
        return f"silent for {format_duration(round(self.age_s * 1e9))}, was {text}"


class DriverStateListener(Closeable):
    """Receives the states of the driver of ``robot``, or of the drivers of all robots for "*".

    ``on_state(robot)`` is called after each, from one thread.
    """

    def __init__(
        self, session: Session, robot: str, on_state: Callable[[str], object] = lambda _: None
    ) -> None:
        self._on_state = on_state
        self._lock = fork_safe_lock()
        self._newest: BoundedDict[str, tuple[DriverState, float]] = BoundedDict()
        self._subscriber = LatchedSubscriber(session, stream_expression(robot, "driver"), self._on_value)

    def get(self, robot: str) -> ReceivedState | None:
        """The newest state of the driver of ``robot``, however old it is; None if none has arrived."""
        return self.states().get(robot)

    def states(self) -> dict[str, ReceivedState]:
        """The newest state of each driver, by robot, sorted."""
        with self._lock:
            newest = dict(self._newest)
        now = time.monotonic()
        return {robot: ReceivedState(state, now - at) for robot, (state, at) in sorted(newest.items())}

    def close(self) -> None:
        self._subscriber.close()

    def _on_value(self, sample: SerializedSample) -> None:
        with suppress(MessageError, InvalidInput):
            robot = robot_from_key(sample.key)
            state = decode(sample.payload, sample.encoding, DriverState)
            with self._lock:
                self._newest[robot] = state, time.monotonic()
            self._on_state(robot)
