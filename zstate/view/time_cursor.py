"""TimeCursor: the instant on display, live, paused or playing."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from zstate._util.fork_safe import fork_safe_lock
from zstate.buffer.snapshot import TimeSpan
from zstate.errors import InvalidInput


class TimeCursor:
    """The instant on display: live, paused, or playing at ``speed``.

    With ``live``, for robots on the network, it starts live, and playing ends there. Otherwise, for a
    recording, it starts to play at the oldest stamp and stops at the newest. ``now_s`` is the clock of
    playback [s]. Any thread may call.
    """

    def __init__(self, *, live: bool = True, now_s: Callable[[], float] = time.monotonic) -> None:
        self.can_be_live = live
        self._now_s = now_s
        self._lock = fork_safe_lock()
        self._speed = 1.0
        self._span: TimeSpan | None = None
        # The stamp at the time ``_since_s``; None if live, or if the oldest stamp is not known yet.
        self._at: int | None = None
        self._since_s = now_s()
        self._playing = not live

    @property
    def is_live(self) -> bool:
        """Whether the newest samples are shown."""
        return self.can_be_live and self._at is None

    @property
    def is_playing(self) -> bool:
        """Whether time advances, as it does live."""
        return self.is_live or self._playing

    @property
    def speed(self) -> float:
        """Playback speed, a factor. May be set; raises InvalidInput unless it is positive and finite."""
        return self._speed

    @speed.setter
    def speed(self, speed: float) -> None:
        if not (math.isfinite(speed) and speed > 0.0):
            raise InvalidInput(f"a speed is a positive number; got {speed!r}")
        with self._lock:
            self._advance()
            self._speed = speed

    def stamp(self, span: TimeSpan | None) -> int | None:
        """The stamp to show [ns], within ``span``; None for the newest samples."""
        with self._lock:
            self._span = span
            self._advance()
            return self._at

    def pause(self) -> None:
        """Stop at the current stamp."""
        with self._lock:
            self._advance()
            if self._at is None and self._span is not None:
                self._at = self._span.newest if self.can_be_live else self._span.oldest
            self._playing = False

    def play(self) -> None:
        """Play from the current stamp; from the oldest at the end of a recording."""
        with self._lock:
            self._advance()
            if not self.can_be_live and self._span is not None and self._at == self._span.newest:
                self._at = self._span.oldest
            self._playing = True

    def seek(self, stamp: int) -> None:
        """Move to ``stamp`` [ns], or to the nearer end of the span; continues to play."""
        with self._lock:
            self._advance()
            self._playing = self._playing and self._at is not None
            self._at = stamp
            self._advance()

    def go_live(self) -> None:
        """Show the newest samples again; of a recording, its end."""
        with self._lock:
            self._playing = False
            self._at = None if self.can_be_live or self._span is None else self._span.newest

    def _advance(self) -> None:
        """Move ``_at`` by the time that has passed, within the span."""
        now_s = self._now_s()
        elapsed_s, self._since_s = now_s - self._since_s, now_s
        span = self._span
        if span is None:
            return
        if self._at is None:
            if self.can_be_live:
                return
            self._at = span.oldest
        elif self._playing:
            self._at += round(elapsed_s * self._speed * 1e9)
        if self._playing and self._at >= span.newest:
            self._at = None if self.can_be_live else span.newest
            self._playing = False
        if self._at is not None:
            # Samples older than the buffer's history are gone.
            self._at = min(max(self._at, span.oldest), span.newest)
