"""An output: one MCAP file while it is written."""

from __future__ import annotations

import errno
import io
from collections.abc import Generator
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path

from mcap.writer import CompressionType, Writer

from zstate.errors import RecordingError

LIBRARY = f"zstate {version('zstate')}"

_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


class _Stage(io.BytesIO):
    """What MCAP's writer wrote, until it goes to the file in one go: whole chunks, or nothing of them.

    The writer asks where it stands (``tell``) for its index.
    """

    def __init__(self, file: io.FileIO) -> None:
        super().__init__()
        self._file = file
        self.kept = 0

    def tell(self) -> int:
        return self.kept + super().tell()

    def flush(self) -> None:
        data = self.getvalue()
        try:
            written = 0
            while written < len(data):
                written += self._file.write(data[written:])
        except OSError:
            with suppress(OSError):
                self._file.truncate(self.kept)
            raise
        self.kept += len(data)
        self.seek(0)
        self.truncate()


class Output:
    """An MCAP file of profile "ros2" or another. After a failure it is closed, and ends with a whole chunk.

    ``writer`` is MCAP's own; what it writes is in memory until ``flush``. Its public ``flush`` (since
    mcap 1.5) ends the chunk in progress, which its ``chunk_size`` does also.
    """

    def __init__(self, path: Path, *, overwrite: bool, profile: str = "ros2", library: str = LIBRARY) -> None:
        self.path = path
        with self._failing():
            self._file = io.FileIO(path, "w" if overwrite else "x")
        self._stage = _Stage(self._file)
        self.writer = Writer(self._stage, compression=CompressionType.ZSTD)
        self.writer.start(profile, library)

    @property
    def size(self) -> int:
        """How many bytes the file has."""
        return self._stage.kept

    @property
    def has_waiting(self) -> bool:
        """Whether a whole chunk waits to be written."""
        return self._stage.tell() > self._stage.kept

    def flush(self) -> None:
        """End the chunk in progress and give all to the system, where a killed process cannot lose it."""
        with self._ending_on_failure():
            self.writer.flush()

    def finish(self) -> None:
        """Write the index, and close the file."""
        with self._ending_on_failure():
            self.writer.finish()
            self._stage.flush()
            self._file.close()

    def abandon(self) -> None:
        """Close the file as it is."""
        with suppress(OSError):
            self._file.close()

    @contextmanager
    def _ending_on_failure(self) -> Generator[None, None, None]:
        try:
            with self._failing():
                yield
        except RecordingError:
            self.abandon()
            raise

    @contextmanager
    def _failing(self) -> Generator[None, None, None]:
        try:
            yield
        except FileExistsError as error:
            text = f"{str(self.path)!r} exists; choose another name, or say that it may be overwritten"
            raise RecordingError(f"{text} (overwrite=True)", path=str(self.path)) from error
        except OSError as error:
            raise RecordingError(self._failure(error), path=str(self.path)) from error

    def _failure(self, error: OSError) -> str:
        if error.errno in _FULL:
            return (
                f"{str(self.path)!r} cannot grow: {error.strerror}; free some space. What was written before "
                "stays readable, and `zstate recover` makes a complete file of it"
            )
        if error.errno == errno.ENOENT:
            return f"{str(self.path)!r} cannot be written: there is no folder {str(self.path.parent)!r}"
        return f"{str(self.path)!r} cannot be written: {error.strerror}"
