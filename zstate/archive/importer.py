"""Import of a recording into an archive: the samples that lookups in the recording read, and all messages.

A robot has what ``Recording(path, robot).buffer()`` holds, by the rules there: a history that another one
replaces is not imported. The recording is read once for all robots. Joint states are decoded in batches, with
their efforts; moving edges, and the joints of several drivers, are taken from a buffer in parts while it is
filled. Memory does not grow with the recording.
"""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyarrow has no annotations

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zstate._util.refusals import Refusals
from zstate.archive.layout import (
    EDGES,
    FRAMES,
    JOINTS,
    MODELS,
    PARTS,
    POSE,
    SUFFIX,
    WRITERS,
    TableFile,
    WrittenFile,
    cuts_by_date,
    folder_of,
    frames_schema,
    model_schema,
    record_schema,
    write_small,
    writers_schema,
)
from zstate.archive.ledger import Ledger, record_path
from zstate.archive.storage import Store, arrow, bytes_digest, file_digest
from zstate.buffer.buffer import RECORDING_HISTORY_S, TransformBuffer, feed_of
from zstate.buffer.joint_samples import track_samples
from zstate.buffer.stored_samples import take_before
from zstate.buffer.tracks import JointTrack, PoseTrack
from zstate.errors import InvalidInput
from zstate.ingest.counters import Counters
from zstate.model.joint_history import JointHistory
from zstate.model.robot import RobotModel
from zstate.recording.decode import (
    DecodedMessage,
    DecodedRecording,
    JoinedMessages,
    RecordedWriter,
    UndecodedRecord,
)
from zstate.recording.errors import RecordingError
from zstate.recording.export import joint_columns
from zstate.recording.joint_parts import has_parts
from zstate.recording.joint_states import DELAYED_NS, JointStateBatch, RecordedJointReader
from zstate.recording.mcap.file import split_files
from zstate.recording.reader import RecordingReader
from zstate.recording.recording import RecordingLoader
from zstate.recording.stream_export import plain_columns
from zstate.stream_registry import stream_named
from zstate.streams import JOINT_STREAMS, StreamName
from zstate.wire.messages import RobotDescription
from zstate.wire.native import encode, encoding_of

NewPath = Callable[[], Path]

_MESSAGES = 4096
"""Messages after which samples are moved from the buffer to files, and messages of a stream written."""

_PROGRESS = 50_000
"""Messages after which progress is reported."""

_WAITING_BYTES = 64_000_000
"""Bytes of records of all robots after which all are decoded."""

_LISTED = ("stream", "robot", "date", "key", "rows", "first", "last", "groups", "columns")
_ROBOTS = 32
"""Robots for which a recording is read once: each has row groups in memory."""

_MOVING = ("tf", "transforms")
_READ_BY_JOINTS = {*JOINT_STREAMS, "robot_description"}
_IN_FILES_OF_THEIR_OWN = {*JOINT_STREAMS, "tf", "transforms", "tf_static", "robot_description", "clock"}
_DATED_NS = 10**17
"""Stamps before 1973 are those of a simulation: they have no date."""


@dataclass
class ImportReport:
    """What one import has added: ``rows`` by stream, in ``files`` of ``size`` bytes, of these ``robots``.

    ``is_known`` marks a recording that the archive had already: nothing was added. ``refused`` counts the
    messages that could not be used, by reason.
    """

    path: Path
    is_known: bool = False
    robots: Sequence[str] = ()
    rows: Counter[str] = field(default_factory=Counter[str])
    files: int = 0
    size: int = 0
    refused: Counter[str] = field(default_factory=Counter[str])


