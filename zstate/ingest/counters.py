"""Counters behind ``TransformListener.stats``: samples received, lost and refused."""

from __future__ import annotations

import logging
from collections import Counter
from dataclasses import dataclass

from zstate._util.bounded_dict import MAX_ENTRIES, BoundedDict
from zstate._util.fork_safe import fork_safe_lock
from zstate._util.refusals import Refusals

_LOG = logging.getLogger("zstate")

_COUNTED = ("received", "dropped", "missed", "late", "recalled", "off_clock")


@dataclass(frozen=True, slots=True)
class ListenerStats:
    """Counts since the listener opened.

    ``received`` samples were inserted; ``dropped`` were lost in the listener's own full ring, ``missed``
    between the writer's sequence numbers; ``late`` were older than the history; ``refused`` counts samples
    that could not be used, by reason. ``recalled`` samples are history from before the listener opened, sent
    from the writers' caches; ``off_clock`` had stamps more than a minute from the clock here, and were
    inserted all the same.
    """

    received: int
    dropped: int
    missed: int
    late: int
    refused: dict[str, int]
    recalled: int = 0
    off_clock: int = 0


class Counters:
    """Counts for all robots. Any thread may count.

    ``for_robot(robot)`` counts for one robot and for all; ``stats`` and ``refusals`` cover all of them.
    """

    def __init__(self, parent: Counters | None = None) -> None:
        self._lock = fork_safe_lock()
        self._parent = parent
        self._robots: dict[str, Counters] = {}
        self._counts: dict[str, int] = dict.fromkeys(_COUNTED, 0)
        self._refusals = Refusals(parent=None if parent is None else parent._refusals)
        self._warned: BoundedDict[str, None] = BoundedDict()

    def for_robot(self, robot: str) -> Counters:
        """The counters of one robot. Robots beyond the first 4096 share those of all."""
        counters = self._robots.get(robot)
        if counters is None and len(self._robots) < MAX_ENTRIES:
            with self._lock:
                counters = self._robots.setdefault(robot, Counters(self))
        return counters or self

    def count(self, what: str, number: int = 1) -> None:
        """Add ``number`` to the count ``what``, a field of ``ListenerStats``."""
        with self._lock:
            self._counts[what] += number

    def count_refusal(self, reason: str, text: str) -> None:
        """Count a refusal; the first of each reason is also logged."""
        self._refusals.count(reason, text)

    def warn_once(self, event: str, text: str) -> None:
        """Log ``text`` if it is the first warning about ``event``."""
        if self._parent is not None:
            self._parent.warn_once(event, text)
            return
        with self._lock:
            is_first = event not in self._warned
            self._warned[event] = None
        if is_first:
            _LOG.warning("%s; further such events are not logged", text)

    def refusals(self) -> dict[str, str]:
        """The text of the first refusal of each reason."""
        return self._refusals.first.copy()

    def stats(self) -> ListenerStats:
        """All counts now."""
        counts, refused = Counter[str](), Counter[str]()
        with self._lock:
            everything = [self, *self._robots.values()]
        for one in everything:
            counts.update(one._counts.copy())
            refused.update(one._refusals.counts.copy())
        return ListenerStats(refused=dict(refused), **{what: counts[what] for what in _COUNTED})
