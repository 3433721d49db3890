"""Any robot of LeRobot, such as SO101Follower; imports nothing of LeRobot."""

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from zstate import JointReading, RobotModel
from zstate.driving import Setpoint


class LeRobotRobot:
    """``robot`` has LeRobot's calls; configure it without cameras, which would block the loop.

    Its numbers are degrees, except those of the joints in ``normalized``, such as {"gripper": (0, 100)} or
    {"elbow": (-100, 100)}: the numbers at the lower and the upper limit of the joint in the URDF.
    """

    modes: frozenset[Literal["position"]] = frozenset({"position"})

    def __init__(
        self, robot: Any, model: RobotModel, normalized: Mapping[str, tuple[float, float]] | None = None
    ) -> None:
        self.joint_names, self._robot = model.joint_names, robot
        self._unit, self._zero = np.full(len(self.joint_names), np.pi / 180), np.zeros(len(self.joint_names))
        for name, (first, last) in (normalized or {}).items():
            row = self.joint_names.index(name)
            limits = model.driven_joints[row].limits
            self._unit[row] = (limits.upper - limits.lower) / (last - first)
            self._zero[row] = limits.lower - first * self._unit[row]

    def open(self) -> None:
        self._robot.connect(calibrate=False)

    def enable(self, on: bool) -> None:
        self._robot.bus.enable_torque() if on else self._robot.bus.disable_torque()

    def read(self, stamp: int) -> JointReading:
        observation = self._robot.get_observation()
        numbers = np.array([observation[f"{name}.pos"] for name in self.joint_names])
        return JointReading(self._zero + self._unit * numbers)

    def write(self, setpoint: Setpoint | JointReading) -> None:
        numbers = ((setpoint.positions - self._zero) / self._unit).tolist()
        keys = [f"{name}.pos" for name in self.joint_names]
        self._robot.send_action(dict(zip(keys, numbers, strict=True)))

    def stop(self, how: str) -> None:
        self.write(self.read(0)) if how == "hold" else self.enable(False)

    def close(self) -> None:
        if self._robot.is_connected:
            self._robot.disconnect()
