"""Tabs Joints and Time: sliders that move a robot or command its driver, plots, the instant on display."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from datetime import datetime

import numpy as np
import viser
from numpy.typing import NDArray
from viser import uplot

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate.buffer.tracks import TimeSpan
from zstate.clock import SYSTEM
from zstate.driving.driver_state import DriverStateListener, ReceivedState
from zstate.driving.messages import DriverState
from zstate.errors import InvalidInput, LookupFailed, format_duration
from zstate.model.robot import RobotModel, coordinate_names
from zstate.net.session import Session
from zstate.view.data_source import ViewSource
from zstate.view.panels import html
from zstate.view.panels.html import format_number
from zstate.view.panels.panel import BoundWidget, PanelContext
from zstate.view.server import ViewServer
from zstate.view.sliders import SliderCommander, SliderMapping, SliderPublisher, SliderSpec, velocity_specs
from zstate.wire.keys import ANY

_UNITS: tuple[str, ...] = ("rad", "deg")
_NO_ROBOT: tuple[str, ...] = ("(none)",)
_ALL = "all joints"
_PLOT_S = 10.0
_PLOT_INTERVAL_NS = round(_PLOT_S * 1e9) // 240
_PLOT_HEIGHT = 180
_PLOT_EVERY = 3
"""A plot is redrawn with every third update: it costs more than any other panel."""

_COLORS = ("#1971c2", "#e8590c", "#2f9e44", "#c2255c", "#6741d9", "#0c8599", "#f08c00", "#495057")
_LEGEND = uplot.Legend(show=True, live=False)
_SCALES = {"x": uplot.Scale(time=False, range=(-_PLOT_S, 0.0))}

_SPEEDS: tuple[str, ...] = ("0.1x", "0.25x", "0.5x", "1x", "2x", "5x", "10x")
_STEP_S = 0.01


class SlidersPanel:
    """The joints of one robot, in radians or degrees, and buttons that move all of them.

    If another program writes the robot's joint states, the panel shows which, and a button to try again.
    """

    def __init__(self, gui: viser.GuiApi, publisher: SliderPublisher) -> None:
        self._gui = gui
        self._publisher = publisher
        self._state = gui.add_html("")
        self._retry = gui.add_button("Try again", visible=False)

        def reopen(_: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
            publisher.open()

        def toggle_sine() -> None:
            publisher.sine_enabled = not publisher.sine_enabled

        self._retry.on_click(reopen)
        actions: dict[str, Callable[[], None]] = {"Home": publisher.home, "Zero": publisher.zero}
        actions |= {"Random": publisher.random, "Sine": toggle_sine}
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
                slider.handle.remove()
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
        publisher, unit = self._publisher, self._unit.value

        def set_value(_: int, name: str, value: float) -> None:
            publisher.set(name, value)

        with self._folder:
            specs = zip(publisher.mapping.specs, publisher.values.tolist(), strict=True)
            return [_JointSlider(self._gui, set_value, spec, value, unit) for spec, value in specs]


class _JointSlider:
    """One slider, in the unit on display.

    ``set_value(client_id, name, value)`` is called when the user of a browser moves it.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        set_value: Callable[[int, str, float], None],
        spec: SliderSpec,
        value: float,
        angle_unit: str = "rad",
    ) -> None:
        self._set_value = set_value
        self._spec = spec
        unit = angle_unit if spec.unit == "rad" else spec.unit
        self._scale, self._precision = (math.degrees(1.0), 1) if unit == "deg" else (1.0, 3)
        lower, upper = (self._displayed(limit) for limit in (spec.lower, spec.upper))
        step = 10.0**-self._precision
        hint = f"{spec.name}: {lower:g} to {upper:g} {unit}"
        value = min(max(self._displayed(value), lower), upper)
        label = spec.name if spec.unit == "rad" else f"{spec.name} [{unit}]"
        self.handle = gui.add_slider(label, lower, max(upper, lower + step), step, value, hint=hint)
        self._bound = BoundWidget[float](self.handle)
        self.handle.on_update(self._set)

    def show(self, value: float, *, disabled: bool) -> None:
        """Display ``value``, unless the user has just moved this slider."""
        self.handle.disabled = disabled
        if self._bound.poll_change() is None:
            self._bound.show(min(max(self._displayed(value), self.handle.min), self.handle.max))

    def _displayed(self, value: float) -> float:
        return round(value * self._scale, self._precision)

    async def _set(self, event: viser.GuiEvent[viser.GuiSliderHandle[float]]) -> None:
        # A coroutine, because viser runs them in order; plain callbacks run in a thread each.
        value = event.target.value
        if event.client_id is not None and math.isfinite(value):
            # A limit is rounded for display, maybe to a value beyond it.
            limited = float(np.clip(value / self._scale, self._spec.lower, self._spec.upper))
            self._set_value(event.client_id, self._spec.name, limited)


