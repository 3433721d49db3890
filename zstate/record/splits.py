"""Splits: the files run.mcap, run_1.mcap, run_2.mcap ... of one recording.

They belong together by an identity that each carries in a metadata record behind its header, not by
their names alone: what an older recording of the same name left behind is not taken in.
"""

from __future__ import annotations

import re
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Metadata

from zstate.record.blocks import Damaged, parsed
from zstate.record.byte_file import ByteFile
from zstate.record.summary import header_of

IDENTITY = "zstate.recording"
"""The name of the metadata record; its keys are "id", and "part" (0, 1, ...)."""


def split_path(first: Path, part: int) -> Path:
    """The file of a recording's part, as rosbag2 numbers them."""
    return first if part == 0 else first.with_name(f"{first.stem}_{part}{first.suffix}")


def later_splits(first: Path) -> list[tuple[int, Path]]:
    """The files beside ``first`` that are called as its later parts, by number."""
    pattern = re.compile(rf"{re.escape(first.stem)}_([1-9]\d*){re.escape(first.suffix)}")
    found = ((pattern.fullmatch(path.name), path) for path in first.parent.iterdir())
    return sorted((int(match[1]), path) for match, path in found if match)


def split_files(first: Path) -> tuple[list[Path], list[str]]:
    """The files of the recording that begins with ``first``, and the names of those that are missing.

    ``first`` alone if it is not the first part of a recording of ours.
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
        with ByteFile(path) as file:
            if not file.starts_as_mcap:
                return None
            opcode, body = file.record(header_of(file)[1])
            if opcode != Opcode.METADATA:
                return None
            found = parsed(Metadata, body)
    except (Damaged, OSError):
        return None
    words = found.metadata
    return (words.get("id", ""), words.get("part", "")) if found.name == IDENTITY else None
