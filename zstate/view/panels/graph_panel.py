"""Who writes and reads what, how fast, and how the writers say they do."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import viser

from zstate.errors import duration_text
from zstate.view.graph_watch import GraphWatch, StreamUse, WriterState
from zstate.view.panels import html
from zstate.view.panels.look import Look

_LATE_S = 3.0
"""A publisher says once a second how it does; what it said so long ago does not hold any more."""


class GraphPanel:
    """How every publisher does, by its own word; then the streams, those together that have the same ends."""

    def __init__(self, gui: viser.GuiApi, watch: GraphWatch) -> None:
        self._watch = watch
        self._text = gui.add_html("")

    def update(self, look: Look) -> None:
        self._text.content = graph_html(self._watch.states(), self._watch.uses())


def graph_html(states: Sequence[WriterState], uses: Sequence[StreamUse]) -> str:
    """The graph and the rates as the page shows them."""
    if not states and not uses:
        return html.paragraph("Nobody writes or reads anything of a robot.", muted=True)
    return "".join([*map(_state_html, states), *_bundles_html(uses)])


def _state_html(state: WriterState) -> str:
    status = state.status
    color = {"ok": "", "warn": html.WARNING}.get(status.level, html.ALARM)
    text = status.text or status.level
    if state.age_s >= _LATE_S:
        color, text = html.ALARM, f"has said nothing for {duration_text(round(state.age_s * 1e9))}"
    head = f"{state.robot} at {status.rate_hz:.1f} Hz"
    return html.heading(head, color=color) + html.paragraph(f"{status.program} pid {status.pid}: {text}")


def _bundles_html(uses: Sequence[StreamUse]) -> Iterator[str]:
    bundles: dict[tuple[str, tuple[str, ...], tuple[str, ...]], list[str]] = {}
    for use in uses:
        bundles.setdefault((use.robot, use.writers, use.readers), []).append(use.stream)
    for (robot, writers, readers), streams in bundles.items():
        yield html.heading(f"{robot}: {', '.join(streams)}", color="" if writers else html.ALARM)
        yield html.pairs([("written by", _lines(writers)), ("read by", _lines(readers))])


def _lines(programs: Sequence[str]) -> str:
    return "\n".join(programs) or "nobody"
