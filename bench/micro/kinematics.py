"""One forward-kinematics call, compared with reading Pinocchio pose by pose.

``publisher`` is what a StatePublisher computes for the stream tf: the moving edges, by Pinocchio. zstate's
other calls include input checks, the Pinocchio loop has none. A loop in C++, or one that keeps Pinocchio's
matrices, would cost less than this loop. Figures are of means over 100 calls.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pinocchio as pin

from bench.micro.form import Call, Row, compared, mean_times_us
from zstate import RobotModel, load_model
from zstate.model.kinematics import Kinematics, MovingEdges

ROBOTS = ("panda", "g1", "talos_full_v2", "tiago_dual")


def measure(robots: tuple[str, ...] = ROBOTS, rounds: int = 41) -> Iterator[Row]:
    """Rows of each robot, compared with its edge poses."""
    for name in robots:
        model = load_model(name)
        yield from compared(
            f"{name}, {len(model.links)} links", "us", mean_times_us(cases(model), rounds, 100)
        )


def cases(model: RobotModel) -> dict[str, Call]:
    """The compared calls by name."""
    kinematics, moving, positions = Kinematics(model), MovingEdges(model), model.neutral + 0.1
    edges, links = np.empty((len(model.joints), 7)), np.empty((len(model.links), 7))
    return {
        "all edges": lambda: kinematics.edge_poses(positions, edges),
        "all links": lambda: kinematics.link_poses(positions, links),
        "moving edges, by Pinocchio": lambda: moving.poses(positions),
        "all links in a loop over Pinocchio": pose_by_pose(model),
    }


def pose_by_pose(model: RobotModel) -> Call:
    """Forward kinematics by Pinocchio, reading each link's pose with its documented calls."""
    robot = pin.buildModelFromXML(model.urdf.removeprefix("\ufeff").strip(), False)
    data, q = robot.createData(), pin.neutral(robot)
    frames = [robot.getFrameId(link, pin.BODY) for link in model.links]
    poses = np.empty((len(frames), 7))

    def tick() -> None:
        pin.framesForwardKinematics(robot, data, q)
        for row, frame in enumerate(frames):
            poses[row] = pin.SE3ToXYZQUAT(data.oMf[frame])

    return tick
