"""A bag: the folder that rosbag2 records into, and its metadata.yaml.

Only what says which files are to be read is taken from the YAML (https://github.com/ros2/rosbag2,
versions 1 to 9 of the format); the files tell the rest. Written by yaml-cpp or ruamel, it has one form:
the keys of a bag stand one step in from ``rosbag2_bagfile_information``, the paths in a block list.
Anything else is refused, not guessed at.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

from zstate.errors import RecordingError
from zstate.record.storage import Format

FORMATS: dict[str, Format] = {".mcap": "mcap", ".db3": "sqlite3"}
METADATA = "metadata.yaml"

_TOP = "rosbag2_bagfile_information:"
_KEY = re.compile(r"( *)([A-Za-z_]\w*):(?: +(.*?))? *$")
_ITEM = re.compile(r" *- +(.*?) *$")
_PLAIN = re.compile(r"[^\s\"'\[\]{}&*!|>%@`#,?:-](?:[^:#]|:(?! )|(?<! )#)*")
_NEWEST = 9


def bag_files(folder: Path) -> list[Path]:
    """The files of a bag in their order, which its metadata.yaml gives, or else their numbers."""
    metadata = folder / METADATA
    if not metadata.exists():
        return _numbered_files(folder)
    try:
        text = metadata.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{str(metadata)!r} cannot be read: {error}", path=str(metadata)) from error
    files = [folder / PurePosixPath(name).name for name in _Bag(metadata, text).names]
    if missing := [str(file) for file in files if not file.exists()]:
        text = f"{str(metadata)!r} names files that are not there: {', '.join(missing)}"
        raise RecordingError(text, path=str(metadata))
    return files


def _numbered_files(folder: Path) -> list[Path]:
    """What a bag without metadata.yaml holds, as a killed ``ros2 bag record`` leaves it."""
    try:
        files = [file for file in folder.iterdir() if file.suffix in FORMATS]
    except OSError as error:
        raise RecordingError(f"{str(folder)!r} cannot be read: {error.strerror}", path=str(folder)) from error
    kinds = {(re.sub(r"_\d+$", "", file.stem), file.suffix) for file in files}
    if len(kinds) == 1:
        return sorted(files, key=_number)
    found = "no .mcap or .db3 file" if not kinds else f"files of {len(kinds)} recordings"
    text = f"the folder {str(folder)!r} holds no {METADATA} and {found}; name a recording's file"
    raise RecordingError(text, path=str(folder))


def _number(file: Path) -> tuple[int, str]:
    """By the numbers at the ends of their names, so that 10 follows 9."""
    match = re.search(r"_(\d+)$", file.stem)
    return int(match[1]) if match else -1, file.name


class _Bag:
    """What a metadata.yaml says of a bag's files, if it is one of those that can be read here."""

    def __init__(self, path: Path, text: str) -> None:
        self._path = path
        self._keys = self._read_keys(text)
        version, storage = self._word("version"), self._word("storage_identifier")
        if not version.isdecimal() or not 1 <= int(version) <= _NEWEST:
            raise self._refusal(f"its version is {version!r}, and 1 to {_NEWEST} are known")
        if storage not in FORMATS.values():
            raise self._refusal(f"its storage is {storage!r}, and 'mcap' and 'sqlite3' are known")
        self._refuse_compression()
        self.names = self._read_names()

    def _refusal(self, reason: str) -> RecordingError:
        text = f"the bag of {str(self._path)!r} cannot be read: {reason}"
        return RecordingError(text, path=str(self._path))

    def _read_keys(self, text: str) -> dict[str, list[str]]:
        """Each key of the bag, with the rest of its line and the lines that belong to it."""
        keys: dict[str, list[str]] = {}
        lines = [line.rstrip() for line in text.splitlines() if line.strip() not in {"", "---"}]
        if not lines or lines[0] != _TOP:
            raise self._refusal(f"it does not begin with {_TOP!r}")
        step, current = "", []
        for line in lines[1:]:
            match = _KEY.match(line)
            step = step or (match[1] if match else "")
            if not match or match[1] != step or not step:
                current.append(line)
            elif match[2] in keys:
                raise self._refusal(f"it says {match[2]!r} twice")
            else:
                current = keys[match[2]] = [match[3] or ""]
        return keys

    def _word(self, key: str) -> str:
        value, *rest = self._keys.get(key, ("", "?"))
        if rest:
            raise self._refusal(f"it does not say {key!r} in one word")
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
            raise self._refusal(f"{text!r} is YAML that is not understood here")
        return text

    def _read_names(self) -> tuple[str, ...]:
        value, *items = self._keys.get("relative_file_paths", ("",))
        names = tuple(self._items(items))
        if value or not names:
            raise self._refusal("it does not list 'relative_file_paths', one a line")
        return names

    def _items(self, lines: Sequence[str]) -> Iterator[str]:
        for line in lines:
            match = _ITEM.match(line)
            if not match:
                raise self._refusal(f"{line.strip()!r} is YAML that is not understood here")
            yield self._scalar(match[1])

    def _refuse_compression(self) -> None:
        mode = self._word("compression_mode") if "compression_mode" in self._keys else ""
        if mode.lower() not in {"", "none"}:
            raise self._refusal(
                f"it is compressed by {mode.lower()}, on top of its storage; `ros2 bag convert` writes it "
                "without (a .zstd file alone: `zstd -d`)"
            )
