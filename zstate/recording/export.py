"""Export of a recording as a table: joint states, and poses of frames, one row for each instant.

==================================  =================================================================
column                              content
==================================  =================================================================
``stamp``                           nanoseconds, int64
``position.COORDINATE``             [rad] or [m]; the name of a joint, or "base.x", "base.y" ...
``velocity.COORDINATE``             per second, if any sample has velocities
``effort.COORDINATE``               [Nm] or [N], if any sample has efforts
``TARGET.SOURCE.x`` ... ``.qw``     the pose of SOURCE in TARGET: x y z [m], qx qy qz qw
==================================  =================================================================

Numbers that are not known are NaN.
"""

# pyright: reportUnknownMemberType=false, reportMissingTypeStubs=false
# pyarrow has no annotations

from __future__ import annotations

import csv
from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import islice
from operator import is_
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from zstate._util.closeable import Closeable
from zstate._util.refusals import Refusals
from zstate.buffer.buffer import RECORDING_HISTORY_S, TransformBuffer, feed_of
from zstate.errors import InvalidInput, LibraryMissing, LookupFailed
from zstate.model.joint_history import JointHistory
from zstate.recording.errors import RecordingError
from zstate.recording.joint_states import DELAYED_NS, JointStateBatch
from zstate.recording.recording import Recording
from zstate.wire.keys import frame_owner
from zstate.wire.messages import Sample

if TYPE_CHECKING:
    from pyarrow.parquet import ParquetWriter

    from zstate.buffer.frame_tree import Edge, FrameInfo

TableFormat = Literal["csv", "parquet"]
Columns: TypeAlias = Mapping[str, NDArray[Any]]
"""Arrays of one length by the names of their columns."""

Frames: TypeAlias = tuple[str, str]
"""Target and source of a pose."""

_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_ROWS = 4096
"""Rows of interpolated samples computed together."""

_MAX_KEPT = 50_000
"""Samples of an edge kept for rows to come, 25 MB for a humanoid."""

_RELOADED_ROWS = 32_768
"""Rows for which a recording is read again: 50 MB for a humanoid."""

_ROW_GROUP = 32_768
"""Rows of a row group of Parquet, which are kept in memory: 25 MB for a humanoid with velocities."""


@dataclass
class ExportReport:
    """What was exported: ``rows`` with stamps from ``first`` to ``last`` [ns], and the kinds of numbers.

    ``kinds`` are "position", "velocity" and "effort". ``unknown_joints`` counts the rows without interpolated
    positions, ``unknown_poses`` those without each pose, ``refused`` the samples left out, by reason.
    """

    robot: str
    rows: int = 0
    first: int = 0
    last: int = 0
    joint_count: int = 0
    kinds: tuple[str, ...] = ()
    unknown_joints: int = 0
    unknown_poses: dict[Frames, int] = field(default_factory=dict[Frames, int])
    refused: Counter[str] = field(default_factory=Counter[str])


