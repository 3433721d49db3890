"""Scans, clouds, pictures and maps to draw, from a recording.

They stay in the file: a lidar writes more than all joints of a robot together. ``RecordedWorld`` indexes them
once, while the poses are loaded, clouds by their headers only, and reads those around the instant on display.
"""

from __future__ import annotations

import statistics
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Generic, TypeVar

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate._util.refusals import Refusals
from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.tracks import TimeSpan
from zstate.cameras.camera import Camera, camera_from_message
from zstate.cameras.messages import CameraInfo, CompressedImage
from zstate.cameras.plugin import CAMERA_INFO, IMAGE
from zstate.clouds.cloud import Cloud, cloud_from_message
from zstate.clouds.messages import PointCloud
from zstate.clouds.plugin import CLOUD
from zstate.errors import InvalidInput
from zstate.ingest.deadline import PERIODS, is_stale
from zstate.recording.decode import DecodedMessage, DecodedRecording, LatchedState, RecordedHeader
from zstate.recording.reader import RecordingReader
from zstate.scans.grid import Grid, grid_from_message
from zstate.scans.messages import LaserScan, OccupancyGrid
from zstate.scans.plugin import MAP, SCAN
from zstate.scans.scan import Scan, scan_from_message
from zstate.streams import StreamName
from zstate.view.pictures import Packet, packet_from_message
from zstate.view.thinned_cloud import ThinnedCloud, thinned_cloud
from zstate.view.world_source import CLOUD_POINTS, TIME_JUMP_NS, M, Measured, WriterName
from zstate.wire.keys import full_name
from zstate.wire.messages import Message

_SCANS_AHEAD = 30
"""Scans that are read together: a second of most sensors."""
_FEW_AHEAD = 3
"""Clouds and pictures that are read together: one takes milliseconds."""
_COMPARED_NS = 1_000_000_000
"""Stamps and log times of a recording are compared so often."""

V = TypeVar("V")


class RecordedSensor(Generic[M]):
    """The scans, clouds or pictures of one sensor in a recording, by the stamps of their ends.

    One that is not newer than the one before is left out; one that is more than a second older begins again,
    as the poses do when a clock was set back. ``read(begin, end)`` yields those with log times [ns] in
    [begin, end), ``ahead`` more than are needed. ``lasts_ns`` is how long each takes if only its stamp is
    read for the index. ``problem`` is why the end of the newest one on display has no pose, None if it has
    one.
    """

    def __init__(
        self,
        read: Callable[[int, int], Iterator[M]],
        ahead: int = _SCANS_AHEAD,
        lasts_ns: int | None = None,
    ) -> None:
        self.frame: str | None = None
        self.problem: str | None = None
        self._read = read
        self._ahead = ahead
        self._lasts_ns = lasts_ns
        self._ends: list[int] = []
        self._log_times: list[int] = []
        self._loaded: dict[int, M | None] = {}
        """By row of the index; None for one that cannot be read."""

    def add(self, measured: Measured, log_time: int) -> None:
        """Index the next one of the recording."""
        self._add_end(measured.frame, measured.end_stamp, log_time)

    def add_start(self, frame: str, stamp: int, log_time: int) -> None:
        """Index the next one, measured in ``frame`` from ``stamp`` [ns] on for ``lasts_ns``."""
        self._add_end(frame, stamp + (self._lasts_ns or 0), log_time)

    def _add_end(self, frame: str, end: int, log_time: int) -> None:
        if self._ends and end <= self._ends[-1]:
            if end >= self._ends[-1] - TIME_JUMP_NS:
                return
            self._ends.clear()
            self._log_times.clear()
        self.frame = frame
        self._ends.append(end)
        self._log_times.append(log_time)

    def _end_of(self, measured: Measured) -> int:
        return measured.end_stamp if self._lasts_ns is None else measured.stamp + self._lasts_ns

    def read_again(self) -> None:
        """Forget what was read."""
        self._loaded = {}

    @property
    def span(self) -> TimeSpan:
        """The stamps of the ends of the first and the last one."""
        return TimeSpan(self._ends[0], self._ends[-1])

    def settle(self, buffer: TransformBuffer, target: str, at: int | None) -> None:
        """Update ``problem`` for the newest one until ``at`` [ns]."""
        end, reason = self._count(at), None
        if end and self.frame is not None:
            reason = buffer.explain(target, self.frame, self._ends[end - 1])
        self.problem = None if reason is None else f"points without a pose: {reason}"

    def latest(self, count: int, at: int | None) -> Sequence[M]:
        """The last ``count`` that ended until ``at`` [ns]; None: of all. The oldest first."""
        end = self._count(at)
        return self._rows(range(max(0, end - count), end))

    def within(self, window_ns: int, at: int | None) -> Sequence[M]:
        """The last one until ``at`` [ns], and those that ended at most ``window_ns`` before it."""
        end = self._count(at)
        begin = bisect_left(self._ends, self._ends[end - 1] - window_ns) if end else 0
        return self._rows(range(begin, end))

    def _rows(self, rows: range) -> Sequence[M]:
        if not all(row in self._loaded for row in rows):
            self._load(range(rows.start, min(rows.stop + self._ahead, len(self._ends))))
        return [one for row in rows if (one := self._loaded.get(row)) is not None]

    def is_stale(self, at: int | None) -> bool:
        """Whether the sensor had missed its deadline ``at`` [ns]. Never at the end of the recording."""
        end = self._count(at)
        if at is None or end < 2:
            return False
        intervals = [after - before for before, after in pairwise(self._ends[max(0, end - PERIODS) : end])]
        return is_stale((at - self._ends[end - 1]) / 1e9, 1e9 / statistics.median(intervals))

    def _count(self, at: int | None) -> int:
        """The number of those that ended until ``at``."""
        return len(self._ends) if at is None else bisect_right(self._ends, at)

    def _load(self, rows: range) -> None:
        """Keep these rows, and read the missing ones."""
        loaded = {row: one for row, one in self._loaded.items() if row in rows}
        missing = [row for row in rows if row not in loaded]
        loaded.update(dict.fromkeys(missing))
        for one in self._read(self._log_times[missing[0]], self._log_times[missing[-1]] + 1):
            row = bisect_left(self._ends, end := self._end_of(one))
            if row in missing and self._ends[row] == end and loaded[row] is None:
                loaded[row] = one
        self._loaded = loaded


