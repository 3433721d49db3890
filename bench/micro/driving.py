"""A driver host at 1 kHz: from a command or a stop in another process to the driver.

The host drives a simulated panda (Pinocchio's dynamics, 8 rad/s^2). ``send to write`` ends with the first
``write`` that accelerates in the direction of the command; commands come at random instants, so that half a
period of the median is the wait for a tick. ``stop to driver`` is measured while the commander also
publishes 16 kB samples as fast as it can over the same link. The own work of a tick is the thread's CPU
time from the end of the driver's ``read`` to its ``write``; a host's report has its lateness.

Instants are on the monotonic clock, which the processes of a machine share. Real-time scheduling needs
CAP_SYS_NICE and CAP_IPC_LOCK.
"""

from __future__ import annotations

import os
import random
import sys
import tempfile
import threading
import time
from bisect import bisect_left
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple

import zenoh

from bench.micro.form import Row, result_of, running_role, send_event
from bench.process import free_ports
from zstate import JointReading, RobotModel, connect, load_model
from zstate.driving import Commander, DriverHost, Limits, Setpoint, SimulatedDriver, stop
from zstate.driving.driver import StopMode
from zstate.net.session import Session

ROBOT, JOINT = "panda", "panda_joint1"
REACH = 2.5
ACCELERATION = 8.0
RATE_HZ = 1000.0
TTL_S = 0.1
COMMANDS, COMMAND_EVERY_S = 500, 0.02
STOPS = 100
FLOOD_KEY, FLOOD_BYTES = "bench/flood", 16_384
WITHIN_S = 20.0


class TimedDriver(SimulatedDriver):
    """A simulated robot that starts amid its limits, and keeps the instants [ns] of its calls."""

    def __init__(self, model: RobotModel, limits: Limits) -> None:
        super().__init__(model, "dynamics", start=0.5 * (limits.lower + limits.upper))
        self.writes: list[int] = []
        self.velocities: list[float] = []
        """The velocity of the first joint at each write."""
        self.stops: list[int] = []
        self.own_us: list[float] = []
        """CPU time of each tick from ``read`` to ``write``."""
        self._left_at = 0

    def open(self) -> None:
        """Hold the joints, as brakes do: without torque they would fall until the first command."""
        self.enable(on=True)

    def read(self, stamp: int) -> JointReading:
        """The joints at ``stamp`` [ns]; a tick begins with it."""
        reading = super().read(stamp)
        self._left_at = time.thread_time_ns()
        return reading

    def write(self, setpoint: Setpoint) -> None:
        """The next target of all joints."""
        self.own_us.append((time.thread_time_ns() - self._left_at) * 1e-3)
        self.writes.append(time.monotonic_ns())
        self.velocities.append(float(setpoint.velocities[0]))
        super().write(setpoint)

    def stop(self, how: StopMode) -> None:
        """Hold the joints, or switch their torque off."""
        self.stops.append(time.monotonic_ns())
        super().stop(how)


class Opened(NamedTuple):
    """The session and driver of a host, and the endpoint at which its session listens."""

    session: Session
    driver: TimedDriver
    endpoint: str


