"""An arm of Universal Robots, by ur_rtde: pip install ur-rtde. Its power is on, its brakes are released."""

from typing import Any, Literal

import numpy as np
from rtde_control import RTDEControlInterface
from rtde_receive import RTDEReceiveInterface

from zstate import JointReading
from zstate.driving import Setpoint

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")


class UrRtdeArm:
    """The arm at ``address``. ``rate_hz`` is that of the host, at most 500, or 125 before the e-Series."""

    joint_names = tuple(f"{joint}_joint" for joint in JOINTS)
    modes: frozenset[Literal["position"]] = frozenset({"position"})

    def __init__(self, address: str, rate_hz: float) -> None:
        self._address, self._period_s = address, 1.0 / rate_hz
        self._newest: float | None = None
        self._state: Any = None  # ur_rtde has no types
        self._control: Any = None

    def open(self) -> None:
        self._state = RTDEReceiveInterface(self._address)
        self._control = RTDEControlInterface(self._address)

    def enable(self, on: bool) -> None:
        if on and not self._control.isProgramRunning():  # such as after a protective stop
            self._check(self._control.reuploadScript(), "reuploadScript")

    def read(self, stamp: int) -> JointReading | None:
        self._check(self._state.isConnected(), "isConnected")
        before, self._newest = self._newest, self._state.getTimestamp()
        if self._newest == before:
            return None
        return JointReading(np.array(self._state.getActualQ()), np.array(self._state.getActualQd()))

    def write(self, setpoint: Setpoint) -> None:
        target = setpoint.positions.tolist()
        self._check(self._control.servoJ(target, 0.0, 0.0, self._period_s, 0.1, 300.0), "servoJ")

    def stop(self, how: str) -> None:
        self._check(self._control.servoStop(), "servoStop")  # also for "relax": the arm keeps its power

    def close(self) -> None:
        for connection in (self._control, self._state):
            if connection is not None:
                connection.disconnect()

    def _check(self, is_done: bool, call: str) -> None:
        if not is_done:
            raise ConnectionError(f"{call} of the arm at {self._address} has failed")