class RecordedValue(Generic[V]):
    """The maps of one writer, or the calibrations of a camera, each in effect until the next.

    ``read(log_time)`` returns the one that was recorded at a log time [ns].
    """

    def __init__(self, read: Callable[[int], V | None]) -> None:
        self._read = read
        self._log_times: list[int] = []
        self._withdrawn: set[int] = set()
        self._loaded: tuple[int, V | None] = -1, None
        """The row that was read last, and its value."""

    def add(self, log_time: int, *, is_withdrawn: bool) -> None:
        """Index the next change."""
        if is_withdrawn:
            self._withdrawn.add(len(self._log_times))
        self._log_times.append(log_time)

    def at(self, log_time: int | None) -> V | None:
        """The one in effect at ``log_time`` [ns], or at the end; None if there is none."""
        row = (len(self._log_times) if log_time is None else bisect_right(self._log_times, log_time)) - 1
        if row < 0 or row in self._withdrawn:
            return None
        if row != self._loaded[0]:
            self._loaded = row, self._read(self._log_times[row])
        return self._loaded[1]


class LogTimes:
    """The log time for each stamp of a recording, linear between pairs that are a second apart.

    A log time is the time of reception by the recorder's clock; stamps may be of a simulated clock.
    """

    def __init__(self) -> None:
        self.due: int | None = None
        """The log time [ns] after which the next pair is needed; None before the first."""
        self._stamps: list[int] = []
        self._log_times: list[int] = []

    def add(self, stamp: int, log_time: int) -> None:
        """Add the newest stamp at ``log_time``. An older one than the last begins again."""
        self.due = log_time + _COMPARED_NS
        if self._stamps and stamp < self._stamps[-1]:
            self._stamps.clear()
            self._log_times.clear()
        if not self._stamps or stamp > self._stamps[-1]:
            self._stamps.append(stamp)
            self._log_times.append(log_time)

    def log_time(self, stamp: int) -> int | None:
        """When ``stamp`` was recorded [ns], at least the first log time; None at or after the last stamp."""
        row = bisect_right(self._stamps, stamp) - 1
        if row == len(self._stamps) - 1:
            return None
        if row < 0:
            return self._log_times[0]
        (before, after), (first, last) = self._stamps[row : row + 2], self._log_times[row : row + 2]
        return first + (last - first) * (stamp - before) // (after - before)


