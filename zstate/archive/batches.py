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

from zstate.archive.archive import Archive, lookup_rows
from zstate.archive.layout import POSE
from zstate.archive.storage import arrow
from zstate.errors import InvalidInput


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
