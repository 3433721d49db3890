"""Scans, clouds, pictures and maps to draw, from the network."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import islice, takewhile
from typing import Generic, NamedTuple, Protocol, TypeVar

from zstate._util.bounded import BoundedQueue
from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate._util.refusals import Refusals
from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.tracks import TimeSpan
from zstate.cameras.camera import Camera, camera_from_message
from zstate.cameras.messages import CameraInfo, CompressedImage
from zstate.cameras.plugin import CAMERA_INFO, IMAGE
from zstate.clouds.cloud import cloud_from_message
from zstate.clouds.messages import PointCloud
from zstate.clouds.plugin import CLOUD
from zstate.errors import InvalidInput, LookupFailed
from zstate.ingest.deadline import Deadline
from zstate.net.presence import announce_reader
from zstate.net.session import Session
from zstate.net.subscription import Received, subscribe
from zstate.scans.grid import Grid, grid_from_message
from zstate.scans.messages import LaserScan, OccupancyGrid
from zstate.scans.plugin import MAP, SCAN
from zstate.scans.scan import Scan, scan_from_message
from zstate.streams import StreamName
from zstate.view.pictures import Packet, packet_from_message
from zstate.view.thinned_cloud import ThinnedCloud, thinned_cloud
from zstate.wire.keys import ANY, shortened
from zstate.wire.registry import get_wire

_TIMEOUT_S = 1.0
"""How long a measurement waits for the pose of its end, as in ``ScanListener`` and ``CloudListener``."""
_MAX_WAITING = 256
_MAX_KEPT = 1000
_SCAN_BYTES = 4_000_000
"""Limits of the waiting and of the kept scans of one sensor: half a minute of 1081 rays and 30 Hz."""
_CLOUD_BYTES = 128_000_000
"""Limits of the waiting and of the kept clouds of one sensor: 4 million points with intensity and time."""
_PICTURE_BYTES = 64_000_000
"""The limit of the pictures of one camera: 500 of 720 rows."""
CLOUD_POINTS = 200_000
"""The points that are kept of each cloud of a sensor without a limit of its own."""
_MAX_WRITERS = 64
_UNKNOWN_S = 10.0
"""How long a sensor may be silent after its first scan."""
_TOO_MANY_SENSORS = "too many sensors"
_TOO_MANY_CLOUDS = "too many sensors of clouds"
_TOO_MANY_CAMERAS = "too many cameras"
_TOO_MANY_MAPS = "too many maps"
_FURTHER = {
    _TOO_MANY_SENSORS: "scans of further sensors",
    _TOO_MANY_CLOUDS: "clouds of further sensors",
    _TOO_MANY_CAMERAS: "pictures of further cameras",
    _TOO_MANY_MAPS: "further maps",
}
_ALWAYS = SCAN.name, CAMERA_INFO.name, MAP.name
_BULK = CLOUD.name, IMAGE.name
DECODED_STREAMS = *_ALWAYS, IMAGE.name
"""What surrounds robots, and is decoded to index a recording; of clouds the headers are enough."""

TIME_JUMP_NS = 1_000_000_000
"""A measurement that is so much older than the last one begins again."""


class Measured(Protocol):
    """A scan, a cloud or a picture: measured in ``frame`` from ``stamp`` to ``end_stamp`` [ns]."""

    @property
    def stamp(self) -> int: ...

    @property
    def end_stamp(self) -> int: ...

    @property
    def frame(self) -> str: ...

    @property
    def nbytes(self) -> int: ...


M = TypeVar("M", bound=Measured)
M_co = TypeVar("M_co", bound=Measured, covariant=True)


class WriterName(NamedTuple):
    """A sensor or a map of a robot: ``robot/name``."""

    robot: str
    name: str

    def __str__(self) -> str:
        return f"{self.robot}/{self.name}"


class Sensor(Protocol[M_co]):
    """What one sensor measured, as it is drawn. ``problem`` is why some of it is not, if any."""

    @property
    def frame(self) -> str | None:
        """The frame of the newest one."""
        ...

    @property
    def problem(self) -> str | None: ...

    def settle(self, buffer: TransformBuffer, target: str, at: int | None) -> None:
        """Decide which of them have poses in ``target``, and update ``problem``."""
        ...

    def latest(self, count: int, at: int | None) -> Sequence[M_co]:
        """The last ``count`` that ended until ``at`` [ns]; None: of all. The oldest first."""
        ...

    def within(self, window_ns: int, at: int | None) -> Sequence[M_co]:
        """The last one until ``at`` [ns], and those that ended at most ``window_ns`` before it."""
        ...

    def is_stale(self, at: int | None) -> bool:
        """Whether the sensor has missed its deadline."""
        ...


class WorldData(Protocol):
    """What is around the robots, as it is drawn: scans, clouds, pictures and maps.

    ``problems`` are what cannot be drawn at all, with the reason.
    """

    @property
    def sensors(self) -> Mapping[WriterName, Sensor[Scan]]: ...

    @property
    def clouds(self) -> Mapping[WriterName, Sensor[ThinnedCloud]]: ...

    def limit_clouds(self, name: WriterName, points: int) -> None:
        """Keep at most so many points of each further cloud of a sensor."""
        ...

    @property
    def pictures(self) -> Mapping[WriterName, Sensor[Packet]]: ...

    def cameras_at(self, at: int | None) -> Mapping[WriterName, Camera]:
        """The calibration of each camera ``at`` a stamp [ns]; None: the newest."""
        ...

    @property
    def problems(self) -> Sequence[tuple[str, str]]: ...

    @property
    def span(self) -> TimeSpan | None:
        """The stamps of all scans, clouds and pictures; None if they are only drawn as they arrive."""
        ...

    def maps_at(self, at: int | None) -> Mapping[WriterName, Grid]:
        """The map of each writer ``at`` a stamp [ns]; None: the newest."""
        ...

    def receive_bulk(self, *, on: bool) -> None:
        """Receive clouds and pictures, or end that. They come from a network only if it is on."""
        ...

    def close(self) -> None: ...


@dataclass(eq=False)
class LiveSensor(Generic[M]):
    """What one sensor measured: scans or clouds that wait for the pose of their end, and the last with it.

    Pictures wait for nothing.

    ``dropped`` counts those whose pose did not come within a second, or before too many others waited.
    ``reason`` is why the newest one was dropped, None if it was kept; one that still waits does not count.
    ``clock`` is a monotonic clock [s]. ``max_bytes`` are those of the waiting, and of the kept ones.
    """

    clock: Callable[[], float] = time.monotonic
    max_bytes: int = _SCAN_BYTES
    dropped: int = 0
    reason: LookupFailed | InvalidInput | None = None
    _waiting: BoundedQueue[tuple[M, float]] = field(init=False)
    _kept: BoundedQueue[M] = field(init=False)
    _deadline: Deadline = field(default_factory=lambda: Deadline(_UNKNOWN_S))
    _has_overflowed: bool = False
    _lock: threading.Lock = field(default_factory=fork_safe_lock)

    def __post_init__(self) -> None:
        self._waiting = BoundedQueue(_MAX_WAITING, self.max_bytes)
        self._kept = BoundedQueue(_MAX_KEPT, self.max_bytes)

    def add(self, measured: M) -> None:
        """Keep what has arrived. Called by one thread, the other methods by another."""
        now_s = self.clock()
        self._deadline.on_sample(now_s)
        with self._lock:
            lost = self._waiting.append((measured, now_s + _TIMEOUT_S), measured.nbytes)
            self.dropped += lost
            self._has_overflowed |= lost > 0

    def is_stale(self, at: int | None = None) -> bool:
        """Whether the sensor has missed its deadline, at present."""
        return self._deadline.is_missed(self.clock())

    def keep(self, measured: M) -> None:
        """Keep what has arrived, and needs no pose."""
        self._deadline.on_sample(self.clock())
        with self._lock:
            self._append(measured)

    @property
    def received_s(self) -> float:
        """When the newest one arrived, by ``clock``."""
        return self._deadline.last_s

    @property
    def frame(self) -> str | None:
        """The frame of the newest one."""
        with self._lock:
            newest = self._waiting[0][0] if self._waiting else self._kept[-1] if self._kept else None
        return None if newest is None else newest.frame

    @property
    def problem(self) -> str | None:
        """Why the newest one was dropped, and how many were; None if it was kept."""
        return None if self.reason is None else f"{self.dropped} dropped: {self.reason}"

    def settle(self, buffer: TransformBuffer, target: str, at: int | None = None) -> None:
        """Keep those whose end has a pose in ``target`` by now, and drop those that are too late."""
        while (waiting := self._first_waiting()) is not None:
            measured, deadline_s = waiting
            reason = buffer.explain(target, measured.frame, measured.end_stamp)
            if reason is not None and self.clock() < deadline_s:
                if self._has_overflowed:
                    self.reason, self._has_overflowed = reason, False
                return
            if self._remove_first(waiting, is_dropped=reason is not None):
                self.reason = reason
                if reason is None:
                    with self._lock:
                        self._append(measured)

    def _first_waiting(self) -> tuple[M, float] | None:
        with self._lock:
            return self._waiting[0] if self._waiting else None

    def _remove_first(self, waiting: tuple[M, float], *, is_dropped: bool) -> bool:
        """Remove ``waiting``, unless it was lost as the queue overflowed. Returns whether it was there."""
        with self._lock:
            if not self._waiting or self._waiting[0] is not waiting:
                return False
            self._waiting.popleft()
            self.dropped += is_dropped
        return True

    def _append(self, measured: M) -> None:
        if self._kept and measured.stamp < self._kept[-1].stamp - TIME_JUMP_NS:
            self._kept.clear()  # the clock was set back, or a replay has begun again
        self._kept.append(measured, measured.nbytes)

    def latest(self, count: int, at: int | None = None) -> Sequence[M]:
        """The last ``count`` that ended until ``at`` [ns]; None: of all. The oldest first."""
        with self._lock:
            return [*islice(self._until(at), count)][::-1]

    def within(self, window_ns: int, at: int | None = None) -> Sequence[M]:
        """The last one until ``at`` [ns], and those that ended at most ``window_ns`` before it."""
        with self._lock:
            newest = next(self._until(at), None)
            if newest is None:
                return ()
            begin = newest.end_stamp - window_ns
            return [*takewhile(lambda one: one.end_stamp >= begin, self._until(at))][::-1]

    def _until(self, at: int | None) -> Iterator[M]:
        """Those that ended until ``at``, the newest first."""
        return (one for one in reversed(self._kept) if at is None or one.end_stamp <= at)


class _SensorTable(dict[WriterName, LiveSensor[M]]):
    """The sensors of one stream; ``too_many`` is why another is refused, ``max_bytes`` are those of each."""

    def __init__(self, too_many: str, max_bytes: int) -> None:
        super().__init__()
        self.too_many, self.max_bytes = too_many, max_bytes


class WorldSource(Closeable):
    """Receives the scans, clouds and pictures of all robots, or of ``robots`` only, and all maps.

    Clouds and pictures, up to 60 MB each, are received while ``receive_bulk`` is on; those that were kept
    are dropped when it ends. Without a ``session`` it receives nothing. ``maps``, ``sensors``, ``clouds`` and
    ``pictures`` are by the names of their writers; a map that is withdrawn is removed from ``maps``, and the
    longest stale sensor when there are more than 64. ``refused`` counts messages that are none of these, or
    for which there is no room, by reason; the first of each is logged.
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
        self._sensors = _SensorTable[Scan](_TOO_MANY_SENSORS, _SCAN_BYTES)
        self._clouds = _SensorTable[ThinnedCloud](_TOO_MANY_CLOUDS, _CLOUD_BYTES)
        self._cloud_limits: dict[WriterName, int] = {}
        self._pictures = _SensorTable[Packet](_TOO_MANY_CAMERAS, _PICTURE_BYTES)
        self._cameras: dict[str, tuple[WriterName, Camera]] = {}
        self._maps: dict[str, tuple[WriterName, Grid]] = {}
        self._refusals = Refusals()
        self.refused: Mapping[str, int] = self._refusals.counts
        self._session = session
        self._robot = robots[0] if len(robots) == 1 else ANY
        self._bulk = ExitStack()
        """The subscriptions to clouds and pictures."""
        self._is_receiving_bulk = self._is_closed = False
        self._bulk_lock = fork_safe_lock()
        with ExitStack() as opening:
            if session is not None:
                self._subscribe(opening, session, SCAN.name, self._on_scans)
                self._subscribe(
                    opening, session, CAMERA_INFO.name, self._on_cameras, self._on_camera_withdrawn
                )
                # Maps of other robots, too, are drawn around the selected ones.
                self._subscribe(opening, session, MAP.name, self._on_maps, self._on_withdrawn, robot=ANY)
                self._announce(opening, session, _ALWAYS)
            self._opened = opening.pop_all()

    def _subscribe(
        self,
        opening: ExitStack,
        session: Session,
        stream: StreamName,
        on_messages: Callable[[list[Received]], object],
        on_withdrawn: Callable[[str], object] | None = None,
        *,
        robot: str = "",
    ) -> None:
        subscription = subscribe(
            session,
            self._wire,
            robot or self._robot,
            stream,
            on_messages,
            on_error=self._refusals.count,
            on_withdrawn=on_withdrawn,
        )
        opening.enter_context(subscription)

    def _announce(self, opening: ExitStack, session: Session, streams: Sequence[StreamName]) -> None:
        for announcement in announce_reader(session, self._wire, self._robot, streams):
            opening.enter_context(announcement)

    def receive_bulk(self, *, on: bool) -> None:
        """Subscribe to clouds and pictures, or end that. Nothing is done a second time, nor once closed."""
        with self._bulk_lock:
            if self._session is None or on == self._is_receiving_bulk or self._is_closed:
                return
            if on:
                with ExitStack() as opening:
                    self._subscribe(opening, self._session, CLOUD.name, self._on_clouds)
                    self._subscribe(opening, self._session, IMAGE.name, self._on_pictures)
                    self._announce(opening, self._session, _BULK)
                    self._bulk = opening.pop_all()
            else:
                self._bulk.close()
                with self._lock:
                    self._clouds.clear()
                    self._pictures.clear()
            self._is_receiving_bulk = on

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
    def sensors(self) -> Mapping[WriterName, LiveSensor[Scan]]:
        """The scans of each sensor."""
        with self._lock:
            return dict(self._sensors)

    @property
    def clouds(self) -> Mapping[WriterName, LiveSensor[ThinnedCloud]]:
        """The clouds of each sensor."""
        with self._lock:
            return dict(self._clouds)

    def limit_clouds(self, name: WriterName, points: int) -> None:
        """Keep at most so many points of each further cloud of a sensor, by default 200,000."""
        self._cloud_limits[name] = points

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
            sensor = self._sensor_of(key, self._sensors, self._writer(robot, key))
            if sensor is not None:
                sensor.add(scan)

    def _on_clouds(self, received: list[Received]) -> None:
        for robot, key, message in received:
            if self._selected and robot not in self._selected:
                continue
            name = self._writer(robot, key)
            try:
                assert isinstance(message, PointCloud)
                most = self._cloud_limits.get(name, CLOUD_POINTS)
                cloud = thinned_cloud(cloud_from_message(message, robot), most)
            except InvalidInput as error:
                self._refusals.count("malformed cloud", f"{shortened(key)}: {error}")
                continue
            sensor = self._sensor_of(key, self._clouds, name)
            if sensor is not None:
                sensor.add(cloud)

    @property
    def pictures(self) -> Mapping[WriterName, LiveSensor[Packet]]:
        """The pictures of each camera."""
        with self._lock:
            return dict(self._pictures)

    def cameras_at(self, at: int | None = None) -> Mapping[WriterName, Camera]:
        """The newest calibration of each camera: those before it are not kept."""
        with self._lock:
            return dict(self._cameras.values())

    def _on_pictures(self, received: list[Received]) -> None:
        for robot, key, message in received:
            if self._selected and robot not in self._selected:
                continue
            assert isinstance(message, CompressedImage)
            sensor = self._sensor_of(key, self._pictures, self._writer(robot, key))
            if sensor is not None:
                sensor.keep(packet_from_message(message, robot))

    def _on_cameras(self, received: list[Received]) -> None:
        for robot, key, message in received:
            if self._selected and robot not in self._selected:
                continue
            assert isinstance(message, CameraInfo)
            try:
                camera = camera_from_message(message, robot) if message.is_calibrated else None
            except InvalidInput as error:
                self._refusals.count("malformed calibration", f"{shortened(key)}: {error}")
                continue
            with self._lock:
                if camera is None:
                    self._cameras.pop(key, None)
                elif key in self._cameras or len(self._cameras) < _MAX_WRITERS:
                    self._cameras[key] = self._writer(robot, key), camera

    def _on_camera_withdrawn(self, key: str) -> None:
        with self._lock:
            self._cameras.pop(key, None)

    def _sensor_of(self, key: str, sensors: _SensorTable[M], name: WriterName) -> LiveSensor[M] | None:
        """The sensor of this name, which replaces the longest stale one; None if there is no room."""
        with self._lock:
            if name in sensors:
                return sensors[name]
            stale = [(one.received_s, other) for other, one in sensors.items() if one.is_stale()]
            if len(sensors) < _MAX_WRITERS or stale:
                if len(sensors) >= _MAX_WRITERS:
                    del sensors[min(stale)[1]]
                return sensors.setdefault(name, LiveSensor(self._clock, sensors.max_bytes))
        text = (
            f"{shortened(key)} is not drawn, as {_MAX_WRITERS} other sensors are; "
            "`zstate view ROBOT` draws those of one robot"
        )
        self._refusals.count(sensors.too_many, text)
        return None

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
        with self._bulk_lock:
            self._is_closed = True
            self._bulk.close()
        self._opened.close()
