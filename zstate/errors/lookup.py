"""Errors about questions that a buffer cannot answer: what all of them tell, and those about frames.

Errors about instants: the frames are joined, and of that moment nothing is known.

WaitTimeout: a wait that ran out, which is also the reason it still waited for.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, cached_property
from typing import Any

from zstate._util.format import difference_text, format_duration, format_time
from zstate.errors.base import ZStateError

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
        return f"pose of {self.source!r} in {self.target!r}: {self.message()}{note}"

    def message(self) -> str:
        """What happened, with which values, and what to do."""
        raise NotImplementedError

    def _clock_text(self) -> str:
        """What the clock of the writer has to do with it; empty where it is not known to have."""
        offset, uncertainty = self.clock_offset_ns, self.clock_uncertainty_ns or 0
        if offset is None or abs(offset) < max(_WORTH_SAYING_NS, uncertainty):
            return ""
        size = f"{format_duration(abs(offset))} {'ahead of' if offset > 0 else 'behind'}"
        return f"the clock of {self.writer!r} is {size} this one (± {format_duration(uncertainty)})"

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

    def message(self) -> str:
        if not self.frame_count:
            return (
                f"the frame {self.name!r} is unknown: this buffer has not heard of any frame yet; "
                "is a publisher running, and was the listener given time (timeout_s=...)?"
            )
        if self.near_misses:
            return f"the frame {self.name!r} is unknown; did you mean {_list_names(self.near_misses)}?"
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

    def message(self) -> str:
        return f"the frame name {self.name!r} is not unique; name it in full: {_list_names(self.candidates)}"


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

    def message(self) -> str:
        target_root, source_root = self.roots
        return (
            f"they are in two trees: {self.target!r} is under root {target_root!r}, {self.source!r} under "
            f"root {source_root!r}; missing is an edge whose child is {source_root!r} or {target_root!r} "
            f"(for instance `zstate static {target_root} {source_root} --xyz ...`){self._removed_text()}"
        )

    def _removed_text(self) -> str:
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

    def message(self) -> str:
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


def _list_names(names: Sequence[str]) -> str:
    return " or ".join(repr(name) for name in names)


_IN_THEIR_TIME = (
    "; ask in the time that they keep, or for the newest instant (at=None), and let all writers keep one time"
)


class NoData(LookupFailed):
    """An edge of the path has no sample at all, or ``latest`` was asked of static edges only."""

    def message(self) -> str:
        if self.edge is None:
            return "every edge of the path is static, so there is no newest instant; ask `lookup` instead"
        if self.newest is not None:
            return f"too little is known of {self._edge_text()}"
        return f"no sample of {self._edge_text()} has arrived yet; is its writer running (`zstate ls`)?"


class _Extrapolation(LookupFailed):
    """The instant asked for is not among those that samples tell of."""

    @property
    def what_happened(self) -> str:
        """What happened, with which values, without advice."""
        raise NotImplementedError

    @property
    def is_of_another_time(self) -> bool:
        """Whether what was asked and the samples are stamped by clocks that say nothing of each other."""
        return bool(self._difference)

    @property
    def _difference(self) -> str:
        if self.requested is None or self.newest is None:
            return ""
        return difference_text(self.requested, self.newest)

    @property
    def _has_one_sample(self) -> bool:
        return self.newest is not None and self.oldest == self.newest

    def _with_likely_cause(self, what: str) -> str:
        """``what``, and why the stamps are so far apart where that can be seen."""
        return f"{what}: {self._difference}" if self._difference else what

    def message(self) -> str:
        advice = _IN_THEIR_TIME if self._difference else self._advice()
        return f"{self.what_happened}{advice}{_also(self._clock_text())}"

    def _advice(self) -> str:
        raise NotImplementedError


class InFuture(_Extrapolation):
    """The instant asked for lies after the newest sample of ``edge``."""

    @property
    def what_happened(self) -> str:
        which = "only" if self._has_one_sample else "newest"
        return self._with_likely_cause(
            f"asked {_span(self.requested, self.newest)} after the {which} sample of {self._edge_text()}"
        )

    def _advice(self) -> str:
        wait = "" if self.ended else "wait for it (timeout_s=...), "
        return f"; {wait}ask for the newest instant (at=None), or predict (predict_s=...)"


class InPast(_Extrapolation):
    """The instant asked for lies before the oldest sample of ``edge``; waiting cannot mend it."""

    @property
    def what_happened(self) -> str:
        which = "only" if self._has_one_sample else "oldest"
        return self._with_likely_cause(
            f"asked {_span(self.oldest, self.requested)} before the {which} sample of {self._edge_text()}"
        )

    def _advice(self) -> str:
        if self.is_recorded:
            return f"; the recording has nothing older of it, and {_span(self.newest, self.oldest)} in all"
        if self._has_one_sample:
            return (
                " so far; ask for the newest instant (at=None), or start the listener earlier; what never "
                "moves is published as static (`zstate static`)"
            )
        return (
            f"; the history there spans {_span(self.newest, self.oldest)}: start the listener earlier or "
            "give the buffer more history_s"
        )


class Stale(LookupFailed):
    """The answer is older than ``max_age_s`` allows, or ``edge`` is silent for so long that there is none.

    An edge without new samples has no instant in common with ``other`` once the history of that one begins
    after its last sample; ``other_newest`` [ns] is the newest sample of ``other``, and ``max_age_s`` None.
    ``age_s`` is the age of the answer by the buffer's clock, or how much later ``other_newest`` is.
    """

    def __init__(
        self,
        target: str,
        source: str,
        *,
        age_s: float,
        max_age_s: float | None = None,
        other: tuple[str, str] | None = None,
        other_newest: int | None = None,
        edge: tuple[str, str] | None = None,
        requested: int | None = None,
        oldest: int | None = None,
        newest: int | None = None,
        rate_hz: float | None = None,
        writer: str | None = None,
    ) -> None:
        super().__init__(
            target,
            source,
            edge=edge,
            requested=requested,
            oldest=oldest,
            newest=newest,
            rate_hz=rate_hz,
            writer=writer,
        )
        self.age_s = age_s
        self.max_age_s = max_age_s
        self.other = other
        self.other_newest = other_newest

    def message(self) -> str:
        if self.max_age_s is None:
            return self._silence()
        if self.clock_offset_ns is None:
            clocks = ", and do the clocks of both machines agree?"
        else:
            clocks = f"? {self._clock_text()}".rstrip()
        return (
            f"the newest answer is {format_duration(round(self.age_s * 1e9))} old, {self.max_age_s:g} s are "
            f"allowed; the oldest link is {self._edge_text()}: is its writer alive (`zstate ls`){clocks}"
        )

    def _silence(self) -> str:
        newest, other_newest = self.newest or 0, self.other_newest or 0
        other = "the others" if self.other is None else f"{self.other[0]!r} -> {self.other[1]!r}"
        if difference := difference_text(other_newest, newest):
            return (
                f"{self._edge_text()} and {other} have no instant in common: {difference}; let all writers "
                "keep one time"
            )
        return (
            f"{self._edge_text()} has been silent since {format_time(newest)}: its newest sample is "
            f"{format_duration(other_newest - newest)} older than that of {other}, whose history does not "
            f"reach back so far; is its writer alive (`zstate ls`)?{_also(self._clock_text())}"
        )


class NotFinite(LookupFailed):
    """The numbers on the path are so large that the result is infinite or NaN."""

    def message(self) -> str:
        return (
            f"the result is not finite: numbers on the path are too large, {self._edge_text()} has the "
            "largest; check the units and the positions that its writer publishes"
        )


def _span(later: int | None, earlier: int | None) -> str:
    return "some time" if later is None or earlier is None else format_duration(later - earlier)


def _also(text: str) -> str:
    return f"; {text}" if text else ""


class WaitTimeout(LookupFailed, TimeoutError):
    """A wait that ran out. Always raised as a subclass of the reason it still waited for."""

    reason: type[LookupFailed] = LookupFailed
    waited_s: float = 0.0

    def __str__(self) -> str:
        return f"after waiting {self.waited_s:g} s, {super().__str__()}"

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored_timeout, (self.reason, self.facts())


@cache
def _timeout_class(reason: type[LookupFailed]) -> type[WaitTimeout]:
    facts = {"reason": reason, "__doc__": WaitTimeout.__doc__}
    return type(f"{reason.__name__}Timeout", (WaitTimeout, reason), facts)


def _restored_timeout(reason: type[LookupFailed], facts: dict[str, Any]) -> WaitTimeout:
    error = _timeout_class(reason).__new__(_timeout_class(reason))
    error.__dict__.update(facts)
    return error


def as_timeout(reason: LookupFailed, waited_s: float) -> WaitTimeout:
    """The same facts as ``reason``, as an error that is also a TimeoutError."""
    return _restored_timeout(type(reason), {**reason.__dict__, "waited_s": waited_s})