class DriversPanel(Closeable):
    """The drivers of the robots on display: their states and stop buttons in ``top``, figures here.

    With ``can_command`` there are sliders, too, that command a driver for the browser that has taken control.
    """

    def __init__(
        self,
        page: ViewServer,
        source: ViewSource,
        session: Session,
        top: viser.GuiFolderHandle,
        *,
        can_command: bool,
    ) -> None:
        self._page = page
        self._source = source
        self._session = session
        self._top = top
        self._can_command = can_command
        self._folder = page.server.gui.add_folder(None)
        self._drivers: dict[str, _DriverPanel] = {}
        self._sliders: dict[str, _DriverSliders] = {}
        self._resources = ExitStack()
        self._states = self._resources.enter_context(DriverStateListener(session, ANY))

    def update(self, context: PanelContext) -> None:
        models = self._source.models
        for robot, received in self._states.states().items():
            if robot in models and robot not in self._drivers:
                self._add(robot, models[robot], received.state)
            if robot in self._drivers:
                self._drivers[robot].update(received)
            if robot in self._sliders:
                self._sliders[robot].update(received.state, context)

    def _add(self, robot: str, model: RobotModel, state: DriverState) -> None:
        gui = self._page.server.gui
        commander = SliderCommander(self._session, robot, self._states, self._page.is_answering)
        self._resources.enter_context(commander)
        with self._folder, gui.add_folder(f"Driver of {robot}"):
            self._drivers[robot] = _DriverPanel(gui, commander, self._top)
            if self._can_command:
                self._sliders[robot] = _DriverSliders(gui, commander, model, state)

    def close(self) -> None:
        """End control of all drivers. A second call does nothing."""
        self._resources.close()


