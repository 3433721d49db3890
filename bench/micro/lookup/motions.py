"""Motions that fill the buffers: the same motion as joint positions and as poses of each edge."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from zstate import RobotModel, load_model
from zstate.model.joint_transforms import JointTransforms

FIRST = 1_790_000_000_000_000_000


@dataclass(frozen=True)
class RecordedMotion:
    """A moving robot, and the pair of frames of the lookups."""

    name: str
    model: RobotModel
    target: str
    source: str
    rate_hz: int = 100
    seconds: int = 10

    @property
    def count(self) -> int:
        """Number of samples."""
        return self.rate_hz * self.seconds

    @property
    def step(self) -> int:
        """The time between two samples [ns]."""
        return 10**9 // self.rate_hz

    @property
    def end(self) -> int:
        """The newest stamp [ns]."""
        return FIRST + (self.count - 1) * self.step

    def positions(self) -> NDArray[np.float64]:
        """Joint positions on independent sines: (count, nq)."""
        rng = np.random.default_rng(7)
        width = self.model.position_count
        amplitude, speed, phase = rng.uniform((0.3, 0.5, 0.0), (1.0, 3.0, 6.0), (width, 3)).T
        seconds = np.arange(self.count)[:, None] / self.rate_hz
        return amplitude * np.sin(speed * seconds + phase)

    def write(self, folder: Path) -> Path:
        """Writes the motion to files that workers with any Python can read; returns their common path."""
        edges = [(joint.parent, joint.child) for joint in self.model.joints]
        fixed = np.array([joint.type == "fixed" for joint in self.model.joints])
        positions = self.positions()
        poses = JointTransforms(self.model).poses(positions)
        head = {
            "target": self.target,
            "source": self.source,
            "first": FIRST,
            "step": self.step,
            "count": self.count,
            "edges": [edge for edge, still in zip(edges, fixed, strict=True) if not still],
            "statics": [
                (*edge, pose.tolist())
                for edge, still, pose in zip(edges, fixed, poses[0], strict=True)
                if still
            ],
        }
        path = folder / self.name
        path.with_suffix(".json").write_text(json.dumps(head))
        path.with_suffix(".urdf").write_text(self.model.urdf)
        positions.tofile(path.with_suffix(".positions"))
        np.ascontiguousarray(poses[:, ~fixed]).tofile(path.with_suffix(".poses"))
        return path


def chain(length: int) -> RobotModel:
    """A chain of ``length`` revolute joints."""
    links = "".join(f'<link name="l{n}"/>' for n in range(length + 1))
    joints = "".join(
        f'<joint name="j{n}" type="revolute"><parent link="l{n}"/><child link="l{n + 1}"/>'
        f'<origin xyz="0.1 0 0.05" rpy="0.3 0 0"/><axis xyz="0 0 1"/>'
        f'<limit lower="-3" upper="3" velocity="9" effort="9"/></joint>'
        for n in range(length)
    )
    return load_model(f'<robot name="chain">{links}{joints}</robot>')


def recorded_motions() -> dict[str, RecordedMotion]:
    """All motions by name."""
    panda, g1 = load_model("panda"), load_model("g1")
    arm = ("panda_link0", "panda_leftfinger")
    motions = [
        RecordedMotion("arm", panda, *arm),
        RecordedMotion("humanoid", g1, "left_ankle_roll_link", "right_rubber_hand"),
        *(RecordedMotion(f"history {seconds} s", panda, *arm, 1000, seconds) for seconds in (1, 10, 100)),
        *(RecordedMotion(f"depth {depth}", chain(depth), "l0", f"l{depth}") for depth in (5, 20, 100)),
        RecordedMotion("40 edges", chain(40), "l0", "l20", 1000),
    ]
    return {motion.name: motion for motion in motions}
