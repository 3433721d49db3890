"""Names and identity of the files run.mcap, run_1.mcap, run_2.mcap ... of one split recording.

Each file carries the recording's identity in a metadata record behind its header. Names alone do not
suffice: an older recording of the same name may have left files behind.
"""

from __future__ import annotations

import re
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Metadata

from zstate.recording.mcap.index import read_header
from zstate.recording.mcap.records import BoundedFile, CorruptData, parse_record

IDENTITY = "zstate.recording"
"""Name of the metadata record; its keys are "id", and "part" (0, 1, ...)."""


def split_path(first: Path, part: int) -> Path:
    """The file of a recording's part, numbered as by rosbag2."""
    return first if part == 0 else first.with_name(f"{first.stem}_{part}{first.suffix}")


def later_splits(first: Path) -> list[tuple[int, Path]]:
    """The files in the folder of ``first`` that are named as its later parts, by number."""
    pattern = re.compile(rf"{re.escape(first.stem)}_([1-9]\d*){re.escape(first.suffix)}")
    found = ((pattern.fullmatch(path.name), path) for path in first.parent.iterdir())
    return sorted((int(match[1]), path) for match, path in found if match)


def split_files(first: Path) -> tuple[list[Path], list[str]]:
    """The files of the recording that begins with ``first``, and the names of missing ones.

    ``first`` alone if it is not the first part of a recording by zstate.
    """
    identity = _identity(first)
    if identity is None or identity[1] != "0":
        return [first], []
    later = [
        (part, path) for part, path in later_splits(first) if _identity(path) == (identity[0], str(part))
    ]
    present = {part for part, _ in later}
    missing = [
        split_path(first, part).name for part in range(1, max(present, default=0)) if part not in present
    ]
    return [first, *(path for _, path in later)], missing


def _identity(path: Path) -> tuple[str, str] | None:
    try:
        with BoundedFile(path) as file:
            if not file.has_mcap_magic:
                return None
            opcode, body = file.record(read_header(file)[1])
            if opcode != Opcode.METADATA:
                return None
            found = parse_record(Metadata, body)
    except (CorruptData, OSError):
        return None
    return (found.metadata.get("id", ""), found.metadata.get("part", "")) if found.name == IDENTITY else None
