"""Meter: how long a sample takes from its stamp until a lookup has it."""

from __future__ import annotations

import threading
from collections import deque
from statistics import median

from zstate.buffer.buffer import TransformBuffer
from zstate.clock import SystemClock
from zstate.errors import LookupFailed

# Enough for a median, bounded for a demo that runs for days.
_KEPT = 100_000
_RECENT = 200
_LOOK_AROUND_S = 0.2


class Meter:
    """Waits in a thread for each new answer of one lookup, as a program would that wants the newest.

    ``has_begun`` is set by the first answer.
    """

    def __init__(self, buffer: TransformBuffer, target: str, source: str) -> None:
        self.has_begun = threading.Event()
        self._buffer = buffer
        self._frames = (target, source)
        self._clock = SystemClock()
        self._latencies: deque[int] = deque(maxlen=_KEPT)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="zstate meter", daemon=True)
        self._thread.start()

    def __enter__(self) -> Meter:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(2 * _LOOK_AROUND_S)

    def latency_ns(self, *, recent: bool) -> int | None:
        """The median, of the last few samples or of all; None before the second sample."""
        latencies = list(self._latencies)[-_RECENT if recent else 0 :]
        return round(median(latencies)) if latencies else None

    def _run(self) -> None:
        newest: int | None = None
        while not self._stop.is_set():
            wanted = None if newest is None else newest + 1
            try:
                self._buffer.wait(*self._frames, wanted, timeout_s=_LOOK_AROUND_S)
                now, newest = self._clock.now(), self._buffer.latest(*self._frames)
            except LookupFailed:
                continue
            # The first answer may have been there for long.
            if self.has_begun.is_set():
                self._latencies.append(now - newest)
            self.has_begun.set()
