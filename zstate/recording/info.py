"""Facts of a recording, without reading its messages."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from zstate.recording.reader import RecordingReader
from zstate.recording.storage import ROBOT, Channel


@dataclass(frozen=True)
class RecordingInfo:
    """Summary of a recording. ``size`` is in bytes; ``first`` and ``last`` are log times [ns].

    ``profiles``, ``libraries`` and ``compressions`` of its files and the ``robots`` named by its channels are
    without duplicates. ``skipped`` are channels that are not CDR; ``complete`` and ``losses`` are those of
    RecordingReader.
    """

    path: Path
    files: tuple[Path, ...]
    formats: tuple[str, ...]
    size: int
    profiles: tuple[str, ...]
    libraries: tuple[str, ...]
    compressions: tuple[str, ...]
    complete: bool
    losses: tuple[str, ...]
    first: int | None
    last: int | None
    channels: tuple[Channel, ...]
    skipped: tuple[Channel, ...]
    robots: tuple[str, ...]

    @property
    def duration_s(self) -> float:
        """Between the first and the last message [s]."""
        return 0.0 if self.first is None or self.last is None else (self.last - self.first) / 1e9

    @property
    def message_count(self) -> int:
        return sum(channel.count for channel in self.channels)


def read_info(path: str | os.PathLike[str]) -> RecordingInfo:
    """Read the summary of a recording. Raises RecordingError as RecordingReader does."""
    with RecordingReader(path) as reader:
        files = reader.storages
        first, last = reader.span or (None, None)
        return RecordingInfo(
            path=reader.path,
            files=tuple(file.path for file in files),
            formats=_unique(file.format for file in files),
            size=sum(file.size for file in files),
            profiles=_unique(file.profile for file in files),
            libraries=_unique(file.library for file in files),
            compressions=_unique(word for file in files for word in file.compressions),
            complete=reader.complete,
            losses=reader.losses,
            first=first,
            last=last,
            channels=reader.channels(),
            skipped=reader.skipped,
            robots=_unique(channel.metadata.get(ROBOT, "") for channel in reader.channels()),
        )


def _unique(words: Iterable[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(word for word in words if word))
