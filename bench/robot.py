"""A robot's motion for a run and the expected poses, computed by zstate."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from zstate import RobotModel, SineSource, load_model
from zstate.model.joint_transforms import JointTransforms
from zstate.model.kinematics import Kinematics

ROWS = 600
ROW_NS = 10_000_000

MODELS = {"panda": "panda", "g1": "g1", "talos": "talos_full_v2", "tiago_dual": "tiago_dual", "a1": "a1"}
"""The robots of the scenarios, and their names in zstate's catalog."""


@dataclass(frozen=True)
class BenchRobot:
    """A robot, six seconds of a smooth motion, and the resulting poses of the tip.

    ``rows`` (N, n_joints) [rad] or [m]; ``poses`` (N, 7) are ``base_from_tip``. The tip is the link with the
    most moving joints between it and the root, the last of them in the order of the URDF.
    """

    name: str
    model: RobotModel
    tip: str
    rows: NDArray[np.float64]
    poses: NDArray[np.float64]

    @property
    def moving_edges(self) -> int:
        """Number of transforms on /tf: moving joints, mimics included."""
        return sum(joint.type != "fixed" for joint in self.model.joints)


@lru_cache
def bench_robot(name: str) -> BenchRobot:
    """One of ``MODELS``. Only joints with one coordinate, because ROS joint states hold no others."""
    model = load_model(MODELS[name])
    source, kinematics = SineSource(model), Kinematics(model)
    rows = np.array([source.read(n * ROW_NS).positions for n in range(ROWS)])
    tip = deepest_link(model)
    tip_row = model.links.index(tip)
    poses = np.array([kinematics.link_poses(row)[tip_row] for row in rows])
    return BenchRobot(name, model, tip, rows, poses)


def deepest_link(model: RobotModel) -> str:
    """The link with the most moving joints above it; if several, the last."""
    above = {joint.child: joint for joint in model.joints}

    def depth(link: str) -> int:
        count = 0
        while link in above:
            count += above[link].type != "fixed"
            link = above[link].parent
        return count

    return max(reversed(model.links), key=depth)


def write_motion(path: Path, model: RobotModel, positions: NDArray[np.float64], **facts: object) -> None:
    """Writes the files of a ``MotionFile``: edges, ``positions`` (N, nq), and the poses of moving edges."""
    edges = [(joint.parent, joint.child) for joint in model.joints]
    moves = np.array([joint.type != "fixed" for joint in model.joints])
    poses = JointTransforms(model).poses(positions)
    statics = [
        (*edge, pose.tolist()) for edge, moved, pose in zip(edges, moves, poses[0], strict=True) if not moved
    ]
    moving = [edge for edge, moved in zip(edges, moves, strict=True) if moved]
    head = {**facts, "count": len(positions), "edges": moving, "statics": statics}
    path.with_suffix(".json").write_text(json.dumps(head), encoding="utf-8")
    path.with_suffix(".urdf").write_text(model.urdf, encoding="utf-8")
    np.ascontiguousarray(positions).tofile(path.with_suffix(".positions"))
    np.ascontiguousarray(poses[:, moves]).tofile(path.with_suffix(".poses"))
