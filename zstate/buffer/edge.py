"""Edge: what places one frame on another."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from zstate import se3
from zstate.buffer.tracks import JointTrack, PoseTrack

EdgeKind = Literal["joint", "pose", "static"]


@dataclass(frozen=True, slots=True)
class Edge:
    """What places ``child`` on ``parent``.

    A static edge holds its ``pose``; a moving one its ``track`` and its ``index`` among the track's
    edges. ``robot`` is the joint track of the model the edge belongs to, fixed joints included.
    """

    parent: str
    child: str
    kind: EdgeKind
    pose: se3.Pose = se3.IDENTITY
    track: JointTrack | PoseTrack | None = None
    index: int = 0
    robot: JointTrack | None = None
    own_writer: str | None = None

    @property
    def names(self) -> tuple[str, str]:
        """(parent, child)."""
        return (self.parent, self.child)

    @property
    def writer(self) -> str | None:
        """Who gives this edge, as far as anybody said."""
        if self.robot is not None:
            said_by = self.robot.model_writer if self.kind == "static" else self.robot.writer
            return said_by or f"the model of {self.robot.model.name!r}"
        return self.track.writer if self.track is not None else self.own_writer
