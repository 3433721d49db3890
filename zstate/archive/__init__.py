"""Archives: recordings of many robots over months, as Parquet files in a folder or an object store."""

from typing import TYPE_CHECKING

from zstate._util.lazy_names import lazy_names

if TYPE_CHECKING:
    from zstate.archive.archive import Archive, ArchivedMessage, Coverage
    from zstate.archive.batches import PoseColumns, poses
    from zstate.archive.compaction import CompactionReport, compact
    from zstate.archive.importer import ImportReport, import_recording

__all__ = [
    "Archive",
    "ArchivedMessage",
    "CompactionReport",
    "Coverage",
    "ImportReport",
    "PoseColumns",
    "compact",
    "import_recording",
    "poses",
]

_HOMES = {
    "Archive": "archive",
    "ArchivedMessage": "archive",
    "CompactionReport": "compaction",
    "compact": "compaction",
    "Coverage": "archive",
    "ImportReport": "importer",
    "import_recording": "importer",
    "PoseColumns": "batches",
    "poses": "batches",
}

if not TYPE_CHECKING:  # type checkers would take any name for one of the package
    __getattr__ = lazy_names(__name__, _HOMES)


def __dir__() -> list[str]:
    return __all__
