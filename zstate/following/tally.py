"""Stats: what a listener received, lost and refused."""

from __future__ import annotations

import logging
from collections import Counter
from dataclasses import dataclass

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
    """The counters behind ``Stats``. Any thread may count."""

    def __init__(self) -> None:
        self._lock = new_lock()
        self._counts: dict[str, int] = dict.fromkeys(_COUNTED, 0)
        self._refused: Counter[str] = Counter()
        self._first: dict[str, str] = {}
        self._noted: set[str] = set()

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
        if first:
            facts = {"event": "refused", "reason": reason}
            _LOG.warning("refused (%s): %s; further ones are only counted", reason, text, extra=facts)

    def note(self, event: str, text: str) -> None:
        """Log the first event of its kind."""
        with self._lock:
            first = event not in self._noted
            self._noted.add(event)
        if first:
            _LOG.warning("%s; further such events are not logged", text)

    def refusals(self) -> dict[str, str]:
        """The first refusal of each reason, in words."""
        with self._lock:
            return dict(self._first)

    def stats(self) -> Stats:
        """All counts now."""
        with self._lock:
            return Stats(refused=dict(self._refused), **self._counts)
