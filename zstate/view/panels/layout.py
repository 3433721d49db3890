"""Layout of the page: its tabs, and the panels in them."""

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
from zstate.view.panels.display_panel import DisplayOptions, DisplayPanel, RobotsPanel, RobotStyler
from zstate.view.panels.frames_panel import FramesPanel, TrailControls, TransformPanel
from zstate.view.panels.graph_panel import GraphPanel
from zstate.view.panels.joints_panel import PlotsPanel, SlidersPanel
from zstate.view.panels.panel import Panel, PanelContext
from zstate.view.panels.time_panel import TimeCursor, TimePanel
from zstate.view.sliders import SliderPublisher


class SceneControls(DisplayOptions, RobotStyler, TrailControls, Protocol):
    """The settings of a scene that the panels change."""


class PanelLayout(Closeable):
    """Adds the panels to the page of ``server``; ``sliders`` belong to the robots that are moved from it.

    ``fixed_frame`` is selected at first. The drawing thread reads ``stamp`` and ``fixed_frame`` for each
    picture, and calls ``update`` with the snapshot on display a few times a second.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        source: ViewSource,
        scene: SceneControls,
        sliders: Sequence[SliderPublisher] = (),
        fixed_frame: str = "",
    ) -> None:
        gui = server.gui
        self._source = source
        self._fixed = FixedFrame(fixed_frame)
        self._resources = ExitStack()
        self.cursor = TimeCursor(live=source.session is not None)
        self._fault = gui.add_html("")
        self._fault_text = ""
        tabs = gui.add_tab_group()
        # The display panel is first: a fixed frame selected there applies to the other panels.
        with tabs.add_tab("View"):
            self._panels: list[Panel] = [
                DisplayPanel(gui, scene, self._fixed),
                RobotsPanel(gui, source, scene),
            ]
        with tabs.add_tab("Frames"):
            self._panels.append(FramesPanel(gui, scene))
            with gui.add_folder("Between two frames"):
                self._panels.append(TransformPanel(gui))
        with tabs.add_tab("Joints"):
            for publisher in sliders:
                with gui.add_folder(f"Move {publisher.robot}"):
                    self._panels.append(SlidersPanel(gui, publisher))
            with gui.add_folder("Plot"):
                self._panels.append(PlotsPanel(gui, source))
        with tabs.add_tab("Time"):
            self._panels.append(TimePanel(gui, self.cursor))
        if source.session is not None:
            with tabs.add_tab("Graph"):
                monitor = self._resources.enter_context(GraphMonitor(source.session))
                self._panels.append(GraphPanel(gui, monitor))

    @property
    def fault(self) -> str:
        """Why the last picture could not be drawn; empty if it was drawn. May be set."""
        return self._fault_text

    @fault.setter
    def fault(self, fault: str) -> None:
        if fault != self._fault_text:
            self._fault_text = fault
            text = f"The last picture could not be drawn; an older one is shown: {fault}"
            self._fault.content = html.paragraph(text, color=html.ALARM) if fault else ""

    @property
    def stamp(self) -> int | None:
        """The stamp to show [ns]; None for the newest samples."""
        return self.cursor.stamp(self._source.buffer.span())

    def fixed_frame(self, snapshot: FramePoses) -> str:
        """The fixed frame; empty if there is no frame."""
        return self._fixed.resolve(snapshot.tree)

    def update(self, snapshot: FramePoses) -> None:
        """Apply the user's input, and show what has changed."""
        buffer, is_live = self._source.buffer, self.cursor.is_live
        domain = buffer.domain.name
        now = buffer.clock.now() if is_live and domain in (None, buffer.clock.domain) else None
        for panel in self._panels:
            panel.update(PanelContext(snapshot, self.fixed_frame(snapshot), buffer, is_live, now, domain))

    def close(self) -> None:
        """Stop monitoring the graph. A second call does nothing."""
        self._resources.close()
