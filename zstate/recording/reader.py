"""Reads the records of a recording in the order of their log times.

The folder of a rosbag2 recording lists its files in metadata.yaml. Only that list is read from the YAML
(https://github.com/ros2/rosbag2, versions 1 to 9 of the format); the rest is in the files. Written by
yaml-cpp or ruamel, it has one form: the keys of a bag are indented once below
``rosbag2_bagfile_information``, the paths are a block list. Any other form is an error.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Collection, Iterator
from pathlib import Path, PurePosixPath

from zstate._util.closeable import Closeable
from zstate.errors import RecordingError
from zstate.recording.mcap.file import McapFile, explain_unreadable, open_errors, split_files
from zstate.recording.mcap.records import MAGIC
from zstate.recording.sqlite_file import SqliteFile
from zstate.recording.storage import (
    CDR,
    Channel,
    Format,
    ReadFilter,
    Record,
    Storage,
    merge_by_log_time,
    merge_channels,
)

FORMATS: dict[str, Format] = {".mcap": "mcap", ".db3": "sqlite3"}
METADATA = "metadata.yaml"

_TOP = "rosbag2_bagfile_information:"
_KEY = re.compile(r"( *)([A-Za-z_]\w*):(?: +(.*?))? *$")
_ITEM = re.compile(r" *- +(.*?) *$")
_PLAIN = re.compile(r"[^\s\"'\[\]{}&*!|>%@`#,?:-](?:[^:#]|:(?! )|(?<! )#)*")
_NEWEST = 9
_SQLITE_MAGIC = b"SQLite format 3\0"


class RecordingReader(Closeable):
    """A recording, opened read-only.

    ``path`` is an MCAP file, the first file of a split recording (the others are found in its folder), a
    .db3 file, or the folder of a bag, with or without metadata.yaml. The format is decided by the first
    bytes of a file, not its name. Raises RecordingError for other files and unreadable ones.

    A truncated or damaged file is read as far as possible: ``complete`` is then False, and ``losses``
    describes what is missing. Damage that is found only during a read raises RecordingError there.
    ``skipped`` are the channels whose encoding is not CDR; their records are left out.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        files, missing = (bag_files(self.path), []) if self.path.is_dir() else split_files(self.path)
        self.storages: list[Storage] = []
        self._is_open = True
        try:
            for file in files:
                self.storages.append(_open_storage(file))
        except RecordingError:
            self.close()
            raise
        channels = merge_channels(channel for storage in self.storages for channel in storage.channels)
        self._channels = tuple(channel for channel in channels if channel.encoding == CDR)
        self.skipped = tuple(channel for channel in channels if channel.encoding != CDR)
        self.losses = (
            *(f"{storage.path.name}: {loss}" for storage in self.storages for loss in storage.losses),
            *(f"{name} is missing" for name in missing),
        )
        self.complete = not self.losses and all(storage.complete for storage in self.storages)

    def channels(self) -> tuple[Channel, ...]:
        """The CDR channels of all files without duplicates, with their record counts."""
        return self._channels

    @property
    def span(self) -> tuple[int, int] | None:
        """The first and the last log time [ns], both inclusive; None without messages."""
        spans = [storage.span for storage in self.storages if storage.span]
        return (min(first for first, _ in spans), max(last for _, last in spans)) if spans else None

    def records(
        self, topics: Collection[str] | None = None, begin: int | None = None, end: int | None = None
    ) -> Iterator[Record]:
        """The records of these topics (None: of all) with log times in [begin, end), by log time.

        Records of one instant are in the order of writing. Only chunks that may contain some are read, one
        after the other.
        """
        default = ReadFilter()
        read_filter = ReadFilter(
            None if topics is None else frozenset(topics),
            default.begin if begin is None else begin,
            default.end if end is None else end,
        )
        if not self._is_open:
            raise RecordingError(f"the recording {str(self.path)!r} is closed", path=str(self.path))
        return merge_by_log_time([part for storage in self.storages for part in storage.parts(read_filter)])

    def close(self) -> None:
        self._is_open = False
        for storage in self.storages:
            storage.close()


def _open_storage(path: Path) -> Storage:
    with open_errors(path) as file:
        beginning = file.read(0, min(file.size, 64))
    if beginning.startswith(MAGIC):
        return McapFile(path)
    if beginning.startswith(_SQLITE_MAGIC):
        return SqliteFile(path)
    raise RecordingError(explain_unreadable(path, beginning), path=str(path))


