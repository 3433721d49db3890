"""Paces: rates of what is only counted."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Hashable

from zstate._util.bounded_dict import BoundedDict

WINDOW_S = 10.0
EVERY_S = 1.0

_Marks = deque[tuple[float, float]]


class Paces:
    """Rates [Hz] of counts over the last ten seconds, independent of when and how often they are read.

    ``note`` is to be called about once a second; without that a rate is the one since the last reading that
    is at least ten seconds old, or since the first. Any thread may call.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._marks: BoundedDict[Hashable, _Marks] = BoundedDict()
        self._lock = threading.Lock()

    def note(self, key: Hashable, count: float) -> None:
        """What ``key`` counts has come to ``count``."""
        with self._lock:
            self._note(key, count, self._clock())

    def rate_hz(self, key: Hashable, count: float) -> float:
        """The rate of what ``key`` counts, which has come to ``count``; 0 at the first reading."""
        with self._lock:
            now = self._clock()
            time_s, before = self._note(key, count, now)
        return (count - before) / (now - time_s) if now > time_s else 0.0

    def _note(self, key: Hashable, count: float, now: float) -> tuple[float, float]:
        """Keep this reading if the last one is a second old. Returns the one at the window's beginning."""
        marks = self._marks.get(key)
        if marks is None:
            marks = _Marks()
            self._marks[key] = marks
        if marks and count < marks[-1][1]:
            marks.clear()  # it counts from the beginning again
        if not marks or now - marks[-1][0] >= EVERY_S:
            marks.append((now, count))
        while len(marks) > 1 and now - marks[1][0] >= WINDOW_S:
            marks.popleft()
        return marks[0]