def import_recording(
    url: str, path: str | Path, on_progress: Callable[[str], object] = lambda text: None
) -> ImportReport:
    """Add the recording ``path`` to the archive ``url``, which is made if it is missing.

    A recording that was added before adds nothing. An import that is interrupted leaves the archive as it
    was; another one of the same recording completes it. Each file of a split recording is added by itself.
    ``on_progress(text)`` is called now and then. Raises RecordingError for a recording that cannot be read
    or is not complete, and an archive that cannot be written, and InvalidInput for a recording in simulated
    time, whose stamps have no date.
    """
    store, path = Store(url), Path(path)
    parts = [path] if path.is_dir() else split_files(path)[0]
    reports = [_import_part(store, part, on_progress) for part in parts]
    whole = ImportReport(path, all(one.is_known for one in reports))
    for one in reports:
        whole.robots = sorted({*whole.robots, *one.robots})
        whole.rows += one.rows
        whole.files += one.files
        whole.size += one.size
        whole.refused += one.refused
    return whole


def _import_part(store: Store, path: Path, on_progress: Callable[[str], object]) -> ImportReport:
    with RecordingReader(path, is_alone=True) as reader:
        if not reader.complete:
            text = f"{str(path)!r} is not complete: {'; '.join(reader.losses) or 'it has no end'}"
            advice = (
                "wait until it is recorded, or let `zstate recover` write a complete file of what is there"
            )
            raise RecordingError(f"{text}; {advice}", path=str(path))
        name = file_digest(storage.path for storage in reader.storages)
        if _has_all(store, name):
            return ImportReport(path, is_known=True)
        refusals = Refusals(f"recorded messages of {path.name!r}")
        decoded = DecodedRecording(reader, refusals.count)
        report = ImportReport(path, robots=decoded.names)
        with store.staging(name) as folder:
            rows: list[dict[str, Any]] = []
            pending: dict[str, Path] = {}
            new_path = map(folder.joinpath, map(str, count()))
            for first in range(0, len(decoded.names), _ROBOTS):
                reading = _Reading(reader, decoded, decoded.names[first : first + _ROBOTS], new_path.__next__)
                for text in reading.run(refusals):
                    on_progress(text)
                for one in reading.robots:
                    rows += listed(one.files, one.scene, pending, name)
                    pending |= one.small_files(store, name)
            imported = time.time_ns()
            for row in rows:
                row |= {"recording": path.name, "recorded": reader.span[0] if reader.span else 0}
                row["imported"] = imported
                report.rows[row["stream"]] += row["rows"]
                report.size += row["bytes"]
            report.files = len(rows)
            report.refused.update(refusals.counts)
            for target, staged in pending.items():
                store.put(staged, target)
            staged = new_path.__next__()
            write_small(staged, record_schema(), rows)
            store.put(staged, record_path(name))  # the import counts from now on
    return report


def _has_all(store: Store, name: str) -> bool:
    """Whether the import ``name`` is complete, and none of its files was lost or removed since."""
    ledger = Ledger(store)
    if not ledger.is_complete(name):
        return False
    return all(store.has(path) for path in {one.path for one in ledger.files_of(name)})


def listed(
    files: Iterable[WrittenFile], scene: str, pending: dict[str, Path], name: str
) -> Iterator[dict[str, Any]]:
    """The rows of the import's record of ``files``, which get their places in ``pending``."""
    for file in files:
        path = f"{folder_of(file.stream, file.robot, file.date)}/{name}.{file.digest}{SUFFIX}"
        pending[path] = file.staged
        yield {
            "path": path,
            "bytes": file.staged.stat().st_size,
            "frames": scene,
            "import": name,
            **{one: getattr(file, one) for one in _LISTED},
        }


