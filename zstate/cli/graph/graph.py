"""Graph: the streams of robots, and the programs that write and read them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class StreamUse:
    """One stream of ``robot``, called ``name``, with the programs at its ends, each once, sorted.

    A topic of ROS belongs to no robot: ``robot`` is empty, ``name`` has the namespace.
    ``rate_hz`` is None for what is said once, and where it was not measured.
    """

    robot: str
    name: str
    rate_hz: float | None
    writers: tuple[str, ...]
    readers: tuple[str, ...]

    @property
    def label(self) -> str:
        """The name, and the rate if there is one."""
        return self.name if self.rate_hz is None else f"{self.name} ({self.rate_hz:.1f} Hz)"


@dataclass(frozen=True, slots=True)
class Bundle:
    """Streams of one robot that the same programs write and read; there is at least one."""

    streams: tuple[StreamUse, ...]

    @property
    def robot(self) -> str:
        return self.streams[0].robot

    @property
    def writers(self) -> tuple[str, ...]:
        return self.streams[0].writers

    @property
    def readers(self) -> tuple[str, ...]:
        return self.streams[0].readers


@dataclass(frozen=True, slots=True)
class Graph:
    """All streams, sorted."""

    streams: tuple[StreamUse, ...]

    @property
    def programs(self) -> list[str]:
        """Whoever writes or reads something, sorted."""
        return sorted({one for stream in self.streams for one in (*stream.writers, *stream.readers)})

    @property
    def bundles(self) -> list[Bundle]:
        """The streams, those together that have the same ends."""
        found: dict[tuple[str, tuple[str, ...], tuple[str, ...]], list[StreamUse]] = {}
        for stream in self.streams:
            found.setdefault((stream.robot, stream.writers, stream.readers), []).append(stream)
        return [Bundle(tuple(streams)) for streams in found.values()]

    def facts(self) -> dict[str, Any]:
        """The same as JSON has it."""
        streams = [
            {
                "robot": stream.robot,
                "stream": stream.name,
                "rate_hz": stream.rate_hz,
                "writers": list(stream.writers),
                "readers": list(stream.readers),
            }
            for stream in self.streams
        ]
        return {"programs": self.programs, "streams": streams}


def graph_text(graph: Graph) -> str:
    """For a person: each bundle, who writes it and who reads it."""
    return "\n".join(line for bundle in graph.bundles for line in _bundle_lines(bundle))


def _bundle_lines(bundle: Bundle) -> list[str]:
    return [
        f"{bundle.robot}{': ' * bool(bundle.robot)}{', '.join(stream.label for stream in bundle.streams)}",
        *_ends_lines("written by", bundle.writers),
        *_ends_lines("read by", bundle.readers),
    ]


def _ends_lines(role: str, programs: Sequence[str]) -> list[str]:
    heads = [role, *[""] * len(programs)]
    return [f"  {head:<10}  {program}" for head, program in zip(heads, programs or ("nobody",), strict=False)]
