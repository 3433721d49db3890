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
one that is under way, or was interrupted.
"""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyarrow has no annotations

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
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
    frames_schema,
    model_schema,
    record_schema,
    writers_schema,
)
from zstate.archive.ledger import Ledger, compacted_path, compacted_stem, record_path
from zstate.archive.storage import Store, arrow
from zstate.errors import LibraryMissing

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

Lookup: TypeAlias = Callable[[NDArray[Any], str, str, NDArray[np.int64]], NDArray[np.float64]]
"""Poses of one frame in another, at the stamps [ns] of robots: (T, 7), NaN where there is none."""


_LISTS = ("list<item: double>", "list<element: double>")
_TYPES = {
    **{"int64": "BIGINT", "double": "DOUBLE", "bool": "BOOLEAN", "string": "VARCHAR", "binary": "BLOB"},
    **{"date32": "DATE", **dict.fromkeys(_LISTS, "DOUBLE[]")},
}
"""The types of DuckDB, by those of Arrow that archives have."""

_NUMBERS = {"int64", "double", "bool"}


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
    columns = _types_of(record_schema())
    made = ", ".join(f"{_quoted(name)} {_TYPES[kind]}" for name, kind in columns.items())
    connection.execute(f"CREATE TABLE files ({made})")
    compacted = [compacted_path(ledger.number)] if ledger.number else []
    for name, paths in (("records", [record_path(name) for name in own]), ("compacted", compacted)):
        if not paths:
            continue
        _add_view(connection, store, name, paths, columns)
        replaced = list(again) if paths is compacted else []
        select = f"SELECT * FROM {name} WHERE path != '' AND NOT coalesce(list_contains(?, import), false)"
        connection.execute(f"INSERT INTO files {select}", [replaced])
        connection.execute(f"DROP VIEW {name}")


def _add_tables(connection: Any, store: Store, ledger: Ledger) -> None:
    """Add views of the tables ``frames``, ``models`` and ``writers``, of what counts in them."""
    robots = connection.execute("SELECT DISTINCT robot, frames FROM files").fetchall()
    frames = {f"{folder_of(FRAMES, robot)}/{digest}{SUFFIX}" for robot, digest in robots}
    stems = {*ledger.recorded_names()} - ledger.imported().keys() | {compacted_stem(ledger.number)}
    for name, table, schema in (
        ("models", MODELS, model_schema()),
        ("frames", FRAMES, frames_schema()),
        ("writers", WRITERS, writers_schema()),
    ):
        paths = [file.path for file in store.files(folder_of(table))]
        if table == FRAMES:
            paths = [path for path in paths if path in frames]
        elif table == WRITERS:
            paths = [path for path in paths if Path(path).name.removesuffix(SUFFIX) in stems]
        _add_view(connection, store, name, paths, _types_of(schema))


def _add_streams(connection: Any, store: Store) -> None:
    """Add a view of each stream, of the files that the table ``files`` lists and that are there."""
    query = "SELECT stream, columns, list(DISTINCT path) FROM files GROUP BY ALL"
    listed: dict[str, dict[str, str | None]] = {}
    for stream, columns, paths in connection.execute(query).fetchall():
        listed.setdefault(stream, {}).update(dict.fromkeys(paths, columns))
    for stream, columns_of in listed.items():
        paths = [file.path for file in store.files(folder_of(stream)) if file.path in columns_of]
        layouts = {columns_of[path] or _columns_of(store, path) for path in paths}
        columns = _united([json.loads(layout) for layout in sorted(layouts)])
        _add_view(connection, store, stream, paths, columns, select="make_timestamp_ns(stamp) AS time, *")


def _columns_of(store: Store, path: str) -> str:
    """The columns of a file whose record does not list them."""
    with store.opened(path) as file:
        return json.dumps(_types_of(arrow().parquet.read_schema(file)))


def _types_of(schema: Any) -> dict[str, str]:
    return {field.name: str(field.type) for field in schema}


def _united(layouts: Sequence[Mapping[str, str]]) -> dict[str, str]:
    """The columns of all ``layouts``; of several types that hold the values of each."""
    found: dict[str, str] = {}
    for name, kind in (item for layout in layouts for item in layout.items()):
        if found.setdefault(name, kind) != kind:
            found[name] = "double" if {found[name], kind} <= _NUMBERS else "string"
    return found


def _quoted(name: str, mark: str = '"') -> str:
    return mark + name.replace(mark, 2 * mark) + mark


def _add_view(
    connection: Any,
    store: Store,
    name: str,
    paths: Sequence[str],
    columns: Mapping[str, str],
    *,
    select: str = "*",
) -> None:
    """A view of the files ``paths`` with ``columns`` and their types; none without files. It opens no file.

    A column that a file does not have is NULL there.
    """
    if not paths:
        return
    folders = [folder for folder in paths[0].split("/")[:-1] if "=" in folder]
    keys = {
        folder.partition("=")[0]: "date32" if folder.startswith("date=") else "string" for folder in folders
    }
    full = [f"{store.root}/{path}" for path in paths]
    if store.is_local:  # DuckDB reads the files itself
        text = partial(_quoted, mark="'")
        wanted = (
            f"{text(one)}: {{name: {text(one)}, type: '{_TYPES[kind]}', default_value: NULL}}"
            for one, kind in columns.items()
        )
        hive = ", ".join(f"{key}: {_TYPES[kind]}" for key, kind in keys.items())
        options = (
            f"hive_partitioning = true, hive_types = {{{hive}}}" if keys else "hive_partitioning = false"
        )
        files = ", ".join(map(text, full))
        source = f"read_parquet([{files}], schema = MAP {{{', '.join(wanted)}}}, {options})"
    else:
        pa = arrow()
        fields = [(one, pa.list_(pa.float64()) if kind in _LISTS else kind) for one, kind in columns.items()]
        fields += keys.items()
        schema = pa.schema(
            [(one, pa.type_for_alias(kind) if isinstance(kind, str) else kind) for one, kind in fields]
        )
        flavor = pa.dataset.partitioning(pa.schema([schema.field(key) for key in keys]), flavor="hive")
        source = _quoted(f"{name} files")
        dataset = pa.dataset.dataset(
            full,
            schema=schema,
            filesystem=store.filesystem,
            partitioning=flavor if keys else None,
            partition_base_dir=f"{store.root}/{paths[0].partition('/')[0]}",
            format="parquet",
        )
        connection.register(f"{name} files", dataset)
    connection.execute(f"CREATE VIEW {_quoted(name)} AS SELECT {select} FROM {source}")
