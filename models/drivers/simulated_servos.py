"""Simulated Dynamixel servos of the X series on a pseudo-terminal, for drivers without hardware.

``python simulated_servos.py ./servos`` simulates two servos on one cable, with IDs 1 and 2 and the joints
in the middle. Programs open ./servos like /dev/ttyUSB0. The signal SIGUSR1 unplugs the cable, which the
programs notice as an I/O error, and plugs it in again; the servos keep their state.

The bytes are those of Robotis' Protocol 2.0 (https://emanual.robotis.com/docs/en/dxl/protocol2/): ping, read,
write, sync read and sync write, with byte stuffing and CRC. A packet with a wrong CRC has no reply.
"""

from __future__ import annotations

import argparse
import math
import os
import pty
import random
import select
import signal
import struct
import sys
import time
import tty
from collections.abc import Iterable, Iterator
from pathlib import Path

HEADER = b"\xff\xff\xfd\x00"
BROADCAST = 0xFE
PING, READ, WRITE, STATUS, SYNC_READ, SYNC_WRITE = 0x01, 0x02, 0x03, 0x55, 0x82, 0x83

# Addresses of the control table.
TORQUE, WATCHDOG, GOAL, VELOCITY, POSITION, TABLE_SIZE = 64, 98, 116, 128, 132, 147

ACCESS_ERROR = 0x07
EXPIRED = 0xFF
"""The state of the watchdog after its time: goals are refused until 0 is written to it."""

WATCHDOG_STEP_S = 0.02
VELOCITY_STEP = 0.229 / 60.0 * 4096.0  # counts per second
LAG_S = 0.02
"""Time constant with which a servo follows its goal."""


def crc16(data: bytes) -> int:
    """CRC-16 with polynomial 0x8005, from 0, not reflected."""
    value = 0
    for byte in data:
        value = ((value << 8) ^ _CRC_OF_BYTE[(value >> 8) ^ byte]) & 0xFFFF
    return value


def _crc_of_byte(byte: int) -> int:
    value = byte << 8
    for _ in range(8):
        value = (value << 1) ^ (0x8005 if value & 0x8000 else 0)
    return value & 0xFFFF


_CRC_OF_BYTE = [_crc_of_byte(byte) for byte in range(256)]


def encode(number: int, instruction: int, parameters: bytes) -> bytes:
    """The packet of or for the servo with that ID."""
    body = (bytes([instruction]) + parameters).replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
    packet = HEADER + struct.pack("<BH", number, len(body) + 2) + body
    return packet + struct.pack("<H", crc16(packet))


def split(buffer: bytearray) -> Iterator[bytes]:
    """Removes the whole packets from the start of ``buffer``, and what is between them."""
    while (start := buffer.find(HEADER)) >= 0:
        del buffer[:start]
        size = max(10, 7 + int.from_bytes(buffer[5:7], "little"))
        if len(buffer) < size:
            return
        yield bytes(buffer[:size])
        del buffer[:size]


class Servo:
    """One servo: a control table, and a position that follows its goal with a lag while it has torque."""

    def __init__(self) -> None:
        self._table = bytearray(TABLE_SIZE)
        self._position = 2048.0
        self._fed_at = 0.0
        self._put(POSITION, 2048)
        self._put(GOAL, 2048)

    def read(self, address: int, size: int) -> bytes:
        return bytes(self._table[address : address + size])

    def write(self, address: int, data: bytes) -> int:
        """Returns the error of the status packet."""
        if address == GOAL and self._table[WATCHDOG] == EXPIRED:
            return ACCESS_ERROR
        self._table[address : address + len(data)] = data
        return 0

    def feed(self, now: float) -> None:
        """The watchdog starts again, at ``now`` [s]."""
        self._fed_at = now

    def advance(self, dt_s: float, now: float) -> None:
        watchdog = self._table[WATCHDOG]
        if watchdog not in (0, EXPIRED) and now - self._fed_at > watchdog * WATCHDOG_STEP_S:
            self._table[WATCHDOG] = EXPIRED
            self._put(GOAL, round(self._position))
        (goal,) = struct.unpack_from("<i", self._table, GOAL)
        step = (goal - self._position) * -math.expm1(-dt_s / LAG_S) if self._table[TORQUE] else 0.0
        self._position += step
        self._put(POSITION, round(self._position))
        self._put(VELOCITY, round(step / dt_s / VELOCITY_STEP) if dt_s > 0.0 else 0)

    def _put(self, address: int, value: int) -> None:
        struct.pack_into("<i", self._table, address, value)


