"""Archive: lookups in the recordings of months, of which each reads the row groups that it needs.

The history of a robot is that of all its recordings together, each edge by the rules of ``Recording``:

======================================  ================================================================
the archive holds                       lookups get
======================================  ================================================================
a recording after another one           one history, interpolated between the two as elsewhere
the same, with another model, or other  two histories: nothing is interpolated between the two, and each
static edges                            instant has the model and the edges of its own time
two recordings of the same time         one history; of samples with one stamp that of the recording that
                                        began later counts
======================================  ================================================================
"""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyarrow has no annotations

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate.archive.files import Files, Group, Groups, Stamps, by_file, needed_groups
from zstate.archive.layout import EDGES, JOINTS, PARTS, POSE, WRITERS, folder_of, value_of
from zstate.archive.ledger import Entry, compacted_stem, newest_compaction
from zstate.archive.scene import Scene, Track
from zstate.archive.storage import Store, arrow, in_threads, numbers_of
from zstate.buffer.buffer import TransformBuffer, feed_of
from zstate.buffer.stored_samples import load_joints, load_poses
from zstate.clock import check_stamp, check_stamps
from zstate.errors import InvalidInput, LookupFailed, MessageError
from zstate.model.joint_history import JointHistory
from zstate.model.robot import coordinate_names, velocity_columns_by_position
from zstate.stream_registry import stream_named
from zstate.wire.messages import Message
from zstate.wire.native import decode

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

T = TypeVar("T")

_MAX_ROWS = 300_000
"""Samples of one track in memory of one thread of ``lookup_many``, unless one stamp needs more."""

_STAMPS = 1 << 15
"""Stamps looked up at once, whose poses stay in the processor's cache."""

_FEW = 4
"""Only samples next to the stamps are copied if there are so many samples for each stamp."""

Needed: TypeAlias = Mapping[Track, set[str]]
"""The tracks that lookups read, and of joints the coordinates."""

Rows: TypeAlias = slice | NDArray[np.intp]

_ALL: Rows = slice(None)

_LOOKED_UP = (JOINTS, PARTS, EDGES)


@dataclass(frozen=True)
class Coverage:
    """What one ``recording``, by the name of its file, has of a robot: stamps from ``start`` to ``end`` [ns].

    Both are inclusive. ``rows`` are numbers of samples and messages by stream.
    """

    recording: str
    start: int
    end: int
    rows: Mapping[str, int]


class ArchivedMessage(NamedTuple):
    """A message of a stream, the name of its writer, and when it was recorded [ns]."""

    name: str
    message: Message
    log_time: int


class _Segment(NamedTuple):
    """The files of consecutive recordings of a robot with the same frames."""

    scene: Scene
    entries: list[Entry]

    @property
    def first(self) -> int:
        """The first stamp [ns]."""
        return min(one.first for one in self.entries)

    @property
    def last(self) -> int:
        """The last stamp [ns]."""
        return max(one.last for one in self.entries)

    def tracks(self) -> dict[Track, list[Entry]]:
        """The files by what they have samples of."""
        found: dict[Track, list[Entry]] = {}
        for entry in self.entries:
            found.setdefault((entry.stream, entry.key), []).append(entry)
        return found


class _Part(NamedTuple):
    """The ``rows`` of instants, and the row groups around these."""

    rows: slice
    groups: Mapping[Track, Sequence[Group]]


