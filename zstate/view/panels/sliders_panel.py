"""Sliders on the page: a robot's joints, moved by hand."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import viser

from zstate.view.panels import html
from zstate.view.panels.context import PanelContext
from zstate.view.panels.html import digits
from zstate.view.panels.widgets import BoundWidget
from zstate.view.sliders import SliderPublisher, SliderSpec

_UNITS: tuple[str, ...] = ("rad", "deg")


class SlidersPanel:
    """The joints of one robot, in radians or degrees, and what moves all of them at once.

    Where another program writes the robot's joints the page says who that is, and offers to try again.
    """

    def __init__(self, gui: viser.GuiApi, sliders: SliderPublisher) -> None:
        self._gui = gui
        self._sliders = sliders
        self._state = gui.add_html("")
        self._again = gui.add_button("Try again", visible=False)
        self._all: viser.GuiButtonGroupHandle = gui.add_button_group(
            "All joints", ("Home", "Zero", "Random", "Sine")
        )
        units: viser.GuiDropdownHandle[str] = gui.add_dropdown("Angles in", _UNITS)
        self._unit = BoundWidget[str](units)
        self._rate = BoundWidget[float](
            gui.add_number("Rate [Hz]", sliders.rate_hz, min=0.1, max=1000.0, step=0.1)
        )
        self._folder = gui.add_folder(None)
        self._knobs = self._new_knobs()
        self._mimics = gui.add_html("")
        self._again.on_click(lambda _: self._try_again())
        self._all.on_click(self._move_all)

    def _try_again(self) -> None:
        self._sliders.open()

    def _move_all(self, event: viser.GuiEvent[viser.GuiButtonGroupHandle]) -> None:
        sliders = self._sliders
        actions: dict[str, Callable[[], None]] = {
            "Home": sliders.home,
            "Zero": sliders.zero,
            "Random": sliders.random,
            "Sine": self._swing,
        }
        actions[event.target.value]()

    def _swing(self) -> None:
        self._sliders.is_swinging = not self._sliders.is_swinging

    def update(self, look: PanelContext) -> None:
        rate_hz = self._rate.poll_change()
        if rate_hz is not None:
            self._sliders.rate_hz = rate_hz
        if self._unit.poll_change() is not None:
            for knob in self._knobs:
                knob.remove()
            self._knobs = self._new_knobs()
        for knob, value in zip(self._knobs, self._sliders.values.tolist(), strict=True):
            knob.show(value, held=bool(self._sliders.refusal))
        self._state.content = self._state_html()
        self._again.visible = bool(self._sliders.refusal)
        self._mimics.content = html.pairs(self._mimic_rows()) if self._sliders.mimics else ""

    def _new_knobs(self) -> list[_JointSlider]:
        with self._folder:
            values = self._sliders.values.tolist()
            pairs = zip(self._sliders.dials.dials, values, strict=True)
            return [
                _JointSlider(self._gui, self._sliders, dial, value, self._unit.value) for dial, value in pairs
            ]

    def _state_html(self) -> str:
        robot, refusal = self._sliders.robot, self._sliders.refusal
        if refusal:
            return html.paragraph(f"{robot} is not published: {refusal}", color=html.ALARM)
        achieved_hz = self._sliders.achieved_hz
        text = f"Publishing {robot} at {self._sliders.rate_hz:g} Hz"
        return html.paragraph(text + (f", achieved {achieved_hz:.1f} Hz" if achieved_hz else ""))

    def _mimic_rows(self) -> Iterator[tuple[str, str]]:
        types = {joint.name: joint.type for joint in self._sliders.model.joints}
        for name, position in self._sliders.mimics.items():
            unit = "m" if types[name] == "prismatic" else self._unit.value
            scale = math.degrees(1.0) if unit == "deg" else 1.0
            yield f"{name} follows", f"{digits(scale * position, 3)} {unit}"


class _JointSlider:
    """One slider, in the unit that is shown."""

    def __init__(
        self, gui: viser.GuiApi, sliders: SliderPublisher, dial: SliderSpec, value: float, angle_unit: str
    ) -> None:
        self._sliders = sliders
        self._dial = dial
        unit = angle_unit if dial.unit == "rad" else dial.unit
        self._scale, self._precision = (math.degrees(1.0), 1) if unit == "deg" else (1.0, 3)
        lower, upper = (self._shown(limit) for limit in (dial.lower, dial.upper))
        step = 10.0**-self._precision
        hint = f"{dial.name}: {lower:g} to {upper:g} {unit}"
        value = min(max(self._shown(value), lower), upper)
        label = f"{dial.name} [m]" if unit == "m" else dial.name
        self._slider = gui.add_slider(label, lower, max(upper, lower + step), step, value, hint=hint)
        self._choice = BoundWidget[float](self._slider)
        self._slider.on_update(self._turn)

    def _shown(self, value: float) -> float:
        return round(value * self._scale, self._precision)

    async def _turn(self, event: viser.GuiEvent[viser.GuiSliderHandle[float]]) -> None:
        # In the order in which they come: a thread for each might end with one before the last.
        value = event.target.value
        if event.client is not None and math.isfinite(value):
            # What is shown of a limit is rounded, maybe to beyond it.
            limited = float(np.clip(value / self._scale, self._dial.lower, self._dial.upper))
            self._sliders.set(self._dial.name, limited)

    def show(self, value: float, *, held: bool) -> None:
        """Stand where the sliders stand, unless a person has just moved this one; ``held``: let nobody."""
        self._slider.disabled = held
        if self._choice.poll_change() is None:
            self._choice.show(min(max(self._shown(value), self._slider.min), self._slider.max))

    def remove(self) -> None:
        self._slider.remove()
