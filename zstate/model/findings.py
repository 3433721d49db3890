"""Finding: one thing a validator has to say about a model; Findings collects them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Literal

from zstate.errors import ModelError

Severity = Literal["error", "warning"]

# A hostile file may hold thousands of unknown names, each compared with thousands of known ones.
_MOST_SUGGESTIONS = 12
_LONGEST_COMPARED = 100
_LONGEST_QUOTED = 80


@dataclass(frozen=True, slots=True)
class Finding:
    """One fault or doubt: in which line (None: of the file as a whole), what, and how bad.

    An "error" makes the model unusable; a "warning" is something its author should know. ``fix`` says
    what to write instead, where that can be said.
    """

    line: int | None
    message: str
    severity: Severity
    fix: str = ""


class Findings:
    """What has been found so far in one source."""

    def __init__(self, source: str) -> None:
        self.source = source
        self._found: list[Finding] = []
        self._suggestions_left = _MOST_SUGGESTIONS

    def error(self, line: int | None, message: str, fix: str = "") -> None:
        """Note a fault that makes the model unusable, and what to write instead."""
        self._found.append(Finding(line, message, "error", fix))

    def warning(self, line: int | None, message: str, fix: str = "") -> None:
        """Note something doubtful that does not prevent use, and what to write instead."""
        self._found.append(Finding(line, message, "warning", fix))

    def did_you_mean(self, name: str, candidates: Iterable[str]) -> str | None:
        """The candidate that was probably meant by ``name``, if there is one."""
        if not self._suggestions_left or len(name) > _LONGEST_COMPARED:
            return None
        self._suggestions_left -= 1
        comparable = [candidate for candidate in candidates if len(candidate) <= _LONGEST_COMPARED]
        for candidate in comparable:
            if candidate.lower() == name.lower():
                return candidate
        near = get_close_matches(name, comparable, n=1)
        return near[0] if near else None

    def sorted(self) -> tuple[Finding, ...]:
        """All findings by line; those of the whole file first."""
        return tuple(sorted(self._found, key=lambda finding: finding.line or 0))

    def raise_errors(self) -> None:
        """Raise ModelError with everything found if there is an error among it."""
        if any(finding.severity == "error" for finding in self._found):
            raise ModelError(self.source, self.sorted())


def quoted(text: str) -> str:
    """``text`` in quotes, shortened where a file holds something endless."""
    return repr(shortened(text))


def shortened(text: str) -> str:
    """``text``, without its end where a file holds something endless."""
    return text if len(text) <= _LONGEST_QUOTED else f"{text[:_LONGEST_QUOTED]}..."