class Archive:
    """The archive ``url``: a folder, or ``s3://BUCKET/PREFIX`` and the other schemes of pyarrow.fs.

    `zstate archive` and ``zstate.archive.import_recording`` add to it. Methods may be called from any thread;
    each sees the recordings that are complete when it is called. Copies and pickles open the same archive.
    Raises LibraryMissing without pyarrow, and RecordingError for a URL that cannot be opened; methods raise
    RecordingError for a file that they need and cannot read, and InvalidInput for a robot that is not in the
    archive.
    """

    def __init__(self, url: str) -> None:
        self.url = str(url)
        self._files = Files(Store(self.url))
        self._scenes: dict[tuple[str, str], Scene] = {}

    def __repr__(self) -> str:
        return f"<Archive {self.url!r}>"

    def __reduce__(self) -> tuple[Any, ...]:
        return Archive, (self.url,)

    def robots(self) -> tuple[str, ...]:
        """The robots of the archive, by name."""
        return self._repeated(self._robots)

    def _robots(self) -> tuple[str, ...]:
        complete = {*self._files.ledger.recorded_names(), compacted_stem(self._files.ledger.number)}
        names = map(value_of, self._files.store.folders(folder_of(WRITERS)))
        return tuple(sorted(name for name in names if complete & set(self._files.writers_of(name))))

    def coverage(self, robot: str) -> tuple[Coverage, ...]:
        """What each recording has of ``robot``, by the first stamp."""
        self._check_robot(robot)
        found: list[Coverage] = []
        by_import: dict[str, list[Entry]] = {}
        for one in self._repeated(lambda: self._files.records(robot, self._files.imports_of(robot))):
            by_import.setdefault(one.name, []).append(one)
        for entries in by_import.values():
            if entries:
                rows: Counter[str] = Counter()
                for one in entries:
                    rows[one.stream] += one.rows
                first, last = min(one.first for one in entries), max(one.last for one in entries)
                found.append(Coverage(entries[0].recording, first, last, rows))
        return tuple(sorted(found, key=lambda one: (one.start, one.end, one.recording)))

    def buffer(self, robot: str, start: int, end: int) -> TransformBuffer:
        """A buffer with all samples of ``robot`` from ``start`` to ``end`` [ns], both inclusive.

        It has the samples next to these as well, so that lookups between the two equal those in the whole
        archive. Raises InvalidInput if the model or a static edge changes in between, and without any
        recording.
        """
        return self._repeated(lambda: self._window_buffer(robot, _window(start, end)))

    def _window_buffer(self, robot: str, stamps: Stamps) -> TransformBuffer:
        segment = self._only_segment(robot, stamps)
        groups = {
            track: self._files.groups(entries, stamps, between=True)
            for track, entries in segment.tracks().items()
            if track[0] in _LOOKED_UP
        }
        return self._filled(segment, groups, None)

    def joint_states(self, robot: str, start: int, end: int) -> JointHistory:
        """The joint states of ``robot`` with stamps in [start, end) [ns], as ``Recording.joint_states``.

        Raises as ``buffer``.
        """
        return self._repeated(lambda: self._window_joint_states(robot, _window(start, end)))

    def _window_joint_states(self, robot: str, stamps: Stamps) -> JointHistory:
        start, end = stamps.tolist()
        segment = self._only_segment(robot, stamps)
        scene = segment.scene
        if scene.parts:
            return self.buffer(robot, start, end).joint_states(robot, start, end)
        whole = segment.tracks().get((JOINTS, ""), [])
        entries = [one for one in whole if one.first < end and one.last >= start]
        table = self._table(self._files.groups(entries, stamps, between=True), None)
        names = [] if table is None else table.column_names
        if scene.model is None:
            joints = coordinates = rates = tuple(_named(names, "position."))
        else:
            joints, coordinates = scene.model.joint_names, coordinate_names(scene.model)
            rates = tuple(coordinates[slot] for slot in velocity_columns_by_position(scene.model))
        if table is None:
            empty = np.empty((0, len(coordinates)))
            return JointHistory(joints, coordinates, rates, np.empty(0, np.int64), empty)
        history = JointHistory(
            *(joints, coordinates, rates, numbers_of(table.column("stamp"))),
            _matrix(table, "position.", coordinates),
            _known(table, "velocity.", rates),
            _known(table, "effort.", rates),
        )
        first, last = history.stamps.searchsorted((start, end)).tolist()
        window = history.select(slice(first, last))
        velocities, efforts = (
            None if block is None or np.isnan(block).all() else block
            for block in (window.velocities, window.efforts)
        )
        return replace(window, velocities=velocities, efforts=efforts)

    def lookup_many(
        self, target: str, source: str, stamps: ArrayLike, *, robot: str
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """The pose of ``source`` in ``target`` at ``stamps``: pose7 (T, 7), and which are valid, (T,).

        Both are as those of ``Recording(path, robot).lookup_many``, of all recordings of ``robot``. Stamps
        [ns] may be in any order, months apart: of each file only row groups around them are read, and of
        joints only those between the two frames. Raises UnknownFrame, AmbiguousFrame and Disconnected.
        """
        self._check_robot(robot)
        instants, order = check_stamps(stamps), None
        if not (np.diff(instants) > 0).all():
            instants, order = np.unique(instants, return_inverse=True)
        poses, valid = self._repeated(lambda: self._poses(target, source, instants, robot))
        return (poses, valid) if order is None else (poses[order], valid[order])

    def _poses(
        self, target: str, source: str, instants: Stamps, robot: str
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """The poses at ascending ``instants``."""
        poses, valid = np.empty((len(instants), 7)), np.zeros(len(instants), np.bool_)
        if not len(instants):
            return poses, valid
        failure: LookupFailed | None = None
        is_known = False
        for segment in self._segments(robot, self._files.around(robot, _LOOKED_UP, instants, between=False)):
            tracks = segment.tracks()
            edges = self._edges(segment)
            try:
                needed = segment.scene.buffer(edges).needed(target, source)
            except LookupFailed as error:
                failure = error
                continue
            is_known = True
            chosen = {track: tracks.get(track, []) for track in needed}

            def look_up(part: _Part, segment: _Segment = segment, needed: Needed = needed) -> None:
                filled = self._filled(segment, part.groups, needed, instants[part.rows])
                for start in range(part.rows.start, part.rows.stop, _STAMPS):
                    rows = slice(start, min(start + _STAMPS, part.rows.stop))
                    found, is_found = filled.lookup_many(target, source, instants[rows])
                    if is_found.all():
                        poses[rows], valid[rows] = found, True
                    else:
                        poses[rows][is_found] = found[is_found]
                        valid[rows] |= is_found

            in_threads(look_up, self._parts(chosen, instants))
        if failure is not None and not is_known:
            raise failure
        poses[~valid] = np.nan
        return poses, valid

    def messages(self, robot: str, stream: str, start: int, end: int) -> Iterator[ArchivedMessage]:
        """The messages of ``stream`` of ``robot`` with stamps in ``[start, end)`` [ns], as recorded.

        Of streams that are not joint states or transforms. Raises InvalidInput for one that no plugin brings.
        """
        kind = stream_named(stream).type
        self._check_robot(robot)
        stamps = _window(start, end)
        entries = self._repeated(lambda: self._files.around(robot, [stream], stamps, between=True))
        entries.sort(key=lambda one: one.order[:2])
        for name in dict.fromkeys(one.name for one in entries if one.stream == stream):
            table = self._repeated(partial(self._messages_of, robot, stream, name, stamps))
            if table is None:
                continue
            for row in table.to_pylist():
                if start <= row["stamp"] < end:
                    try:
                        message = decode(row["message"], row["encoding"], kind)
                    except MessageError as error:
                        raise InvalidInput(f"{stream} of {robot!r}: {error}") from None
                    yield ArchivedMessage(row["name"], message, row["log_time"])

    def _messages_of(self, robot: str, stream: str, name: str, stamps: Stamps) -> Any:
        """The messages of one import in their order, a pyarrow.Table; None without any."""
        entries = [one for one in self._files.records(robot, [name]) if one.stream == stream]
        columns = ("stamp", "log_time", "number", "name", "encoding", "message")
        groups = self._files.groups(entries, stamps, between=True)
        tables = [self._files.read(one, columns) for one in by_file(groups)]
        return arrow().concat_tables(tables).sort_by("number") if tables else None

    def duckdb(self) -> DuckDBPyConnection:
        """A DuckDB connection with views of the archive, and ``zstate_pose``; see ``zstate.archive.sql``."""
        from zstate.archive.sql import connect  # noqa: PLC0415 - an extra

        return self._repeated(lambda: connect(self._files.store, partial(lookup_rows, self)))

    def _repeated(self, call: Callable[[], T]) -> T:
        """The result of ``call``; again if `compact` has replaced files during it, which it may miss."""
        while True:
            number = self._files.refresh()
            try:
                result = call()
            except Exception:  # also those of DuckDB
                if newest_compaction(self._files.store) == number:
                    raise
            else:
                if newest_compaction(self._files.store) == number:
                    return result

    def _has(self, robot: str) -> bool:
        ledger, stems = self._files.ledger, self._files.writers_of(robot)
        return compacted_stem(ledger.number) in stems or any(map(ledger.has_record, stems))

    def _check_robot(self, robot: str) -> None:
        if not self._repeated(partial(self._has, robot)):
            known = ", ".join(map(repr, self.robots())) or "none"
            raise InvalidInput(f"the archive {self.url!r} has no robot {robot!r}; its robots: {known}")

    def _segments(self, robot: str, entries: Sequence[Entry]) -> list[_Segment]:
        """``entries`` by the frames that were in effect, in the order of the recordings."""
        segments: list[_Segment] = []
        last = ""
        for entry in sorted(entries, key=lambda one: one.order):
            if entry.frames != last or not segments:
                last = entry.frames
                if (robot, last) not in self._scenes:
                    self._scenes[robot, last] = Scene.read(self._files, robot, last)
                segments.append(_Segment(self._scenes[robot, last], []))
            segments[-1].entries.append(entry)
        return segments

    def _only_segment(self, robot: str, stamps: Stamps) -> _Segment:
        self._check_robot(robot)
        first, last = int(stamps[0]), int(stamps[-1])
        segments = self._segments(robot, self._files.around(robot, _LOOKED_UP, stamps, between=True))
        inside = [one for one in segments if one.first <= last and one.last >= first]
        if len(inside) > 1:
            changes = ", ".join(str(one.first) for one in inside[1:])
            raise InvalidInput(
                f"the model or the static edges of {robot!r} change between {first} and {last}, at "
                f"{changes}: read the time before and after that apart (lookup_many does)"
            )
        if not inside:
            raise InvalidInput(
                f"the archive {self.url!r} has no recording of {robot!r} between {first} and {last}; "
                "coverage(robot) lists them"
            )
        return inside[0]

    def _edges(self, segment: _Segment) -> list[tuple[str, str]]:
        """The moving edges of a segment. The parent is the one of the last file."""
        parents: dict[str, str] = {}
        for (stream, key), entries in segment.tracks().items():
            if stream == EDGES:
                parents[key] = self._parent(entries[-1])
        return [(parent, child) for child, parent in parents.items()]

    def _parent(self, entry: Entry) -> str:
        footer = self._files.footer(entry.path)
        group = footer.row_group(0)
        return group.column(footer.schema.names.index("parent")).statistics.min

    def _parts(self, chosen: Mapping[Track, Sequence[Entry]], instants: Stamps) -> list[_Part]:
        """Consecutive ``instants`` with the row groups around them, as many at once as fit into memory."""
        found: list[_Part] = []
        whole = {
            track: self._files.groups(entries, instants, between=False) for track, entries in chosen.items()
        }
        waiting = [_Part(slice(0, len(instants)), whole)]
        while waiting:
            part = waiting.pop()
            start, stop = part.rows.start, part.rows.stop
            rows = max((sum(one.rows for one in groups) for groups in part.groups.values()), default=0)
            if rows <= _MAX_ROWS or stop - start == 1:
                found.append(part)
                continue
            middle = (start + stop) // 2
            for half in (slice(middle, stop), slice(start, middle)):
                around = {
                    track: needed_groups(groups, instants[half]) for track, groups in part.groups.items()
                }
                waiting.append(_Part(half, around))
        return found

    def _filled(
        self,
        segment: _Segment,
        groups: Mapping[Track, Sequence[Group]],
        needed: Needed | None,
        instants: Stamps | None = None,
    ) -> TransformBuffer:
        """A buffer with the samples of ``groups``; of joints only the positions ``needed``, if given.

        Samples that are not next to one of ``instants``, if these are given, may be left out.
        """
        filled = segment.scene.buffer(())
        feed = feed_of(filled.buffer)
        for (stream, key), files in groups.items():
            track = filled.tracks.get((stream, key))
            if stream != EDGES and track is None:
                continue
            names = None if needed is None else needed[stream, key]
            is_pruned = names is not None and stream != EDGES
            columns = ["stamp", *(f"position.{name}" for name in names)] if names and is_pruned else None
            table = self._table(files, columns)
            if table is None:
                continue
            parent = ""
            if track is None:
                parent = table.column("parent")[-1].as_py()
                table = table.filter(arrow("compute").compute.equal(table.column("parent"), parent))
            times = numbers_of(table.column("stamp"))
            rows = _ALL if instants is None else _rows_around(times, instants)
            if track is None:
                covariances = _covariances(table)
                triangles = None if covariances is None else covariances[rows]
                load_poses(feed, (parent, key), times[rows], _matrix(table, "", POSE, rows), triangles)
                continue
            coordinates = coordinate_names(track.model)
            rates = tuple(coordinates[slot] for slot in velocity_columns_by_position(track.model))
            velocities = None if is_pruned else _known(table, "velocity.", rates, rows)
            positions = _matrix(table, "position.", coordinates, rows)
            load_joints(feed, track, times[rows], positions, velocities)
        return filled.buffer

    def _table(self, groups: Sequence[Group], columns: Sequence[str] | None) -> Any:
        """The rows of ``groups`` by ascending stamps, each stamp once; None without any."""
        pa = arrow()
        ordered = sorted(by_file(groups), key=lambda one: one.piece.entries[0].order)
        tables = self._files.read_all(ordered, columns)
        if not tables:
            return None
        table = pa.concat_tables(tables, promote_options="default")
        stamps = numbers_of(table.column("stamp"))
        if (np.diff(stamps) > 0).all():
            return table
        parts = [part for one, table in zip(ordered, tables, strict=True) for part in _by_entry(one, table)]
        parts.sort(key=lambda part: part[0].order)
        table = pa.concat_tables([part for _, part in parts], promote_options="default")
        stamps = numbers_of(table.column("stamp"))
        order = np.argsort(stamps, kind="stable")
        is_last = np.append(np.diff(stamps[order]) > 0, True)
        return table.take(pa.array(order[is_last]))


def _by_entry(groups: Groups, table: Any) -> Iterator[tuple[Entry, Any]]:
    """The rows of each import in the ``table`` of samples that was read of ``groups``."""
    stamps = numbers_of(table.column("stamp"))
    for entry in groups.piece.entries:
        first, last = stamps.searchsorted(entry.first), stamps.searchsorted(entry.last, "right")
        if first < last:
            yield entry, table.slice(first, last - first)


def _window(start: int, end: int) -> Stamps:
    stamps = np.array([check_stamp(start), check_stamp(end)], np.int64)
    if start > end:
        raise InvalidInput(f"a window begins before its end; got {start} and {end}")
    return stamps


def _named(names: Sequence[str], prefix: str) -> list[str]:
    return [name.removeprefix(prefix) for name in names if name.startswith(prefix)]


def _rows_around(times: Stamps, instants: Stamps) -> Rows:
    """The samples next to ascending ``instants``, by their ascending ``times``; all if that is quicker."""
    if len(instants) * _FEW > len(times):
        return _ALL
    after = times.searchsorted(instants)
    is_next = np.zeros(len(times), np.bool_)
    is_next[np.minimum(after, len(times) - 1)] = True
    is_next[np.maximum(after - 1, 0)] = True
    return np.flatnonzero(is_next)


def _matrix(table: Any, prefix: str, names: Sequence[str], rows: Rows = _ALL) -> NDArray[np.float64]:
    """The columns ``prefix`` + ``names``, row by row; 0 for those not read, NaN for unknown numbers."""
    matrix = np.zeros((len(numbers_of(table.column("stamp"))[rows]), len(names)))
    for number, name in enumerate(names):
        if prefix + name in table.column_names:
            matrix[:, number] = numbers_of(table.column(prefix + name))[rows]
    return matrix


def _known(table: Any, prefix: str, names: Sequence[str], rows: Rows = _ALL) -> NDArray[np.float64] | None:
    """The same; None without any such column, or number."""
    if not _named(table.column_names, prefix):
        return None
    matrix = _matrix(table, prefix, names, rows)
    return None if np.isnan(matrix).all() else matrix


def _covariances(table: Any) -> NDArray[np.float64] | None:
    """The covariances (T, 21), NaN where they are not known; None if none is."""
    column = table.column("covariance").combine_chunks()
    if column.null_count == len(column):
        return None
    rows = np.full((len(column), 21), np.nan)
    is_known = column.is_valid().to_numpy(zero_copy_only=False)
    rows[is_known] = np.array(column.drop_null().flatten().to_numpy(zero_copy_only=False)).reshape(-1, 21)
    return rows


def lookup_rows(
    archive: Archive, robots: NDArray[Any], target: str, source: str, stamps: Stamps
) -> NDArray[np.float64]:
    """The pose (T, 7) at each stamp of the robot in the same row; NaN where there is none.

    Frames that one of the robots does not have are unknown there. Raises LookupFailed if none has them.
    """
    found = np.full((len(stamps), 7), np.nan)
    failure: LookupFailed | None = None
    is_known = False
    for robot in np.unique(robots).tolist():
        rows = np.flatnonzero(robots == robot)
        try:
            found[rows] = archive.lookup_many(target, source, stamps[rows], robot=robot)[0]
            is_known = True
        except LookupFailed as error:
            failure = error
    if failure is not None and not is_known:
        raise failure
    return found
