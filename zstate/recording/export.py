"""Export of joint states and poses as columns: CSV, or Parquet with pyarrow."""

# pyright: reportUnknownMemberType=false, reportMissingTypeStubs=false
# pyarrow has no annotations

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from zstate._util.closeable import Closeable
from zstate.errors import LibraryMissing
from zstate.model.joint_trajectory import JointTrajectory

if TYPE_CHECKING:
    from pyarrow.parquet import ParquetWriter

Columns: TypeAlias = Mapping[str, NDArray[Any]]
"""Arrays of one length by the names of their columns."""

POSE_COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw")


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


def pose_columns(target: str, source: str, poses: NDArray[np.float64]) -> dict[str, NDArray[Any]]:
    """``TARGET.SOURCE.x`` to ``.qw`` of pose7 rows, NaN where the pose is not known."""
    return {f"{target}.{source}.{name}": poses[:, number] for number, name in enumerate(POSE_COLUMNS)}


class CsvWriter(Closeable):
    """Writes columns as comma-separated values, with a line of names first. Missing numbers are ``nan``."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", newline="", encoding="utf-8")
        self._lines = csv.writer(self._file)
        self._has_names = False

    def write(self, columns: Columns) -> None:
        """Append the rows of ``columns``, which are the same for each call."""
        if not self._has_names:
            self._lines.writerow(columns)
            self._has_names = True
        self._lines.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))

    def close(self) -> None:
        """Close the file. A second call does nothing."""
        self._file.close()


class ParquetFile(Closeable):
    """Writes columns as Parquet, compressed with Zstandard. Raises LibraryMissing without pyarrow."""

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

    def write(self, columns: Columns) -> None:
        """Append the rows of ``columns``, which are the same for each call."""
        table: Any = self._arrow.table(
            {name: np.ascontiguousarray(column) for name, column in columns.items()}
        )
        writer = self._writer or self._parquet.ParquetWriter(self._path, table.schema, compression="zstd")
        self._writer = writer
        writer.write_table(table)

    def close(self) -> None:
        """Complete and close the file. A second call does nothing."""
        if self._writer is not None:
            self._writer.close()
