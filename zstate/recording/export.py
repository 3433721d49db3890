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
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from zstate._util.closeable import Closeable
from zstate._util.refusals import Refusals
from zstate.errors import InvalidInput, LibraryMissing, RecordingError
from zstate.model.joint_trajectory import JointTrajectory
from zstate.recording.joint_states import JointStatePart
from zstate.recording.recording import Recording

if TYPE_CHECKING:
    from pyarrow.parquet import ParquetWriter

    from zstate.buffer.buffer import TransformBuffer

TableFormat = Literal["csv", "parquet"]
Columns: TypeAlias = Mapping[str, NDArray[Any]]
"""Arrays of one length by the names of their columns."""

Frames: TypeAlias = tuple[str, str]
"""Target and source of a pose."""

_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_ROWS = 4096
"""Rows of interpolated samples computed together."""

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
    ``poses`` are pairs (target, source) of frames, looked up at the same instants.

    Samples as recorded are streamed in bounded memory. Interpolated samples and poses need a buffer, whose
    memory grows with the number of rows. ``on_progress(read, recorded)`` is called with numbers of samples.
    Raises InvalidInput for an unknown robot, and for interpolation without a model of the robot.
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
        if not (self._is_as_recorded or reader.has_model):
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
        if path.exists():
            if any(path.samefile(file) for file in self._recording.info.files):
                raise RecordingError(f"{str(path)!r} is the recording; choose another name", path=str(path))
            if not overwrite:
                text = f"{str(path)!r} exists; choose another name, or pass overwrite=True"
                raise RecordingError(text, path=str(path))
        incomplete = path.with_name(f"{path.name}.part")
        try:
            with (CsvTable if kind == "csv" else ParquetTable)(incomplete) as table:
                report = self._write(table)
            incomplete.replace(path)
        except OSError as error:
            text = f"{str(path)!r} cannot be written: {error.strerror or error}"
            raise RecordingError(text, path=str(path)) from error
        finally:
            incomplete.unlink(missing_ok=True)
        return report

    def _write(self, table: Table) -> ExportReport:
        if self._is_as_recorded and not self._poses:
            return self._write_samples(table, None)
        stamps = self._instants()
        buffer = self._recording.buffer(stamps)
        for target, source in self._poses:
            buffer.path(target, source)  # raises before anything is written
        if self._is_as_recorded:
            return self._write_samples(table, buffer)
        return self._write_interpolated(table, buffer, stamps)

    def _samples(self) -> Iterator[JointStatePart]:
        """All samples, in order of their stamps. Raises InvalidInput if there are none."""
        self._refusals.counts.clear()
        reader = self._recording.joint_state_reader(self.robot, self._refusals.count)
        read = 0
        for part in reader.parts():
            read += len(part.trajectory)
            yield part
            self._on_progress(read, reader.count)
        if not read:
            reasons = ", ".join(f"{reason} {count}" for reason, count in self._refusals.counts.items())
            raise InvalidInput(f"no joint state of {self.robot!r} can be used: {reasons or 'there is none'}")

    def _instants(self) -> NDArray[np.int64]:
        """The stamps of all rows."""
        if self._stamps is not None:
            return self._stamps
        parts: list[NDArray[np.int64]] = []
        for trajectory, restarts in self._samples():
            if restarts:
                parts.clear()
            parts.append(trajectory.stamps.copy())
        recorded = np.concatenate(parts)
        if self._rate_hz is None:
            return recorded
        first, last = int(recorded[0]), int(recorded[-1])
        count = int((last - first) * 1e-9 * self._rate_hz) + 2
        grid = first + np.round(np.arange(count) * (1e9 / self._rate_hz)).astype(np.int64)
        return grid[grid <= last]

    def _write_samples(self, table: Table, buffer: TransformBuffer | None) -> ExportReport:
        """Write all samples; from the start again if velocities or efforts first appear later."""
        kinds: dict[int, set[str]] = {}
        while (report := self._try_samples(table, buffer, kinds)) is None:
            table.restart()
        return report

    def _try_samples(
        self, table: Table, buffer: TransformBuffer | None, kinds: dict[int, set[str]]
    ) -> ExportReport | None:
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
            self._write_rows(table, trajectory.with_kinds(known), buffer, report)
        report.refused += self._refusals.counts
        return report

    def _write_interpolated(
        self, table: Table, buffer: TransformBuffer, stamps: NDArray[np.int64]
    ) -> ExportReport:
        report, nothing = self._report(), buffer.joint_states(self.robot, 0, 0)
        for first in range(0, len(stamps), _ROWS):
            part = stamps[first : first + _ROWS]
            positions, valid = buffer.joint_positions_many(self.robot, part)
            report.unknown_joints += int((~valid).sum())
            self._write_rows(table, replace(nothing, stamps=part, positions=positions), buffer, report)
        report.refused += self._refusals.counts
        return report

    def _report(self) -> ExportReport:
        return ExportReport(self.robot, unknown_poses=dict.fromkeys(self._poses, 0))

    def _write_rows(
        self, table: Table, trajectory: JointTrajectory, buffer: TransformBuffer | None, report: ExportReport
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


def joint_columns(trajectory: JointTrajectory) -> dict[str, NDArray[Any]]:
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


class Table(Closeable):
    """A file of columns, which are the same for each ``write``."""

    @abstractmethod
    def write(self, columns: Columns) -> None:
        """Append rows."""

    @abstractmethod
    def restart(self) -> None:
        """Remove all rows; the next ones may have other columns."""


class CsvTable(Table):
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


class ParquetTable(Table):
    """Parquet, compressed with Zstandard. Raises LibraryMissing without pyarrow."""

    def __init__(self, path: Path) -> None:
        try:
            import pyarrow as arrow  # noqa: PLC0415 - an extra
            from pyarrow import parquet  # noqa: PLC0415
        except ImportError as error:
            raise LibraryMissing(
                f"Parquet needs pyarrow, which cannot be loaded ({error}): pip install 'zstate[export]'"
            ) from None
        self._arrow, self._parquet = arrow, parquet
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
        writer = self._writer or self._parquet.ParquetWriter(
            self._path,
            table.schema,
            compression="zstd",
            use_dictionary=False,  # numbers hardly repeat
            use_byte_stream_split=True,
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
