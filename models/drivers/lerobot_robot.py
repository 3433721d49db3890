"""Any robot of LeRobot, such as SO101Follower; imports nothing of LeRobot."""

import numpy as np

from zstate import JointReading


class LeRobotRobot:
    """``robot`` has LeRobot's calls; configure it without cameras, which would block the loop.

    Its numbers are degrees, except those of the joints in ``normalized``, such as {"gripper": (0, 100)} or
    {"elbow": (-100, 100)}: the numbers at the lower and the upper limit of the joint in the URDF.
    """

    modes = frozenset({"position"})

    def __init__(self, robot, model, normalized=None):
        self.joint_names, self._robot = model.joint_names, robot
        self._unit, self._zero = np.full(len(self.joint_names), np.pi / 180), np.zeros(len(self.joint_names))
        for name, (first, last) in (normalized or {}).items():
            row = self.joint_names.index(name)
            limits = model.driven_joints[row].limits
            self._unit[row] = (limits.upper - limits.lower) / (last - first)
            self._zero[row] = limits.lower - first * self._unit[row]

    def open(self):
        self._robot.connect(calibrate=False)

    def enable(self, on):
        self._robot.bus.enable_torque() if on else self._robot.bus.disable_torque()

    def read(self, stamp):
        observation = self._robot.get_observation()
        numbers = np.array([observation[f"{name}.pos"] for name in self.joint_names])
        return JointReading(self._zero + self._unit * numbers)

    def write(self, setpoint):
        numbers = ((setpoint.positions - self._zero) / self._unit).tolist()
        keys = [f"{name}.pos" for name in self.joint_names]
        self._robot.send_action(dict(zip(keys, numbers, strict=True)))

    def stop(self, how):
        self.write(self.read(0)) if how == "hold" else self.enable(False)

    def close(self):
        if self._robot.is_connected:
            self._robot.disconnect()
