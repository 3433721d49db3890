"""Errors about input, models, messages and the network."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol


def printable(text: str) -> str:
    """``text`` with escapes such as ``\\x1b`` for what a terminal acts on: control characters, line ends.

    For names and texts that come from the network: a program that prints them must not be steered by them.
    """
    if text.isprintable():
        return text
    return "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in text)


class ZStateError(Exception):
    """What every error of zstate is. Survives pickling, so that it can cross processes."""

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self)!r})"

    def facts(self) -> dict[str, Any]:
        """Everything it knows, by the names of its attributes."""
        return self.__dict__

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (type(self), self.args, self.facts())


def _restored(kind: type[ZStateError], texts: tuple[Any, ...], facts: dict[str, Any]) -> ZStateError:
    # Not by the constructor, whose keyword-only facts pickle would not give it.
    error = kind.__new__(kind)
    error.args = texts
    error.__dict__.update(facts)
    return error


class InvalidInput(ZStateError, ValueError):
    """An argument that cannot be used. Nothing was changed by the call."""


class FrameMismatch(InvalidInput):
    """Two transforms were composed whose inner frames differ."""


class InsertRefused(InvalidInput):
    """The buffer did not take a transform; what it held before is untouched.

    ``reason`` is one word or two for programs and counters ("loop", "second parent", ...);
    ``edge`` is (parent, child) as given.
    """

    def __init__(self, message: str, *, reason: str, edge: tuple[str, str]) -> None:
        super().__init__(message)
        self.reason = reason
        self.edge = edge


class ConfigError(InvalidInput):
    """A configuration file or option that cannot be used; ``path`` says where in it."""

    def __init__(self, message: str, *, path: str = "") -> None:
        super().__init__(message)
        self.path = path


class FindingLike(Protocol):
    """What a ModelError needs to know of a finding (see ``zstate.model.urdf.Finding``)."""

    @property
    def line(self) -> int | None: ...
    @property
    def message(self) -> str: ...
    @property
    def severity(self) -> str: ...
    @property
    def fix(self) -> str: ...


class ModelError(ZStateError, ValueError):
    """A robot model that cannot be used, with everything that is wrong with it.

    ``findings`` holds errors and warnings in the order of their lines; ``source`` names the file
    or text they were found in.
    """

    def __init__(self, source: str, findings: Sequence[FindingLike] = (), message: str = "") -> None:
        self.source = source
        self.findings = tuple(findings)
        super().__init__(message or self._summary())

    def _summary(self) -> str:
        errors = [f for f in self.findings if f.severity == "error"]
        count = f"{len(errors)} finding{'s' if len(errors) != 1 else ''}"
        lines = [f"{self.source} cannot be used ({count})"]
        for finding in errors:
            where = f"line {finding.line}" if finding.line is not None else "file"
            lines.append(f"  {where}  {finding.message}")
        return "\n".join(lines)


class UnknownModel(ModelError):
    """No file, URDF text or catalog entry answers to that name."""

    def __init__(self, name: str, near_misses: Sequence[str], message: str) -> None:
        super().__init__(name, (), message)
        self.name = name
        self.near_misses = tuple(near_misses)


class LibraryMissing(ZStateError, ImportError):
    """A library that this call needs cannot be loaded; the text says what to install."""


class MessageError(ZStateError, ValueError):
    """Bytes that are not a message we can read.

    ``reason`` is a counter's name: "foreign", "newer version", "truncated", "malformed", and what a
    message lacks: "no attachment", "no stamp", "no positions", "missing joints".
    """

    def __init__(self, message: str, *, reason: str) -> None:
        super().__init__(message)
        self.reason = reason


class NetworkError(ZStateError):
    """Zenoh refused, or the network does not do what was asked."""


class Unreachable(NetworkError, TimeoutError):
    """Nothing answers at the endpoints."""

    def __init__(self, message: str, *, endpoints: Sequence[str]) -> None:
        super().__init__(message)
        self.endpoints = tuple(endpoints)


class AccessDenied(NetworkError):
    """Somebody answers at ``endpoint`` and does not let this session in, or drops what it writes.

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
    """Somebody listens at that endpoint already."""

    def __init__(self, message: str, *, endpoint: str) -> None:
        super().__init__(message)
        self.endpoint = endpoint


class NoClock(NetworkError, TimeoutError):
    """Nobody tells the simulated time; ``waited_s`` says how long it was waited for."""

    def __init__(self, message: str, *, waited_s: float) -> None:
        super().__init__(message)
        self.waited_s = waited_s


class Closed(NetworkError):
    """Used after ``close()``, or in a process forked from the one that opened it."""


class WriterLike(Protocol):
    """What a SecondWriter tells of the first (see ``zstate.wire.identity.Writer``)."""

    @property
    def program(self) -> str: ...
    @property
    def host(self) -> str: ...
    @property
    def pid(self) -> int: ...
    @property
    def since(self) -> int: ...


class SecondWriter(ZStateError):
    """Somebody else writes the same already, and came first.

    ``first`` is who, ``robot`` and ``stream`` are what; ``edge`` is the (parent, child) that both place,
    or None where it is the whole stream.
    """

    def __init__(
        self, message: str, *, robot: str, stream: str, first: WriterLike, edge: tuple[str, str] | None = None
    ) -> None:
        super().__init__(message)
        self.robot = robot
        self.stream = stream
        self.first = first
        self.edge = edge


class RecordingError(ZStateError):
    """A recording that cannot be read or written; ``path`` is the file or folder at fault."""

    def __init__(self, message: str, *, path: str) -> None:
        super().__init__(message)
        self.path = path