class SampleTable:
    """The samples of one stream, robot and key, in a file for each date; they may begin again."""

    def __init__(self, new_path: NewPath, stream: str, robot: str, key: str) -> None:
        self._new_path = new_path
        self._head = stream, robot
        self._key = key
        self._files: dict[str, TableFile] = {}
        self._written: list[WrittenFile] = []
        self._columns: dict[str, list[str]] = {}

    def write(self, stamps: NDArray[np.int64], columns: Mapping[str, Any]) -> None:
        """Append samples with ascending ``stamps``; ``columns`` are arrays of numpy or pyarrow."""
        if len(stamps) and int(stamps[0]) < _DATED_NS:
            raise InvalidInput(
                f"{self._head[0]} of {self._head[1]!r} has the stamp {int(stamps[0])}, which is before 1973: "
                "simulated time has no date, and an archive is by date; keep the recording as a file"
            )
        table = arrow().table({"stamp": stamps, **columns})
        for day, rows in cuts_by_date(stamps):
            self._file(day, table.column_names).write(table.slice(rows.start, rows.stop - rows.start))

    def _file(self, day: str, columns: list[str]) -> TableFile:
        file = self._files.get(day)
        if file is not None and (file.is_full or self._columns[day] != columns):
            self._written.append(self._files.pop(day).finish())
            file = None
        if file is None:
            file = self._files[day] = TableFile(self._new_path(), *self._head, day, self._key)
            self._columns[day] = columns
        return file

    def restart(self) -> None:
        """Remove all samples: another history replaces them."""
        for file in self._files.values():
            file.abandon()
        for written in self._written:
            written.staged.unlink()
        self._files, self._written = {}, []

    def finish(self) -> list[WrittenFile]:
        """The finished files."""
        files = [*self._written, *(file.finish() for file in self._files.values())]
        self._files, self._written = {}, []
        return files


class _Numbered(NamedTuple):
    """A message, the stamp by which it is found [ns], and its number in the recording."""

    stamp: int
    number: int
    decoded: DecodedMessage


class _Taken(NamedTuple):
    """The parent of an edge whose samples were taken from the buffer, and the stamp of the last one [ns]."""

    parent: str
    last: int


class _Reading:
    """Reads a recording once for the imports of ``names``."""

    def __init__(
        self,
        reader: RecordingReader,
        decoded: DecodedRecording,
        names: Sequence[str],
        new_path: NewPath,
    ) -> None:
        self._reader, self._decoded, self._new_path = reader, decoded, new_path
        self._names = names
        self.robots: list[_RobotImport] = []

    def run(self, refusals: Refusals) -> Iterator[str]:
        """Write all files; texts of the progress are returned in between."""
        decoded = self._decoded
        # What is decoded before the imports begin is decoded again by them.
        beginning = DecodedRecording(self._reader, lambda reason, text: None)
        self.robots = [
            _RobotImport(name, decoded, beginning, self._new_path, refusals) for name in self._names
        ]
        receivers: dict[RecordedWriter, list[_RobotImport]] = {}
        for one in self.robots:
            for writer in one.writers_read:
                receivers.setdefault(writer, []).append(one)
        streams = {writer.stream for writer in receivers}
        total, waiting = sum(decoded.writers[writer] for writer in receivers), 0
        selected = set(self._names) if len(self._names) < len(decoded.names) else None
        for number, undecoded in enumerate(decoded.records(selected, streams), 1):
            for one in receivers.get(undecoded.channel.writer, ()):
                one.add(undecoded)
            waiting += len(undecoded.record.payload)
            if waiting >= _WAITING_BYTES:
                waiting = 0
                for one in self.robots:
                    one.flush()
            if not number % _PROGRESS:
                yield f"{number} of {total} messages"
        for one in self.robots:
            one.finish()