def measure(realtime: str = "fifo") -> Iterator[Row]:
    """Rows of commands and stops; ``realtime`` is none, fifo or spin."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_STATE_HOME"] = folder  # stops are kept there
        yield from commands(realtime)
        yield from stops(realtime)


def commands(realtime: str) -> Iterator[Row]:
    """From ``send`` to ``write``."""
    with running_host(realtime) as (_, driver, endpoint), running_role(send, endpoint=endpoint) as sender:
        sent = result_of(sender, WITHIN_S + 3.0 * COMMANDS * COMMAND_EVERY_S)
    found_ms: list[float] = []
    for at, towards in sent:
        for row in range(bisect_left(driver.writes, at), len(driver.writes)):
            if (driver.velocities[row] - driver.velocities[row - 1]) * towards > 0.0:
                found_ms.append((driver.writes[row] - at) * 1e-6)
                break
    yield Row(f"send to write, {len(found_ms)} of {len(sent)} commands", "ms", found_ms)
    yield Row("own work of a tick", "us", driver.own_us)


def stops(realtime: str) -> Iterator[Row]:
    """From ``stop`` to the driver's ``stop`` on a full link."""
    with running_host(realtime) as (session, driver, endpoint):
        # A ring takes the samples without the interpreter, for which the loop would have to wait.
        subscriber = session.zenoh.declare_subscriber(FLOOD_KEY, zenoh.handlers.RingChannel(1))
        with running_role(stop_often, endpoint=endpoint) as stopper:
            found = result_of(stopper, WITHIN_S + 1.0 * STOPS)
        subscriber.undeclare()
    delays_ms = [(driver.stops[bisect_left(driver.stops, at)] - at) * 1e-6 for at in found["sent"]]
    yield Row("stop to driver, on a full link", "ms", delays_ms)
    yield Row("flood on that link", "MB/s", [found["flooded"] * FLOOD_BYTES / found["span_s"] * 1e-6])


@contextmanager
def running_host(realtime: str) -> Iterator[Opened]:
    """A host whose loop runs in a thread."""
    model = load_model(ROBOT)
    limits = Limits.of(model, acceleration=ACCELERATION)
    driver = TimedDriver(model, limits)
    (port,) = free_ports(1)
    options = {"rate_hz": RATE_HZ, "ttl_s": TTL_S, "limits": limits}
    options["realtime"] = None if realtime == "none" else realtime
    with (
        connect(listen=f"tcp/127.0.0.1:{port}") as session,
        DriverHost(session, driver, model, **options) as host,
    ):
        thread = threading.Thread(target=host.run)
        thread.start()
        try:
            yield Opened(session, driver, f"tcp/127.0.0.1:{port}")
        finally:
            host.close()
            thread.join()


@contextmanager
def commander(endpoint: str) -> Iterator[tuple[Session, Commander]]:
    """A commander whose driver is known."""
    with (
        connect(mode="peer", endpoints=endpoint) as session,
        Commander(session, ROBOT, program="bench") as arm,
    ):
        arm.wait_for_driver(WITHIN_S)
        send_event("ready")
        yield session, arm


def send(endpoint: str) -> list[tuple[int, float]]:
    """Sends commands at random instants, in alternating directions."""
    sent: list[tuple[int, float]] = []
    with commander(endpoint) as (_, arm):
        for number in range(COMMANDS):
            sent.append((time.monotonic_ns(), direction(number)))
            arm.send({JOINT: direction(number)})
            time.sleep(random.uniform(0.5, 1.5) * COMMAND_EVERY_S)
    return sent[COMMANDS // 10 :]


def stop_often(endpoint: str) -> dict[str, Any]:
    """Stops the moving robot again and again, on a link that is full."""
    sent: list[int] = []
    flooded = 0
    sys.setswitchinterval(1e-4)

    def flood(publisher: zenoh.Publisher) -> None:
        nonlocal flooded
        payload = bytes(FLOOD_BYTES)
        with suppress(zenoh.ZError):  # the session is closed
            while True:
                publisher.put(payload)
                flooded += 1

    with commander(endpoint) as (session, arm):
        publisher = session.zenoh.declare_publisher(FLOOD_KEY)
        threading.Thread(target=flood, args=(publisher,), daemon=True).start()
        begin = time.monotonic()
        for number in range(STOPS):
            arm.send({JOINT: direction(number)})
            while arm.wait_for_driver(WITHIN_S).state != "active":
                time.sleep(0.005)
                arm.send({JOINT: direction(number)})
            sent.append(time.monotonic_ns())
            stop(session, ROBOT, timeout_s=WITHIN_S)
            arm.release(WITHIN_S)
        return {"sent": sent, "flooded": flooded, "span_s": time.monotonic() - begin}


def direction(number: int) -> float:
    """A far position, on the other side for each ``number``."""
    return REACH if number % 2 else -REACH
