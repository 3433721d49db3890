"""What listeners to scans and to clouds have in common: a measurement waits for the pose of its end."""

from __future__ import annotations

import threading
import time
from abc import abstractmethod
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import ExitStack
from functools import partial
from typing import Generic, NamedTuple, Protocol, TypeVar

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate._util.inbox import Inbox
from zstate._util.refusals import Refusals
from zstate.buffer.buffer import TransformBuffer, check_duration
from zstate.checks import check_names
from zstate.clock import Clock
from zstate.errors import InvalidInput, LookupFailed, WaitTimeout
from zstate.net.presence import announce_reader
from zstate.net.session import Session
from zstate.net.subscription import Received, subscribe
from zstate.nodes.listener import TransformListener
from zstate.streams import StreamName
from zstate.wire.keys import ANY, check_robot, check_writer, full_name, shortened
from zstate.wire.messages import Message
from zstate.wire.registry import get_wire

CAPACITY = 256
"""Placed measurements kept for a slow reader, and measurements of one sensor that wait for their poses."""
_OVERFLOW = "Overflow"
_MAX_SENSORS = 64
_LONGEST_WAIT_S = 0.5
"""After this time at the latest a thread that waits for a pose ends with its listener."""


class Measurement(Protocol):
    """What a sensor measured in ``frame``, one part after the other until ``end_stamp`` [ns]."""

    @property
    def frame(self) -> str: ...

    @property
    def end_stamp(self) -> int: ...

    @property
    def nbytes(self) -> int: ...


M = TypeVar("M", bound=Measurement)
P = TypeVar("P")


class ByteLimits(NamedTuple):
    """Of what is ``unread``, and of what is ``waiting`` for its pose, of one sensor [bytes]."""

    unread: int
    waiting: int


class _SensorQueue(Closeable, Generic[M]):
    """The measurements of one sensor, which wait for their poses in a thread of their own."""

    def __init__(self, place: Callable[[M, float], object], name: str, max_bytes: int) -> None:
        self._place = place
        # The thread ends with the listener, not with its session.
        self._waiting: Inbox[tuple[M, float]] = Inbox(
            CAPACITY, lambda: None, max_bytes=max_bytes, size_of=lambda waiting: waiting[0].nbytes
        )
        threading.Thread(target=self._run, name=f"zstate {name}", daemon=True).start()

    def add(self, measured: M, deadline: float) -> int:
        """Place ``measured`` until ``deadline`` [s, ``time.monotonic``], after those before it.

        Returns how many older ones are lost.
        """
        return self._waiting.add([(measured, deadline)])

    def _run(self) -> None:
        for measured, deadline in self._waiting:
            self._place(measured, deadline)

    def close(self) -> None:
        """End the thread, after what waits."""
        self._waiting.close()


