"""transform-tree (``pip install transform-tree==0.0.9``), filled with the pose of each moving edge."""

from __future__ import annotations

from typing import Any

import numpy as np
import tf_tree

from bench.micro.lookup.worker import MotionFile, serve

WXYZ_XYZ = [6, 3, 4, 5, 0, 1, 2]


class Robot:
    """A filled tree."""

    def __init__(self, recorded: MotionFile, samples: list[Any]) -> None:
        self.tree = tf_tree.build(_topology(recorded))
        self.names = recorded.target, recorded.source
        self.publishers = [self.tree.publisher(child, parent) for parent, child in recorded.edges]
        self.samples = samples
        self.stamp = recorded.first
        self.step = recorded.step
        for sample in self.samples:
            self.insert(sample)
        self.plan = self.tree.plan(*self.names)

    def insert(self, sample: list[Any]) -> None:
        for publisher, pose in zip(self.publishers, sample, strict=True):
            publisher.push(self.stamp, pose)
        self.stamp += self.step


def _topology(recorded: MotionFile) -> str:
    """The tree in transform-tree's format, with tf2's rule of interpolation."""
    text = '[topology]\ninterp = "lerpslerp"\n'
    for parent, child, pose in recorded.statics:
        numbers = ", ".join(repr(float(pose[k])) for k in WXYZ_XYZ)
        text += f'[[edge]]\nparent = "{parent}"\nchild = "{child}"\nkind = "static"\npose = [{numbers}]\n'
    for parent, child in recorded.edges:
        text += f'[[edge]]\nparent = "{parent}"\nchild = "{child}"\nkind = "dynamic"\n'
        text += f"capacity = {recorded.count}\n"
    return text


class TransformTree:
    """The cases of the table; poses are requested as seven numbers, its fastest layout."""

    @staticmethod
    def read(recorded: MotionFile) -> Any:
        poses = np.fromfile(recorded.path.with_suffix(".poses")).reshape(recorded.count, -1, 7)
        return [list(sample) for sample in np.ascontiguousarray(poses[..., WXYZ_XYZ])]

    @staticmethod
    def fill(recorded: MotionFile, samples: list[Any]) -> Robot:
        return Robot(recorded, samples)

    @staticmethod
    def name(robot: Robot, stamps: list[int]) -> Any:
        lookup, (target, source) = robot.tree.lookup, robot.names
        return (lambda stamp: lookup(target, source, stamp)), stamps

    @staticmethod
    def plan(robot: Robot, stamps: list[int]) -> Any:
        at = robot.plan.at
        return (lambda stamp: at(stamp, layout="quat")), stamps

    @staticmethod
    def batch(robot: Robot, stamps: list[int]) -> Any:
        at = robot.plan.at
        return (lambda column: at(column, layout="quat")), [np.array(stamps[:1000])] * 10

    @staticmethod
    def future(robot: Robot, stamps: list[int]) -> Any:
        lookup, (target, source) = robot.tree.lookup, robot.names

        def lookup_error(stamp: int) -> object:
            try:
                return lookup(target, source, stamp + 10**12)
            except tf_tree.TfTreeError as reason:
                return reason

        return lookup_error, stamps

    @staticmethod
    def insert(robot: Robot, stamps: list[int]) -> Any:
        return robot.insert, robot.samples[: len(stamps)]


if __name__ == "__main__":
    serve(TransformTree())