class _RobotImport:
    """Writes files of one ``robot`` of the recording ``decoded``, each to the next path, ``new_path()``.

    ``beginning`` is the same recording, for what is read ahead. ``files`` and ``scene``, the digest of its
    frames, are known after ``finish``.
    """

    def __init__(
        self,
        robot: str,
        decoded: DecodedRecording,
        beginning: DecodedRecording,
        new_path: NewPath,
        refusals: Refusals,
    ) -> None:
        self._robot, self._new_path = robot, new_path
        self._writers = {one: number for one, number in decoded.writers.items() if one.robot == robot}
        self.writers_read = {one for one in decoded.writers_of((robot,)) if one.stream != "clock"}
        self._tables: dict[tuple[str, str], SampleTable] = {}
        self._taken: dict[tuple[str, str], _Taken] = {}
        self._frames: list[dict[str, Any]] = []
        self._model: RobotModel | None = None
        self._messages: dict[tuple[StreamName, str], list[_Numbered]] = {}
        self._number = 0
        self.files: list[WrittenFile] = []
        self.scene = ""
        self._joints: RecordedJointReader | None = None
        self._kinds: set[str] = set()
        if any(one.robot == robot and one.stream in JOINT_STREAMS for one in decoded.writers):
            joints = RecordedJointReader(decoded, robot, refusals.count)
            if joints.model is None or not has_parts(beginning, robot, joints.model):
                self._joints = joints
        self._buffer = TransformBuffer(RECORDING_HISTORY_S)
        self._loader = RecordingLoader.of(beginning, self._buffer, Counters(), (robot,))
        self._joined = JoinedMessages(decoded)
        self._decoded = decoded
        self._waiting: list[UndecodedRecord] = []
        self._description = b""

    def add(self, undecoded: UndecodedRecord) -> None:
        """The next record of ``writers_read``."""
        stream = undecoded.channel.writer.stream
        if self._joints is not None and stream in _READ_BY_JOINTS:
            self._write_batches(self._joints.add(undecoded))
            if stream in JOINT_STREAMS:
                return
        waiting = self._waiting
        if stream == "robot_description":
            if undecoded.record.payload == self._description:
                return  # it is written again every 10 s
            self._description = undecoded.record.payload
            self._insert_waiting()  # by the model that they belong to
            waiting = self._waiting
        waiting.append(undecoded)
        if len(waiting) >= _MESSAGES or stream == "robot_description":
            self._insert_waiting()

    def flush(self) -> None:
        """Decode what was added."""
        if self._joints is not None:
            self._write_batches(self._joints.flush())
        self._insert_waiting()

    def finish(self) -> None:
        """Write what is left, and end all files."""
        self.flush()
        if self._joints is not None:
            self._write_batches(self._joints.finish())
        self._take(self._buffer, is_end=True)
        for key in list(self._messages):
            self._write_messages(key)
        self._describe(self._buffer)
        for table in self._tables.values():
            self.files += table.finish()
        rows = sorted(json.dumps(row, sort_keys=True) for row in self._frames)
        self.scene = bytes_digest("\n".join(rows).encode())

    def _table(self, stream: str, key: str = "") -> SampleTable:
        if (stream, key) not in self._tables:
            self._tables[stream, key] = SampleTable(self._new_path, stream, self._robot, key)
        return self._tables[stream, key]

    def _write_batches(self, batches: Iterable[JointStateBatch]) -> None:
        for trajectory, restarts in batches:
            table = self._table(JOINTS)
            if restarts:
                table.restart()
                self._kinds = set()
            self._kinds |= trajectory.kinds
            columns = joint_columns(trajectory.with_kinds(self._kinds))
            table.write(columns.pop("stamp"), columns)

    def _insert_waiting(self) -> None:
        """Insert the records that wait, without the transforms that the model defines."""
        waiting, self._waiting = self._waiting, []
        for undecoded in self._without_model_edges(waiting):
            for decoded in self._joined.add(undecoded):
                self._loader.insert(decoded)
                if isinstance(decoded.message, RobotDescription):
                    self._check_clock(decoded.message)
                elif decoded.writer.stream not in _IN_FILES_OF_THEIR_OWN:
                    self._add_message(decoded)
        self._take(self._buffer, is_end=False)

    def _without_model_edges(self, waiting: Sequence[UndecodedRecord]) -> Iterable[UndecodedRecord]:
        """``waiting`` without transforms of the model's edges: those of one layout are looked at together."""
        alike: dict[tuple[int, int], list[int]] = {}
        for row, (channel, record, _) in enumerate(waiting):
            if channel.writer.stream in _MOVING and not channel.covariances_of:
                alike.setdefault((id(channel), len(record.payload)), []).append(row)
        left_out: set[int] = set()
        for rows in alike.values():
            channel = waiting[rows[0]].channel
            edges = channel.ros.edges([waiting[row].record.payload for row in rows])
            if edges is not None:
                names = channel.names.edges_to_zstate(edges)
                if self._loader.leaves_out(channel.writer.robot, names):
                    left_out.update(rows)
        return (one for row, one in enumerate(waiting) if row not in left_out)

    def _check_clock(self, description: RobotDescription) -> None:
        if description.clock not in ("", "system"):
            raise InvalidInput(
                f"the stamps of {self._robot!r} are of the simulated clock {description.clock!r}, which have "
                "no date, and an archive is by date; keep the recording as a file"
            )

    def _add_message(self, decoded: DecodedMessage) -> None:
        key = decoded.writer.stream, decoded.writer.edge_writer or ""
        waiting = self._messages.setdefault(key, [])
        stamp: int = getattr(decoded.message, "stamp", 0)
        waiting.append(_Numbered(stamp if stamp >= _DATED_NS else decoded.log_time, self._number, decoded))
        self._number += 1
        if len(waiting) >= (64 if stream_named(key[0]).bulk else _MESSAGES):
            self._write_messages(key)

    def _write_messages(self, key: tuple[StreamName, str]) -> None:
        rows = self._messages.pop(key)
        rows.sort(key=lambda row: row[:2])
        pa = arrow()
        messages = [row.decoded.message for row in rows]
        kind = type(messages[0])
        columns: dict[str, Any] = {
            "log_time": np.array([row.decoded.log_time for row in rows], np.int64),
            "number": np.array([row.number for row in rows], np.int64),
            "name": pa.array([key[1]] * len(rows)),
            "encoding": pa.array([encoding_of(kind)] * len(rows)),
            "message": pa.array([encode(message) for message in messages], pa.binary()),
        }
        known = plain_columns(messages)
        columns |= {f"field.{name}": column for name, column in known.items()}
        self._table(*key).write(np.array([row.stamp for row in rows], np.int64), columns)

    def _take(self, buffer: TransformBuffer, *, is_end: bool) -> None:
        """Move samples that no later message changes from the tracks of ``buffer`` to files."""
        feed = feed_of(buffer)
        edges = [edge for edge in feed.tree_snapshot().edges.values() if edge is not None]
        present: dict[tuple[str, str], str] = {}
        for track, robot in {edge.track: edge.robot for edge in edges if edge.track is not None}.items():
            newest = track.newest
            if newest is None:
                continue
            view = take_before(feed, track, newest + 1 if is_end else newest - DELAYED_NS)
            if isinstance(track, JointTrack):
                key = "" if track is robot else " ".join(track.model.joint_names)
                present[PARTS if key else JOINTS, key] = ""
                self._write_joints(key, track_samples(track, view))
            else:
                present |= {(EDGES, child): parent for parent, child in track.edges}
                self._write_edges(track, view.kept_stamps(), view.kept_rows())
        if is_end:
            for place, taken in self._taken.items():
                if present.get(place) != taken.parent:  # the whole recording does not have it
                    self._table(*place).restart()

    def _new_rows(self, stream: str, key: str, parent: str, stamps: NDArray[np.int64]) -> int:
        """The first row that was not taken before; the table begins again if the history has."""
        if not len(stamps):
            return 0
        before = self._taken.get((stream, key))
        self._taken[stream, key] = _Taken(parent, int(stamps[-1]))
        if before is None:
            return 0
        if before != (parent, int(stamps[0])):
            self._table(stream, key).restart()
            return 0
        return 1

    def _write_edges(self, track: PoseTrack, stamps: NDArray[np.int64], rows: NDArray[np.float64]) -> None:
        pa = arrow()
        for index, (parent, child) in enumerate(track.edges):
            first = self._new_rows(EDGES, child, parent, stamps)
            if first == len(stamps):
                continue
            count = len(stamps) - first
            poses = rows[first:, 7 * index : 7 * index + 7]
            triangles = rows[first:, track.covariance_columns(index)] if track.has_covariances else None
            columns = {
                "parent": pa.array([parent] * count),
                "child": pa.array([child] * count),
                **{name: poses[:, number].copy() for number, name in enumerate(POSE)},
                "covariance": _covariance_column(triangles, count),
            }
            self._table(EDGES, child).write(stamps[first:], columns)

    def _write_joints(self, key: str, samples: JointHistory) -> None:
        stream = PARTS if key else JOINTS
        first = self._new_rows(stream, key, "", samples.stamps)
        if first < len(samples):
            columns: dict[str, Any] = joint_columns(samples.select(slice(first, None)))
            self._table(stream, key).write(columns.pop("stamp"), columns)

    def _describe(self, buffer: TransformBuffer) -> None:
        """Note the static edges, the model, and the joints of drivers of some."""
        snapshot = feed_of(buffer).tree_snapshot()
        for edge in snapshot.edges.values():
            if edge is not None and edge.kind == "static" and edge.robot is None:
                row = {"kind": "static", "parent": edge.parent, "child": edge.child}
                pose = dict(zip(POSE, map(float, edge.pose), strict=True))
                self._frames.append({**row, "writer": edge.static_writer, "model": None, **pose})
        track = snapshot.robots.get(self._robot)
        if track is not None:
            self._model = track.model
            root = track.frame(track.model.root)
            self._frames.append(_named_row("model", self._robot, root, track.model.digest))
            for joint, part in track.parts.items():
                self._frames.append(_named_row("part", " ".join(part.model.joint_names), joint, None))

    def small_files(self, store: Store, name: str) -> dict[str, Path]:
        """The tables of frames, models and writers that the archive does not have, by their paths."""
        found: dict[str, Path] = {}

        def add(path: str, schema: Any, rows: Sequence[Mapping[str, object]]) -> None:
            if not store.has(path):
                found[path] = self._new_path()
                write_small(found[path], schema, rows)

        add(f"{folder_of(FRAMES, self._robot)}/{self.scene}{SUFFIX}", frames_schema(), self._frames)
        if self._model is not None:
            row = {"digest": self._model.digest, "name": self._model.name, "urdf": self._model.urdf}
            add(f"{folder_of(MODELS)}/{self._model.digest}{SUFFIX}", model_schema(), [row])
        writers = [
            {
                "import": name,
                "stream": writer.stream,
                "name": writer.edge_writer,
                "program": writer.program,
                "session": f"{writer.session:016x}",
                "messages": count,
            }
            for writer, count in self._writers.items()
        ]
        add(f"{folder_of(WRITERS, self._robot)}/{name}{SUFFIX}", writers_schema(), writers)
        return found


def _named_row(kind: str, parent: str, child: str, model: str | None) -> dict[str, Any]:
    """A row of the frames without a pose."""
    row = {"kind": kind, "parent": parent, "child": child, "writer": None, "model": model}
    return row | dict.fromkeys(POSE)


def _covariance_column(triangles: NDArray[np.float64] | None, count: int) -> Any:
    """The upper triangles (T, 21) as a column of lists; null where they are not known."""
    pa = arrow()
    if triangles is None:
        return pa.nulls(count, pa.list_(pa.float64()))
    is_known = ~np.isnan(triangles).all(axis=1)
    ends = np.concatenate(([0], np.cumsum(is_known * triangles.shape[1]))).astype(np.int32)
    return pa.ListArray.from_arrays(pa.array(ends), triangles[is_known].ravel(), mask=pa.array(~is_known))
