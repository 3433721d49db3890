"""ReplayClock: which instant is looked at, of those that are known."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from zstate._util.fork_safe import fork_safe_lock
from zstate.buffer.snapshot import TimeSpan
from zstate.errors import InvalidInput


class TimeCursor:
    """The present, a moment that stands still, or one that goes on at ``speed``.

    ``live`` for a robot that is heard now: it begins in the present, and playing on comes back to it.
    Otherwise it begins to play at the oldest instant, and stops at the newest. ``now_s`` tells how time
    passes. Any thread may call.
    """

    def __init__(self, *, live: bool = True, now_s: Callable[[], float] = time.monotonic) -> None:
        self.live = live
        self._now_s = now_s
        self._lock = fork_safe_lock()
        self._speed = 1.0
        self._span: TimeSpan | None = None
        # Where it was, and when that was; None for the present, or for an instant still to be known.
        self._at: int | None = None
        self._since_s = now_s()
        self._playing = not live

    @property
    def is_present(self) -> bool:
        """Whether the newest of everything is looked at."""
        return self.live and self._at is None

    @property
    def is_playing(self) -> bool:
        """Whether time goes on; in the present it does."""
        return self.is_present or self._playing

    @property
    def speed(self) -> float:
        """How many seconds are shown in one. May be set; raises InvalidInput for zero and less."""
        return self._speed

    @speed.setter
    def speed(self, speed: float) -> None:
        if not (math.isfinite(speed) and speed > 0.0):
            raise InvalidInput(f"a speed is a positive number; got {speed!r}")
        with self._lock:
            self._settle()
            self._speed = speed

    def stamp(self, span: TimeSpan | None) -> int | None:
        """The instant to look at [ns], of those in ``span``; None for the newest of everything."""
        with self._lock:
            self._span = span
            self._settle()
            return self._at

    def pause(self) -> None:
        """Stand still where it is."""
        with self._lock:
            self._settle()
            if self._at is None and self._span is not None:
                self._at = self._span.newest if self.live else self._span.oldest
            self._playing = False

    def play(self) -> None:
        """Go on from where it is; from the oldest instant when that is the end."""
        with self._lock:
            self._settle()
            if not self.live and self._span is not None and self._at == self._span.newest:
                self._at = self._span.oldest
            self._playing = True

    def seek(self, stamp: int) -> None:
        """Go to ``stamp`` [ns], or to the end that is nearer; plays on if it played before."""
        with self._lock:
            self._settle()
            self._playing = self._playing and self._at is not None
            self._at = stamp
            self._settle()

    def return_to_present(self) -> None:
        """Look at the newest of everything again. Of a recording, at its end."""
        with self._lock:
            self._playing = False
            self._at = None if self.live or self._span is None else self._span.newest

    def _settle(self) -> None:
        """Bring ``_at`` to the present time, within what is known."""
        now_s = self._now_s()
        elapsed_s, self._since_s = now_s - self._since_s, now_s
        span = self._span
        if span is None:
            return
        if self._at is None:
            if self.live:
                return
            self._at = span.oldest
        elif self._playing:
            self._at += round(elapsed_s * self._speed * 1e9)
        if self._playing and self._at >= span.newest:
            self._at = None if self.live else span.newest
            self._playing = False
        if self._at is not None:
            # What the buffer has forgotten meanwhile cannot be looked at any more.
            self._at = min(max(self._at, span.oldest), span.newest)
