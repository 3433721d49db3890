"""SQL on an archive, by DuckDB: a view of each stream and table, and poses.

==================  ====================================================================================
view                rows
==================  ====================================================================================
``joint_states``    and so on, one of each stream: the columns of its files (``zstate.archive.layout``), then
                    ``robot``, ``date`` and ``time``, a timestamp of ``stamp``
``frames``          static edges and models, by ``robot``
``writers``         the writers of each recording, by ``robot``
``models``          the URDFs, by ``digest``
``files``           what each import has added: ``rows`` by ``robot`` and ``date`` (``record_schema`` there)
==================  ====================================================================================

``zstate_pose(robot, target, source, stamp)`` is the pose of a frame, a struct of x y z [m], qx qy qz qw, as
``Archive.lookup_many`` returns it; NULL where there is none. Select by ``robot`` and ``date``: only files of
these are read then. Views show the imports that were complete when the connection was made, and nothing of
one that is under way, or was interrupted. After a compaction, which replaces files, make another connection.
"""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyarrow has no annotations

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from zstate.archive.layout import (
    FRAMES,
    MODELS,
    POSE,
    SUFFIX,
    WRITERS,
    folder_of,
    record_schema,
)
from zstate.archive.ledger import Ledger, compacted_path, compacted_stem, record_path
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
    ledger = Ledger(store)
    _add_files(connection, store, ledger)
    _add_tables(connection, store, ledger)
    _add_streams(connection, store)
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


def _add_files(connection: Any, store: Store, ledger: Ledger) -> None:
    """Make the table ``files``: its files are read once, here, as there may be as many as imports."""
    own, again = ledger.counted()
    types = {field.name: "BIGINT" if str(field.type) == "int64" else "VARCHAR" for field in record_schema()}
    columns = ", ".join(f"NULL::{kind} AS {_quoted(one)}" for one, kind in types.items())
    selects = [f"SELECT {columns} WHERE false"]
    if own:
        _add_view(connection, store, "records", [[record_path(name) for name in own]])
        selects.append("SELECT * FROM records")
    if ledger.number:
        _add_view(connection, store, "compacted", [[compacted_path(ledger.number)]])
        replaced = ", ".join(_quoted(one, "'") for one in ["", *sorted(again)])
        selects.append(f"SELECT * FROM compacted WHERE import NOT IN ({replaced}) AND path != ''")
    connection.execute(f"CREATE TABLE files AS {' UNION ALL BY NAME '.join(selects)}")
    connection.execute("DROP VIEW IF EXISTS records; DROP VIEW IF EXISTS compacted")


def _add_tables(connection: Any, store: Store, ledger: Ledger) -> None:
    """Add views of the tables ``frames``, ``models`` and ``writers``, of what counts in them."""
    robots = connection.execute("SELECT DISTINCT robot, frames FROM files").fetchall()
    frames = {f"{folder_of(FRAMES, robot)}/{digest}{SUFFIX}" for robot, digest in robots}
    stems = {*ledger.recorded_names()} - ledger.imported().keys() | {compacted_stem(ledger.number)}
    for name, table in (("models", MODELS), ("frames", FRAMES), ("writers", WRITERS)):
        paths = [file.path for file in store.files(folder_of(table))]
        if table == FRAMES:
            paths = [path for path in paths if path in frames]
        elif table == WRITERS:
            paths = [path for path in paths if Path(path).name.removesuffix(SUFFIX) in stems]
        _add_view(connection, store, name, [paths])


def _add_streams(connection: Any, store: Store) -> None:
    """Add a view of each stream, of the files that the table ``files`` lists and that are there."""
    query = "SELECT stream, columns, list(DISTINCT path) FROM files GROUP BY ALL"
    listed: dict[str, dict[str, str | None]] = {}
    for stream, columns, paths in connection.execute(query).fetchall():
        listed.setdefault(stream, {}).update(dict.fromkeys(paths, columns))
    for stream, columns_of in listed.items():
        paths = [file.path for file in store.files(folder_of(stream)) if file.path in columns_of]
        alike: dict[str, list[str]] = {}
        for path in paths:
            alike.setdefault(columns_of[path] or _columns_of(store, path), []).append(path)
        _add_view(connection, store, stream, list(alike.values()), "make_timestamp_ns(stamp) AS time, *")


def _columns_of(store: Store, path: str) -> str:
    """The columns of a file whose record does not list them."""
    with store.opened(path) as file:
        return json.dumps({field.name: str(field.type) for field in arrow().parquet.read_schema(file)})


def _quoted(name: str, mark: str = '"') -> str:
    return mark + name.replace(mark, 2 * mark) + mark


def _add_view(
    connection: Any, store: Store, name: str, alike: Sequence[Sequence[str]], select: str = "*"
) -> None:
    """A view of the files ``alike``, each of a list with the same columns; none without files.

    One file of each list is opened. A column that a file does not have is NULL there.
    """
    sources: list[str] = []
    for number, paths in enumerate(paths for paths in alike if paths):
        folders = [folder.partition("=")[0] for folder in paths[0].split("/")[:-1] if "=" in folder]
        full = [f"{store.root}/{path}" for path in paths]
        if store.is_local:  # DuckDB reads the files itself
            types = ", ".join(f"{key}: {'DATE' if key == 'date' else 'VARCHAR'}" for key in folders)
            hive = (
                f"hive_partitioning = true, hive_types = {{{types}}}"
                if folders
                else "hive_partitioning = false"
            )
            texts = ", ".join(_quoted(one, "'") for one in full)
            sources.append(f"read_parquet([{texts}], {hive})")
            continue
        pa = arrow("dataset")
        keys = pa.schema([(key, pa.date32() if key == "date" else pa.string()) for key in folders])
        dataset = pa.dataset.dataset(
            full,
            filesystem=store.filesystem,
            partitioning=pa.dataset.partitioning(keys, flavor="hive") if folders else None,
            partition_base_dir=f"{store.root}/{paths[0].partition('/')[0]}",
            format="parquet",
        )
        connection.register(f"{name} files {number}", dataset)
        sources.append(_quoted(f"{name} files {number}"))
    if sources:
        united = " UNION ALL BY NAME ".join(f"SELECT * FROM {source}" for source in sources)
        connection.execute(f"CREATE VIEW {_quoted(name)} AS SELECT {select} FROM ({united})")