class Exporter:
    """Exports the joint states of ``robot``, by default of the only one, from an open recording.

    Rows are the samples as recorded; or the instants of a grid at ``rate_hz`` from the first sample to the
    last, or ``stamps`` [ns], with positions interpolated as in lookups, and without velocities and efforts.
    If drivers published some of the joints each, there is a row for each sample of a driver, from the
    instant that all drivers have reached until the first of them ends: positions of the other drivers are
    interpolated between their own samples, their velocities are NaN, and efforts are left out.
    ``poses`` are pairs (target, source) of frames, looked up at the same instants.

    The recording is streamed: memory does not grow with it, unless it has several drivers of ``robot``, whose
    samples are then in memory. ``on_progress(read, recorded)`` is called with
    numbers of samples. Raises InvalidInput for an unknown robot, and for interpolation without a model of
    the robot.
    """

    def __init__(
        self,
        recording: Recording,
        robot: str | None = None,
        *,
        rate_hz: float | None = None,
        stamps: NDArray[np.int64] | None = None,
        poses: Sequence[Frames] = (),
        on_progress: Callable[[int, int], object] = lambda read, recorded: None,
    ) -> None:
        self._recording = recording
        self._rate_hz = rate_hz
        self._stamps = stamps
        self._poses = tuple(dict.fromkeys(poses))
        self._on_progress = on_progress
        self._refusals = Refusals("recorded joint_states")
        reader = recording.joint_state_reader(robot, self._refusals.count)
        self.robot = reader.robot
        if not (self._is_as_recorded or reader.model is not None):
            raise InvalidInput(
                f"positions of {self.robot!r} are interpolated by its model, and the recording has no "
                "robot_description that fits its joint states; export the samples as recorded"
            )

    @property
    def _is_as_recorded(self) -> bool:
        return self._rate_hz is None and self._stamps is None

    def write(self, path: Path, kind: TableFormat, *, overwrite: bool = False) -> ExportReport:
        """Write the table. The file appears when it is complete.

        Raises RecordingError if it exists (unless ``overwrite``) or cannot be written, InvalidInput without
        a sample, LibraryMissing for Parquet without pyarrow, and LookupFailed for frames without a path.
        """
        with new_table(path, kind, self._recording, overwrite=overwrite) as table:
            return self._write(table)

    def _write(self, table: ColumnFile) -> ExportReport:
        if self._is_as_recorded and not self._poses:
            return self._write_samples(table)
        survey = self._survey()
        if (np.diff(survey.stamps) >= 0).all():
            try:
                streamed = StreamedBuffer(self._recording, self.robot, self._poses, survey.stamps)
                return self._write_lookups(table, survey, streamed)
            except _Changed:
                table.restart()
        reloaded = ReloadedBuffer(self._recording, self._poses, survey.stamps)
        return self._write_lookups(table, survey, reloaded)

    def _samples(self) -> Iterator[JointStateBatch]:
        """All samples, in order of their stamps. Raises InvalidInput if there are none."""
        self._refusals.counts.clear()
        reader = self._recording.joint_state_reader(self.robot, self._refusals.count)
        read = 0
        for batch in reader.batches():
            read += len(batch.trajectory)
            yield batch
            self._on_progress(read, reader.count)
        if not read:
            reasons = ", ".join(f"{reason} {count}" for reason, count in self._refusals.counts.items())
            raise InvalidInput(f"no joint state of {self.robot!r} can be used: {reasons or 'there is none'}")

    def _survey(self) -> Survey:
        """The stamps of all rows, and which samples they are."""
        if self._stamps is not None:
            return Survey(self._stamps)
        parts: list[NDArray[np.int64]] = []
        kinds: set[str] = set()
        histories = 0
        for trajectory, restarts in self._samples():
            if restarts:
                parts.clear()
                kinds.clear()
                histories += 1
            parts.append(trajectory.stamps.copy())
            kinds |= trajectory.kinds
        recorded = np.concatenate(parts)
        if self._rate_hz is None:
            return Survey(recorded, frozenset(kinds), histories)
        first, last = int(recorded[0]), int(recorded[-1])
        count = int((last - first) * 1e-9 * self._rate_hz) + 2
        grid = first + np.round(np.arange(count) * (1e9 / self._rate_hz)).astype(np.int64)
        return Survey(grid[grid <= last])

    def _write_samples(self, table: ColumnFile) -> ExportReport:
        """Write all samples; from the start again if velocities or efforts first appear later."""
        kinds: dict[int, set[str]] = {}
        while (report := self._try_samples(table, kinds)) is None:
            table.restart()
        return report

    def _try_samples(self, table: ColumnFile, kinds: dict[int, set[str]]) -> ExportReport | None:
        """Write all samples with the columns of ``kinds``, by the number of the history.

        None if a part has more; ``kinds`` then has them.
        """
        report, history = self._report(), 0
        for trajectory, restarts in self._samples():
            if restarts:
                table.restart()
                report, history = self._report(), history + 1
            known = kinds.setdefault(history, set())
            missing = trajectory.kinds - known
            known |= missing
            if missing and report.rows:
                return None
            self._write_rows(table, trajectory.with_kinds(known), None, report)
        report.refused += self._refusals.counts
        return report

    def _write_lookups(
        self, table: ColumnFile, survey: Survey, source: StreamedBuffer | ReloadedBuffer
    ) -> ExportReport:
        """Write the rows of ``survey`` with lookups in the buffers of ``source``."""
        report = self._report()
        if self._is_as_recorded:
            for trajectory in self._recorded(survey):
                self._write_rows(table, trajectory, source.around(trajectory.stamps), report)
        for first in () if self._is_as_recorded else range(0, len(survey.stamps), _ROWS):
            stamps = survey.stamps[first : first + _ROWS]
            buffer = source.around(stamps)
            positions, valid = buffer.joint_positions_many(self.robot, stamps)
            report.unknown_joints += int((~valid).sum())
            trajectory = replace(buffer.joint_states(self.robot, 0, 0), stamps=stamps, positions=positions)
            self._write_rows(table, trajectory, buffer, report)
        source.finish()
        report.refused += self._refusals.counts
        return report

    def _recorded(self, survey: Survey) -> Iterator[JointHistory]:
        """The samples of ``survey``."""
        histories = 0
        for trajectory, restarts in self._samples():
            histories += restarts
            if histories == survey.histories:
                yield trajectory.with_kinds(survey.kinds)

    def _report(self) -> ExportReport:
        return ExportReport(self.robot, unknown_poses=dict.fromkeys(self._poses, 0))

    def _write_rows(
        self,
        table: ColumnFile,
        trajectory: JointHistory,
        buffer: TransformBuffer | None,
        report: ExportReport,
    ) -> None:
        columns = joint_columns(trajectory)
        for target, source in self._poses:
            assert buffer is not None
            poses, valid = buffer.lookup_many(target, source, trajectory.stamps)
            columns |= {f"{target}.{source}.{name}": poses[:, number] for number, name in enumerate(_POSE)}
            report.unknown_poses[target, source] += int((~valid).sum())
        table.write(columns)
        first, last = int(trajectory.stamps.min()), int(trajectory.stamps.max())
        report.first = min(first, report.first) if report.rows else first
        report.last = max(last, report.last) if report.rows else last
        report.rows += len(trajectory)
        report.joint_count = len(trajectory.joint_names)
        report.kinds = ("position", *sorted(trajectory.kinds, reverse=True))


