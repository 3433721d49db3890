"""Names with times, and the deletion of old recordings: `zstate record rec-%Y%m%d.mcap --keep 7d`.

A bound applies to the files that one pattern names, each part of a split recording on its own, since each is
readable alone. Only files that a recorder of zstate wrote count: their identity is in the file.
"""

from __future__ import annotations

import fcntl
import logging
import math
import os
import re
import time
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

from zstate.errors import InvalidInput
from zstate.recording.mcap.file import read_identity

_LOG = logging.getLogger("zstate")

_WIDTHS = {"Y": 4, "y": 2, "m": 2, "d": 2, "j": 3, "H": 2, "M": 2, "S": 2}
"""Digits of each directive of strftime that a name may have."""

_SIZES = {"kB": 1e3, "MB": 1e6, "GB": 1e9, "TB": 1e12}
_AGES_S = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86_400.0}
_UNITS = {unit.casefold(): unit for unit in (*_SIZES, *_AGES_S)}


class RecordedFile(NamedTuple):
    """One file of a recording; ``modified`` is the time of its last write [s since 1970]."""

    path: Path
    size: int
    modified: float


class FilePattern:
    """The names of a recorder's files: ``path`` with directives of strftime in its last component.

    %Y %y %m %d %j %H %M %S are digits of the local time at which a recording starts, %% is a percent sign.
    Later parts of a split recording have the number of the part behind the time. Raises InvalidInput for any
    other directive.
    """

    def __init__(self, path: str) -> None:
        self._path = Path(path)
        self._pieces = re.split(r"(%.?)", self._path.stem)
        directives = [piece[1:] for piece in self._pieces[1::2]]
        for directive in directives:
            if directive not in _WIDTHS and directive != "%":
                raise InvalidInput(
                    f"the file name {self._path.name!r} has '%{directive}'; write "
                    f"{', '.join(f'%{known}' for known in _WIDTHS)} for parts of the time at which the "
                    "recording starts, or %% for a percent sign"
                )
        self.has_time = any(directive in _WIDTHS for directive in directives)
        stem = "".join(_expression(piece) for piece in self._pieces)
        self._names = re.compile(rf"{stem}(?:_([1-9]\d*))?{re.escape(self._path.suffix)}", re.ASCII)

    def __str__(self) -> str:
        return str(self._path)

    @property
    def folder(self) -> Path:
        """The folder of all files."""
        return self._path.parent

    def path_at(self, start: datetime) -> Path:
        """The file of a recording that starts then, by the local time."""
        stem = "".join(
            piece if not piece.startswith("%") else "%" if piece == "%%" else start.strftime(piece)
            for piece in self._pieces
        )
        return self.folder / f"{stem}{self._path.suffix}"

    def recordings(self) -> list[RecordedFile]:
        """The files with such a name that zstate recorded, oldest first by their last write."""
        found: list[RecordedFile] = []
        with os.scandir(self.folder) as entries:
            for entry in entries:
                match = self._names.fullmatch(entry.name)
                if match is None or not entry.is_file(follow_symlinks=False):
                    continue
                identity = read_identity(Path(entry.path))
                if identity is not None and identity[1] == (match[1] or "0"):
                    status = entry.stat(follow_symlinks=False)
                    found.append(RecordedFile(Path(entry.path), status.st_size, status.st_mtime))
        return sorted(found, key=lambda file: (file.modified, file.path.name))


def _expression(piece: str) -> str:
    if not piece.startswith("%"):
        return re.escape(piece)
    return "%" if piece == "%%" else rf"\d{{{_WIDTHS[piece[1:]]}}}"


@dataclass(frozen=True)
class Keep:
    """How much is kept: recordings of ``max_bytes`` in total, or the time since ``max_age_s`` ago."""

    text: str
    max_bytes: float = math.inf
    max_age_s: float = math.inf

    @classmethod
    def parse(cls, text: str) -> Keep:
        """A size such as "50GB" or an age such as "7d". Raises InvalidInput with the list of units."""
        match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([A-Za-z]*)\s*", text, re.ASCII)
        unit = _UNITS.get(match[2].casefold()) if match else None
        if match is None or unit is None or float(match[1]) == 0.0:
            raise InvalidInput(
                f"{text!r} is no size and no age; write a positive number with a unit: "
                f"{', '.join(_SIZES)} of files in total, or {', '.join(_AGES_S)} since they were written, "
                "such as 50GB or 7d"
            )
        amount = float(match[1])
        if unit in _SIZES:
            return cls(text, max_bytes=amount * _SIZES[unit])
        return cls(text, max_age_s=amount * _AGES_S[unit])


class Retention:
    """Deletes the oldest recordings of ``pattern`` beyond ``keep``, and counts what it deletes.

    ``is_split`` is True if the recording in progress splits, so that its own files can be deleted.
    """

    def __init__(self, pattern: FilePattern, keep: Keep, *, is_split: bool) -> None:
        self._pattern, self._is_split, self.keep = pattern, is_split, keep
        self.deleted_files = self.deleted_bytes = self.kept_bytes = 0

    def delete_excess(self, used: Collection[Path]) -> Iterator[RecordedFile]:
        """Delete files, oldest first, until the rest is within the bound; the deleted ones.

        Those in ``used``, the current one among them, and others that a recorder is writing count, and stay.
        A file that cannot be deleted is logged, and stays.
        """
        try:
            files = self._pattern.recordings()
        except OSError as error:  # the folder is gone, or another program deletes files there
            _LOG.warning("recordings in %r cannot be listed: %s", str(self._pattern.folder), error.strerror)
            return
        self.kept_bytes = sum(file.size for file in files)
        now = time.time()
        for file in files:
            is_old = now - file.modified > self.keep.max_age_s
            if not is_old and self.kept_bytes <= self.keep.max_bytes:
                return
            if file.path in used or _is_being_written(file.path):
                continue
            try:
                file.path.unlink()
            except OSError as error:
                _LOG.warning("%r cannot be deleted: %s", str(file.path), error.strerror)
                continue
            self.kept_bytes -= file.size
            self.deleted_files += 1
            self.deleted_bytes += file.size
            yield file

    def growth(self, bytes_per_s: float, duration_s: float) -> float:
        """Bytes by which the recordings grow in that time, beyond those kept at the last deletion."""
        written = bytes_per_s * duration_s
        if not self._is_split or not written:
            return written
        bound = min(self.keep.max_bytes, self.keep.max_age_s * bytes_per_s)
        return min(written, max(0.0, bound - self.kept_bytes))


def _is_being_written(path: Path) -> bool:
    """Whether a recorder has it open: it holds a lock on the file that it writes."""
    try:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # gone, or a file system without locks
        return False
    return False
