"""A driver host on a serial bus with corrupted bytes: which faults it counts, and what its loop does.

Simulated servos (models/drivers/simulated_servos.py) run in a process of their own and corrupt each byte, in
both directions, with the probability ``--noise``; they print the sync reads of which a byte was corrupted.
The host counts the calls of the driver that failed, also because a reply came too late. A commander moves all
joints. Needs dynamixel-sdk.
"""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from bench.micro.form import Row, chain_urdf
from bench.process import ROOT
from models.drivers.serial_servos import SerialServos
from zstate import connect, load_model
from zstate.driving import Commander, DriverHost
from zstate.net.session import Session

SIMULATOR = ROOT / "models" / "drivers" / "simulated_servos.py"
PATIENCE = 400
"""Faults in a row after which the host gives up: of two readings in three a byte is corrupted."""


def measure(
    seconds: float = 60.0, noise: float = 0.01, servos: int = 6, rate: float = 200.0
) -> Iterator[Row]:
    """Rows of the host's report."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "servos")
        command = [sys.executable, str(SIMULATOR), str(path), "--servos", str(servos), "--noise", str(noise)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as simulator:
            assert simulator.stdout
            try:
                simulator.stdout.readline()
                yield from drive(path, servos, rate, seconds)
            finally:
                simulator.terminate()
            print(simulator.stdout.read().strip())


def drive(path: Path, servos: int, rate_hz: float, seconds: float) -> Iterator[Row]:
    """Runs a host and a commander."""
    joints = tuple(f"joint{number}" for number in range(1, servos + 1))
    driver = SerialServos(str(path), joints, list(range(1, servos + 1)), latency_ms=0)
    options = {"rate_hz": rate_hz, "faults_allowed": PATIENCE, "following_error": 1.0}
    ended = threading.Event()
    with (
        connect() as session,
        connect() as other,
        DriverHost(session, driver, load_model(chain_urdf(servos)), **options) as host,
    ):
        commander = threading.Thread(target=command, args=(other, joints, ended))
        commander.start()
        try:
            report = host.run(seconds=seconds)
        finally:
            ended.set()
            commander.join()
    assert report.rate is not None
    yield Row("ticks", "", [report.rate.ticks])
    yield Row("faults counted", "", [report.faults])
    yield Row("setpoints written", "", [report.written])
    for name in ("lateness_us", "read_us", "write_us"):
        values = getattr(report, name)
        yield Row(f"{name.removesuffix('_us')}, median", "us", [values.p50])
        yield Row(f"{name.removesuffix('_us')}, p99", "us", [values.p99])


def command(session: Session, joints: tuple[str, ...], ended: threading.Event) -> None:
    """Lets all joints swing by half a radian, at 50 Hz."""
    with Commander(session, "chain") as commander:
        commander.wait_for_driver(10.0)
        while not ended.wait(0.02):
            commander.send(dict.fromkeys(joints, 0.5 * math.sin(time.monotonic())))
