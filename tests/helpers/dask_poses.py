"""Poses by Dask in processes of its own; run by a Python with Dask.

Arguments: ARCHIVE TARGET SOURCE OUTPUT. The output has the rows in the order of their stamps.
"""

from __future__ import annotations

import os
import sys

import dask
import dask.dataframe as dd
import pandas as pd
import pyarrow as pa

import zstate.archive


def main(url: str, target: str, source: str, output: str) -> None:
    poses = zstate.archive.poses(target, source, archive=url)

    def of_partition(rows: pd.DataFrame) -> pd.DataFrame:
        table = pa.Table.from_pandas(rows, preserve_index=False)
        return poses(table).to_pandas().assign(process=os.getpid())

    dask.config.set({"dataframe.parquet.minimum-partition-size": 1})  # a partition of each file
    rows = dd.read_parquet(f"{url}/stream=joint_states", columns=["robot", "stamp"])
    columns = [f"{target}.{source}.{name}" for name in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    meta = rows._meta.astype({"robot": object}).assign(**dict.fromkeys(columns, 0.0), process=0)
    found = rows.map_partitions(of_partition, meta=meta)
    table = found.compute(scheduler="processes", num_workers=2, chunksize=1).sort_values("stamp")
    is_elsewhere = os.getpid() not in set(table.pop("process"))
    print(
        f"{rows.npartitions} partitions, {'in other processes' if is_elsewhere else 'some in this process'}"
    )
    table.to_parquet(output, index=False)


if __name__ == "__main__":
    main(*sys.argv[1:])