class _DriverPanel:
    """The state of one driver and the button that stops it, in ``top``, and its figures."""

    def __init__(self, gui: viser.GuiApi, commander: SliderCommander, top: viser.GuiFolderHandle) -> None:
        self._commander = commander
        self._robot = commander.robot
        with top:
            self._state = gui.add_html("")
            self._problem = gui.add_html("")
            hint = "Stops its driver until the stop is released. An emergency stop is wired to the power."
            stop = gui.add_button(f"STOP {self._robot}", color="red", hint=hint)
        self._figures = gui.add_html("")

        async def on_click(_: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
            # A coroutine: other callbacks of all browsers wait for the same few threads.
            commander.request_stop()

        stop.on_click(on_click)

    def update(self, received: ReceivedState) -> None:
        state = received.state
        is_alarm = not received.is_live or state.state in ("stopped", "fault")
        text = f"Driver of {self._robot}: {received}"
        self._state.content = html.paragraph(text, color=html.ALARM if is_alarm else "")
        problem = self._commander.problem
        self._problem.content = html.paragraph(problem, color=html.ALARM) if problem else ""
        refused = ", ".join(f"{reason} {count}" for reason, count in state.refused.items())
        rows = [("program", state.program), ("loop", f"{state.rate_hz:.1f} Hz, {state.skipped} skipped")]
        if state.command_age is not None:
            age = format_duration(state.command_age)
            rows += [("commander", state.commander), ("newest command", f"{age} ago")]
        if state.transit_excess is not None:
            rows.append(("it waited for", format_duration(state.transit_excess)))
        rows.append(("failed calls", str(state.faults)))
        if state.refused:
            rows += [("refused", refused), ("newest refusal", state.last_refusal)]
        if received.last_motion:
            rows.append(("last motion", received.last_motion))
        if state.limited:
            rows.append(("slowed by limits", ", ".join(state.limited)))
        self._figures.content = html.pairs(rows)


class _DriverSliders:
    """Buttons that take and release control of a driver, and a slider for each of its joints.

    Sliders follow the joints until they are moved; those of velocities are at zero. Nothing is sent before,
    and a stop is released by a button of its own: neither opening the page nor taking control moves anything.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        commander: SliderCommander,
        model: RobotModel,
        state: DriverState,
    ) -> None:
        self._commander = commander
        self._has_positions = "position" in state.modes
        self._columns = model.columns
        self._positions = model.neutral
        self._text = gui.add_html("")
        self._take = gui.add_button(f"Command {commander.robot} by sliders")
        self._release = gui.add_button("Stop commanding", visible=False)
        self._release_stops = gui.add_button("Release the stop", color="orange", visible=False)
        self._take.on_click(self._on_take)
        self._release.on_click(lambda _: commander.release_control())
        self._release_stops.on_click(self._on_release_stops)
        known = SliderMapping(model).specs if self._has_positions else velocity_specs(model)
        self._sliders = {
            spec.name: _JointSlider(gui, commander.set, spec, 0.0)
            for spec in known
            if spec.name in state.joint_names
        }

    def _on_take(self, event: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
        if event.client_id is not None:
            self._commander.take_control(event.client_id)

    def _on_release_stops(self, event: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
        if event.client_id is not None:
            self._commander.release_stops(event.client_id)

    def update(self, state: DriverState, context: PanelContext) -> None:
        commander, targets = self._commander, self._commander.targets
        has_control, is_stopped = commander.has_control, state.state == "stopped"
        self._take.visible, self._release.visible = not has_control, has_control
        self._release_stops.visible = has_control and is_stopped
        is_known = False
        with suppress(LookupFailed, InvalidInput):  # no samples yet, or the robot has been removed
            self._positions, _ = context.buffer.joint_positions(commander.robot)
            is_known = True
        for name, slider in self._sliders.items():
            present = float(self._positions[self._columns[name]]) if self._has_positions else 0.0
            value = targets.get(name, present)
            slider.show(value, disabled=not (has_control and is_known) or is_stopped)
        if has_control and is_stopped:
            self._text.content = html.paragraph(
                "One browser is in control of a stopped driver. Nothing moves before its release."
            )
        elif has_control:
            sent = f"sending {', '.join(targets)}" if targets else "nothing is sent until a slider is moved"
            self._text.content = html.paragraph(f"One browser is in control: {sent}.")
        else:
            self._text.content = html.paragraph("The sliders follow the joints, and command nothing.")


class PlotsPanel:
    """The last ten seconds of one joint of a robot, or of all of them."""

    def __init__(self, gui: viser.GuiApi, source: ViewSource) -> None:
        self._gui = gui
        self._source = source
        self._robot: viser.GuiDropdownHandle[str] = gui.add_dropdown("Robot", _NO_ROBOT)
        hint = "The last ten seconds, in rad or m."
        self._joint: viser.GuiDropdownHandle[str] = gui.add_dropdown("Joint", _NO_ROBOT, hint=hint)
        self._folder = gui.add_folder(None)
        self._plot: viser.GuiUplotHandle | None = None
        self._drawn: tuple[str, ...] = ()
        self._updates = 0

    def update(self, context: PanelContext) -> None:
        models = self._source.models
        robots = tuple(models) or _NO_ROBOT
        if robots != self._robot.options:
            self._robot.options = robots
        robot = self._robot.value
        if robot in models:
            joints = (*_NO_ROBOT, _ALL, *coordinate_names(models[robot]))
            if joints != self._joint.options:
                self._joint.options = joints
        joint, stamp = self._joint.value, context.snapshot.stamp
        track = context.snapshot.tree.robots.get(robot)
        names = () if track is None else coordinate_names(track.model)
        columns = [k for k, name in enumerate(names) if joint in (_ALL, name)]
        drawn = () if stamp is None else tuple(names[k] for k in columns)
        self._updates += 1
        if drawn != self._drawn and self._plot is not None:
            self._plot.remove()
            self._plot = None
        is_due = self._plot is None or self._updates % _PLOT_EVERY == 0
        if track is not None and stamp is not None and drawn and is_due:
            with suppress(InvalidInput):  # the robot has been removed since the snapshot
                states = context.buffer.joint_states(robot, stamp - round(_PLOT_S * 1e9), stamp + 1)
                shown = states.select(plotted_rows(states.stamps))
                self._draw(drawn, ((shown.stamps - stamp) / 1e9, *shown.positions[:, columns].T))
        self._drawn = drawn

    def _draw(self, names: tuple[str, ...], data: tuple[NDArray[np.float64], ...]) -> None:
        if self._plot is not None:
            self._plot.data = data
            return
        lines = [
            uplot.Series(label=name, stroke=_COLORS[number % len(_COLORS)], width=1.5)
            for number, name in enumerate(names)
        ]
        series = (uplot.Series(label="s"), *lines)
        with self._folder:
            self._plot = self._gui.add_uplot(
                data, series, scales=_SCALES, legend=_LEGEND, height=_PLOT_HEIGHT
            )


def plotted_rows(stamps: NDArray[np.int64]) -> NDArray[np.intp]:
    """The first of the ``stamps`` [ns] in each interval of a plot: the same ones in consecutive plots."""
    intervals = stamps // _PLOT_INTERVAL_NS
    return np.flatnonzero(np.diff(intervals, prepend=intervals[:1] - 1))


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
        if span is None or self.is_live:
            return
        if self._at is None:
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
        span = context.span
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
        if context.domain in (None, SYSTEM):
            then = datetime.fromtimestamp(at // 1_000_000_000).astimezone()
            text = f"{then:%Y-%m-%d %H:%M:%S}.{at // 10_000_000 % 100:02d}"
        else:
            text = f"{at / 1e9:.2f} s of {context.domain!r} time"
        text = f"{'Playing' if cursor.is_playing else 'Paused'} at {text}"
        self._state.content = html.paragraph("Live" if cursor.is_live else text)

    def _origin(self, span: TimeSpan) -> int:
        return span.newest if self._cursor.can_be_live else span.oldest
