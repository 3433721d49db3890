"""A robot that is commanded over a slow link, and for how long it moves after its commander has failed.

As a program: the results of several trials as JSON, one a line. Arguments: bytes per second, commands per
second, "killed", "frozen" or "cut", number of trials.
"""

from __future__ import annotations

import json
import math
import mmap
import os
import struct
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Literal, NamedTuple

from helpers.processes import Child, find_free_port, until
from helpers.robots import RRBOT
from helpers.slow_relay import SlowRelay

from zstate import connect
from zstate.driving import DriverHost, Limits, SimulatedDriver

Fault = Literal["killed", "frozen", "cut"]

TTL_S = 0.25
RATE_HZ = 100.0
COMMAND_BYTES = 180
"""At least what a command of one joint takes on the link."""

_CUT_S = 1.5
"""The link is cut for as many commands as take this time."""

_QUIET_S = 1.5
"""A link that has carried nothing for so long has no old commands left."""

_MOST_S = 60.0

COMMANDER = """
    import mmap, struct, sys, time
    from zstate import connect
    from zstate.driving import Commander
    endpoint, rate_hz, path = sys.argv[1], float(sys.argv[2]), sys.argv[3]
    with (
        open(path, "r+b") as file,
        connect(mode="client", endpoints=endpoint) as session,
        Commander(session, "arm", program="teleop") as arm,
    ):
        shared = mmap.mmap(file.fileno(), 16)
        arm.wait_for_driver(20.0)
        print("commanding", flush=True)
        begin, number = time.monotonic(), 0
        while True:
            sent = time.time_ns()
            arm.send({"shoulder": 1e3})
            number += 1
            shared[:] = struct.pack("<qq", sent, number)
            time.sleep(max(0.0, begin + number / rate_hz - time.monotonic()))
"""


class Result(NamedTuple):
    """For how long joints moved after the last command [s], and the worst tick of the host [s].

    ``active`` is the part of the time of commanding in which they moved. ``waited_s`` is for how long the
    link still carried what the commander had sent.
    """

    moved_s: float
    tick_s: float
    active: float
    waited_s: float
    sent: int
    refused: dict[str, int]


class _Arm(SimulatedDriver):
    """Keeps the stamp of each setpoint that moves."""

    def __init__(self) -> None:
        super().__init__(RRBOT, "mirror")
        self.moved: list[int] = []
        self._last = None

    def write(self, setpoint) -> None:
        if self._last is not None and (setpoint.positions != self._last).any():
            self.moved.append(setpoint.stamp)
        self._last = setpoint.positions.copy()
        super().write(setpoint)


def trial(bytes_per_s: float, command_hz: float, fault: Fault, drive_s: float) -> Result:
    """Sends commands for ``drive_s`` [s], ends their commander, and waits until nothing is under way."""
    port, driver = find_free_port(), _Arm()
    with (
        tempfile.NamedTemporaryFile() as file,
        SlowRelay(port, bytes_per_s) as relay,
        connect(mode="router", listen=f"tcp/127.0.0.1:{port}") as session,
        DriverHost(
            session,
            driver,
            RRBOT,
            "arm",
            rate_hz=RATE_HZ,
            ttl_s=TTL_S,
            limits=Limits.of(RRBOT, velocity=2.0, acceleration=math.inf),  # at rest without time to brake
        ) as host,
    ):
        file.write(bytes(16))
        file.flush()
        shared = mmap.mmap(file.fileno(), 16)

        def sent() -> tuple[int, int]:
            """The stamp of the commander's last command, and the number of all."""
            return struct.unpack("<qq", shared[:])

        thread = threading.Thread(target=host.run)
        thread.start()
        commander = Child(COMMANDER, relay.endpoint, str(command_hz), file.name)
        try:
            commander.line(40.0)
            began = time.time_ns()
            until(lambda: sent()[1] >= drive_s * command_hz, _MOST_S)
            failed_at = time.monotonic()
            if fault == "cut":
                relay.is_cut = True
            elif fault == "killed":
                commander.kill()
            else:
                commander.freeze()
            last, number = sent()
            if fault == "cut":
                until(lambda: sent()[1] >= number + _CUT_S * command_hz, _MOST_S)
                commander.kill()
                relay.is_cut = False
                healed_at = time.monotonic()
                until(lambda: time.monotonic() - healed_at > _QUIET_S)
            until(
                lambda: time.monotonic() - max(relay.passed_at, failed_at) > _QUIET_S,
                timeout_s=_MOST_S,
            )
            waited_s = relay.passed_at - failed_at
        finally:
            commander.kill()
            host.close()
            thread.join()
        report = host.report()
    period_s = 1.0 / RATE_HZ
    active = sum(began <= stamp <= last for stamp in driver.moved) * period_s / ((last - began) * 1e-9)
    moved_s = (driver.moved[-1] - last) * 1e-9 if driver.moved else 0.0
    tick_s = report.lateness_us.max * 1e-6 + period_s
    return Result(moved_s, tick_s, active, waited_s, number, dict(report.refused))


def main() -> None:
    bytes_per_s, command_hz, fault, count = (
        float(sys.argv[1]),
        float(sys.argv[2]),
        sys.argv[3],
        int(sys.argv[4]),
    )
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_STATE_HOME"] = str(Path(folder))
        for number in range(count):
            result = trial(bytes_per_s, command_hz, fault, 3.0 + 0.37 * (number % 7))  # pyright: ignore
            print(json.dumps([bytes_per_s, command_hz, fault, result._asdict()]), flush=True)


if __name__ == "__main__":
    main()
