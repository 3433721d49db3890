"""Check: what was found of one link of the chain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

State = Literal["ok", "warning", "broken", "skipped"]


@dataclass(frozen=True, slots=True)
class Check:
    """One link: its ``name``, how it is and what that was seen by; ``next`` is the command to go on with.

    ``robot`` is whose link it is; None for those that all robots share. A link is skipped when those
    before it leave nothing to look at.
    """

    name: str
    state: State
    text: str
    next: str = ""
    robot: str | None = None

    def of(self, robot: str) -> Check:
        """The same, of ``robot``."""
        return replace(self, robot=robot)


def ok(name: str, text: str) -> Check:
    """A link that holds."""
    return Check(name, "ok", text)


def warning(name: str, text: str, then: str = "") -> Check:
    """A link that holds, and might not for long, or not for everybody."""
    return Check(name, "warning", text, then)


def broken(name: str, text: str, then: str) -> Check:
    """A link that does not hold."""
    return Check(name, "broken", text, then)


def skipped(name: str, text: str) -> Check:
    """A link that cannot be looked at."""
    return Check(name, "skipped", text)


def first_broken(checks: Sequence[Check]) -> Check | None:
    """The link to mend first: all behind it may hang on it."""
    return next((check for check in checks if check.state == "broken"), None)
