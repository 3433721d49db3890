"""Joints over time."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray
from viser import uplot

from zstate.model.robot import coordinate_names
from zstate.view.data_source import ViewSource
from zstate.view.panels.context import PanelContext
from zstate.view.panels.widgets import BoundWidget

_OFF = "(none)"
_ALL = "all joints"
_NOTHING: tuple[str, ...] = (_OFF,)
_SECONDS = 10.0
_HEIGHT = 180
_EVERY = 3
"""A plot is drawn each third time: it is the heaviest thing beside the picture."""

_COLORS = ("#1971c2", "#e8590c", "#2f9e44", "#c2255c", "#6741d9", "#0c8599", "#f08c00", "#495057")


class PlotsPanel:
    """The last ten seconds of one joint of a robot, or of all of them."""

    def __init__(self, gui: viser.GuiApi, world: ViewSource) -> None:
        self._gui = gui
        self._world = world
        self._robots: tuple[str, ...] = ()
        self._robot: viser.GuiDropdownHandle[str] = gui.add_dropdown("Robot", _NOTHING)
        hint = "The last ten seconds, in rad or m."
        self._joint: viser.GuiDropdownHandle[str] = gui.add_dropdown("Joint", _NOTHING, hint=hint)
        self._joint_choice = BoundWidget[str](self._joint)
        self._offered = ""
        self._place = gui.add_folder(None)
        self._plot: viser.GuiUplotHandle | None = None
        self._drawn: tuple[str, ...] = ()
        self._round = 0

    def update(self, look: PanelContext) -> None:
        self._offer(tuple(self._world.models))
        robot, joint = self._robot.value, self._joint.value
        track = look.moment.tree.robots.get(robot)
        names = () if track is None else _columns(coordinate_names(track.model), joint)
        self._round += 1
        if track is None or not names or look.moment.stamp is None:
            self._clear()
        elif names != self._drawn or self._round % _EVERY == 0:
            until = look.moment.stamp
            history = look.buffer.joint_history(track, until, _SECONDS)
            columns = [coordinate_names(track.model).index(name) for name in names]
            seconds = (history.stamps - until) / 1e9
            self._draw(names, (seconds, *history.positions[:, columns].T))

    def _offer(self, robots: tuple[str, ...]) -> None:
        if robots != self._robots:
            self._robots = robots
            self._robot.options = robots or (_OFF,)
        robot = self._robot.value
        if robot != self._offered and robot in self._world.models:
            self._offered = robot
            self._joint.options = (_OFF, _ALL, *coordinate_names(self._world.models[robot]))

    def _clear(self) -> None:
        if self._plot is not None:
            self._plot.remove()
            self._plot = None
        self._drawn = ()

    def _draw(self, names: tuple[str, ...], data: tuple[NDArray[np.float64], ...]) -> None:
        if names != self._drawn or self._plot is None:
            self._clear()
            with self._place:
                self._plot = self._gui.add_uplot(
                    data, _series(names), scales=_SCALES, legend=_LEGEND, height=_HEIGHT
                )
            self._drawn = names
        else:
            self._plot.data = data


_LEGEND = uplot.Legend(show=True, live=False)
_SCALES = {"x": uplot.Scale(time=False, range=(-_SECONDS, 0.0))}


def _columns(names: tuple[str, ...], joint: str) -> tuple[str, ...]:
    if joint == _ALL:
        return names
    return (joint,) if joint in names else ()


def _series(names: tuple[str, ...]) -> tuple[uplot.Series, ...]:
    lines = (
        uplot.Series(label=name, stroke=_COLORS[number % len(_COLORS)], width=1.5)
        for number, name in enumerate(names)
    )
    return (uplot.Series(label="s"), *lines)