class PlacingListener(Closeable, Generic[M, P]):
    """Base of the listeners that place the measurements of ``stream`` of ``robot`` in ``target``.

    A subclass makes a measurement of a message (``_read``), and places it once the pose of its end is known
    (``_place``). ``target`` is None if measurements are not placed: then they wait for nothing.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        stream: StreamName,
        target: str | None,
        *,
        sensor: str,
        buffer: TransformBuffer | None,
        wire: str,
        timeout_s: float,
        clock: Clock | None,
        limits: ByteLimits,
        size_of: Callable[[P], int],
    ) -> None:
        if target is not None:
            check_names(target)
        check_duration("timeout_s", timeout_s)
        self.robot = check_robot(robot)
        self.sensor = sensor if sensor == ANY else check_writer(sensor)
        self.dropped: Counter[str] = Counter()
        self._dropped_lock = fork_safe_lock()
        self.last_reason: LookupFailed | None = None
        self._stream = stream
        self._refusals = Refusals(stream)
        self.refused: dict[str, int] = self._refusals.counts
        self._target = None if target is None else full_name(robot, target)
        self._timeout_s = timeout_s
        self._limits = limits
        self._unread: Inbox[P] = Inbox(CAPACITY, session.check, max_bytes=limits.unread, size_of=size_of)
        self._sensors: dict[str, _SensorQueue[M]] = {}
        self._wire = get_wire(wire)
        self._closed = False
        with ExitStack() as opening:
            if buffer is None and target is not None:
                listener = TransformListener(session, robot, wire=wire, clock=clock)
                buffer = opening.enter_context(listener).buffer
            self._buffer = buffer
            on_error = self._refusals.count
            opening.enter_context(
                subscribe(
                    session,
                    self._wire,
                    robot,
                    stream,
                    self._on_messages,
                    name=self.sensor,
                    on_error=on_error,
                )
            )
            for announcement in announce_reader(session, self._wire, robot, (stream,)):
                opening.enter_context(announcement)
            self._opened = opening.pop_all()

    @abstractmethod
    def _read(self, message: Message, robot: str) -> M:
        """The measurement of ``robot`` in ``message``. Raises InvalidInput if it is none."""

    @abstractmethod
    def _place(self, measured: M, sensor: str) -> P:
        """``measured`` of ``sensor``, in the target if there is one. Raises LookupFailed."""

    def __len__(self) -> int:
        """How many are unread."""
        return len(self._unread)

    def _on_messages(self, received: list[Received]) -> None:
        deadline = time.monotonic() + self._timeout_s
        for robot, key, message in received:
            sensor = self._wire.edge_writer_name(key) or self._stream
            try:
                lost = self._queue_of(sensor).add(self._read(message, robot), deadline)
            except InvalidInput as error:
                self._refusals.count("malformed", f"{shortened(key)}: {error}")
            else:
                self._count_dropped(_OVERFLOW, lost)

    def _queue_of(self, sensor: str) -> _SensorQueue[M]:
        if sensor not in self._sensors:
            if len(self._sensors) >= _MAX_SENSORS:
                raise InvalidInput(f"the robot {self.robot!r} has more than {_MAX_SENSORS} sensors")
            add = partial(self._add_placed, sensor)
            name = f"{self._stream}s of {sensor}"
            self._sensors[sensor] = _SensorQueue(add, name, self._limits.waiting)
        return self._sensors[sensor]

    def _add_placed(self, sensor: str, measured: M, deadline: float) -> None:
        """Add what was placed to the unread ones once its last pose is known, or count it."""
        try:
            if not self._wait_for_pose(measured, deadline):
                return
            placed = self._place(measured, sensor)
        except LookupFailed as reason:
            self.last_reason = reason
            self._count_dropped(type(reason).__name__.removesuffix("Timeout"))
        else:
            self._count_dropped(_OVERFLOW, self._unread.add([placed]))

    def _count_dropped(self, reason: str, count: int = 1) -> None:
        if count:
            with self._dropped_lock:
                self.dropped[reason] += count

    def _wait_for_pose(self, measured: M, deadline: float) -> bool:
        """Wait for the pose at its end. False if this listener is closed; raises LookupFailed."""
        began = time.monotonic()
        while not self._closed:
            if self._buffer is None or self._target is None:
                return True
            left_s = max(deadline - time.monotonic(), 0.0)
            try:
                self._buffer.wait(
                    self._target, measured.frame, measured.end_stamp, min(left_s, _LONGEST_WAIT_S)
                )
            except WaitTimeout as reason:
                if left_s <= _LONGEST_WAIT_S:
                    reason.waited_s = max(deadline - began, 0.0)
                    raise
            else:
                return True
        return False

    def __iter__(self) -> Iterator[P]:
        return iter(self._unread)

    def __aiter__(self) -> AsyncIterator[P]:
        return aiter(self._unread)

    def close(self) -> None:
        """Stop listening; iterations end. A second call does nothing."""
        self._closed = True
        self._opened.close()
        for queue in self._sensors.values():
            queue.close()
        self._unread.close()
