"""zstate's buffer, filled with joint positions."""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.micro.lookup.worker import MotionFile, serve
from zstate import LookupFailed, RobotModel, TransformBuffer, load_model


class Robot:
    """A filled buffer."""

    def __init__(self, recorded: MotionFile, model: RobotModel, positions: Any) -> None:
        self.buffer = TransformBuffer(recorded.count * recorded.step * 1e-9)
        self.track = self.buffer.add_robot(model)
        self.names = recorded.target, recorded.source
        self.positions = positions
        self.stamp = recorded.first
        self.step = recorded.step
        for row in self.positions:
            self.insert(row)
        self.plan = self.buffer.plan(*self.names)

    def insert(self, row: Any) -> None:
        self.buffer.insert_joints(self.track, self.stamp, row)
        self.stamp += self.step


class Zstate:
    """The cases of the table."""

    @staticmethod
    def read(recorded: MotionFile) -> Any:
        model = load_model(recorded.path.with_suffix(".urdf").read_text())
        TransformBuffer().add_robot(model)  # modules loaded by this call do not count as memory of the buffer
        return model, list(np.fromfile(recorded.path.with_suffix(".positions")).reshape(recorded.count, -1))

    @staticmethod
    def fill(recorded: MotionFile, samples: Any) -> Robot:
        return Robot(recorded, *samples)

    @staticmethod
    def name(robot: Robot, stamps: list[int]) -> Any:
        lookup, (target, source) = robot.buffer.lookup, robot.names
        return (lambda stamp: lookup(target, source, stamp)), stamps

    @staticmethod
    def plan(robot: Robot, stamps: list[int]) -> Any:
        return robot.plan.at, stamps

    @staticmethod
    def batch(robot: Robot, stamps: list[int]) -> Any:
        return robot.plan.poses, [np.array(stamps[:1000])] * 10

    @staticmethod
    def future(robot: Robot, stamps: list[int]) -> Any:
        lookup, (target, source) = robot.buffer.lookup, robot.names

        def lookup_error(stamp: int) -> object:
            try:
                return lookup(target, source, stamp + 10**12)
            except LookupFailed as reason:
                return reason

        return lookup_error, stamps

    @staticmethod
    def insert(robot: Robot, stamps: list[int]) -> Any:
        return robot.insert, robot.positions[: len(stamps)]


if __name__ == "__main__":
    serve(Zstate())
