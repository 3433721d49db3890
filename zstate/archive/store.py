"""An archive as a store of recordings: where commands take a file, they take a window of an archive."""

from __future__ import annotations

from pathlib import Path

from zstate.archive.layout import IMPORTS


class ArchiveStore:
    """The archive ``url``, a ``zstate.recording.stores.RecordingStore``."""

    def __init__(self, url: str) -> None:
        self._url = url

    @staticmethod
    def is_store(name: str) -> bool:
        """Whether ``name`` is a URL, or a folder with an archive."""
        return "://" in name or Path(name, IMPORTS).is_dir()

    def write_window(self, path: Path, robot: str, start: int, end: int) -> None:
        """Write the samples from ``start`` to ``end`` [ns]; raises as ``zstate.archive.cut.cut``."""
        from zstate.archive.cut import cut  # noqa: PLC0415 - a command that opens a file does not need it

        cut(self._url, path, robot, start, end)

    def check(self) -> None:
        """Raise LibraryMissing without pyarrow, and RecordingError for a URL that cannot be opened."""
        from zstate.archive.ledger import Ledger  # noqa: PLC0415 - pyarrow takes time
        from zstate.archive.storage import Store  # noqa: PLC0415

        Ledger(Store(self._url)).recorded_names()

    def add(self, path: Path) -> None:
        """Add the recording ``path``; raises as ``import_recording``."""
        from zstate.archive.importer import import_recording  # noqa: PLC0415 - likewise

        import_recording(self._url, path)
