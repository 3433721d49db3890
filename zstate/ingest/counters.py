"""Counters behind ``TransformListener.stats``: samples received, refused, and missing by sequence number."""

from __future__ import annotations

import logging
import sys
from collections import Counter
from dataclasses import dataclass

from zstate._util.bounded import MAX_ENTRIES, BoundedDict
from zstate._util.fork_safe import fork_safe_lock
from zstate._util.refusals import Refusals

_LOG = logging.getLogger("zstate")

_MAX_GAPS = 64
_COUNTED = ("received", "dropped", "missed", "late", "recalled", "off_clock")


@dataclass(frozen=True, slots=True)
class ListenerStats:
    """Counts since the listener opened.

    ``received`` samples were inserted; ``dropped`` were lost in the listener's own full ring, ``missed``
    between the writer's sequence numbers, those that a router thins as well; ``late`` were older than the
    history; ``refused`` counts samples that could not be used, by reason. ``recalled`` samples are from the
    writers' caches: history from before the listener opened, and what exact lookups requested; ``off_clock``
    had stamps more than a minute from the clock here, and were inserted all the same.
    """

    received: int
    dropped: int
    missed: int
    late: int
    refused: dict[str, int]
    recalled: int = 0
    off_clock: int = 0

    def _repr_html_(self) -> str:
        from zstate._util.html import html_of_fields  # noqa: PLC0415 - for notebooks alone

        return html_of_fields(self)


class Counters:
    """Counts for all robots. Any thread may count.

    ``for_robot(robot)`` counts for one robot and for all; ``stats`` and ``refusals`` cover all of them.
    """

    def __init__(self, parent: Counters | None = None) -> None:
        self._lock = fork_safe_lock()
        self._parent = parent
        self._robots: dict[str, Counters] = {}
        self._counts: dict[str, int] = dict.fromkeys(_COUNTED, 0)
        self.fast_counts: dict[str, int] = {}
        """The part of these counts that the extension adds, in atomic calls and without the lock."""
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
            counts.update(one.fast_counts.copy())
            refused.update(one._refusals.counts.copy())
        return ListenerStats(refused=dict(refused), **{what: counts[what] for what in _COUNTED})


class MissingSamples:
    """The missing sequence numbers of the current session; of more than 64 gaps the newest are kept."""

    def __init__(self) -> None:
        self._ranges = [range(sys.maxsize)]

    def __bool__(self) -> bool:
        return bool(self._ranges)

    def __contains__(self, seq: int) -> bool:
        return any(seq in missing for missing in self._ranges)

    def add(self, first: int, end: int) -> None:
        """Add the samples from ``first`` up to, without, ``end``."""
        if self._ranges and self._ranges[-1].stop == first:
            first = self._ranges.pop().start
        self._ranges.append(range(first, end))
        del self._ranges[:-_MAX_GAPS]

    def stop_at(self, seq: int) -> None:
        """Remove the samples from ``seq`` on: they were received, or will be."""
        kept = [range(one.start, min(one.stop, seq)) for one in self._ranges]
        self._ranges = [one for one in kept if one]


class SequenceNumbers:
    """The sequence numbers of one session: the ``next`` one, and those that are missing.

    The samples of one ROS message have the same number.
    """

    def __init__(self) -> None:
        self.next: int | None = None
        self.newest_recalled = -1
        """The largest number that came from the writer's cache."""
        self.missing = MissingSamples()

    def skip_to(self, seq: int) -> int:
        """Go on after ``seq``, which is not the next one. Returns how many are missing before it."""
        gap = 0
        if self.next is None:
            self.missing.stop_at(seq)
        elif seq > self.next:
            self.missing.add(self.next, seq)
            gap = seq - self.next
        self.next = max(seq + 1, self.next or 0)
        return gap

    def is_missing(self, seq: int) -> bool:
        """Whether the sample ``seq`` was not received live, and is no older than the session."""
        # After a network cut, history may arrive before the first live sample, which shows the gap.
        return seq in self.missing or (self.next is not None and seq >= self.next)

    def recall(self, seq: int) -> None:
        """Note that the sample ``seq`` was inserted from the writer's cache."""
        self.newest_recalled = max(self.newest_recalled, seq)
