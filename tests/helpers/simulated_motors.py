"""Two ODrive motor controllers on a CAN bus, by CANSimple frames."""

from __future__ import annotations

import struct
import threading
from typing import Any

import can

NODES = (3, 4)


class SimulatedMotors:
    """Two ODrives: they send estimates every 5 ms, and go to their input positions in closed loop."""

    def __init__(self, **bus: Any) -> None:
        self.turns = dict.fromkeys(NODES, 0.0)
        self.inputs = dict.fromkeys(NODES, 1.0)
        """From before, where the motors are not."""
        self.states = dict.fromkeys(NODES, 1)
        self.silent: set[int] = set()
        self._bus = can.Bus(**bus)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> SimulatedMotors:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        self._bus.shutdown()

    def _run(self) -> None:
        while not self._ended.wait(0.005):
            while (frame := self._bus.recv(0.0)) is not None:
                self._obey(frame)
            for node in NODES:
                if self.states[node] == 8:
                    self.turns[node] += 0.5 * (self.inputs[node] - self.turns[node])
                if node not in self.silent:
                    estimates = struct.pack("<ff", self.turns[node], 0.0)
                    self._bus.send(
                        can.Message(arbitration_id=node << 5 | 0x09, data=estimates, is_extended_id=False)
                    )

    def _obey(self, frame: can.Message) -> None:
        node, command = frame.arbitration_id >> 5, frame.arbitration_id & 0x1F
        if command == 0x0C:
            self.inputs[node], *_ = struct.unpack("<fhh", frame.data)
        elif command == 0x07:
            (self.states[node],) = struct.unpack("<I", frame.data)