class Survey(NamedTuple):
    """The ``stamps`` of all rows [ns]; of samples as recorded also their ``kinds``, in the last history.

    ``histories`` counts the histories that other ones replaced.
    """

    stamps: NDArray[np.int64]
    kinds: frozenset[str] = frozenset()
    histories: int = 0


class _Changed(Exception):
    """The rest of a recording changes what earlier lookups returned."""


class StreamedBuffer:
    """A buffer that follows ascending ``stamps`` through a recording, which is read once.

    It holds what lookups of ``poses`` and of the positions of ``robot`` need at the next stamps. They equal
    those in the whole recording unless the rest of it changes the past: a clock is set back, a model
    replaced, a static edge moved, a frame placed on another, or a sample comes more than 10 s late. Then
    ``around`` and ``finish`` raise _Changed, also if an edge pauses for ``_MAX_KEPT`` samples of another.
    """

    def __init__(
        self, recording: Recording, robot: str, poses: Sequence[Frames], stamps: NDArray[np.int64]
    ) -> None:
        self._robot = robot
        self._poses = poses
        self._stamps = stamps
        self._buffer = TransformBuffer(RECORDING_HISTORY_S)
        self._messages = recording.fill(self._buffer)
        self._newest = -(1 << 63)
        self._returned: int | None = None
        self._layout: tuple[Sequence[Edge], Sequence[FrameInfo]] = (), ()

    def around(self, stamps: NDArray[np.int64]) -> TransformBuffer:
        """The buffer for the next of the stamps. Raises LookupFailed for frames without a path."""
        last = int(stamps[-1])
        while not self._has_passed(last) and self._read():
            pass
        self._check()
        self._returned = last
        self._stamps = self._stamps[len(stamps) :]
        return self._buffer

    def finish(self) -> None:
        """Read the rest of the recording."""
        while self._read():
            pass
        self._check()

    def _read(self) -> bool:
        """Insert the next messages; False at the end of the recording."""
        messages = [decoded.message for decoded in islice(self._messages, _ROWS)]
        for message in messages:
            if isinstance(message, Sample):
                if self._returned is not None and message.stamp <= self._returned:
                    raise _Changed
                self._newest = max(self._newest, message.stamp)
        reached = self._stamps.searchsorted(self._newest, "right")
        self._buffer.keep_only_around(self._stamps[: reached + 1])
        return len(messages) == _ROWS

    def _has_passed(self, stamp: int) -> bool:
        """Whether all samples that lookups until ``stamp`` need were read."""
        try:
            frames = self._moving_frames()
        except LookupFailed:  # its edges may follow
            return False
        if any(frame.count > _MAX_KEPT for frame in frames):
            raise _Changed
        is_known = all(frame.newest is not None and frame.newest >= stamp for frame in frames)
        return is_known and self._newest >= stamp + DELAYED_NS

    def _moving_frames(self) -> list[FrameInfo]:
        """The frames whose samples lookups read."""
        joints = (frame for frame in self._buffer.frames() if frame.kind == "joint")
        own = (frame for frame in joints if frame_owner(frame.name) == self._robot)
        paths = (frame for pair in self._poses for _, frame in self._buffer.path_frames(*pair))
        moving = (frame for frame in paths if frame is not None and frame.kind in ("joint", "pose"))
        return [*own, *moving]

    def _check(self) -> None:
        """Raise _Changed if frames, edges or the beginnings of histories are others than before."""
        try:
            edges = [edge for pair in self._poses for edge in feed_of(self._buffer).edges_between(*pair)]
            frames = self._moving_frames()
        except LookupFailed:
            if self._returned is None:
                raise
            raise _Changed from None
        if self._returned is not None:
            edges_before, frames_before = self._layout
            are_same = len(edges) == len(edges_before) and all(map(is_, edges, edges_before))
            if not are_same or _beginnings(frames) != _beginnings(frames_before):
                raise _Changed
        self._layout = edges, frames


