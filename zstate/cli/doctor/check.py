"""Result of one check of `zstate doctor`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

State = Literal["ok", "warning", "broken", "skipped"]


@dataclass(frozen=True, slots=True)
class Check:
    """One link of the chain: its ``name``, its state, and the evidence in ``text``.

    ``next`` is the command to continue with. ``robot`` is None for links that all robots share. A link is
    skipped if the links before it leave nothing to check.
    """

    name: str
    state: State
    text: str
    next: str = ""
    robot: str | None = None

    def for_robot(self, robot: str) -> Check:
        """The same check as a link of ``robot``."""
        return replace(self, robot=robot)


def ok(name: str, text: str) -> Check:
    """A link that works."""
    return Check(name, "ok", text)


def warning(name: str, text: str, then: str = "") -> Check:
    """A link that works, but may fail later or for other readers."""
    return Check(name, "warning", text, then)


def broken(name: str, text: str, then: str) -> Check:
    """A link that does not work."""
    return Check(name, "broken", text, then)


def skipped(name: str, text: str) -> Check:
    """A link that cannot be checked."""
    return Check(name, "skipped", text)


def first_broken(checks: Sequence[Check]) -> Check | None:
    """The link to repair first: failures of later links may follow from it."""
    return next((check for check in checks if check.state == "broken"), None)
