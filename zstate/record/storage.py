"""Storage: what a recording's reader asks of one file, whatever its format."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple, Protocol, TypeAlias

from zstate.record.channel import Channel
from zstate.record.time_order import Part

Format: TypeAlias = Literal["mcap", "sqlite3"]
"""As rosbag2 calls them."""


class Choice(NamedTuple):
    """Which records to read: of these topics (None: all), and of log times in [begin, end)."""

    topics: frozenset[str] | None = None
    begin: int = -(1 << 63)
    end: int = 1 << 64


class Storage(Protocol):
    """One file of a recording. Everything about it raises RecordingError and nothing else.

    ``channels`` are all of its channels, with any encoding; ``span`` its first and last log time;
    ``profile`` and ``library`` what its writer said of itself. ``complete`` says that the writer closed
    it and that nothing is lost; ``losses`` names what is.
    """

    path: Path
    format: Format
    size: int
    profile: str
    library: str
    channels: tuple[Channel, ...]
    span: tuple[int, int] | None
    compressions: tuple[str, ...]
    complete: bool
    losses: tuple[str, ...]

    def parts(self, choice: Choice) -> Sequence[Part]:
        """The chosen records of CDR channels."""
        ...

    def close(self) -> None:
        """Let go of the file."""
        ...