class RecordedWorld(Closeable):
    """The scans, clouds, pictures and maps of all robots in the recording at ``path``, at any instant of it.

    Call ``add`` with each message, and ``add_clouds``, before anything is drawn. One thread draws; another
    may close. Raises RecordingError if the recording cannot be read.
    """

    problems: Sequence[tuple[str, str]] = ()

    def __init__(self, path: str | Path) -> None:
        self._refusals = Refusals("recorded scans, clouds, pictures and maps")
        self._reader = RecordingReader(path)
        self._recording = DecodedRecording(self._reader, self._refusals.count)
        self._lock = fork_safe_lock()
        self._is_open = True
        self._log_times = LogTimes()
        self._latched = LatchedState()
        self._maps: dict[WriterName, RecordedValue[Grid]] = {}
        self._cameras: dict[WriterName, RecordedValue[Camera]] = {}
        self.pictures: dict[WriterName, RecordedSensor[Packet]] = {}
        self.sensors: dict[WriterName, RecordedSensor[Scan]] = {}
        self.clouds: dict[WriterName, RecordedSensor[ThinnedCloud]] = {}
        self._cloud_limits: dict[WriterName, int] = {}

    @property
    def span(self) -> TimeSpan | None:
        """The stamps of all scans, clouds and pictures; None without any."""
        measured = *self.sensors.values(), *self.clouds.values(), *self.pictures.values()
        spans = [sensor.span for sensor in measured]
        if not spans:
            return None
        return TimeSpan(min(one.oldest for one in spans), max(one.newest for one in spans))

    def add(self, decoded: DecodedMessage, buffer: TransformBuffer) -> None:
        """Index the next message of the recording, which ``buffer`` has."""
        is_value = isinstance(decoded.message, (OccupancyGrid, CameraInfo)) and self._add_value(decoded)
        if isinstance(decoded.message, LaserScan):
            self._add_scan(decoded)
        if isinstance(decoded.message, CompressedImage):
            self._add_picture(decoded)
        due = self._log_times.due
        if (is_value or due is None or decoded.log_time >= due) and (span := buffer.span()) is not None:
            self._log_times.add(span.newest, decoded.log_time)

    def _add_scan(self, decoded: DecodedMessage) -> None:
        scan, name = self._to_scan(decoded), _name(decoded)
        if scan is not None:
            if name not in self.sensors:
                self.sensors[name] = RecordedSensor(partial(self._read_scans, name))
            self.sensors[name].add(scan, decoded.log_time)

    def add_clouds(self) -> None:
        """Index all clouds by their headers: only one of each sensor is read, for how long a turn takes."""
        for header in self._recording.headers(CLOUD.name):
            name = _name(header)
            if name not in self.clouds:
                if (lasts_ns := self._cloud_duration(name, header.log_time)) is None:
                    continue
                read = partial(self._read_clouds, name)
                self.clouds[name] = RecordedSensor(read, _FEW_AHEAD, lasts_ns)
            self.clouds[name].add_start(full_name(name.robot, header.frame), header.stamp, header.log_time)

    def _cloud_duration(self, name: WriterName, log_time: int) -> int | None:
        """How long after its stamp the cloud recorded at ``log_time`` ends [ns]; None if it is none."""
        messages = self._messages(name, CLOUD.name, log_time, log_time + 1)
        clouds = (self._to_cloud(decoded) for decoded in messages)
        return next((one.end_stamp - one.stamp for one in clouds if one is not None), None)

    def limit_clouds(self, name: WriterName, points: int) -> None:
        """Keep at most so many points of each cloud of a sensor, by default 200,000."""
        if points > self._cloud_limits.get(name, CLOUD_POINTS):
            self.clouds[name].read_again()
        self._cloud_limits[name] = points

    def receive_bulk(self, *, on: bool) -> None:
        """Does nothing: clouds and pictures are read from the file when they are drawn."""

    def _add_picture(self, decoded: DecodedMessage) -> None:
        assert isinstance(decoded.message, CompressedImage)
        name = _name(decoded)
        if name not in self.pictures:
            self.pictures[name] = RecordedSensor(partial(self._read_pictures, name), _FEW_AHEAD)
        self.pictures[name].add(packet_from_message(decoded.message, name.robot), decoded.log_time)

    def _add_value(self, decoded: DecodedMessage) -> bool:
        """Returns whether it has changed: it is repeated for readers that start in the middle."""
        if self._latched.update(decoded) is None:
            return False
        name, message = _name(decoded), decoded.message
        if isinstance(message, OccupancyGrid):
            maps = self._maps.setdefault(name, RecordedValue(partial(self._read_map, name)))
            maps.add(decoded.log_time, is_withdrawn=not message.cells)
        if isinstance(message, CameraInfo):
            cameras = self._cameras.setdefault(name, RecordedValue(partial(self._read_camera, name)))
            cameras.add(decoded.log_time, is_withdrawn=not message.is_calibrated)
        return True

    def maps_at(self, at: int | None) -> Mapping[WriterName, Grid]:
        """The maps in effect ``at`` a stamp [ns]; None: at the end."""
        return self._in_effect(self._maps, at)

    def cameras_at(self, at: int | None) -> Mapping[WriterName, Camera]:
        """The calibrations in effect ``at`` a stamp [ns]; None: at the end."""
        return self._in_effect(self._cameras, at)

    def _in_effect(
        self, values: Mapping[WriterName, RecordedValue[V]], at: int | None
    ) -> Mapping[WriterName, V]:
        log_time = None if at is None else self._log_times.log_time(at)
        found = {name: value.at(log_time) for name, value in values.items()}
        return {name: value for name, value in found.items() if value is not None}

    def _read_scans(self, name: WriterName, begin: int, end: int) -> Iterator[Scan]:
        for decoded in self._messages(name, SCAN.name, begin, end):
            scan = self._to_scan(decoded)
            if scan is not None:
                yield scan

    def _read_clouds(self, name: WriterName, begin: int, end: int) -> Iterator[ThinnedCloud]:
        for decoded in self._messages(name, CLOUD.name, begin, end):
            cloud = self._to_cloud(decoded)
            if cloud is not None:
                yield thinned_cloud(cloud, self._cloud_limits.get(name, CLOUD_POINTS))

    def _read_pictures(self, name: WriterName, begin: int, end: int) -> Iterator[Packet]:
        for decoded in self._messages(name, IMAGE.name, begin, end):
            assert isinstance(decoded.message, CompressedImage)
            yield packet_from_message(decoded.message, name.robot)

    def _read_camera(self, name: WriterName, log_time: int) -> Camera | None:
        info: Message | None = None
        for decoded in self._messages(name, CAMERA_INFO.name, log_time, log_time + 1):
            info = decoded.message
        try:
            return camera_from_message(info, name.robot) if isinstance(info, CameraInfo) else None
        except InvalidInput as error:
            self._refusals.count("malformed calibration", f"{name}: {error}")
            return None

    def _read_map(self, name: WriterName, log_time: int) -> Grid | None:
        grid: Message | None = None
        for decoded in self._messages(name, MAP.name, log_time, log_time + 1):
            grid = decoded.message
        try:
            return grid_from_message(grid, name.robot) if isinstance(grid, OccupancyGrid) else None
        except InvalidInput as error:
            self._refusals.count("malformed map", f"{name}: {error}")
            return None

    def _messages(
        self, name: WriterName, stream: StreamName, begin: int, end: int
    ) -> Iterator[DecodedMessage]:
        with self._lock:
            if not self._is_open:
                return
            messages = self._recording.messages((name.robot,), (stream,), begin, end)
            yield from (decoded for decoded in messages if _name(decoded) == name)

    def _to_scan(self, decoded: DecodedMessage) -> Scan | None:
        assert isinstance(decoded.message, LaserScan)
        try:
            return scan_from_message(decoded.message, decoded.writer.robot)
        except InvalidInput as error:
            self._refusals.count("malformed scan", f"{_name(decoded)}: {error}")
            return None

    def _to_cloud(self, decoded: DecodedMessage) -> Cloud | None:
        assert isinstance(decoded.message, PointCloud)
        try:
            cloud = cloud_from_message(decoded.message, decoded.writer.robot)
            _ = cloud.end_stamp  # raises for impossible times
        except InvalidInput as error:
            self._refusals.count("malformed cloud", f"{_name(decoded)}: {error}")
            return None
        return cloud

    def close(self) -> None:
        """Close the file. A second call does nothing."""
        with self._lock:
            self._is_open = False
            self._reader.close()


def _name(decoded: DecodedMessage | RecordedHeader) -> WriterName:
    return WriterName(decoded.writer.robot, decoded.writer.edge_writer or "")
