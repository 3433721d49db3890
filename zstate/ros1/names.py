"""Frame names: ROS 1 has one name space for all robots, zstate has one for each."""

from __future__ import annotations

from dataclasses import dataclass

from zstate.wire.keys import wire_name


@dataclass(frozen=True, slots=True)
class FrameNames:
    """How the frames of ``robot`` are called in ROS: ``prefix`` and the bare name.

    Frames of other robots have their full name, ``robot/frame``, on both sides.
    """

    robot: str
    prefix: str = ""

    def in_ros(self, frame: str) -> str:
        """What ROS calls a frame of a message of this robot."""
        bare = frame.removeprefix(f"{self.robot}/")
        return frame if bare == frame and "/" in frame else f"{self.prefix}{bare}"

    def bare(self, frame_id: str) -> str:
        """A ``frame_id`` without the prefix, and without the slash that old programs put before it."""
        return frame_id.removeprefix("/").removeprefix(self.prefix)

    def in_zstate(self, frame_id: str, links: frozenset[str]) -> str:
        """What zstate calls a ``frame_id`` in messages of this robot, whose model has ``links``."""
        bare = self.bare(frame_id)
        return wire_name(self.robot, bare) if bare in links else bare
