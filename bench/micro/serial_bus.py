"""A driver host on a serial bus with corrupted bytes: which faults it counts, and what its loop does.

    python -m bench.micro.serial_bus [--seconds 60] [--noise 0.01] [--servos 6] [--rate 200]

Simulated servos (models/drivers/simulated_servos.py) run in a process of their own and corrupt each byte, in
both directions, with the probability ``--noise``. They count the sync reads of which a byte was corrupted;
the host counts the calls of the driver that failed, also because a reply came too late. A commander moves
all joints. Needs dynamixel-sdk.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from models.drivers.serial_servos import SerialServos
from zstate import connect, load_model
from zstate.driving import Commander, DriverHost

SIMULATOR = Path(__file__).parents[2] / "models" / "drivers" / "simulated_servos.py"
PATIENCE = 400
"""Faults in a row after which the host gives up: of two readings in three a byte is corrupted."""


def main() -> None:
    """Print the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--noise", type=float, default=0.01)
    parser.add_argument("--servos", type=int, default=6)
    parser.add_argument("--rate", type=float, default=200.0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "servos")
        arguments = [str(path), "--servos", str(options.servos), "--noise", str(options.noise)]
        with subprocess.Popen(
            [sys.executable, str(SIMULATOR), *arguments], stdout=subprocess.PIPE, text=True
        ) as simulator:
            assert simulator.stdout
            try:
                simulator.stdout.readline()
                drive(path, options.servos, options.rate, options.seconds)
            finally:
                simulator.terminate()
            print(simulator.stdout.read().strip())


def drive(path: Path, servos: int, rate_hz: float, seconds: float) -> None:
    """Run a host and a commander, and print the report of the host."""
    joints = tuple(f"joint{number}" for number in range(1, servos + 1))
    driver = SerialServos(str(path), joints, range(1, servos + 1), latency_ms=0)
    ended = threading.Event()
    with connect() as session, connect() as other:
        options = {"rate_hz": rate_hz, "faults_allowed": PATIENCE, "following_error": 1.0}
        with DriverHost(session, driver, load_model(arm(joints)), **options) as host:
            commander = threading.Thread(target=command, args=(other, joints, ended))
            commander.start()
            try:
                report = host.run(seconds=seconds)
            finally:
                ended.set()
                commander.join()
    assert report.rate is not None
    print(f"{report.rate.ticks} ticks at {report.rate.rate_hz:.1f} Hz, {report.rate.skipped} skipped")
    print(f"{report.faults} faults counted, {report.written} setpoints written")
    for name in ("lateness_us", "read_us", "write_us"):
        p50, p99, most = getattr(report, name)
        print(f"{name}: {p50:.0f} p50, {p99:.0f} p99, {most:.0f} max")


def command(session, joints: tuple[str, ...], ended: threading.Event) -> None:
    """Let all joints swing by half a radian, at 50 Hz."""
    with Commander(session, "arm") as commander:
        commander.wait_for_driver(10.0)
        while not ended.wait(0.02):
            angle = 0.5 * math.sin(time.monotonic())
            commander.send(dict.fromkeys(joints, angle))


def arm(joints: tuple[str, ...]) -> str:
    """The URDF of revolute ``joints`` in a row."""
    links = "".join(f'<link name="{name}_link"/>' for name in ("base", *joints))
    parts = "".join(
        f'<joint name="{name}" type="revolute"><parent link="{parent}_link"/><child link="{name}_link"/>'
        f'<axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="9" velocity="4"/></joint>'
        for parent, name in zip(("base", *joints), joints, strict=False)
    )
    return f'<robot name="arm">{links}{parts}</robot>'


if __name__ == "__main__":
    main()
