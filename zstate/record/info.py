"""What there is to say of a recording without reading its messages."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from zstate.record.channel import ROBOT, Channel
from zstate.record.reader import RecordReader


@dataclass(frozen=True)
class RecordingInfo:
    """A recording in a few facts. ``size`` is in bytes; ``first`` and ``last`` are log times [ns].

    ``profiles``, ``libraries`` and ``compressions`` are those of its files, each once; ``robots`` are
    those that its channels name. ``skipped`` are channels that are not CDR; ``complete`` and ``losses``
    are as in RecordReader.
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


def describe(path: str | os.PathLike[str]) -> RecordingInfo:
    """The facts of a recording. RecordingError as RecordReader raises it."""
    with RecordReader(path) as reader:
        files = reader.storages
        first, last = reader.span or (None, None)
        return RecordingInfo(
            path=reader.path,
            files=tuple(file.path for file in files),
            formats=_each_once(file.format for file in files),
            size=sum(file.size for file in files),
            profiles=_each_once(file.profile for file in files),
            libraries=_each_once(file.library for file in files),
            compressions=_each_once(word for file in files for word in file.compressions),
            complete=reader.complete,
            losses=reader.losses,
            first=first,
            last=last,
            channels=reader.channels(),
            skipped=reader.skipped,
            robots=_each_once(channel.metadata.get(ROBOT, "") for channel in reader.channels()),
        )


def _each_once(words: Iterable[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(word for word in words if word))
