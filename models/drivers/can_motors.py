"""ODrive motor controllers on a CAN bus (CANSimple frames), by python-can: pip install python-can."""

import struct
import time
from collections.abc import Sequence
from typing import Any, Literal

import can
import numpy as np

from zstate import JointReading
from zstate.driving import Setpoint

AXIS_STATE, ESTIMATES, INPUT_POS = 0x007, 0x009, 0x00C  # commands; the ID of a frame is node * 32 + command


class CanMotors:
    """``motors[joint]``: a node ID, and turns of the motor per turn of the joint; ``bus`` as for can.Bus."""

    modes: frozenset[Literal["position"]] = frozenset({"position"})

    def __init__(self, motors: dict[str, tuple[int, float]], timeout_s: float = 0.1, **bus: Any) -> None:
        self.joint_names, self._timeout_s, self._options = tuple(motors), timeout_s, bus
        self._bus: Any = None  # can.BusABC while it is open
        self._nodes, ratios = zip(*motors.values(), strict=True)
        self._turns = np.array(ratios) / (2 * np.pi)  # of the motors, per radian of the joints

    def open(self) -> None:
        filters = [{"can_id": node * 32 + ESTIMATES, "can_mask": 0x7FF} for node in self._nodes]
        self._bus = can.Bus(can_filters=filters, **self._options)

    def enable(self, on: bool) -> None:
        if on:
            self.stop("hold")  # the setpoints of the motors may be old
        self._send(AXIS_STATE, [struct.pack("<I", 8 if on else 1)] * len(self._nodes))  # closed loop, or idle

    def read(self, stamp: int) -> JointReading:  # blocks until each motor has sent: they set the pace
        newest: dict[int, tuple[float, float]] = {}
        motors, end = len(self._nodes), time.monotonic() + self._timeout_s
        while frame := self._bus.recv(max(0.0, end - time.monotonic()) if len(newest) < motors else 0.0):
            newest[frame.arbitration_id // 32] = struct.unpack("<ff", frame.data)
        if len(newest) < motors:
            raise TimeoutError(f"only nodes {sorted(newest)} have sent estimates within {self._timeout_s} s")
        turns, rates = np.array([newest[node] for node in self._nodes]).T
        return JointReading(turns / self._turns, rates / self._turns)

    def write(self, setpoint: Setpoint | JointReading) -> None:
        self._send(INPUT_POS, [struct.pack("<fhh", x, 0, 0) for x in setpoint.positions * self._turns])

    def stop(self, how: str) -> None:
        self.write(self.read(0)) if how == "hold" else self.enable(False)

    def close(self) -> None:
        if self._bus is not None:
            self._bus.shutdown()
        self._bus = None

    def _send(self, command: int, payloads: Sequence[bytes]) -> None:
        for node, data in zip(self._nodes, payloads, strict=True):
            self._bus.send(can.Message(arbitration_id=node * 32 + command, data=data, is_extended_id=False))
