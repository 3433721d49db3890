"""Poses by Ray on two nodes, one worker of which is killed; run by a Python with Ray.

Arguments: ARCHIVE TARGET SOURCE OUTPUT. The output has the rows in the order of their stamps.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import ray
import ray.data
from ray.cluster_utils import Cluster

import zstate.archive


def killed_once(function: Callable[[pa.Table], pa.Table], marker: Path) -> Callable[[pa.Table], pa.Table]:
    """``function``, whose first call with a row kills its process."""

    def call(batch: pa.Table) -> pa.Table:
        if batch.num_rows and not marker.exists():
            marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return function(batch)

    return call


def main(url: str, target: str, source: str, output: str) -> None:
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    cluster.add_node(num_cpus=1)
    ray.init(address=cluster.address)
    marker = Path(f"{output}.killed")
    poses = killed_once(zstate.archive.poses(target, source, archive=url), marker)
    rows = ray.data.read_parquet(f"{url}/stream=joint_states").select_columns(["robot", "stamp"])
    found = rows.repartition(12).map_batches(poses, batch_format="pyarrow", batch_size=17)
    table = pa.concat_tables(ray.get(found.to_arrow_refs()))
    nodes = sum(node["Alive"] for node in ray.nodes())
    print(f"{nodes} nodes, {'one worker killed' if marker.exists() else 'none killed'}")
    pq.write_table(table.sort_by("stamp"), output)
    ray.shutdown()
    cluster.shutdown()


if __name__ == "__main__":
    main(*sys.argv[1:])
