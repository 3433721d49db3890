"""SQL on an archive, by DuckDB: a view of each stream and table, and poses.

==================  ====================================================================================
view                rows
==================  ====================================================================================
``joint_states``    and so on, one of each stream: the columns of its files (``zstate.archive.layout``), then
                    ``robot``, ``date`` and ``time``, a timestamp of ``stamp``
``frames``          static edges and models, by ``robot``
``writers``         the writers of each recording, by ``robot``
``models``          the URDFs, by ``digest``
``files``           what each import has added: ``rows`` by ``robot`` and ``date``
==================  ====================================================================================

``zstate_pose(robot, target, source, stamp)`` is the pose of a frame, a struct of x y z [m], qx qy qz qw, as
``Archive.lookup_many`` returns it; NULL where there is none. Select by ``robot`` and ``date``: only files of
these are read then. Views show the imports that were complete when the connection was made, and nothing of
one that is under way, or was interrupted.
"""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyarrow has no annotations

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from zstate.archive.layout import FRAMES, IMPORTS, MODELS, POSE, SUFFIX, WRITERS, folder_of, value_of
from zstate.archive.storage import Store, arrow
from zstate.errors import LibraryMissing

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

Lookup: TypeAlias = Callable[[NDArray[Any], str, str, NDArray[np.int64]], NDArray[np.float64]]
"""Poses of one frame in another, at the stamps [ns] of robots: (T, 7), NaN where there is none."""


def connect(store: Store, lookup: Lookup) -> DuckDBPyConnection:
    """A connection in memory, with views of the files in ``store``, and ``lookup`` as ``zstate_pose``.

    Raises LibraryMissing without DuckDB.
    """
    try:
        import duckdb  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise LibraryMissing(
            f"SQL needs duckdb, which cannot be loaded ({error}): pip install 'zstate[archive]'"
        ) from None
    connection = duckdb.connect()
    for name, table in (("files", IMPORTS), ("models", MODELS)):
        _add_view(connection, store, name, [file.path for file in store.files(folder_of(table))])
    complete = _Complete.read(connection, store)
    for name, table in (("frames", FRAMES), ("writers", WRITERS)):
        _add_view(connection, store, name, complete.of_table(store, table))
    for folder in store.folders(""):
        if folder.startswith("stream="):
            paths = [file.path for file in store.files(folder) if file.path in complete.paths]
            _add_view(connection, store, value_of(folder), paths, "make_timestamp_ns(stamp) AS time, *")
    poses = ", ".join(f"{name} DOUBLE" for name in POSE)
    create_function: Any = connection.create_function  # its annotations are others in each version
    parameters = ["VARCHAR", "VARCHAR", "VARCHAR", "BIGINT"]
    create_function("zstate_pose", _PoseFunction(lookup), parameters, f"STRUCT({poses})", type="arrow")
    return connection


class _PoseFunction:
    """Poses of columns of robots, targets, sources and stamps, as a column of structs."""

    def __init__(self, lookup: Lookup) -> None:
        self._lookup = lookup

    def __call__(self, robots: Any, targets: Any, sources: Any, stamps: Any) -> Any:
        pa = arrow()
        times = np.asarray(stamps, np.int64)
        poses = np.full((len(times), 7), np.nan)
        pairs = np.array([*zip(targets.to_pylist(), sources.to_pylist(), strict=True)])
        for target, source in np.unique(pairs, axis=0).tolist():
            rows = np.flatnonzero((pairs == (target, source)).all(axis=1))
            names = np.asarray(robots.take(pa.array(rows)))
            poses[rows] = self._lookup(names, target, source, times[rows])
        columns = [pa.array(np.ascontiguousarray(column)) for column in poses.T]
        return pa.StructArray.from_arrays(columns, POSE, mask=pa.array(np.isnan(poses[:, 0])))


class _Complete(NamedTuple):
    """What complete imports have: their ``names``, the ``paths`` of their samples, and of their frames."""

    names: set[str]
    paths: set[str]
    frames: set[str]

    @classmethod
    def read(cls, connection: Any, store: Store) -> _Complete:
        """What the view ``files`` lists."""
        names = {name.removesuffix(SUFFIX) for name in store.names(folder_of(IMPORTS))}
        if not names:
            return cls(set(), set(), set())
        rows = connection.execute("SELECT path, robot, frames FROM files").fetchall()
        frames = {f"{folder_of(FRAMES, robot)}/{digest}{SUFFIX}" for _, robot, digest in rows}
        return cls(names, {path for path, _, _ in rows}, frames)

    def of_table(self, store: Store, table: str) -> list[str]:
        """The files of ``table``, frames or writers."""
        paths = [file.path for file in store.files(folder_of(table))]
        if table == FRAMES:
            return [path for path in paths if path in self.frames]
        return [path for path in paths if path.rpartition("/")[2].removesuffix(SUFFIX) in self.names]


def _add_view(connection: Any, store: Store, name: str, paths: Sequence[str], columns: str = "*") -> None:
    """A view of the files ``paths``; none without a file."""
    if not paths:
        return
    quoted = '"' + name.replace('"', '""') + '"'
    full = [f"{store.root}/{path}" for path in paths]
    if store.is_local:  # DuckDB reads the files itself
        is_alike = not paths[0].startswith("stream=")  # then one file shows the columns of all
        options = f"hive_partitioning = true, union_by_name = {str(not is_alike).lower()}"
        literals = ", ".join("'" + path.replace("'", "''") + "'" for path in full)
        source = f"read_parquet([{literals}], {options})"
    else:
        fs = arrow().dataset
        dataset = fs.dataset(
            full,
            filesystem=store.filesystem,
            partitioning=fs.partitioning(flavor="hive"),
            partition_base_dir=f"{store.root}/{paths[0].partition('/')[0]}",
            format="parquet",
        )
        schemas = [dataset.schema, *(one.physical_schema for one in dataset.get_fragments())]
        source = f'"{name} files"'
        connection.register(f"{name} files", dataset.replace_schema(arrow().unify_schemas(schemas)))
    connection.execute(f"CREATE VIEW {quoted} AS SELECT {columns} FROM {source}")
