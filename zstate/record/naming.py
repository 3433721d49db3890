"""Naming: where in a recording each robot stands, as a ROS tool sees it."""

from __future__ import annotations

import re

from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.topics import SHARED


class Naming:
    """The namespace and the frame prefix of each robot of one recording.

    ``alone`` stands in the root with its frames as they are, which is where every ROS tool looks; so does
    what belongs to nobody in particular. Any other robot has a namespace and a frame prefix of its own.
    """

    def __init__(self, alone: str | None = None) -> None:
        self._root = {SHARED, alone}
        self._namespaces: dict[str, str] = {}

    def options(self, robot: str) -> Ros2Options:
        """Raises InvalidInput for what is no robot's name."""
        if robot in self._root:
            return Ros2Options()
        return Ros2Options(namespace=self._namespace(robot), frame_prefix=f"{robot}/")

    def _namespace(self, robot: str) -> str:
        if robot not in self._namespaces:
            # "arm-1" and "arm.1" are robots of ours, but no names for ROS.
            name = re.sub(r"\W|^(?=\d)", "_", robot, flags=re.ASCII)
            while name in self._namespaces.values():
                name += "_"
            self._namespaces[robot] = name
        return self._namespaces[robot]
