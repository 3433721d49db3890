"""FrameFacts: what a buffer knows of frames and robots beside their poses."""

from __future__ import annotations

from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.edge import Edge
from zstate.buffer.frames import FrameInfo, frame_info
from zstate.buffer.layout import Layout
from zstate.buffer.tracks import JointTrack, Track, coverage
from zstate.view.replay_clock import Span


class FrameFacts:
    """Reads ``buffer``, of which the whole layout is looked at only when that has changed."""

    def __init__(self, buffer: TransformBuffer) -> None:
        self._buffer = buffer
        self._layout: Layout | None = None
        self._tracks: dict[Track, Edge] = {}

    def _current(self) -> Layout:
        if self._layout is None or self._layout.version != self._buffer.version:
            self._layout = self._buffer.layout()
            edges = (edge for edge in self._layout.edges.values() if edge is not None)
            self._tracks = {edge.track: edge for edge in edges if edge.track is not None}
        return self._layout

    def info(self, frame: str) -> FrameInfo | None:
        """What is known of a frame; None for one that is not there."""
        layout = self._current()
        known = frame in layout.edges
        return frame_info(frame, layout.edges[frame], self._buffer.domain) if known else None

    def track(self, robot: str) -> JointTrack | None:
        """The joints of a robot; None where they are not known."""
        return self._current().robots.get(robot)

    def rate_hz(self, robot: str) -> float | None:
        """How many samples of a robot come in a second, as far as that is known."""
        track = self.track(robot)
        return None if track is None else coverage(track.history.view).rate_hz

    def span(self) -> Span | None:
        """What can be looked at: of a buffer that forgets, as much as it keeps; None for nothing.

        Of robots with two clocks, the span of those with the clock that the buffer's domain names.
        """
        self._current()
        domain = self._buffer.domain
        views = [
            view
            for track, edge in self._tracks.items()
            if (view := track.history.view).size and (domain.of_edge(edge) or domain.name) == domain.name
        ]
        if not views:
            return None
        newest = max(view.newest for view in views)
        oldest = min(view.oldest for view in views)
        return Span(max(oldest, newest - round(self._buffer.history_s * 1e9)), newest)
