"""Scans and maps to draw, from a recording.

Scans and maps stay in the file: a lidar writes more than all joints of a robot together. ``RecordedWorld``
indexes them once, while the poses are loaded, and reads those around the instant on display.
"""

from __future__ import annotations

import statistics
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate._util.refusals import Refusals
from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.tracks import TimeSpan
from zstate.errors import InvalidInput
from zstate.ingest.deadline import PERIODS, is_stale
from zstate.recording.decode import DecodedMessage, DecodedRecording, LatchedState
from zstate.recording.reader import RecordingReader
from zstate.scans.grid import Grid, grid_from_message
from zstate.scans.messages import LaserScan, OccupancyGrid
from zstate.scans.plugin import MAP, SCAN
from zstate.scans.scan import Scan, scan_from_message
from zstate.streams import StreamName
from zstate.view.world_source import TIME_JUMP_NS, WriterName
from zstate.wire.messages import Message

_READ_AHEAD = 30
"""Scans that are read together: a second of most sensors."""
_COMPARED_NS = 1_000_000_000
"""Stamps and log times of a recording are compared so often."""


class RecordedScans:
    """The scans of one sensor in a recording, by the stamps of their last rays.

    A scan that is not newer than the one before is left out; one that is more than a second older begins
    again, as the poses do when a clock was set back. ``read(begin, end)`` yields the scans with log times
    [ns] in [begin, end). ``problem`` is why the last ray of the newest scan on display has no pose, None if
    it has one.
    """

    def __init__(self, read: Callable[[int, int], Iterator[Scan]]) -> None:
        self.frame: str | None = None
        self.problem: str | None = None
        self._read = read
        self._ends: list[int] = []
        self._log_times: list[int] = []
        self._loaded: dict[int, Scan] = {}
        """By row of the index."""

    def add(self, scan: Scan, log_time: int) -> None:
        """Index the next scan of the recording."""
        if self._ends and scan.end_stamp <= self._ends[-1]:
            if scan.end_stamp >= self._ends[-1] - TIME_JUMP_NS:
                return
            self._ends.clear()
            self._log_times.clear()
        self.frame = scan.frame
        self._ends.append(scan.end_stamp)
        self._log_times.append(log_time)

    @property
    def span(self) -> TimeSpan:
        """The stamps of the last rays of the first and the last scan."""
        return TimeSpan(self._ends[0], self._ends[-1])

    def settle(self, buffer: TransformBuffer, target: str, at: int | None) -> None:
        """Update ``problem`` for the newest scan until ``at`` [ns]."""
        end, reason = self._count(at), None
        if end and self.frame is not None:
            reason = buffer.explain(target, self.frame, self._ends[end - 1])
        self.problem = None if reason is None else f"rays without a pose: {reason}"

    def latest(self, count: int, at: int | None) -> Sequence[Scan]:
        """The last ``count`` scans that ended until ``at`` [ns]; None: of all. The oldest first."""
        end = self._count(at)
        rows = range(max(0, end - count), end)
        if not all(row in self._loaded for row in rows):
            self._load(range(rows.start, min(rows.stop + _READ_AHEAD, len(self._ends))))
        return [self._loaded[row] for row in rows if row in self._loaded]

    def is_stale(self, at: int | None) -> bool:
        """Whether the sensor had missed its deadline ``at`` [ns]. Never at the end of the recording."""
        end = self._count(at)
        if at is None or end < 2:
            return False
        intervals = [after - before for before, after in pairwise(self._ends[max(0, end - PERIODS) : end])]
        return is_stale((at - self._ends[end - 1]) / 1e9, 1e9 / statistics.median(intervals))

    def _count(self, at: int | None) -> int:
        """The number of scans that ended until ``at``."""
        return len(self._ends) if at is None else bisect_right(self._ends, at)

    def _load(self, rows: range) -> None:
        """Keep the scans of these rows, and read the missing ones."""
        loaded = {row: scan for row, scan in self._loaded.items() if row in rows}
        missing = [row for row in rows if row not in loaded]
        for scan in self._read(self._log_times[missing[0]], self._log_times[missing[-1]] + 1):
            row = bisect_left(self._ends, scan.end_stamp)
            if row in rows and self._ends[row] == scan.end_stamp:
                loaded.setdefault(row, scan)
        self._loaded = loaded


