"""Robots and frames to draw, from the network or from a recording, and the fixed frame."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from zstate._util.closeable import Closeable
from zstate.buffer.buffer import RECORDING_HISTORY_S, TransformBuffer
from zstate.buffer.snapshot import FramePoses, FrameTable
from zstate.buffer.tracks import TimeSpan, Track
from zstate.clock import Clock
from zstate.model.robot import RobotModel
from zstate.net.session import Session
from zstate.nodes.listener import TransformListener
from zstate.recording.decode import STREAMS
from zstate.recording.recording import Recording
from zstate.view.recorded_world import RecordedWorld
from zstate.view.world_source import DECODED_STREAMS, WorldData, WorldSource
from zstate.wire.keys import ANY

_HOLD_S = 0.5
"""How long a robot is drawn after its newest sample: the robots of a recording end one by one."""


class ViewSource(Closeable):
    """All announced robots, or only ``robots``, and their poses.

    With a ``session``, ``listener`` fills ``buffer`` from the wire format ``wire``; without one, ``buffer``
    and ``world`` are complete, see ``from_recording``. ``world`` has the scans and maps; it is closed with
    the source. Ages and stamps are those of ``clock``; by default, of the clock that most robots use.
    Methods may be called from any thread.
    """

    def __init__(
        self,
        session: Session | None,
        robots: Sequence[str] = (),
        *,
        wire: str = "native",
        buffer: TransformBuffer | None = None,
        world: WorldData | None = None,
        history_s: float = 30.0,
        clock: Clock | None = None,
        placers: Collection[str] | None = None,
    ) -> None:
        self.session = session
        self.buffer = TransformBuffer(history_s, clock) if buffer is None else buffer
        self.listener: TransformListener | None = None
        if session is not None:
            robot = robots[0] if len(robots) == 1 else ANY
            self.listener = TransformListener(session, robot, self.buffer, wire, placers=placers)
        self.world: WorldData = WorldSource(session, robots, wire) if world is None else world
        self._selected = frozenset(robots)
        self._version = 0
        self._recorded: tuple[str, ...] = ()
        # By track: its newest stamp [ns], and when that was first seen, by time.monotonic [s].
        self._newest: dict[Track, tuple[int, float]] = {}
        self._table = self.buffer.frame_table(self._selected)

    @classmethod
    def from_recording(cls, path: str | Path) -> ViewSource:
        """The robots, scans and maps of a recording, an MCAP file or a bag. Raises RecordingError."""
        buffer = TransformBuffer(RECORDING_HISTORY_S)
        with Recording(path) as recording, ExitStack() as opening:
            world = opening.enter_context(RecordedWorld(path))
            for decoded in recording.fill(buffer, (*STREAMS, *DECODED_STREAMS)):
                world.add(decoded, buffer)
            world.add_clouds()
            source = cls(None, buffer=buffer, world=world)
            source._recorded = recording.robots
            opening.pop_all()
        return source

    def close(self) -> None:
        """Stop listening; the buffer keeps its samples. A second call does nothing."""
        self.world.close()
        if self.listener is not None:
            self.listener.close()

    @property
    def span(self) -> TimeSpan | None:
        """The stamps of all samples; where nothing moves, those of the recorded scans; None without any."""
        return self.buffer.span() or self.world.span

    @property
    def version(self) -> int:
        """Grows when a robot, a model, a frame or the writer of an edge changes."""
        self._set_table(self.buffer.frame_table(self._selected))
        return self._version

    @property
    def models(self) -> Mapping[str, RobotModel]:
        """The robots with a known model."""
        robots = self.buffer.frame_table(self._selected).robots
        return {name: track.model for name, track in robots.items()}

    def robots(self) -> tuple[str, ...]:
        """Every robot received or with a known model, sorted by name."""
        received = self._recorded if self.listener is None else self.listener.robots()
        selected = (robot for robot in received if not self._selected or robot in self._selected)
        return tuple(sorted({*self.models, *selected}))

    def snapshot(self, at: int | None = None) -> FramePoses:
        """The pose of every frame ``at`` a stamp [ns]; by default, at the newest sample of each robot.

        A robot keeps the pose of its newest sample for half a second; later, and before its oldest sample,
        its poses are unknown.
        """
        poses = self.buffer.snapshot(at, robots=self._selected, hold_s=_HOLD_S)
        self._set_table(poses.tree)
        self.poll()
        return poses

    def poll(self) -> None:
        """Look for new samples, to time them for ``silent_s``. ``snapshot`` does this too."""
        now = time.monotonic()
        for track in self._table.moving:
            newest = track.newest
            known = self._newest.get(track)
            if newest is not None and (known is None or known[0] != newest):
                self._newest[track] = newest, now

    def silent_s(self, track: Track) -> float | None:
        """The time since a new sample of a track [s]; None without samples, and in a recording."""
        known = self._newest.get(track)
        return None if known is None or self.session is None else time.monotonic() - known[1]

    def _set_table(self, table: FrameTable) -> None:
        if table is not self._table:
            self._version += 1
            self._table = table
            kept = set(table.moving)
            self._newest = {track: seen for track, seen in list(self._newest.items()) if track in kept}


@dataclass
class FixedFrame:
    """The fixed frame, as in rviz: the ``requested`` one if it exists, else the root of the largest tree."""

    requested: str = ""

    def resolve(self, tree: FrameTable) -> str:
        """Its name; of equally large trees, the first root. Empty if there is no frame."""
        if self.requested in tree.index:
            return self.requested
        return tree.names[int(np.bincount(tree.roots).argmax())] if tree.names else ""
