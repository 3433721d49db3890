"""Board: all panels of the page."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from typing import Protocol

import viser

from zstate._util.closeable import Closeable
from zstate.buffer.snapshot import FramePoses
from zstate.net.graph import GraphMonitor
from zstate.view.data_source import FixedFrame, ViewSource
from zstate.view.panels import html
from zstate.view.panels.context import Panel, PanelContext
from zstate.view.panels.display_panel import DisplayOptions, DisplayPanel
from zstate.view.panels.frames_panel import FramesPanel, TrailControls
from zstate.view.panels.graph_panel import GraphPanel
from zstate.view.panels.plots_panel import PlotsPanel
from zstate.view.panels.robots_panel import RobotsPanel, RobotStyler
from zstate.view.panels.sliders_panel import SlidersPanel
from zstate.view.panels.time_panel import ReplayPanel
from zstate.view.panels.transform_panel import TransformPanel
from zstate.view.sliders import SliderPublisher
from zstate.view.time_cursor import TimeCursor


class SceneControls(DisplayOptions, RobotStyler, TrailControls, Protocol):
    """What the panels want of a scene."""


class PanelLayout(Closeable):
    """Puts the panels on the page of ``server``; ``sliders`` are of the robots that are moved here.
    ``fixed_frame`` is chosen at first.

    Whoever draws asks for each picture ``stamp``, the instant to show, and ``fixed``, the frame to see it
    from; and tells it the moment that is shown, with ``update``, a few times a second. One thread does all
    of this; closing is for the end.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        world: ViewSource,
        scene: SceneControls,
        sliders: Sequence[SliderPublisher] = (),
        fixed_frame: str = "",
    ) -> None:
        gui = server.gui
        self._world = world
        self._fixed = FixedFrame(fixed_frame)
        self._opened = ExitStack()
        self.clock = TimeCursor(live=world.session is not None)
        self._fault = gui.add_html("")
        self._fault_text = ""
        tabs = gui.add_tab_group()
        self._panels: list[Panel] = []
        with tabs.add_tab("View"):
            self._panels += [DisplayPanel(gui, scene, self._fixed), RobotsPanel(gui, world, scene)]
        with tabs.add_tab("Frames"):
            self._panels.append(FramesPanel(gui, world, scene))
            with gui.add_folder("Between two frames"):
                self._panels.append(TransformPanel(gui, world))
        with tabs.add_tab("Joints"):
            self._add_joints(gui, sliders)
        with tabs.add_tab("Time"):
            self._panels.append(ReplayPanel(gui, self.clock))
        if world.session is not None:
            with tabs.add_tab("Graph"):
                monitor = self._opened.enter_context(GraphMonitor(world.session))
                self._panels.append(GraphPanel(gui, monitor))

    def _add_joints(self, gui: viser.GuiApi, sliders: Sequence[SliderPublisher]) -> None:
        for one in sliders:
            with gui.add_folder(f"Move {one.robot}"):
                self._panels.append(SlidersPanel(gui, one))
        with gui.add_folder("Plot"):
            self._panels.append(PlotsPanel(gui, self._world))

    @property
    def fault(self) -> str:
        """Why the last picture could not be drawn; empty when it could."""
        return self._fault_text

    @fault.setter
    def fault(self, text: str) -> None:
        if text != self._fault_text:
            self._fault_text = text
            said = f"The last picture could not be drawn, so what is shown is older: {text}"
            self._fault.content = html.paragraph(said, color=html.ALARM) if text else ""

    @property
    def stamp(self) -> int | None:
        """The instant to show [ns]; None for the newest of everything."""
        return self.clock.stamp(self._world.buffer.span())

    def fixed(self, moment: FramePoses) -> str:
        """The frame to see ``moment`` from; empty where there is none."""
        return self._fixed.choose(moment.tree)

    def update(self, moment: FramePoses) -> None:
        """Do what was chosen on the page since the last time, and tell there what is new."""
        buffer, is_present = self._world.buffer, self.clock.is_present
        domain = buffer.domain.name
        now = buffer.clock.now() if is_present and domain in (None, buffer.clock.domain) else None
        for panel in self._panels:
            # The panel of the fixed frame stands first: what was chosen there holds for the others.
            panel.update(PanelContext(moment, self.fixed(moment), buffer, is_present, now, domain))

    def close(self) -> None:
        """Look no more at who writes what. A second call does nothing."""
        self._opened.close()
