"""Tab Time: the time cursor (live, paused or playing), and the slider that moves it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from datetime import datetime

import viser

from zstate._util.fork_safe import fork_safe_lock
from zstate.buffer.snapshot import TimeSpan
from zstate.clock import SYSTEM
from zstate.errors import InvalidInput
from zstate.view.panels import html
from zstate.view.panels.panel import BoundWidget, PanelContext

_SPEEDS: tuple[str, ...] = ("0.1x", "0.25x", "0.5x", "1x", "2x", "5x", "10x")
_STEP_S = 0.01


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


class TimePanel:
    """Pause, seek and play at a selectable speed.

    The slider counts seconds: of a recording from its beginning, live backwards from the newest sample.
    """

    def __init__(self, gui: viser.GuiApi, cursor: TimeCursor) -> None:
        self._cursor = cursor
        self._state = gui.add_html("")
        actions = {"Live": cursor.go_live} if cursor.can_be_live else {}
        actions |= {"Pause": cursor.pause, "Play": cursor.play}
        buttons: viser.GuiButtonGroupHandle = gui.add_button_group("Time", tuple(actions))
        buttons.on_click(lambda event: actions[event.target.value]())
        self._slider = gui.add_slider("Seconds", min=0.0, max=_STEP_S, step=_STEP_S, initial_value=0.0)
        self._seconds = BoundWidget[float](self._slider)
        speeds: viser.GuiDropdownHandle[str] = gui.add_dropdown("Speed", _SPEEDS, initial_value="1x")
        self._speed = BoundWidget[str](speeds)
        self._span: TimeSpan | None = None

    def update(self, context: PanelContext) -> None:
        cursor = self._cursor
        speed, seconds = self._speed.poll_change(), self._seconds.poll_change()
        if speed is not None:
            cursor.speed = float(speed.removesuffix("x"))
        if seconds is not None and self._span is not None:
            cursor.seek(self._origin(self._span) + round(seconds * 1e9))
            return
        span = context.buffer.span()
        if span is None:
            return
        if cursor.is_live and self._span is not None and self._seconds.value == 0.0:
            # The range of an unused slider is sent about once a second, not with every update.
            span = self._span if span.newest - self._span.newest < 1_000_000_000 else span
        length_s = max(_STEP_S, round((span.newest - span.oldest) / 1e9, 2))
        self._slider.min, self._slider.max = (-length_s, 0.0) if cursor.can_be_live else (0.0, length_s)
        self._span = span
        stamp = context.snapshot.stamp
        at = span.newest if cursor.is_live or stamp is None else stamp
        self._seconds.show(round((at - self._origin(span)) / 1e9, 2))
        text = f"{'Playing' if cursor.is_playing else 'Paused'} at {_stamp_text(at, context.domain)}"
        self._state.content = html.paragraph("Live" if cursor.is_live else text)

    def _origin(self, span: TimeSpan) -> int:
        return span.newest if self._cursor.can_be_live else span.oldest


def _stamp_text(stamp: int, domain: str | None) -> str:
    if domain not in (None, SYSTEM):
        return f"{stamp / 1e9:.2f} s of {domain!r} time"
    then = datetime.fromtimestamp(stamp // 1_000_000_000).astimezone()
    return f"{then:%Y-%m-%d %H:%M:%S}.{stamp // 10_000_000 % 100:02d}"
