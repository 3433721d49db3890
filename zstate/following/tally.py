"""Stats: what a listener received, lost and refused."""

from __future__ import annotations

import logging
from collections import Counter
from dataclasses import dataclass

from zstate.following.bounded import MOST, remember
from zstate.locks import new_lock

_LOG = logging.getLogger("zstate")

_COUNTED = ("received", "dropped", "missed", "late", "recalled", "off_clock")


@dataclass(frozen=True, slots=True)
class Stats:
    """Counts since the listener opened.

    ``received`` samples were taken; ``dropped`` by our own full ring, ``missed`` between the writer's
    sequence numbers; ``late`` ones were older than the history; ``refused`` says why others were not used.
    ``recalled`` samples were said before we listened, and their writer still knew them; ``off_clock`` had
    stamps more than a minute from the clock here, and were used all the same.
    """

    received: int
    dropped: int
    missed: int
    late: int
    refused: dict[str, int]
    recalled: int = 0
    off_clock: int = 0


class Tally:
    """The counters behind ``Stats``. Any thread may count.

    ``of(robot)`` counts for one robot, and for all of them; ``stats`` are those of all.
    """

    def __init__(self, parent: Tally | None = None) -> None:
        self._lock = new_lock()
        self._parent = parent
        self._parts: dict[str, Tally] = {}
        self._counts: dict[str, int] = dict.fromkeys(_COUNTED, 0)
        self._refused: Counter[str] = Counter()
        self._first: dict[str, str] = {}
        self._noted: dict[str, None] = {}

    def of(self, robot: str) -> Tally:
        """The counters of one robot. Robots beyond the first 4096 have none of their own."""
        part = self._parts.get(robot)
        if part is None and len(self._parts) < MOST:
            with self._lock:
                part = self._parts.setdefault(robot, Tally(self))
        return part or self

    def count(self, what: str, number: int = 1) -> None:
        """Add to one of the counts that ``Stats`` has."""
        with self._lock:
            self._counts[what] += number

    def refuse(self, reason: str, text: str) -> None:
        """Count a refusal; the first of each reason is also logged."""
        with self._lock:
            self._refused[reason] += 1
            first = self._refused[reason] == 1
            self._first.setdefault(reason, text)
        if first and (self._parent is None or self._parent._is_first(reason, text)):
            facts = {"event": "refused", "reason": reason}
            _LOG.warning("refused (%s): %s; further ones are only counted", reason, text, extra=facts)

    def _is_first(self, reason: str, text: str) -> bool:
        """Whether no robot had a refusal for that reason before."""
        with self._lock:
            return self._first.setdefault(reason, text) is text and not self._refused[reason]

    def note(self, event: str, text: str) -> None:
        """Log the first event of its kind."""
        if self._parent is not None:
            self._parent.note(event, text)
            return
        with self._lock:
            first = event not in self._noted
            remember(self._noted, event, None)
        if first:
            _LOG.warning("%s; further such events are not logged", text)

    def refusals(self) -> dict[str, str]:
        """The first refusal of each reason, in words."""
        with self._lock:
            return dict(self._first)

    def stats(self) -> Stats:
        """All counts now."""
        with self._lock:
            refused, counts, parts = self._refused.copy(), Counter(self._counts), list(self._parts.values())
        for part in parts:
            with part._lock:
                refused.update(part._refused)
                counts.update(part._counts)
        return Stats(refused=dict(refused), **{what: counts[what] for what in _COUNTED})
