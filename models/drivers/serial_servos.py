"""Dynamixel servos of the X series on a serial bus, by Robotis' SDK: pip install dynamixel-sdk."""

from typing import Literal

import dynamixel_sdk as dxl
from numpy.typing import ArrayLike

from zstate import JointReading
from zstate.driving import Calibration, Setpoint

TORQUE, GOAL, POSITION = 64, 116, 132  # addresses in the control table


class SerialServos:
    """The servos ``ids`` move the joints. A lost write raises nothing: the next tick repeats it."""

    modes: frozenset[Literal["position"]] = frozenset({"position"})

    def __init__(
        self, port: str, joint_names: tuple[str, ...], ids: list[int], latency_ms: int = 16, **its: ArrayLike
    ) -> None:
        self.joint_names, self._ids = joint_names, ids
        self._encoders = Calibration(4096, **{"zero": 2048, **its})  # zero, sign, ratio
        self._port, self._bus = dxl.PortHandler(port), dxl.PacketHandler(2.0)
        dxl.port_handler.LATENCY_TIMER = latency_ms  # of the USB adapter: replies may take twice as long

    def open(self) -> None:
        self._port.openPort()

    def enable(self, on: bool) -> None:
        if on:
            self.stop("hold")  # the goals may be old
        for reply in [self._bus.write1ByteTxRx(self._port, one, TORQUE, on) for one in self._ids]:
            self._check(*reply)

    def read(self, stamp: int) -> JointReading:
        self._port.is_using = False  # the SDK leaves it set when the port raises
        group = dxl.GroupSyncRead(self._port, self._bus, POSITION, 4)
        for one in self._ids:
            group.addParam(one)
        self._check(group.txRxPacket())
        counts = [(group.getData(one, POSITION, 4) ^ 2**31) - 2**31 for one in self._ids]  # signed
        return JointReading(self._encoders.to_positions(counts))

    def write(self, setpoint: Setpoint | JointReading) -> None:
        group = dxl.GroupSyncWrite(self._port, self._bus, GOAL, 4)
        for one, count in zip(self._ids, self._encoders.to_counts(setpoint.positions), strict=True):
            group.addParam(one, int(count).to_bytes(4, "little", signed=True))
        self._check(group.txPacket())

    def stop(self, how: str) -> None:
        self.write(self.read(0)) if how == "hold" else self.enable(False)

    def close(self) -> None:
        if self._port.is_open:
            self._port.closePort()

    def _check(self, result: int, error: int = 0) -> None:
        if result != dxl.COMM_SUCCESS or error:
            raise ConnectionError(self._bus.getTxRxResult(result) + self._bus.getRxPacketError(error))
