"""Panel of the graph: status of each publisher, and the writers and readers of each stream."""

from __future__ import annotations

from collections.abc import Sequence

import viser

from zstate.errors import format_duration
from zstate.net.graph import Graph, GraphMonitor, StreamGroup, WriterState
from zstate.view.panels import html
from zstate.view.panels.context import PanelContext

_LATE_S = 3.0
"""Publishers send a status once a second; an older one is not valid any more."""


class GraphPanel:
    """The status of every publisher, then the streams, grouped by writers and readers."""

    def __init__(self, gui: viser.GuiApi, monitor: GraphMonitor) -> None:
        self._monitor = monitor
        self._text = gui.add_html("")

    def update(self, look: PanelContext) -> None:
        self._text.content = graph_html(self._monitor.states(), self._monitor.graph())


def graph_html(states: Sequence[WriterState], graph: Graph) -> str:
    """Publishers and streams as HTML."""
    if not states and not graph.streams:
        return html.paragraph("Nobody writes or reads anything of a robot.", muted=True)
    return "".join([*map(_state_html, states), *map(_group_html, graph.groups)])


def _state_html(state: WriterState) -> str:
    status = state.status
    color = {"ok": "", "warn": html.WARNING}.get(status.level, html.ALARM)
    text = status.text or status.level
    if state.age_s >= _LATE_S:
        color, text = html.ALARM, f"has said nothing for {format_duration(round(state.age_s * 1e9))}"
    head = f"{state.robot} at {status.rate_hz:.1f} Hz"
    return html.heading(head, color=color) + html.paragraph(f"{status.program} pid {status.pid}: {text}")


def _group_html(group: StreamGroup) -> str:
    names = ", ".join(stream.name for stream in group.streams)
    ends = [("written by", _lines(group.writers)), ("read by", _lines(group.readers))]
    return html.heading(f"{group.robot}: {names}", color="" if group.writers else html.ALARM) + html.pairs(
        ends
    )


def _lines(programs: Sequence[str]) -> str:
    return "\n".join(programs) or "nobody"
