"""World: what there is to be seen, of the network or of a recording.

FixedFrame: the frame that everything is seen from.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from zstate._util.closeable import Closeable
from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.snapshot import FramePoses, FrameTable
from zstate.clock import Clock
from zstate.model.robot import RobotModel
from zstate.net.session import Session
from zstate.nodes.listener import TransformListener
from zstate.recording.recording import Recording
from zstate.wire.keys import ANY

_HOLD_S = 0.5
"""A robot is drawn for so long after its newest sample: robots end a recording one by one."""


class ViewSource(Closeable):
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
        # By robot: its newest stamp [ns], and when that was first seen, by time.monotonic [s].
        self._seen: dict[str, tuple[int, float]] = {}
        self._table: FrameTable = FrameTable((), np.empty(0, np.intp), (), ())
        self._refresh()

    @classmethod
    def of_recording(cls, path: str | Path) -> ViewSource:
        """The robots of a recording, an MCAP file or a bag. Raises RecordingError."""
        with Recording(path) as recording:
            return cls(None, buffer=recording.buffer())

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

    def moment(self, at: int | None = None) -> FramePoses:
        """Where every frame was ``at`` a stamp [ns]; with None, at the newest sample of each robot.

        A robot is still drawn at its newest sample half a second after that; later, as before its
        oldest one, its poses are not known.
        """
        poses = self.buffer.snapshot(at, robots=self._shown, hold_s=_HOLD_S)
        self._adopt(poses.tree)
        self.poll()
        return poses

    def poll(self) -> None:
        """See which robots have said something new. ``moment`` does; between moments, look often."""
        now = time.monotonic()
        for robot, track in self._table.robots.items():
            newest = track.newest
            seen = self._seen.get(robot)
            if newest is not None and (seen is None or seen[0] != newest):
                self._seen[robot] = newest, now

    def silent_s(self, robot: str) -> float | None:
        """How long no sample of a robot has been seen [s]; None where none ever was, and in a recording."""
        seen = self._seen.get(robot)
        return None if seen is None or self.session is None else time.monotonic() - seen[1]

    def _is_shown(self, robot: str) -> bool:
        return not self._shown or robot in self._shown

    def _refresh(self) -> None:
        self._adopt(self.buffer.frame_table(self._shown))

    def _adopt(self, table: FrameTable) -> None:
        if table is not self._table:
            self._table = table
            self._models = {name: track.model for name, track in table.robots.items()}
            self._version += 1


class FixedFrame:
    """The frame that was chosen, while it is there; else the root that carries the most frames."""

    def __init__(self, chosen: str = "") -> None:
        self.chosen = chosen
        """What was asked for; empty for nothing in particular."""
        self._tree: FrameTable | None = None
        self._default = ""

    def choose(self, tree: FrameTable) -> str:
        """Its name; empty where there is no frame at all."""
        if tree is not self._tree:
            self._tree, self._default = tree, default_fixed_frame(tree)
        return self.chosen if self.chosen in tree.index else self._default


def default_fixed_frame(tree: FrameTable) -> str:
    """The root with the most frames, of equal ones the first; empty where there is none."""
    if not tree.names:
        return ""
    return tree.names[int(np.bincount(tree.roots).argmax())]
