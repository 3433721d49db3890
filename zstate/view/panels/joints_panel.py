"""Tab Joints: sliders that move a robot, and plots of joint positions over time."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import viser
from numpy.typing import NDArray
from viser import uplot

from zstate.model.robot import coordinate_names
from zstate.view.data_source import ViewSource
from zstate.view.panels import html
from zstate.view.panels.html import format_number
from zstate.view.panels.panel import BoundWidget, PanelContext
from zstate.view.sliders import SliderPublisher, SliderSpec

_UNITS: tuple[str, ...] = ("rad", "deg")


class SlidersPanel:
    """The joints of one robot, in radians or degrees, and buttons that move all of them.

    If another program writes the robot's joint states, the panel shows which, and a button to try again.
    """

    def __init__(self, gui: viser.GuiApi, publisher: SliderPublisher) -> None:
        self._gui = gui
        self._publisher = publisher
        self._state = gui.add_html("")
        self._retry = gui.add_button("Try again", visible=False)
        self._retry.on_click(self._reopen)
        actions: dict[str, Callable[[], None]] = {
            "Home": publisher.home,
            "Zero": publisher.zero,
            "Random": publisher.random,
            "Sine": self._toggle_sine,
        }
        buttons: viser.GuiButtonGroupHandle = gui.add_button_group("All joints", tuple(actions))
        buttons.on_click(lambda event: actions[event.target.value]())
        units: viser.GuiDropdownHandle[str] = gui.add_dropdown("Angles in", _UNITS)
        self._unit = BoundWidget[str](units)
        self._rate = BoundWidget[float](
            gui.add_number("Rate [Hz]", publisher.rate_hz, min=0.1, max=1000.0, step=0.1)
        )
        self._folder = gui.add_folder(None)
        self._sliders = self._new_sliders()
        self._mimics = gui.add_html("")

    def update(self, context: PanelContext) -> None:
        publisher = self._publisher
        rate_hz = self._rate.poll_change()
        if rate_hz is not None:
            publisher.rate_hz = rate_hz
        if self._unit.poll_change() is not None:
            for slider in self._sliders:
                slider.remove()
            self._sliders = self._new_sliders()
        robot, conflict, achieved_hz = publisher.robot, publisher.conflict, publisher.achieved_hz
        for slider, value in zip(self._sliders, publisher.values.tolist(), strict=True):
            slider.show(value, disabled=bool(conflict))
        if conflict:
            self._state.content = html.paragraph(f"{robot} is not published: {conflict}", color=html.ALARM)
        else:
            text = f"Publishing {robot} at {publisher.rate_hz:g} Hz"
            achieved = f", achieved {achieved_hz:.1f} Hz" if achieved_hz else ""
            self._state.content = html.paragraph(text + achieved)
        self._retry.visible = bool(conflict)
        types = {joint.name: joint.type for joint in publisher.model.joints}
        rows: html.Rows = []
        for name, position in publisher.mimics.items():
            unit = "m" if types[name] == "prismatic" else self._unit.value
            scale = math.degrees(1.0) if unit == "deg" else 1.0
            rows.append((f"{name} follows", f"{format_number(scale * position, 3)} {unit}"))
        self._mimics.content = html.pairs(rows) if rows else ""

    def _new_sliders(self) -> list[_JointSlider]:
        publisher = self._publisher
        with self._folder:
            specs = zip(publisher.mapping.specs, publisher.values.tolist(), strict=True)
            return [
                _JointSlider(self._gui, publisher, spec, value, self._unit.value) for spec, value in specs
            ]

    def _reopen(self, _: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
        self._publisher.open()

    def _toggle_sine(self) -> None:
        self._publisher.sine_enabled = not self._publisher.sine_enabled


class _JointSlider:
    """One slider, in the unit on display."""

    def __init__(
        self, gui: viser.GuiApi, publisher: SliderPublisher, spec: SliderSpec, value: float, angle_unit: str
    ) -> None:
        self._publisher = publisher
        self._spec = spec
        unit = angle_unit if spec.unit == "rad" else spec.unit
        self._scale, self._precision = (math.degrees(1.0), 1) if unit == "deg" else (1.0, 3)
        lower, upper = (self._displayed(limit) for limit in (spec.lower, spec.upper))
        step = 10.0**-self._precision
        hint = f"{spec.name}: {lower:g} to {upper:g} {unit}"
        value = min(max(self._displayed(value), lower), upper)
        label = f"{spec.name} [m]" if unit == "m" else spec.name
        self._slider = gui.add_slider(label, lower, max(upper, lower + step), step, value, hint=hint)
        self._bound = BoundWidget[float](self._slider)
        self._slider.on_update(self._set)

    def _displayed(self, value: float) -> float:
        return round(value * self._scale, self._precision)

    async def _set(self, event: viser.GuiEvent[viser.GuiSliderHandle[float]]) -> None:
        # A coroutine, because viser runs them in order; plain callbacks run in a thread each.
        value = event.target.value
        if event.client is not None and math.isfinite(value):
            # A limit is rounded for display, maybe to a value beyond it.
            limited = float(np.clip(value / self._scale, self._spec.lower, self._spec.upper))
            self._publisher.set(self._spec.name, limited)

    def show(self, value: float, *, disabled: bool) -> None:
        """Display ``value``, unless the user has just moved this slider."""
        self._slider.disabled = disabled
        if self._bound.poll_change() is None:
            self._bound.show(min(max(self._displayed(value), self._slider.min), self._slider.max))

    def remove(self) -> None:
        self._slider.remove()


_NO_ROBOT: tuple[str, ...] = ("(none)",)
_ALL = "all joints"
_SECONDS = 10.0
_HEIGHT = 180
_EVERY = 3
"""A plot is redrawn with every third update: it costs more than any other panel."""

_COLORS = ("#1971c2", "#e8590c", "#2f9e44", "#c2255c", "#6741d9", "#0c8599", "#f08c00", "#495057")
_LEGEND = uplot.Legend(show=True, live=False)
_SCALES = {"x": uplot.Scale(time=False, range=(-_SECONDS, 0.0))}


class PlotsPanel:
    """The last ten seconds of one joint of a robot, or of all of them."""

    def __init__(self, gui: viser.GuiApi, source: ViewSource) -> None:
        self._gui = gui
        self._source = source
        self._robots: tuple[str, ...] = ()
        self._robot: viser.GuiDropdownHandle[str] = gui.add_dropdown("Robot", _NO_ROBOT)
        hint = "The last ten seconds, in rad or m."
        self._joint: viser.GuiDropdownHandle[str] = gui.add_dropdown("Joint", _NO_ROBOT, hint=hint)
        self._listed_robot = ""
        self._folder = gui.add_folder(None)
        self._plot: viser.GuiUplotHandle | None = None
        self._drawn: tuple[str, ...] = ()
        self._updates = 0

    def update(self, context: PanelContext) -> None:
        models = self._source.models
        if tuple(models) != self._robots:
            self._robots = tuple(models)
            self._robot.options = self._robots or _NO_ROBOT
        robot = self._robot.value
        if robot != self._listed_robot and robot in models:
            self._listed_robot = robot
            self._joint.options = (*_NO_ROBOT, _ALL, *coordinate_names(models[robot]))
        joint, stamp = self._joint.value, context.snapshot.stamp
        track = context.snapshot.tree.robots.get(robot)
        names = () if track is None else coordinate_names(track.model)
        columns = [k for k, name in enumerate(names) if joint in (_ALL, name)]
        self._updates += 1
        if track is None or not columns or stamp is None:
            self._clear()
            return
        drawn = tuple(names[k] for k in columns)
        if drawn != self._drawn or self._updates % _EVERY == 0:
            history = context.buffer.joint_history(track, stamp, _SECONDS)
            data = ((history.stamps - stamp) / 1e9, *history.positions[:, columns].T)
            self._draw(drawn, data)

    def _clear(self) -> None:
        if self._plot is not None:
            self._plot.remove()
            self._plot = None
        self._drawn = ()

    def _draw(self, names: tuple[str, ...], data: tuple[NDArray[np.float64], ...]) -> None:
        if names == self._drawn and self._plot is not None:
            self._plot.data = data
            return
        self._clear()
        lines = [
            uplot.Series(label=name, stroke=_COLORS[number % len(_COLORS)], width=1.5)
            for number, name in enumerate(names)
        ]
        series = (uplot.Series(label="s"), *lines)
        with self._folder:
            self._plot = self._gui.add_uplot(data, series, scales=_SCALES, legend=_LEGEND, height=_HEIGHT)
        self._drawn = names