def _beginnings(frames: Sequence[FrameInfo]) -> list[tuple[str, int | None]]:
    return [(frame.name, frame.oldest) for frame in frames]


class ReloadedBuffer:
    """Buffers around ``stamps`` in any order, for which the recording is read every ``_RELOADED_ROWS``."""

    def __init__(self, recording: Recording, poses: Sequence[Frames], stamps: NDArray[np.int64]) -> None:
        self._recording = recording
        self._poses = poses
        self._stamps = stamps
        self._buffer = TransformBuffer()
        self._rows = 0

    def around(self, stamps: NDArray[np.int64]) -> TransformBuffer:
        """The buffer for the next of the stamps. Raises LookupFailed for frames without a path."""
        if len(stamps) > self._rows:
            window = self._stamps[: max(len(stamps), _RELOADED_ROWS)]
            self._buffer = self._recording.buffer(window)
            for target, source in self._poses:
                self._buffer.plan(target, source)
            self._rows = len(window)
        self._stamps = self._stamps[len(stamps) :]
        self._rows -= len(stamps)
        return self._buffer

    def finish(self) -> None:
        """Nothing: each buffer is of the whole recording."""


def joint_columns(trajectory: JointHistory) -> dict[str, NDArray[Any]]:
    """``stamp`` [ns], then ``position.NAME``, ``velocity.NAME`` and ``effort.NAME`` for each coordinate."""
    columns: dict[str, NDArray[Any]] = {"stamp": trajectory.stamps}
    blocks = (
        ("position", trajectory.coordinates, trajectory.positions),
        ("velocity", trajectory.velocity_coordinates, trajectory.velocities),
        ("effort", trajectory.velocity_coordinates, trajectory.efforts),
    )
    for kind, names, block in blocks:
        if block is not None:
            columns |= {f"{kind}.{name}": block[:, number] for number, name in enumerate(names)}
    return columns