def bag_files(folder: Path) -> list[Path]:
    """The files of a bag, ordered by its metadata.yaml, or by their numbers if it has none."""
    metadata = folder / METADATA
    if not metadata.exists():
        return _numbered_files(folder)
    try:
        text = metadata.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{str(metadata)!r} cannot be read: {error}", path=str(metadata)) from error
    files = [folder / PurePosixPath(name).name for name in _Metadata(metadata, text).names]
    if missing := [str(file) for file in files if not file.exists()]:
        text = f"{str(metadata)!r} names files that are not there: {', '.join(missing)}"
        raise RecordingError(text, path=str(metadata))
    return files


def _numbered_files(folder: Path) -> list[Path]:
    """The files of a bag without metadata.yaml, as a killed ``ros2 bag record`` leaves it."""
    try:
        files = [file for file in folder.iterdir() if file.suffix in FORMATS]
    except OSError as error:
        raise RecordingError(f"{str(folder)!r} cannot be read: {error.strerror}", path=str(folder)) from error
    kinds = {(re.sub(r"_\d+$", "", file.stem), file.suffix) for file in files}
    if len(kinds) == 1:
        # By the numbers at the ends of their names, so that 10 follows 9.
        numbers = {file: re.search(r"_(\d+)$", file.stem) for file in files}
        return sorted(files, key=lambda file: (int(n[1]) if (n := numbers[file]) else -1, file.name))
    found = "no .mcap or .db3 file" if not kinds else f"files of {len(kinds)} recordings"
    text = f"the folder {str(folder)!r} holds no {METADATA} and {found}; name a recording's file"
    raise RecordingError(text, path=str(folder))


class _Metadata:
    """The list of files in a metadata.yaml. Raises RecordingError for a form that is not supported."""

    def __init__(self, path: Path, text: str) -> None:
        self._path = path
        self._keys = self._read_keys(text)
        version, storage = self._word("version"), self._word("storage_identifier")
        if not version.isdecimal() or not 1 <= int(version) <= _NEWEST:
            raise self._error(f"its version is {version!r}, and 1 to {_NEWEST} are known")
        if storage not in FORMATS.values():
            raise self._error(f"its storage is {storage!r}, and 'mcap' and 'sqlite3' are known")
        mode = self._word("compression_mode").lower() if "compression_mode" in self._keys else ""
        if mode not in {"", "none"}:
            raise self._error(
                f"it is compressed by {mode}, on top of its storage; `ros2 bag convert` writes it "
                "without (a .zstd file alone: `zstd -d`)"
            )
        value, *lines = self._keys.get("relative_file_paths", ("",))
        names: list[str] = []
        for line in lines:
            match = _ITEM.match(line)
            if not match:
                raise self._error(f"{line.strip()!r} is YAML that is not supported here")
            names.append(self._scalar(match[1]))
        self.names = tuple(names)
        if value or not names:
            raise self._error("it does not list 'relative_file_paths', one a line")

    def _error(self, reason: str) -> RecordingError:
        text = f"the bag of {str(self._path)!r} cannot be read: {reason}"
        return RecordingError(text, path=str(self._path))

    def _read_keys(self, text: str) -> dict[str, list[str]]:
        """Each key, with the rest of its line and the lines below it."""
        keys: dict[str, list[str]] = {}
        lines = [line.rstrip() for line in text.splitlines() if line.strip() not in {"", "---"}]
        if not lines or lines[0] != _TOP:
            raise self._error(f"it does not begin with {_TOP!r}")
        step, current = "", []
        for line in lines[1:]:
            match = _KEY.match(line)
            step = step or (match[1] if match else "")
            if not match or match[1] != step or not step:
                current.append(line)
            elif match[2] in keys:
                raise self._error(f"it has the key {match[2]!r} twice")
            else:
                current = keys[match[2]] = [match[3] or ""]
        return keys

    def _word(self, key: str) -> str:
        value, *rest = self._keys.get(key, ("", "?"))
        if rest:
            raise self._error(f"its {key!r} is not one word")
        return self._scalar(value)

    def _scalar(self, text: str) -> str:
        try:
            value = json.loads(text) if text.startswith('"') else None
        except ValueError:
            value = None
        if isinstance(value, str):
            return value
        if len(text) > 1 and text[0] == text[-1] == "'":
            return text[1:-1].replace("''", "'")
        if not _PLAIN.fullmatch(text):
            raise self._error(f"{text!r} is YAML that is not supported here")
        return text
