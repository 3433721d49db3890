"""Poses of the rows of Arrow batches, for engines that run a function on many machines.

Ray, Spark (``mapInArrow``) and Dask cut rows into batches as they like. A pose needs the samples around its
stamp, which may be in another batch: so the function takes of each row only ``robot`` and ``stamp``, and
reads the samples from the archive itself. What a row gets does not depend on the batch that it is in. The
function reads row groups again that the engine may have read, so let the engine read these two columns
only::

    rows = ray.data.read_parquet(f"{url}/stream=joint_states", columns=["robot", "stamp"])
    rows.map_batches(zstate.archive.poses("base", "hand", archive=url), batch_format="pyarrow")

Ray does not keep the order of rows; sort by robot and stamp to compare.
"""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyarrow has no annotations

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from zstate.archive.archive import Archive
from zstate.archive.layout import POSE
from zstate.archive.storage import arrow
from zstate.errors import InvalidInput, LookupFailed


@lru_cache(maxsize=4)
def opened(url: str) -> Archive:
    """The archive ``url``, opened once in each process."""
    return Archive(url)


@dataclass(frozen=True)
class PoseColumns:
    """What ``poses`` returns."""

    url: str
    target: str
    source: str

    @property
    def __name__(self) -> str:  # engines print it
        return f"poses({self.target}, {self.source})"

    def __call__(self, batch: Any) -> Any:
        """``batch``, a pyarrow.Table or RecordBatch, with the columns of the pose."""
        pa = arrow()
        missing = [name for name in ("robot", "stamp") if name not in batch.schema.names]
        if missing:
            raise InvalidInput(
                f"poses are looked up by the columns robot and stamp [ns] of an archive; the batch has "
                f"{', '.join(batch.schema.names)}"
            )
        stamps = np.asarray(batch.column("stamp"), np.int64)
        robots = np.asarray(batch.column("robot").cast(pa.string()))
        poses = lookup_rows(opened(self.url), robots, self.target, self.source, stamps)
        table = batch if isinstance(batch, pa.Table) else pa.Table.from_batches([batch])
        for number, name in enumerate(POSE):
            table = table.append_column(
                f"{self.target}.{self.source}.{name}", pa.array(np.ascontiguousarray(poses[:, number]))
            )
        if isinstance(batch, pa.Table):
            return table
        return pa.RecordBatch.from_arrays(
            [column.combine_chunks() for column in table.columns], schema=table.schema
        )


def poses(target: str, source: str, *, archive: str) -> PoseColumns:
    """A function from an Arrow batch to the same batch with the pose of ``source`` in ``target`` in each row.

    The batch has the columns ``robot`` and ``stamp`` [ns], as the files of ``archive`` do; its type is kept.
    New columns are ``TARGET.SOURCE.x`` to ``.qw``, x y z [m], qx qy qz qw, NaN where there is no pose: they
    are those of ``Archive.lookup_many``, however rows are cut into batches. It can be pickled; each process
    opens the archive. Raises InvalidInput for a batch without these columns.
    """
    return PoseColumns(archive, target, source)


def lookup_rows(
    archive: Archive, robots: np.ndarray[Any, Any], target: str, source: str, stamps: np.ndarray[Any, Any]
) -> np.ndarray[Any, Any]:
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
