"""Scans and maps to draw, from the network."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from zstate._util.bounded import BoundedQueue
from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate._util.refusals import Refusals
from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.tracks import TimeSpan
from zstate.errors import InvalidInput, LookupFailed
from zstate.ingest.deadline import Deadline
from zstate.net.presence import announce_reader
from zstate.net.session import Session
from zstate.net.subscription import Received, subscribe
from zstate.scans.grid import Grid, grid_from_message
from zstate.scans.messages import LaserScan, OccupancyGrid
from zstate.scans.plugin import MAP, SCAN
from zstate.scans.scan import Scan, scan_from_message
from zstate.wire.keys import ANY, shortened
from zstate.wire.registry import get_wire

_TIMEOUT_S = 1.0
"""How long a scan waits for the pose of its last ray, as in ``ScanListener``."""
_MAX_WAITING = 256
_MAX_SCANS = 1000
_MAX_BYTES = 4_000_000
"""Limits of the waiting and of the kept scans of one sensor: half a minute of 1081 rays and 30 Hz."""
_MAX_WRITERS = 64
_UNKNOWN_S = 10.0
"""How long a sensor may be silent after its first scan."""
_TOO_MANY_SENSORS = "too many sensors"
_TOO_MANY_MAPS = "too many maps"
_FURTHER = {_TOO_MANY_SENSORS: "scans of further sensors", _TOO_MANY_MAPS: "further maps"}
WORLD_STREAMS = SCAN.name, MAP.name
"""What surrounds robots."""

TIME_JUMP_NS = 1_000_000_000
"""A scan that is so much older than the last one begins again."""


class WriterName(NamedTuple):
    """A sensor or a map of a robot: ``robot/name``."""

    robot: str
    name: str

    def __str__(self) -> str:
        return f"{self.robot}/{self.name}"


class Sensor(Protocol):
    """The scans of one sensor, as they are drawn. ``problem`` is why some are not; None if all are."""

    @property
    def frame(self) -> str | None:
        """The frame of the newest scan."""
        ...

    @property
    def problem(self) -> str | None: ...

    def settle(self, buffer: TransformBuffer, target: str, at: int | None) -> None:
        """Decide which scans have poses in ``target``, and update ``problem``."""
        ...

    def latest(self, count: int, at: int | None) -> Sequence[Scan]:
        """The last ``count`` scans that ended until ``at`` [ns]; None: of all. The oldest first."""
        ...

    def is_stale(self, at: int | None) -> bool:
        """Whether the sensor has missed its deadline."""
        ...


class WorldData(Protocol):
    """What is around the robots, as it is drawn: scans and maps.

    ``problems`` are what cannot be drawn at all, with the reason.
    """

    @property
    def sensors(self) -> Mapping[WriterName, Sensor]: ...

    @property
    def problems(self) -> Sequence[tuple[str, str]]: ...

    @property
    def span(self) -> TimeSpan | None:
        """The stamps of all scans; None if they are only drawn as they arrive."""
        ...

    def maps_at(self, at: int | None) -> Mapping[WriterName, Grid]:
        """The map of each writer ``at`` a stamp [ns]; None: the newest."""
        ...

    def close(self) -> None: ...


@dataclass(eq=False)
class SensorScans:
    """The scans of one sensor: those that wait for the pose of their last ray, and the last ones with it.

    ``dropped`` counts scans whose pose did not come within a second, or before too many others waited.
    ``reason`` is why the newest scan was dropped, None if it was kept; one that still waits does not count.
    ``clock`` is a monotonic clock [s].
    """

    clock: Callable[[], float] = time.monotonic
    dropped: int = 0
    reason: LookupFailed | InvalidInput | None = None
    _waiting: BoundedQueue[tuple[Scan, float]] = field(
        default_factory=lambda: BoundedQueue(_MAX_WAITING, _MAX_BYTES)
    )
    _scans: BoundedQueue[Scan] = field(default_factory=lambda: BoundedQueue(_MAX_SCANS, _MAX_BYTES))
    _deadline: Deadline = field(default_factory=lambda: Deadline(_UNKNOWN_S))
    _has_overflowed: bool = False
    _lock: threading.Lock = field(default_factory=fork_safe_lock)

    def add(self, scan: Scan) -> None:
        """Keep a scan that has arrived. Called by one thread, the other methods by another."""
        now_s = self.clock()
        self._deadline.on_sample(now_s)
        with self._lock:
            lost = self._waiting.append((scan, now_s + _TIMEOUT_S), scan.nbytes)
            self.dropped += lost
            self._has_overflowed |= lost > 0

    def is_stale(self, at: int | None = None) -> bool:
        """Whether the sensor has missed its deadline, at present."""
        return self._deadline.is_missed(self.clock())

    @property
    def received_s(self) -> float:
        """When the newest scan arrived, by ``clock``."""
        return self._deadline.last_s

    @property
    def frame(self) -> str | None:
        """The frame of the newest scan."""
        with self._lock:
            newest = self._waiting[0][0] if self._waiting else self._scans[-1] if self._scans else None
        return None if newest is None else newest.frame

    @property
    def problem(self) -> str | None:
        """Why the newest scan was dropped, and how many were; None if it was kept."""
        return None if self.reason is None else f"{self.dropped} dropped: {self.reason}"

    def settle(self, buffer: TransformBuffer, target: str, at: int | None = None) -> None:
        """Keep the scans whose last ray has a pose in ``target`` by now, and drop those that are too late."""
        while (waiting := self._first_waiting()) is not None:
            scan, deadline_s = waiting
            reason = buffer.explain(target, scan.frame, scan.end_stamp)
            if reason is not None and self.clock() < deadline_s:
                if self._has_overflowed:
                    self.reason, self._has_overflowed = reason, False
                return
            if self._remove_first(waiting, is_dropped=reason is not None):
                self.reason = reason
                if reason is None:
                    self._keep(scan)

    def _first_waiting(self) -> tuple[Scan, float] | None:
        with self._lock:
            return self._waiting[0] if self._waiting else None

    def _remove_first(self, waiting: tuple[Scan, float], *, is_dropped: bool) -> bool:
        """Remove ``waiting``, unless it was lost as the queue overflowed. Returns whether it was there."""
        with self._lock:
            if not self._waiting or self._waiting[0] is not waiting:
                return False
            self._waiting.popleft()
            self.dropped += is_dropped
        return True

    def _keep(self, scan: Scan) -> None:
        if self._scans and scan.stamp < self._scans[-1].stamp - TIME_JUMP_NS:
            self._scans.clear()  # the clock was set back, or a replay has begun again
        self._scans.append(scan, scan.nbytes)

    def latest(self, count: int, at: int | None = None) -> Sequence[Scan]:
        """The last ``count`` scans that ended until ``at`` [ns]; None: of all. The oldest first."""
        found: list[Scan] = []
        for scan in reversed(self._scans):
            if len(found) == count:
                break
            if at is None or scan.end_stamp <= at:
                found.append(scan)
        return found[::-1]


class WorldSource(Closeable):
    """Receives the scans of all robots, or of ``robots`` only, and all maps; nothing without a ``session``.

    ``maps`` and ``sensors`` are by the names of their writers; a map that is withdrawn is removed from
    ``maps``, and the longest stale sensor when there are more than 64. ``refused`` counts messages that are
    no scan or map, or for which there is no room, by reason; the first of each is logged.
    """

    def __init__(
        self,
        session: Session | None,
        robots: Sequence[str] = (),
        wire: str = "native",
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock = clock
        self._selected = frozenset(robots)
        self._wire = get_wire(wire)
        self._lock = fork_safe_lock()
        self._sensors: dict[WriterName, SensorScans] = {}
        self._maps: dict[str, tuple[WriterName, Grid]] = {}
        self._refusals = Refusals()
        self.refused: Mapping[str, int] = self._refusals.counts
        with ExitStack() as opening:
            if session is not None:
                robot = robots[0] if len(robots) == 1 else ANY
                count = self._refusals.count
                scans = subscribe(session, self._wire, robot, SCAN.name, self._on_scans, on_error=count)
                opening.enter_context(scans)
                maps = subscribe(
                    session,
                    self._wire,
                    ANY,
                    MAP.name,
                    self._on_maps,
                    on_error=count,
                    on_withdrawn=self._on_withdrawn,
                )
                opening.enter_context(maps)
                for announcement in announce_reader(session, self._wire, robot, WORLD_STREAMS):
                    opening.enter_context(announcement)
            self._opened = opening.pop_all()

    span = None

    def maps_at(self, at: int | None = None) -> Mapping[WriterName, Grid]:
        """The newest map of each writer: those before it are not kept."""
        with self._lock:
            return dict(self._maps.values())

    @property
    def problems(self) -> Sequence[tuple[str, str]]:
        """The sensors and maps for which there was no room."""
        return [
            (further, f"{self.refused[reason]} refused; the first: {self._refusals.first[reason]}")
            for reason, further in _FURTHER.items()
            if reason in self.refused
        ]

    @property
    def sensors(self) -> Mapping[WriterName, SensorScans]:
        """The scans of each sensor."""
        with self._lock:
            return dict(self._sensors)

    def _on_scans(self, received: list[Received]) -> None:
        for robot, key, message in received:
            if self._selected and robot not in self._selected:
                continue
            try:
                assert isinstance(message, LaserScan)
                scan = scan_from_message(message, robot)
            except InvalidInput as error:
                self._refusals.count("malformed scan", f"{shortened(key)}: {error}")
                continue
            sensor = self._scans_of(self._writer(robot, key))
            if sensor is None:
                text = (
                    f"{shortened(key)} is not drawn, as {_MAX_WRITERS} other sensors are; "
                    "`zstate view ROBOT` draws those of one robot"
                )
                self._refusals.count(_TOO_MANY_SENSORS, text)
            else:
                sensor.add(scan)

    def _scans_of(self, name: WriterName) -> SensorScans | None:
        """The scans of a sensor, which replaces the longest stale one; None if there is no room."""
        with self._lock:
            if name not in self._sensors and len(self._sensors) >= _MAX_WRITERS:
                stale = [(one.received_s, other) for other, one in self._sensors.items() if one.is_stale()]
                if not stale:
                    return None
                del self._sensors[min(stale)[1]]
            return self._sensors.setdefault(name, SensorScans(self._clock))

    def _on_maps(self, received: list[Received]) -> None:
        for robot, key, message in received:
            try:
                assert isinstance(message, OccupancyGrid)
                grid = grid_from_message(message, robot)
            except InvalidInput as error:
                self._refusals.count("malformed map", f"{shortened(key)}: {error}")
                continue
            if not self._set_map(key, self._writer(robot, key), grid):
                text = (
                    f"{shortened(key)} is not drawn, as {_MAX_WRITERS} other maps are; stop publishing one "
                    "of them (`zstate ls` lists them), and open the view again"
                )
                self._refusals.count(_TOO_MANY_MAPS, text)

    def _set_map(self, key: str, name: WriterName, grid: Grid) -> bool:
        """Whether there was room for the map."""
        with self._lock:
            if key not in self._maps and len(self._maps) >= _MAX_WRITERS:
                return False
            self._maps[key] = name, grid
            return True

    def _on_withdrawn(self, key: str) -> None:
        with self._lock:
            self._maps.pop(key, None)

    def _writer(self, robot: str, key: str) -> WriterName:
        return WriterName(robot, self._wire.edge_writer_name(key) or "")

    def close(self) -> None:
        """Stop listening. A second call does nothing."""
        self._opened.close()
