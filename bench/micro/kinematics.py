"""Cost of one forward-kinematics call, compared with reading Pinocchio pose by pose.

    python -m bench.micro.kinematics

Figures are medians over rounds of thread CPU time per call. ``publisher`` is what a StatePublisher computes
for the stream tf: the moving edges, by Pinocchio. zstate's other calls include input checks, the Pinocchio
loop has none. The cases are interleaved within each round, so that a slow moment affects all of
them. Needs example-robot-data. A loop in C++, or one that keeps Pinocchio's matrices, would cost less than
this loop.
"""

from __future__ import annotations

import platform
from collections.abc import Callable
from importlib.metadata import version

import numpy as np
import pinocchio as pin

from bench.micro.timing import mean_times_us
from zstate.model.kinematics import Kinematics, MovingEdges
from zstate.model.load import load_model
from zstate.model.robot import RobotModel

ROBOTS = ("panda", "g1", "talos_full_v2", "tiago_dual")
ROUNDS = 41
CALLS = 100


def pose_by_pose(model: RobotModel) -> Callable[[], np.ndarray]:
    """Forward kinematics by Pinocchio, reading each link's pose with its documented calls."""
    robot = pin.buildModelFromXML(model.urdf.removeprefix("\ufeff").strip(), False)
    data, q = robot.createData(), pin.neutral(robot)
    frames = [robot.getFrameId(link, pin.BODY) for link in model.links]
    poses = np.empty((len(frames), 7))

    def tick() -> np.ndarray:
        pin.framesForwardKinematics(robot, data, q)
        for row, frame in enumerate(frames):
            poses[row] = pin.SE3ToXYZQUAT(data.oMf[frame])
        return poses

    return tick


def cases(model: RobotModel) -> dict[str, Callable[[], np.ndarray]]:
    """The compared calls by name."""
    kinematics, moving, positions = Kinematics(model), MovingEdges(model), model.neutral + 0.1
    edges, links = np.empty((len(model.joints), 7)), np.empty((len(model.links), 7))
    return {
        "edge_poses": lambda: kinematics.edge_poses(positions, edges),
        "link_poses": lambda: kinematics.link_poses(positions, links),
        "publisher": lambda: moving.poses(positions),
        "loop": pose_by_pose(model),
    }


def main() -> None:
    """Print the table."""
    print(f"Python {platform.python_version()}, numpy {np.__version__}, pin {version('pin')}, ", end="")
    print(f"{platform.machine()}; median of {ROUNDS} rounds of {CALLS} calls, us of thread CPU time")
    print(f"{'robot':<15}{'links':>6}{'numbers':>8}{'edge_poses':>12}{'link_poses':>12}", end="")
    print(f"{'publisher':>11}{'loop':>8}{'loop/edge':>11}{'loop/link':>11}")
    for name in ROBOTS:
        model = load_model(name)
        times = mean_times_us(cases(model), ROUNDS, CALLS)
        cost = {case: np.median(values) for case, values in times.items()}
        print(f"{name:<15}{len(model.links):>6}{model.position_count:>8}", end="")
        print(f"{cost['edge_poses']:>12.1f}{cost['link_poses']:>12.1f}{cost['publisher']:>11.1f}", end="")
        print(f"{cost['loop']:>8.1f}", end="")
        print(f"{cost['loop'] / cost['edge_poses']:>11.1f}{cost['loop'] / cost['link_poses']:>11.1f}")


if __name__ == "__main__":
    main()
