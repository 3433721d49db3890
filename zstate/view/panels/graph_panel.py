"""Tab Graph: the status of each publisher, and the writers and readers of each stream."""

from __future__ import annotations

from collections.abc import Sequence

import viser

from zstate.errors import format_duration
from zstate.net.graph import Graph, GraphMonitor, WriterState
from zstate.view.panels import html
from zstate.view.panels.panel import PanelContext

_EXPIRED_S = 3.0
"""Publishers send a status once a second; an older one is not valid any more."""


class GraphPanel:
    """The status of every publisher, then the streams, grouped by writers and readers."""

    def __init__(self, gui: viser.GuiApi, monitor: GraphMonitor) -> None:
        self._monitor = monitor
        self._text = gui.add_html("")

    def update(self, context: PanelContext) -> None:
        self._text.content = graph_html(self._monitor.states(), self._monitor.graph())


def graph_html(states: Sequence[WriterState], graph: Graph) -> str:
    """Publishers and streams as HTML."""
    parts: list[str] = []
    for state in states:
        status = state.status
        color = {"ok": "", "warn": html.WARNING}.get(status.level, html.ALARM)
        text = status.text or status.level
        if state.age_s >= _EXPIRED_S:
            color, text = html.ALARM, f"no status for {format_duration(round(state.age_s * 1e9))}"
        parts.append(html.heading(f"{state.robot} at {status.rate_hz:.1f} Hz", color=color))
        parts.append(html.paragraph(f"{status.program} pid {status.pid}: {text}"))
    for group in graph.groups:
        names = ", ".join(stream.name for stream in group.streams)
        parts.append(html.heading(f"{group.robot}: {names}", color="" if group.writers else html.ALARM))
        ends = (("written by", group.writers), ("read by", group.readers))
        parts.append(html.pairs((label, "\n".join(programs) or "none") for label, programs in ends))
    return "".join(parts) or html.paragraph("No robot stream has a writer or a reader.", muted=True)
