"""Explains files that are not recordings, from their first bytes."""

from __future__ import annotations

from pathlib import Path

from zstate.recording.mcap.records import MAGIC

_KNOWN = {
    b"#ROSBAG V": "a bag of ROS 1: `rosbags-convert` makes a ROS 2 one of it",
    b"\x28\xb5\x2f\xfd": "compressed: `zstd -d` unpacks it",
    b"\x1f\x8b": "compressed: `gunzip` unpacks it",
    b"\x04\x22\x4d\x18": "compressed: `lz4 -d` unpacks it",
    b"PK\x03\x04": "a ZIP archive: unpack it",
    b"rosbag2_bagfile_information": "a bag's metadata.yaml: name its folder",
}


def explain_unreadable(path: Path, beginning: bytes) -> str:
    """Why the file at ``path`` with these first bytes cannot be read, and what to do."""
    if not beginning:
        return f"{str(path)!r} is empty: its recorder ended before it wrote anything"
    if MAGIC.startswith(beginning):
        return f"{str(path)!r} is cut off within its first {len(MAGIC)} bytes; nothing of it can be saved"
    for magic, what in _KNOWN.items():
        if beginning.startswith(magic):
            return f"{str(path)!r} is {what}"
    return (
        f"{str(path)!r} is not a recording: it begins with {beginning[:12]!r}, and neither as an MCAP file "
        "nor as the SQLite file of a bag"
    )
