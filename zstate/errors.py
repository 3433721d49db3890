"""The exceptions of zstate, as one tree::

 ZStateError
 ├── InvalidInput (ValueError)          an unusable argument; nothing was changed
 │   ├── FrameMismatch                  a_from_b @ c_from_d with b != c
 │   ├── InsertRefused                  the buffer rejected a transform            .reason .edge
 │   └── ConfigError                    a configuration file or option             .path
 ├── ModelError (ValueError)            an unusable robot model                    .source .findings
 │   └── UnknownModel                   no model of that name                      .name .near_misses
 ├── LibraryMissing (ImportError)       a library to install first
 ├── MessageError (ValueError)          a payload that cannot be decoded           .reason
 ├── SecondWriter                       another writer is active already           .first .robot .stream .edge
 ├── NetworkError                       Zenoh reports a failure
 │   ├── Unreachable (TimeoutError)     no answer from the endpoints               .endpoints
 │   ├── AccessDenied                   the endpoint rejects this session          .reason .endpoint
 │   ├── NoClock (TimeoutError)         simulated time is not published            .waited_s
 │   ├── PortBusy                       the endpoint is in use                     .endpoint
 │   └── Closed                         used after close(), or after fork
 └── LookupFailed                       .target .source .edge .requested .oldest .newest .track .rate_hz ...
     ├── UnknownFrame                   a frame that is not in the buffer          .name .near_misses
     ├── AmbiguousFrame                 a bare name that several robots have       .name .candidates
     ├── Disconnected                   two trees                                  .roots .gone_s
     ├── ClockMismatch                  stamps of two clocks on one path           .edges .robots .domains
     ├── NoData                         an edge without any sample
     ├── InFuture                       after the newest sample of an edge
     ├── InPast                         before the oldest sample of an edge
     ├── Stale                          too old for max_age_s, or silent           .age_s .max_age_s .other
     └── NotFinite                      numbers too large to compute with

Those of plugins are also ZStateErrors: ``zstate.RecordingError``, and those in ``zstate.driving``.
A wait that times out raises the last reason for waiting, as a subclass that is also
``WaitTimeout`` (a TimeoutError): ``except InFuture`` and ``except TimeoutError`` both catch it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, cached_property
from typing import Any, Protocol, TypeVar

from zstate._util.format import difference_text, format_duration, format_time

E = TypeVar("E", bound="ZStateError")

# A smaller clock offset does not explain a failed lookup.
_LEAST_OFFSET_NS = 1_000_000

_USE_ONE_CLOCK = (
    "; use stamps of their clock, or the newest instant (at=None), and let all writers share one clock"
)


def printable(text: str) -> str:
    """``text`` with escapes such as ``\\x1b`` for control characters and line ends.

    For names and texts that come from the network: printing them must not control the terminal.
    """
    if text.isprintable():
        return text
    return "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in text)


class ZStateError(Exception):
    """Base class of every error of zstate. Survives pickling, so that it can cross processes."""

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self)!r})"

    def facts(self) -> dict[str, Any]:
        """Values by attribute name."""
        return self.__dict__

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (type(self), self.args, self.facts())


def _restored(kind: type[E], texts: tuple[Any, ...], facts: dict[str, Any]) -> E:
    # Bypasses the constructor: pickle does not pass its keyword-only arguments.
    error = kind.__new__(kind)
    error.args = texts
    error.__dict__.update(facts)
    return error


class InvalidInput(ZStateError, ValueError):
    """An unusable argument. The call changed nothing."""


class FrameMismatch(InvalidInput):
    """Two transforms were composed whose inner frames differ."""


class InsertRefused(InvalidInput):
    """The buffer rejected a transform; its content is unchanged.

    ``reason`` is one word or two for programs and counters ("loop", "second parent", ...);
    ``edge`` is (parent, child) as passed.
    """

    def __init__(self, message: str, *, reason: str, edge: tuple[str, str]) -> None:
        super().__init__(message)
        self.reason = reason
        self.edge = edge


class ConfigError(InvalidInput):
    """An unusable configuration file or option; ``path`` is the place in it."""

    def __init__(self, message: str, *, path: str = "") -> None:
        super().__init__(message)
        self.path = path


class FindingLike(Protocol):
    """The part of a ``zstate.model.findings.Finding`` that ModelError reads."""

    @property
    def line(self) -> int | None: ...
    @property
    def message(self) -> str: ...
    @property
    def severity(self) -> str: ...
    @property
    def fix(self) -> str: ...


class ModelError(ZStateError, ValueError):
    """An unusable robot model, with all of its faults.

    ``findings`` holds errors and warnings in the order of their lines; ``source`` names the file
    or text that contains them.
    """

    def __init__(self, source: str, findings: Sequence[FindingLike] = (), message: str = "") -> None:
        self.source = source
        self.findings = tuple(findings)
        errors = [finding for finding in findings if finding.severity == "error"]
        count = f"{len(errors)} finding{'s' if len(errors) != 1 else ''}"
        lines = [f"{source} cannot be used ({count})"]
        for finding in errors:
            where = "file" if finding.line is None else f"line {finding.line}"
            lines.append(f"  {where}  {finding.message}")
        super().__init__(message or "\n".join(lines))


class UnknownModel(ModelError):
    """No file, URDF text or catalog entry has that name."""

    def __init__(self, name: str, near_misses: Sequence[str], message: str) -> None:
        super().__init__(name, (), message)
        self.name = name
        self.near_misses = tuple(near_misses)


class LibraryMissing(ZStateError, ImportError):
    """A library that this call needs cannot be loaded; the text names the package to install.

    ``command`` installs it, if known.
    """

    def __init__(self, message: str, *, command: str = "") -> None:
        super().__init__(message)
        self.command = command


class MessageError(ZStateError, ValueError):
    """A payload that cannot be decoded, or a message that lacks a part.

    ``reason`` is a counter's name: "foreign", "newer version", "truncated", "malformed", and for missing
    parts "no attachment", "no stamp", "no positions", "missing joints".
    """

    def __init__(self, message: str, *, reason: str) -> None:
        super().__init__(message)
        self.reason = reason


class NetworkError(ZStateError):
    """Zenoh reports a failure, or the network does not do what was requested."""


class Unreachable(NetworkError, TimeoutError):
    """No answer from the endpoints."""

    def __init__(self, message: str, *, endpoints: Sequence[str]) -> None:
        super().__init__(message)
        self.endpoints = tuple(endpoints)


class AccessDenied(NetworkError):
    """The process at ``endpoint`` rejects this session, or drops what the session writes.

    ``reason`` is "not allowed to write", and then ``endpoint`` is the key; or one of "no TLS there", "TLS
    demanded", "wrong CA", "name mismatch", "their certificate expired", "their certificate not yet
    valid", "our certificate expired", "our certificate refused", "certificate demanded", "not a
    server", "user or password", "user demanded".
    """

    def __init__(self, message: str, *, reason: str, endpoint: str) -> None:
        super().__init__(message)
        self.reason = reason
        self.endpoint = endpoint


class PortBusy(NetworkError):
    """Another process listens at that endpoint already."""

    def __init__(self, message: str, *, endpoint: str) -> None:
        super().__init__(message)
        self.endpoint = endpoint


class NoClock(NetworkError, TimeoutError):
    """No simulated time was received within ``waited_s``."""

    def __init__(self, message: str, *, waited_s: float) -> None:
        super().__init__(message)
        self.waited_s = waited_s


class Closed(NetworkError):
    """Used after ``close()``, or in a process forked from the one that opened it."""


class WriterLike(Protocol):
    """The part of a ``zstate.wire.identity.WriterId`` that a SecondWriter carries."""

    @property
    def program(self) -> str: ...
    @property
    def host(self) -> str: ...
    @property
    def pid(self) -> int: ...
    @property
    def since(self) -> int: ...


class SecondWriter(ZStateError):
    """An older writer publishes the same ``stream`` of ``robot`` already.

    ``first`` is the older writer; ``edge`` is the (parent, child) that both publish, or None if the
    conflict is about the whole stream.
    """

    def __init__(
        self, message: str, *, robot: str, stream: str, first: WriterLike, edge: tuple[str, str] | None = None
    ) -> None:
        super().__init__(message)
        self.robot, self.stream, self.first, self.edge = robot, stream, first, edge


class LookupFailed(ZStateError):
    """A lookup without an answer, with the facts of the failure.

    ``target`` and ``source`` are the frames as requested, ``edge`` is the (parent, child) at fault.
    ``requested``, ``oldest`` and ``newest`` are stamps [ns]; ``track`` (the publisher's history), ``rate_hz``
    and ``writer`` belong to the edge; each is None when it does not apply. The text is built when it is
    read: a failed lookup in a control loop costs little. ``note`` is an additional remark, ``ended``
    the reason why no more data comes, if there is one.
    ``clock_offset_ns`` is how far the clock of the edge's writer is ahead of the local one, if it was
    measured, and ``clock_uncertainty_ns`` its uncertainty. ``is_recorded`` is true if the samples
    come from a recording. ``facts`` of subclasses are the keyword arguments of this class.
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
        self.target, self.source, self.edge = target, source, edge
        self.requested, self.oldest, self.newest = requested, oldest, newest
        self.rate_hz, self.writer = rate_hz, writer
        self.track: str | None = None
        self.note = ""

    def __str__(self) -> str:
        note = "".join(f" ({note})" for note in (self.note, self.ended) if note)
        return f"pose of {self.source!r} in {self.target!r}: {self.message()}{note}"

    def message(self) -> str:
        """What happened, with which values, and what to do."""
        raise NotImplementedError

    def _clock_text(self) -> str:
        """The offset of the writer's clock; empty if unknown, below 1 ms or below its uncertainty."""
        offset, uncertainty = self.clock_offset_ns, self.clock_uncertainty_ns or 0
        if offset is None or abs(offset) < max(_LEAST_OFFSET_NS, uncertainty):
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

    ``near_misses`` are searched when they are first read, because the search takes milliseconds among
    thousands of frames. They are chosen among the frames of the moment when this was raised.
    """

    def __init__(
        self,
        target: str,
        source: str,
        *,
        name: str,
        near_misses: Sequence[str] | Callable[[], Sequence[str]] = (),
        frame_count: int = 0,
        hint: Callable[[int], str] | None = None,
        **facts: Any,
    ) -> None:
        super().__init__(target, source, **facts)
        self.name = name
        self.frame_count = frame_count
        if hint is not None:
            self._hint = hint
        if callable(near_misses):
            self._search = near_misses
        else:
            self.near_misses = tuple(near_misses)

    _hint: Callable[[int], str] | None = None

    @cached_property
    def near_misses(self) -> tuple[str, ...]:
        """Similar known names, best first."""
        return tuple(self._search())

    def facts(self) -> dict[str, Any]:
        facts = {**super().facts(), "near_misses": self.near_misses, "hint": self.hint}
        for private in ("_search", "_hint"):
            facts.pop(private, None)
        return facts

    @cached_property
    def hint(self) -> str:
        """Why the buffer has no such frame, as its listener knows it; empty without a listener."""
        return "" if self._hint is None else self._hint(self.frame_count)

    def message(self) -> str:
        if not self.frame_count:
            advice = self.hint or ("is a publisher running, and was the listener given time (timeout_s=...)?")
            return f"the frame {self.name!r} is unknown: this buffer has received no frame yet; {advice}"
        if self.near_misses:
            return f"the frame {self.name!r} is unknown; did you mean {_choices(self.near_misses)}?"
        return (
            f"the frame {self.name!r} is unknown among {self.frame_count} frames; "
            + (f"{self.hint}; " if self.hint else "")
            + "`buffer.frames()` or `zstate tree` lists them"
        )


class AmbiguousFrame(LookupFailed):
    """A bare frame name that more than one robot has."""

    def __init__(self, target: str, source: str, *, name: str, candidates: Sequence[str]) -> None:
        super().__init__(target, source)
        self.name = name
        self.candidates = tuple(candidates)

    def message(self) -> str:
        return f"the frame name {self.name!r} is not unique; name it in full: {_choices(self.candidates)}"


class Disconnected(LookupFailed):
    """Both frames are known, but no chain of edges joins them. ``roots``: (target's, source's).

    If one of these roots had a parent before, ``edge`` and ``writer`` name that edge, and ``gone_s`` is
    the time since its withdrawal [s].
    """

    gone_s: float | None = None

    def __init__(self, target: str, source: str, *, roots: tuple[str, str], **facts: Any) -> None:
        super().__init__(target, source, **facts)
        self.roots = roots

    def message(self) -> str:
        target_root, source_root = self.roots
        removed = ""
        if self.gone_s is not None:
            when = f"{int(self.gone_s)} s ago" if self.gone_s >= 1.0 else "just now"
            removed = f"; {self._edge_text()} was withdrawn {when}"
        return (
            f"they are in two trees: {self.target!r} is under root {target_root!r}, {self.source!r} under "
            f"root {source_root!r}; missing is an edge whose child is {source_root!r} or {target_root!r} "
            f"(for instance `zstate static {target_root} {source_root} --xyz ...`){removed}"
        )


class ClockMismatch(LookupFailed):
    """Stamps of two clock domains would have to be compared; ``domains`` names both.

    Either the path crosses two ``edges`` of two ``robots``, each stamped in its own domain; or the age of one
    edge was requested by a clock of another domain, the second of ``domains``.
    """

    def __init__(
        self,
        target: str,
        source: str,
        *,
        edges: tuple[tuple[str, str], ...],
        robots: tuple[str, ...],
        domains: tuple[str, str],
        **facts: Any,
    ) -> None:
        super().__init__(target, source, edge=edges[0], **facts)
        self.edges, self.robots, self.domains = edges, robots, domains

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


class NoData(LookupFailed):
    """An edge of the path has no sample at all, or ``latest`` was asked of static edges only."""

    def message(self) -> str:
        if self.edge is None:
            return "every edge of the path is static, so there is no newest instant; ask `lookup` instead"
        if self.newest is not None:
            return f"too little is known of {self._edge_text()}"
        return f"no sample of {self._edge_text()} has arrived yet; is its writer running (`zstate ls`)?"


class _OutsideHistory(LookupFailed):
    """The requested instant is outside the range of the samples."""

    @property
    def what_happened(self) -> str:
        """The message without advice."""
        if isinstance(self, InPast):
            distance, which = f"{_span(self.oldest, self.requested)} before", "oldest"
        else:
            distance, which = f"{_span(self.requested, self.newest)} after", "newest"
        sample = "only" if self._has_one_sample else which
        cause = f": {self._difference}" if self._difference else ""
        return f"asked {distance} the {sample} sample of {self._edge_text()}{cause}"

    @property
    def is_of_another_time(self) -> bool:
        """Whether the requested stamp and those of the samples seem to be of unrelated clocks."""
        return bool(self._difference)

    @property
    def _difference(self) -> str:
        if self.requested is None or self.newest is None:
            return ""
        return difference_text(self.requested, self.newest)

    @property
    def _has_one_sample(self) -> bool:
        return self.newest is not None and self.oldest == self.newest

    def message(self) -> str:
        advice = _USE_ONE_CLOCK if self._difference else self._advice()
        return f"{self.what_happened}{advice}{_also(self._clock_text())}"

    def _advice(self) -> str:
        raise NotImplementedError


class InFuture(_OutsideHistory):
    """The requested instant is after the newest sample of ``edge``."""

    def _advice(self) -> str:
        wait = "" if self.ended else "wait for it (timeout_s=...), "
        return f"; {wait}ask for the newest instant (at=None), or predict (predict_s=...)"


class InPast(_OutsideHistory):
    """The requested instant is before the oldest sample of ``edge``; waiting does not help."""

    def _advice(self) -> str:
        if self.is_recorded:
            return f"; the recording has nothing older of it, and {_span(self.newest, self.oldest)} in all"
        if self._has_one_sample:
            return (
                " so far; ask for the newest instant (at=None), or start the listener earlier; publish what "
                "never moves as static (`zstate static`)"
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
        **facts: Any,
    ) -> None:
        super().__init__(target, source, **facts)
        self.age_s, self.max_age_s = age_s, max_age_s
        self.other, self.other_newest = other, other_newest

    def message(self) -> str:
        if self.max_age_s is not None:
            clocks = ", and do the clocks of both machines agree?"
            if self.clock_offset_ns is not None:
                clocks = f"? {self._clock_text()}".rstrip()
            return (
                f"the newest answer is {format_duration(round(self.age_s * 1e9))} old, {self.max_age_s:g} s "
                f"are allowed; the oldest link is {self._edge_text()}: is its writer alive (`zstate ls`)"
                f"{clocks}"
            )
        newest, other_newest = self.newest or 0, self.other_newest or 0
        other = "the others" if self.other is None else f"{self.other[0]!r} -> {self.other[1]!r}"
        if difference := difference_text(other_newest, newest):
            return (
                f"{self._edge_text()} and {other} have no instant in common: {difference}; let all writers "
                "share one clock"
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


class WaitTimeout(LookupFailed, TimeoutError):
    """A wait that timed out. Always raised as a subclass of the last reason for waiting."""

    reason: type[LookupFailed] = LookupFailed
    waited_s: float = 0.0

    def __str__(self) -> str:
        return f"after waiting {self.waited_s:g} s, {super().__str__()}"

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored_timeout, (self.reason, self.facts())


def as_timeout(reason: LookupFailed, waited_s: float) -> WaitTimeout:
    """The same facts as ``reason``, as an error that is also a TimeoutError."""
    return _restored_timeout(type(reason), {**reason.__dict__, "waited_s": waited_s})


def _restored_timeout(reason: type[LookupFailed], facts: dict[str, Any]) -> WaitTimeout:
    return _restored(_timeout_class(reason), (), facts)


@cache
def _timeout_class(reason: type[LookupFailed]) -> type[WaitTimeout]:
    members = {"reason": reason, "__doc__": WaitTimeout.__doc__}
    return type(f"{reason.__name__}Timeout", (WaitTimeout, reason), members)


def _span(later: int | None, earlier: int | None) -> str:
    return "some time" if later is None or earlier is None else format_duration(later - earlier)


def _also(text: str) -> str:
    return f"; {text}" if text else ""


def _choices(names: Sequence[str]) -> str:
    return " or ".join(map(repr, names))