class ServoBus:
    """Servos with IDs from 1 at a pseudo-terminal, to which ``path`` is a link while the cable is plugged in.

    Each byte, in both directions, is corrupted with the probability ``noise``.
    """

    def __init__(self, path: Path, servos: int = 2, noise: float = 0.0) -> None:
        self.servos = {number: Servo() for number in range(1, servos + 1)}
        self.sync_reads = self.corrupted_sync_reads = 0
        self._path = path
        self._noise = noise
        self._random = random.Random(0)
        self._received = bytearray()
        self._advanced_at = time.monotonic()
        self._ends: tuple[int, int] | None = None

    def plug(self) -> None:
        """Plugs the cable in, or unplugs it."""
        if self._ends is not None:
            self.unplug()
            return
        self._path.unlink(missing_ok=True)
        self._ends = pty.openpty()
        tty.setraw(self._ends[1])
        self._received.clear()
        self._path.symlink_to(os.ttyname(self._ends[1]))

    def unplug(self) -> None:
        """Closes the pseudo-terminal: reading and writing fail in programs that have it open."""
        if self._ends is None:
            return
        self._path.unlink(missing_ok=True)
        for end in self._ends:
            os.close(end)
        self._ends = None

    def serve(self, wait_s: float = 0.02) -> None:
        """Replies to what arrives within ``wait_s``."""
        ready, _, _ = select.select([] if self._ends is None else self._ends[:1], [], [], wait_s)
        now = time.monotonic()
        for servo in self.servos.values():
            servo.advance(now - self._advanced_at, now)
        self._advanced_at = now
        for end in ready:
            self._received += os.read(end, 4096)
            for packet in split(self._received):
                os.write(end, self._exchange(packet, now))

    def _exchange(self, packet: bytes, now: float) -> bytes:
        """The bytes of the replies to ``packet``."""
        received = self._corrupted(packet)
        is_intact = crc16(received[:-2]) == int.from_bytes(received[-2:], "little")
        reply = b"".join(self._replies(received, now)) if is_intact else b""
        sent = self._corrupted(reply)
        if packet[7] == SYNC_READ:
            self.sync_reads += 1
            self.corrupted_sync_reads += not is_intact or sent != reply
        return sent

    def _corrupted(self, data: bytes) -> bytes:
        if not self._noise:
            return data
        chance = self._random
        return bytes(
            byte ^ chance.randrange(1, 256) if chance.random() < self._noise else byte for byte in data
        )

    def _replies(self, packet: bytes, now: float) -> Iterator[bytes]:
        number, instruction = packet[4], packet[7]
        parameters = packet[8:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
        addressed = self._addressed([number])
        for servo in self.servos.values() if number == BROADCAST else addressed.values():
            servo.feed(now)
        if instruction == PING:
            for one in self.servos if number == BROADCAST else addressed:
                yield encode(one, STATUS, b"\x00\x06\x04\x26")
        elif instruction == READ:
            yield from self._read(parameters, addressed)
        elif instruction == WRITE:
            for one, servo in addressed.items():
                error = servo.write(int.from_bytes(parameters[:2], "little"), parameters[2:])
                yield encode(one, STATUS, bytes([error]))
        elif instruction == SYNC_READ:
            yield from self._read(parameters, self._addressed(parameters[4:]))
        elif instruction == SYNC_WRITE:
            self._sync_write(parameters)

    def _addressed(self, numbers: Iterable[int]) -> dict[int, Servo]:
        return {number: self.servos[number] for number in numbers if number in self.servos}

    def _read(self, parameters: bytes, servos: dict[int, Servo]) -> Iterator[bytes]:
        address, size = struct.unpack_from("<HH", parameters)
        for number, servo in servos.items():
            yield encode(number, STATUS, b"\x00" + servo.read(address, size))

    def _sync_write(self, parameters: bytes) -> None:
        address, size = struct.unpack_from("<HH", parameters)
        for start in range(4, len(parameters), size + 1):
            for servo in self._addressed(parameters[start : start + 1]).values():
                servo.write(address, parameters[start + 1 : start + 1 + size])


def main() -> None:
    """Serves until Ctrl-C or SIGTERM."""
    parser = argparse.ArgumentParser(description="simulated Dynamixel servos on a pseudo-terminal")
    parser.add_argument("path", type=Path, help="of the serial port that programs open")
    parser.add_argument("--servos", type=int, default=2, help="their number; default 2")
    parser.add_argument("--noise", type=float, default=0.0, help="fraction of bytes to corrupt; default 0")
    arguments = parser.parse_args()
    if arguments.path.exists() and not arguments.path.is_symlink():
        parser.error(f"{arguments.path} exists, and is not the link of a simulated port")
    bus = ServoBus(arguments.path, arguments.servos, arguments.noise)
    signals: list[int] = []
    signal.signal(signal.SIGUSR1, lambda number, _: signals.append(number))
    signal.signal(signal.SIGTERM, lambda _number, _frame: sys.exit())
    bus.plug()
    print(f"{arguments.servos} servos at {arguments.path}; kill -USR1 {os.getpid()} unplugs them", flush=True)
    try:
        while True:
            bus.serve()
            if signals:
                signals.clear()
                bus.plug()
                print("plugged in" if arguments.path.is_symlink() else "unplugged", flush=True)
    except KeyboardInterrupt:
        pass
    finally:
        bus.unplug()
        if arguments.noise:
            print(f"{bus.sync_reads} sync reads, {bus.corrupted_sync_reads} of them corrupted")


if __name__ == "__main__":
    main()