class RecordedMap:
    """The maps of one writer in a recording, each in effect until the next.

    ``read(log_time)`` returns the map that was recorded at a log time [ns].
    """

    def __init__(self, read: Callable[[int], Grid | None]) -> None:
        self._read = read
        self._log_times: list[int] = []
        self._withdrawn: set[int] = set()
        self._loaded: tuple[int, Grid | None] = -1, None
        """The row of the map that was read last, and that map."""

    def add(self, log_time: int, *, is_withdrawn: bool) -> None:
        """Index the next change of the map."""
        if is_withdrawn:
            self._withdrawn.add(len(self._log_times))
        self._log_times.append(log_time)

    def at(self, log_time: int | None) -> Grid | None:
        """The map in effect at ``log_time`` [ns], or at the end; None if there is none."""
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
    """The scans and maps of all robots in the recording at ``path``, at any instant of it.

    Call ``add`` with each message before anything is drawn. One thread draws; another may close.
    Raises RecordingError if the recording cannot be read.
    """

    problems: Sequence[tuple[str, str]] = ()

    def __init__(self, path: str | Path) -> None:
        self._refusals = Refusals("recorded scans and maps")
        self._reader = RecordingReader(path)
        self._recording = DecodedRecording(self._reader, self._refusals.count)
        self._lock = fork_safe_lock()
        self._is_open = True
        self._log_times = LogTimes()
        self._latched = LatchedState()
        self._maps: dict[WriterName, RecordedMap] = {}
        self.sensors: dict[WriterName, RecordedScans] = {}

    @property
    def span(self) -> TimeSpan | None:
        """The stamps of all scans; None without scans."""
        spans = [sensor.span for sensor in self.sensors.values()]
        if not spans:
            return None
        return TimeSpan(min(one.oldest for one in spans), max(one.newest for one in spans))

    def add(self, decoded: DecodedMessage, buffer: TransformBuffer) -> None:
        """Index the next message of the recording, which ``buffer`` has."""
        is_map = isinstance(decoded.message, OccupancyGrid) and self._add_map(decoded)
        if isinstance(decoded.message, LaserScan):
            self._add_scan(decoded)
        due = self._log_times.due
        if (is_map or due is None or decoded.log_time >= due) and (span := buffer.span()) is not None:
            self._log_times.add(span.newest, decoded.log_time)

    def _add_scan(self, decoded: DecodedMessage) -> None:
        scan, name = self._to_scan(decoded), _name(decoded)
        if scan is not None:
            if name not in self.sensors:
                self.sensors[name] = RecordedScans(partial(self._read_scans, name))
            self.sensors[name].add(scan, decoded.log_time)

    def _add_map(self, decoded: DecodedMessage) -> bool:
        """Returns whether the map has changed: it is repeated for readers that start in the middle."""
        if self._latched.update(decoded) is None:
            return False
        name = _name(decoded)
        if name not in self._maps:
            self._maps[name] = RecordedMap(partial(self._read_map, name))
        assert isinstance(decoded.message, OccupancyGrid)
        self._maps[name].add(decoded.log_time, is_withdrawn=not decoded.message.cells)
        return True

    def maps_at(self, at: int | None) -> Mapping[WriterName, Grid]:
        """The maps in effect ``at`` a stamp [ns]; None: at the end."""
        log_time = None if at is None else self._log_times.log_time(at)
        grids = {name: maps.at(log_time) for name, maps in self._maps.items()}
        return {name: grid for name, grid in grids.items() if grid is not None}

    def _read_scans(self, name: WriterName, begin: int, end: int) -> Iterator[Scan]:
        for decoded in self._messages(name, SCAN.name, begin, end):
            scan = self._to_scan(decoded)
            if scan is not None:
                yield scan

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
    ) -> Sequence[DecodedMessage]:
        with self._lock:
            if not self._is_open:
                return ()
            messages = self._recording.messages((name.robot,), (stream,), begin, end)
            return [decoded for decoded in messages if _name(decoded) == name]

    def _to_scan(self, decoded: DecodedMessage) -> Scan | None:
        assert isinstance(decoded.message, LaserScan)
        try:
            return scan_from_message(decoded.message, decoded.writer.robot)
        except InvalidInput as error:
            self._refusals.count("malformed scan", f"{_name(decoded)}: {error}")
            return None

    def close(self) -> None:
        """Close the file. A second call does nothing."""
        with self._lock:
            self._is_open = False
            self._reader.close()


def _name(decoded: DecodedMessage) -> WriterName:
    return WriterName(decoded.writer.robot, decoded.writer.edge_writer or "")
