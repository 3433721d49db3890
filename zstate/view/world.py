"""World: what there is to be seen, of the network or of a recording."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.layout import Layout
from zstate.buffer.tracks import JointTrack
from zstate.clock import Clock
from zstate.closing import Closing
from zstate.model.robot import RobotModel
from zstate.net.session import Session
from zstate.nodes.listener import TransformListener
from zstate.view.moment import Moment
from zstate.view.readings import Readings, readings_of, tracks_of
from zstate.wire.keys import ANY


class World(Closing):
    """Every robot that is announced, or those of ``robots``, with what is known of them.

    Where the ``session`` is None nothing is followed and ``buffer`` is all there is: a recording, see
    ``of_recording``. Otherwise it is filled by ``listener``, which hears ``wire``. Ages, and the
    time line, are those of ``clock``; without one, of the clock that most robots have. Methods may be called
    from any thread.
    """

    def __init__(
        self,
        session: Session | None,
        robots: Sequence[str] = (),
        *,
        wire: str = "native",
        buffer: TransformBuffer | None = None,
        history_s: float = 30.0,
        clock: Clock | None = None,
    ) -> None:
        self.session = session
        self.buffer = TransformBuffer(history_s, clock) if buffer is None else buffer
        self.listener: TransformListener | None = None
        if session is not None:
            followed = robots[0] if len(robots) == 1 else ANY
            self.listener = TransformListener(session, followed, self.buffer, wire)
        self._shown = frozenset(robots)
        self._version = 0
        self._models: Mapping[str, RobotModel] = {}
        self._tracks: Mapping[str, JointTrack] = {}
        # By robot: its newest stamp [ns], and when that was first seen, by time.monotonic [s].
        self._seen: dict[str, tuple[int, float]] = {}
        self._readings = self._read_layout(self.buffer.layout())

    @classmethod
    def of_recording(cls, path: str | Path) -> World:
        """The robots of a recording, an MCAP file or a bag. Raises RecordingError."""
        return cls(None, buffer=TransformBuffer.from_recording(path))

    def close(self) -> None:
        """Follow nothing any more; the buffer keeps what it has. A second call does nothing."""
        if self.listener is not None:
            self.listener.close()

    @property
    def version(self) -> int:
        """Grows whenever a robot, its model, a frame or what places one has changed."""
        self._refresh()
        return self._version

    @property
    def models(self) -> Mapping[str, RobotModel]:
        """The robots whose model is known."""
        self._refresh()
        return self._models

    def robots(self) -> tuple[str, ...]:
        """Every robot that was heard, or whose model is known, sorted by name."""
        heard = () if self.listener is None else self.listener.robots()
        return tuple(sorted({*self.models, *filter(self._is_shown, heard)}))

    def moment(self, at: int | None = None) -> Moment:
        """Where every frame was ``at`` a stamp [ns]; with None, at the newest sample of each robot.

        A robot is still drawn at its newest sample half a second after that; later, as before its
        oldest one, its poses are not known.
        """
        readings = self._refresh()
        self.look()
        return readings.at(self.buffer, at)

    def look(self) -> None:
        """See which robots have said something new. ``moment`` does; between moments, look often."""
        now = time.monotonic()
        for robot, track in self._tracks.items():
            newest = track.history.newest
            seen = self._seen.get(robot)
            if newest is not None and (seen is None or seen[0] != newest):
                self._seen[robot] = newest, now

    def silent_s(self, robot: str) -> float | None:
        """How long no sample of a robot has been seen [s]; None where none ever was, and in a recording."""
        seen = self._seen.get(robot)
        return None if seen is None or self.session is None else time.monotonic() - seen[1]

    def _is_shown(self, robot: str) -> bool:
        return not self._shown or robot in self._shown

    def _refresh(self) -> Readings:
        readings = self._readings
        # A writer is announced after its first samples: that is no change of the tree.
        writers = tuple(use.track.writer for use in readings.uses)
        if readings.version != self.buffer.version or readings.writers != writers:
            readings = self._readings = self._read_layout(self.buffer.layout())
        return readings

    def _read_layout(self, layout: Layout) -> Readings:
        shown = self._chosen(layout)
        self._tracks = shown.robots
        self._models = {name: track.model for name, track in shown.robots.items()}
        self._version += 1
        return readings_of(shown, tuple(track.writer for track in tracks_of(shown.edges.values())))

    def _chosen(self, layout: Layout) -> Layout:
        """What is shown of a layout: the chosen robots' frames, and those that they stand on."""
        if not self._shown:
            return layout
        names: set[str] = set()
        for name in layout.edges:
            above: str | None = name if name.partition("/")[0] in self._shown else None
            while above is not None and above not in names:
                names.add(above)
                edge = layout.edges[above]
                above = None if edge is None else edge.parent
        edges = {name: edge for name, edge in layout.edges.items() if name in names}
        robots = {name: track for name, track in layout.robots.items() if name in self._shown}
        return Layout(layout.version, edges, robots)
