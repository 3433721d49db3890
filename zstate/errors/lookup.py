"""Errors about questions that a buffer cannot answer: what all of them tell, and those about frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

from zstate.errors.base import ZStateError
from zstate.errors.times import duration_text

# An offset of clocks that is smaller than this does not explain why there is no answer.
_WORTH_SAYING_NS = 1_000_000


class LookupFailed(ZStateError):
    """A question the buffer cannot answer, with what it knows.

    ``target`` and ``source`` are the frames as asked, ``edge`` is the (parent, child) at fault.
    ``requested``, ``oldest`` and ``newest`` are stamps [ns]; ``track`` (whose history it is), ``rate_hz``
    and ``writer`` belong to the edge; each is None when it does not apply. The text is built when it is
    read: a failed lookup in a control loop costs little. ``note`` says what else there is to know, ``ended``
    why no more data comes, where that is so.
    ``clock_offset_ns`` is how far the clock of the edge's writer is ahead of the one here, where that was
    measured, and ``clock_uncertainty_ns`` how far off that may be. ``is_recorded`` says that the samples
    come from a recording.
    """

    clock_offset_ns: int | None = None
    clock_uncertainty_ns: int | None = None
    ended: str = ""
    is_recorded: bool = False

    def __init__(
        self,
        target: str,
        source: str,
        *,
        edge: tuple[str, str] | None = None,
        requested: int | None = None,
        oldest: int | None = None,
        newest: int | None = None,
        rate_hz: float | None = None,
        writer: str | None = None,
    ) -> None:
        super().__init__()
        self.target = target
        self.source = source
        self.edge = edge
        self.requested = requested
        self.oldest = oldest
        self.newest = newest
        self.rate_hz = rate_hz
        self.writer = writer
        self.track: str | None = None
        self.note = ""

    def __str__(self) -> str:
        note = "".join(f" ({note})" for note in (self.note, self.ended) if note)
        return f"pose of {self.source!r} in {self.target!r}: {self.explanation()}{note}"

    def explanation(self) -> str:
        """What happened, with which values, and what to do."""
        raise NotImplementedError

    def _clock_text(self) -> str:
        """What the clock of the writer has to do with it; empty where it is not known to have."""
        offset, uncertainty = self.clock_offset_ns, self.clock_uncertainty_ns or 0
        if offset is None or abs(offset) < max(_WORTH_SAYING_NS, uncertainty):
            return ""
        size = f"{duration_text(abs(offset))} {'ahead of' if offset > 0 else 'behind'}"
        return f"the clock of {self.writer!r} is {size} this one (± {duration_text(uncertainty)})"

    def _edge_text(self) -> str:
        if self.edge is None:
            return "an edge"
        details = [] if self.writer is None else [f"writer {self.writer}"]
        if self.rate_hz is not None:
            details.append(f"{self.rate_hz:.4g} Hz")
        suffix = f" ({', '.join(details)})" if details else ""
        return f"{self.edge[0]!r} -> {self.edge[1]!r}{suffix}"


class UnknownFrame(LookupFailed):
    """A frame that no model, static edge or sample has named so far.

    ``near_misses`` are looked for when they are first read, as that takes milliseconds among thousands of
    frames; among those that there were when this was raised.
    """

    def __init__(
        self,
        target: str,
        source: str,
        *,
        name: str,
        near_misses: Sequence[str] | Callable[[], Sequence[str]] = (),
        frame_count: int = 0,
        requested: int | None = None,
    ) -> None:
        super().__init__(target, source, requested=requested)
        self.name = name
        self.frame_count = frame_count
        if callable(near_misses):
            self._search = near_misses
        else:
            self.near_misses = tuple(near_misses)

    @cached_property
    def near_misses(self) -> tuple[str, ...]:
        """Known names that look like it, best first."""
        return tuple(self._search())

    def facts(self) -> dict[str, Any]:
        facts = {**super().facts(), "near_misses": self.near_misses}
        facts.pop("_search", None)
        return facts

    def explanation(self) -> str:
        if not self.frame_count:
            return (
                f"the frame {self.name!r} is unknown: this buffer has not heard of any frame yet; "
                "is a publisher running, and was the listener given time (timeout_s=...)?"
            )
        if self.near_misses:
            return f"the frame {self.name!r} is unknown; did you mean {_any_of(self.near_misses)}?"
        return (
            f"the frame {self.name!r} is unknown among {self.frame_count} frames; "
            "`buffer.frames()` or `zstate tree` lists them"
        )


class AmbiguousFrame(LookupFailed):
    """A bare frame name that more than one robot has."""

    def __init__(self, target: str, source: str, *, name: str, candidates: Sequence[str]) -> None:
        super().__init__(target, source)
        self.name = name
        self.candidates = tuple(candidates)

    def explanation(self) -> str:
        return f"the frame name {self.name!r} is not unique; name it in full: {_any_of(self.candidates)}"


class Disconnected(LookupFailed):
    """Both frames are known, but no chain of edges joins them. ``roots``: (target's, source's).

    Where one of these roots was placed before, ``edge`` and ``writer`` tell by what, and ``gone_s`` how
    long ago [s] that was taken away.
    """

    gone_s: float | None = None

    def __init__(
        self, target: str, source: str, *, roots: tuple[str, str], requested: int | None = None
    ) -> None:
        super().__init__(target, source, requested=requested)
        self.roots = roots

    def explanation(self) -> str:
        target_root, source_root = self.roots
        return (
            f"they are in two trees: {self.target!r} is under root {target_root!r}, {self.source!r} under "
            f"root {source_root!r}; missing is an edge whose child is {source_root!r} or {target_root!r} "
            f"(for instance `zstate static {target_root} {source_root} --xyz ...`){self._gone_text()}"
        )

    def _gone_text(self) -> str:
        if self.gone_s is None:
            return ""
        when = f"{int(self.gone_s)} s ago" if self.gone_s >= 1.0 else "just now"
        return f"; {self._edge_text()} was taken away {when}"


class ClockMismatch(LookupFailed):
    """Stamps of two clock domains would have to be compared; ``domains`` names both.

    Either the path crosses two ``edges`` of two ``robots``, each stamped in its own domain; or the age of one
    edge was asked for by a clock of another domain, the second of ``domains``.
    """

    def __init__(
        self,
        target: str,
        source: str,
        *,
        edges: tuple[tuple[str, str], ...],
        robots: tuple[str, ...],
        domains: tuple[str, str],
        requested: int | None = None,
    ) -> None:
        super().__init__(target, source, edge=edges[0], requested=requested)
        self.edges = edges
        self.robots = robots
        self.domains = domains

    def explanation(self) -> str:
        first, *others = (
            f"{parent!r} -> {child!r} of robot {robot!r} is stamped in {domain!r} time"
            for (parent, child), robot, domain in zip(self.edges, self.robots, self.domains, strict=False)
        )
        if others:
            return (
                f"{first}, but {others[0]}; stamps of two clocks cannot be compared: start both robots with "
                "one clock, or look up within one of them"
            )
        return (
            f"{first}, but max_age_s is measured by a clock of {self.domains[1]!r} time; give the listener, "
            f"or the buffer, a clock of {self.domains[0]!r} time, or leave max_age_s out"
        )


def _any_of(names: Sequence[str]) -> str:
    return " or ".join(repr(name) for name in names)
