"""Findings of the model validator: errors and warnings with lines and fixes."""

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
    """One fault of a model in ``line`` (None: of the whole file).

    An "error" makes the model unusable, a "warning" does not. ``fix`` is what to write instead; empty if
    unknown.
    """

    line: int | None
    message: str
    severity: Severity
    fix: str = ""


class Findings:
    """The findings in one source so far."""

    def __init__(self, source: str) -> None:
        self.source = source
        self._found: list[Finding] = []
        self._suggestions_left = _MOST_SUGGESTIONS

    def error(self, line: int | None, message: str, fix: str = "") -> None:
        """Add a fault that makes the model unusable, and what to write instead."""
        self._found.append(Finding(line, message, "error", fix))

    def warning(self, line: int | None, message: str, fix: str = "") -> None:
        """Add a fault that does not prevent use, and what to write instead."""
        self._found.append(Finding(line, message, "warning", fix))

    def did_you_mean(self, name: str, candidates: Iterable[str]) -> str | None:
        """The candidate most similar to ``name``, if there is one."""
        if not self._suggestions_left or len(name) > _LONGEST_COMPARED:
            return None
        self._suggestions_left -= 1
        comparable = [candidate for candidate in candidates if len(candidate) <= _LONGEST_COMPARED]
        same = [candidate for candidate in comparable if candidate.lower() == name.lower()]
        return next(iter(same or get_close_matches(name, comparable, n=1)), None)

    def sorted(self) -> tuple[Finding, ...]:
        """All findings by line, after those of the whole file."""
        return tuple(sorted(self._found, key=lambda finding: finding.line or 0))

    def raise_errors(self) -> None:
        """Raise ModelError with all findings if one of them is an error."""
        if any(finding.severity == "error" for finding in self._found):
            raise ModelError(self.source, self.sorted())


def model_error(source: str, message: str, line: int | None = None, fix: str = "") -> ModelError:
    """A ModelError with one finding."""
    return ModelError(source, [Finding(line, message, "error", fix)])


def quoted(text: str) -> str:
    """``text`` in quotes, cut after 80 characters."""
    return repr(shortened(text))


def shortened(text: str) -> str:
    """``text``, cut after 80 characters."""
    return text if len(text) <= _LONGEST_QUOTED else f"{text[:_LONGEST_QUOTED]}..."
