"""ScanListener: the scans of a robot, each ray placed by the pose at its own instant."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

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
from zstate.scans.messages import LaserScan
from zstate.scans.scan import Scan, scan_from_message
from zstate.wire.keys import ANY, check_robot, check_writer, full_name, shortened
from zstate.wire.registry import get_wire

_CAPACITY = 256
"""Scans kept for a slow reader, and scans of one sensor that wait for their poses."""
_UNREAD_BYTES = 64 * 2**20
_WAITING_BYTES = 16 * 2**20
"""Limits of their bytes, if these are reached first: 30 and 20 of the largest scans."""
_OVERFLOW = "Overflow"
_MAX_SENSORS = 64
_LONGEST_WAIT_S = 0.5
"""After this time at the latest a thread that waits for a pose ends with its listener."""


@dataclass(frozen=True, eq=False)
class PlacedScan:
    """A ``scan`` whose rays stand in ``target``: ``points`` (N, 3) [m], NaN where ``valid`` (N,) is False.

    ``sensor`` is the name of the scanner. Each ray is placed by the pose at its own stamp. It is not valid if
    its range is no measurement, or if the history of the buffer begins after it. ``is_rigid`` means that the
    times of the rays are not known, and all are placed by the pose at the stamp of the scan.
    """

    scan: Scan
    sensor: str
    target: str
    points: NDArray[np.float32]
    valid: NDArray[np.bool_]

    @property
    def stamp(self) -> int:
        """The instant of the first ray [ns]."""
        return self.scan.stamp

    @property
    def is_rigid(self) -> bool:
        """Whether all rays are placed by one pose."""
        return self.scan.is_rigid

    def __repr__(self) -> str:
        rigid = ", rigid" if self.is_rigid else ""
        return f"<PlacedScan of {self.sensor!r} in {self.target!r}: {self.valid.sum()} points{rigid}>"


def _placed_size(placed: PlacedScan) -> int:
    return placed.scan.nbytes + placed.points.nbytes + placed.valid.nbytes


class _SensorScans(Closeable):
    """The scans of one sensor, which wait for their poses in a thread of their own."""

    def __init__(self, place: Callable[[Scan, float], object], sensor: str) -> None:
        self._place = place
        # The thread ends with the listener, not with its session.
        self._waiting: Inbox[tuple[Scan, float]] = Inbox(
            _CAPACITY, lambda: None, max_bytes=_WAITING_BYTES, size_of=lambda waiting: waiting[0].nbytes
        )
        threading.Thread(target=self._run, name=f"zstate scans of {sensor}", daemon=True).start()

    def add(self, scan: Scan, deadline: float) -> int:
        """Place ``scan`` until ``deadline`` [s, ``time.monotonic``], after the scans before it.

        Returns how many older scans are lost.
        """
        return self._waiting.add([(scan, deadline)])

    def _run(self) -> None:
        for scan, deadline in self._waiting:
            self._place(scan, deadline)

    def close(self) -> None:
        """End the thread, after the scans that wait."""
        self._waiting.close()


class ScanListener(Closeable):
    """Receives the scans of ``robot``, and places each ray in ``target`` by the pose at its own instant.

    ``for placed in scans`` and ``async for placed in scans`` return a PlacedScan for each scan, in the order
    in which they became placeable, and end with ``close()``. A scan waits for the pose of its *last* ray, at
    most ``timeout_s`` from its arrival: then it is counted in ``dropped`` by the name of the error, and
    ``last_reason`` names the edge that was too late. If more than 256 scans or 64 MiB are unread, or
    256 scans or 16 MiB of one sensor wait, the oldest are lost; ``dropped["Overflow"]`` counts them.
    ``refused`` counts messages that are no scan, by reason; the first of each reason is also logged.

    ``sensor`` selects one scanner of the robot, on the native wire; "*": all of them. Frames come from
    ``buffer``; without one, the listener fills a buffer of its own with the transforms of the robot. Bare
    frame names are the robot's own. ``clock`` is that of the buffer of its own; default: the system's. A
    context manager.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        target: str,
        *,
        sensor: str = ANY,
        buffer: TransformBuffer | None = None,
        wire: str = "native",
        timeout_s: float = 1.0,
        clock: Clock | None = None,
    ) -> None:
        check_names(target)
        check_duration("timeout_s", timeout_s)
        self.robot = check_robot(robot)
        self.sensor = sensor if sensor == ANY else check_writer(sensor)
        self.target = full_name(robot, target)
        self.dropped: Counter[str] = Counter()
        self._dropped_lock = fork_safe_lock()
        self.last_reason: LookupFailed | None = None
        self._refusals = Refusals("scan")
        self.refused: dict[str, int] = self._refusals.counts
        self._timeout_s = timeout_s
        self._unread: Inbox[PlacedScan] = Inbox(
            _CAPACITY, session.check, max_bytes=_UNREAD_BYTES, size_of=_placed_size
        )
        self._sensors: dict[str, _SensorScans] = {}
        self._wire = get_wire(wire)
        self._closed = False
        with ExitStack() as opening:
            if buffer is None:
                listener = TransformListener(session, robot, wire=wire, clock=clock)
                buffer = opening.enter_context(listener).buffer
            self.buffer = buffer
            on_error = self._refusals.count
            opening.enter_context(
                subscribe(session, self._wire, robot, "scan", self._on_messages, on_error=on_error)
            )
            for announcement in announce_reader(session, self._wire, robot, ("scan",)):
                opening.enter_context(announcement)
            self._opened = opening.pop_all()

    def __repr__(self) -> str:
        return f"<ScanListener of {self.robot!r} in {self.target!r}: {len(self)} unread scans>"

    def __len__(self) -> int:
        """How many placed scans are unread."""
        return len(self._unread)

    def _on_messages(self, received: list[Received]) -> None:
        deadline = time.monotonic() + self._timeout_s
        for robot, key, message in received:
            sensor = self._wire.edge_writer_name(key) or "scan"
            if self.sensor not in (ANY, sensor):
                continue
            try:
                assert isinstance(message, LaserScan)
                lost = self._scans_of(sensor).add(scan_from_message(message, robot), deadline)
            except InvalidInput as error:
                self._refusals.count("malformed", f"{shortened(key)}: {error}")
            else:
                self._count_dropped(_OVERFLOW, lost)

    def _scans_of(self, sensor: str) -> _SensorScans:
        if sensor not in self._sensors:
            if len(self._sensors) >= _MAX_SENSORS:
                raise InvalidInput(f"the robot {self.robot!r} has more than {_MAX_SENSORS} sensors")
            self._sensors[sensor] = _SensorScans(partial(self._place, sensor), sensor)
        return self._sensors[sensor]

    def _place(self, sensor: str, scan: Scan, deadline: float) -> None:
        """Add the placed scan to the unread ones once the pose of its last ray is known, or count it."""
        points, stamps = scan.points(), scan.stamps()  # before the wait, not after it
        try:
            if not self._wait_for_pose(scan, deadline):
                return
            points, valid = self.buffer.place(points, stamps, scan.frame, self.target)
        except LookupFailed as reason:
            self.last_reason = reason
            self._count_dropped(type(reason).__name__.removesuffix("Timeout"))
        else:
            points = points.astype(np.float32, copy=False)  # for type checkers
            placed = PlacedScan(scan, sensor, self.target, points, valid)
            self._count_dropped(_OVERFLOW, self._unread.add([placed]))

    def _count_dropped(self, reason: str, count: int = 1) -> None:
        if count:
            with self._dropped_lock:
                self.dropped[reason] += count

    def _wait_for_pose(self, scan: Scan, deadline: float) -> bool:
        """Wait for the pose of the last ray. False if this listener is closed; raises LookupFailed."""
        began = time.monotonic()
        while not self._closed:
            left_s = max(deadline - time.monotonic(), 0.0)
            try:
                self.buffer.wait(self.target, scan.frame, scan.end_stamp, min(left_s, _LONGEST_WAIT_S))
            except WaitTimeout as reason:
                if left_s <= _LONGEST_WAIT_S:
                    reason.waited_s = max(deadline - began, 0.0)
                    raise
            else:
                return True
        return False

    def __iter__(self) -> Iterator[PlacedScan]:
        return iter(self._unread)

    def __aiter__(self) -> AsyncIterator[PlacedScan]:
        return aiter(self._unread)

    def close(self) -> None:
        """Stop listening; iterations end. A second call does nothing."""
        self._closed = True
        self._opened.close()
        for scans in self._sensors.values():
            scans.close()
        self._unread.close()