class ColumnFile(Closeable):
    """A file of columns, which are the same for each ``write``."""

    @abstractmethod
    def write(self, columns: Columns) -> None:
        """Append rows."""

    @abstractmethod
    def restart(self) -> None:
        """Remove all rows; the next ones may have other columns."""


@contextmanager
def new_table(
    path: Path, kind: TableFormat, recording: Recording, *, overwrite: bool
) -> Generator[ColumnFile, None, None]:
    """A table of data of ``recording``, which is at ``path`` when the context ends without an exception.

    Raises RecordingError if the file exists (unless ``overwrite``) or cannot be written, and LibraryMissing
    for Parquet without pyarrow.
    """
    if path.exists():
        if any(path.samefile(file) for file in recording.info.files):
            raise RecordingError(f"{str(path)!r} is the recording; choose another name", path=str(path))
        if not overwrite:
            text = f"{str(path)!r} exists; choose another name, or pass overwrite=True"
            raise RecordingError(text, path=str(path))
    incomplete = path.with_name(f"{path.name}.part")
    try:
        with (CsvTable if kind == "csv" else ParquetTable)(incomplete) as table:
            yield table
        incomplete.replace(path)
    except OSError as error:
        text = f"{str(path)!r} cannot be written: {error.strerror or error}"
        raise RecordingError(text, path=str(path)) from error
    finally:
        incomplete.unlink(missing_ok=True)


class CsvTable(ColumnFile):
    """Comma-separated values, with a line of names first. Missing numbers are ``nan``."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", newline="", encoding="utf-8")
        self._lines = csv.writer(self._file, lineterminator="\n")

    def write(self, columns: Columns) -> None:
        if not self._file.tell():
            self._lines.writerow(columns)
        self._lines.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))

    def restart(self) -> None:
        self._file.seek(0)
        self._file.truncate()

    def close(self) -> None:
        self._file.close()


def arrow() -> tuple[Any, Any]:
    """The modules pyarrow and pyarrow.parquet. Raises LibraryMissing."""
    try:
        import pyarrow  # noqa: PLC0415 - an extra
        from pyarrow import parquet  # noqa: PLC0415
    except ImportError as error:
        raise LibraryMissing(
            f"Parquet needs pyarrow, which cannot be loaded ({error}): pip install 'zstate[export]'"
        ) from None
    return pyarrow, parquet


class ParquetTable(ColumnFile):
    """Parquet, compressed with Zstandard. Raises LibraryMissing without pyarrow."""

    def __init__(self, path: Path) -> None:
        self._arrow, self._parquet = arrow()
        self._path = path
        self._writer: ParquetWriter | None = None
        self._pending: list[Any] = []

    def write(self, columns: Columns) -> None:
        arrays = {name: np.ascontiguousarray(column) for name, column in columns.items()}
        self._pending.append(self._arrow.table(arrays))
        if sum(table.num_rows for table in self._pending) >= _ROW_GROUP:
            self._write_row_group()

    def _write_row_group(self) -> None:
        table = self._arrow.concat_tables(self._pending)
        self._pending = []
        types = self._arrow.types
        numbers = [
            one.name for one in table.schema if types.is_integer(one.type) or types.is_floating(one.type)
        ]
        writer = self._writer or self._parquet.ParquetWriter(
            self._path,
            table.schema,
            compression="zstd",
            use_dictionary=False,  # numbers hardly repeat
            use_byte_stream_split=numbers,
        )
        self._writer = writer
        writer.write_table(table)

    def restart(self) -> None:
        self._pending = []
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def close(self) -> None:
        if self._pending:
            self._write_row_group()
        if self._writer is not None:
            self._writer.close()
            self._writer = None
