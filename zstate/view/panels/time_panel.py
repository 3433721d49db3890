"""The slider of time: the present, or an instant of what is remembered."""

from __future__ import annotations

from datetime import datetime

import viser

from zstate.buffer.snapshot import TimeSpan
from zstate.clock import SYSTEM
from zstate.view.panels import html
from zstate.view.panels.context import PanelContext
from zstate.view.panels.widgets import BoundWidget
from zstate.view.time_cursor import TimeCursor

_SPEEDS: tuple[str, ...] = ("0.1x", "0.25x", "0.5x", "1x", "2x", "5x", "10x")
_STEP_S = 0.01


class ReplayPanel:
    """Pause, go back, and play, at the speed that is chosen.

    The slider counts seconds: of a recording from its beginning, of what is heard now back from the newest.
    """

    def __init__(self, gui: viser.GuiApi, clock: TimeCursor) -> None:
        self._clock = clock
        self._state = gui.add_html("")
        buttons = ("Live", "Pause", "Play") if clock.live else ("Pause", "Play")
        self._buttons: viser.GuiButtonGroupHandle = gui.add_button_group("Time", buttons)
        self._slider = gui.add_slider("Seconds", min=0.0, max=_STEP_S, step=_STEP_S, initial_value=0.0)
        self._place = BoundWidget[float](self._slider)
        speeds: viser.GuiDropdownHandle[str] = gui.add_dropdown("Speed", _SPEEDS, initial_value="1x")
        self._speed = BoundWidget[str](speeds)
        self._span: TimeSpan | None = None
        self._buttons.on_click(self._press)

    def _press(self, event: viser.GuiEvent[viser.GuiButtonGroupHandle]) -> None:
        actions = {
            "Live": self._clock.return_to_present,
            "Pause": self._clock.pause,
            "Play": self._clock.play,
        }
        actions[event.target.value]()

    def update(self, look: PanelContext) -> None:
        speed, place = self._speed.poll_change(), self._place.poll_change()
        if speed is not None:
            self._clock.speed = float(speed.removesuffix("x"))
        if place is not None and self._span is not None:
            self._clock.seek(self._origin(self._span) + round(place * 1e9))
            return
        span = look.buffer.span()
        if span is not None:
            self._show(span, look)

    def _origin(self, span: TimeSpan) -> int:
        return span.newest if self._clock.live else span.oldest

    def _show(self, span: TimeSpan, look: PanelContext) -> None:
        is_present = self._clock.is_present
        if is_present and self._span is not None and self._place.value == 0.0:
            # Where nobody goes back, the slider need not say ten times a second how far one could go.
            span = self._span if span.newest - self._span.newest < 1_000_000_000 else span
        length_s = max(_STEP_S, round((span.newest - span.oldest) / 1e9, 2))
        self._slider.min, self._slider.max = (-length_s, 0.0) if self._clock.live else (0.0, length_s)
        self._span = span
        at = span.newest if is_present or look.moment.stamp is None else look.moment.stamp
        self._place.show(round((at - self._origin(span)) / 1e9, 2))
        self._state.content = html.paragraph(self._text(at, look))

    def _text(self, at: int, look: PanelContext) -> str:
        if self._clock.is_present:
            return "Live"
        doing = "Playing" if self._clock.is_playing else "Paused"
        return f"{doing} at {_instant_text(at, look.domain)}"


def _instant_text(stamp: int, domain: str | None) -> str:
    if domain not in (None, SYSTEM):
        return f"{stamp / 1e9:.2f} s of {domain!r} time"
    then = datetime.fromtimestamp(stamp // 1_000_000_000).astimezone()
    return f"{then:%Y-%m-%d %H:%M:%S}.{stamp // 10_000_000 % 100:02d}"
