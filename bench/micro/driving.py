"""The control loop of a driver host: lateness, work of a tick, commands, stops, and commanders that end.

    python -m bench.micro.driving [WORD...] [--seconds 60] [--times 20] [--realtime fifo]

A host drives a simulated panda (Pinocchio's dynamics, 8 rad/s^2) at 1 kHz; its commander is another process.
Without words all of these are measured:

- **lateness**: how long ticks begin after their deadlines, for ``--seconds`` with each kind of ``realtime``.
  Sigma is the standard deviation of the rates of single periods. The own work of a tick is the thread's CPU
  time from the end of the driver's ``read`` to its ``write``; in brackets all of the thread's CPU time
  outside of both, which includes the wait for the tick and so is not shown for "spin".
- **commands**: from ``send`` in the other process to the first ``write`` that accelerates in its direction.
  Commands come at random instants, so that half a period of the median is the wait for a tick.
- **stops**: from ``stop`` in the other process to the driver's ``stop``, while that process publishes 16 kB
  samples as fast as it can over the same link.
- **ends**: from the end of the commander (SIGKILL, SIGSTOP, a link that carries nothing more) to the last
  setpoint that moves a joint, ``--times`` each, compared with the ttl of its commands and one tick. Here
  joints are at their setpoints and have no limit of acceleration: with one they would brake after that time.

Instants are on the monotonic clock, which the processes of a machine share. Real-time scheduling needs
CAP_SYS_NICE and CAP_IPC_LOCK; ``--realtime`` is that of all but the first.
"""

from __future__ import annotations

import argparse
import math
import os
import platform
import random
import signal
import socket
import sys
import tempfile
import threading
import time
from bisect import bisect_left
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from json import dumps
from typing import NamedTuple

import numpy as np
import zenoh

import zstate
from bench.process import Process, free_ports
from zstate import JointReading, RobotModel, connect, load_model
from zstate.driving import Commander, DriverHost, Limits, Setpoint, SimulatedDriver, stop
from zstate.driving.driver import StopMode
from zstate.driving.pace import Realtime
from zstate.driving.simulated_driver import Plant
from zstate.net.session import Session

ROBOT = "panda"
JOINT = "panda_joint1"
REACH = 2.5
ACCELERATION = 8.0
RATE_HZ = 1000.0
PERIOD_MS = 1e3 / RATE_HZ
TTL_S = 0.1
COMMANDS, COMMAND_EVERY_S = 500, 0.02
STOPS = 100
FLOOD_KEY, FLOOD_BYTES = "bench/flood", 16_384
WITHIN_S = 20.0


class TimedDriver(SimulatedDriver):
    """A simulated robot that starts amid its limits, and keeps the instants [ns] of its calls."""

    def __init__(self, model: RobotModel, limits: Limits, plant: Plant) -> None:
        super().__init__(model, plant, start=0.5 * (limits.lower + limits.upper))
        self.reads: list[int] = []
        self.writes: list[int] = []
        self.velocities: list[float] = []
        """Of the first joint at each write."""
        self.moved_at = 0
        """When a setpoint was written that differs from the one before."""
        self.stops: list[int] = []
        self.own_us: list[float] = []
        """CPU time of each tick from ``read`` to ``write``."""
        self.outside_us: list[float] = []
        """CPU time from each ``write`` to the next ``read``."""
        self._left_at = 0
        self._written = np.zeros(0)

    def open(self) -> None:
        """Hold the joints, as brakes do: without torque they would fall until the first command."""
        self.enable(on=True)

    def read(self, stamp: int) -> JointReading:
        """The joints at ``stamp`` [ns]; a tick begins with it."""
        self.outside_us.append((time.thread_time_ns() - self._left_at) * 1e-3)
        self.reads.append(time.monotonic_ns())
        reading = super().read(stamp)
        self._left_at = time.thread_time_ns()
        return reading

    def write(self, setpoint: Setpoint) -> None:
        """The next target of all joints."""
        self.own_us.append((time.thread_time_ns() - self._left_at) * 1e-3)
        self.writes.append(time.monotonic_ns())
        self.velocities.append(float(setpoint.velocities[0]))
        if not np.array_equal(self._written, setpoint.positions):
            self.moved_at = self.writes[-1]
        self._written = setpoint.positions
        super().write(setpoint)
        self._left_at = time.thread_time_ns()

    def stop(self, how: StopMode) -> None:
        """Hold the joints, or switch their torque off."""
        self.stops.append(time.monotonic_ns())
        super().stop(how)


class Link:
    """Forwards one TCP connection to ``port`` until it is cut: both ends stay open and receive nothing."""

    def __init__(self, port: int) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._target = port
        self._is_cut = False
        self._ends: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        """Forward nothing from now on."""
        self._is_cut = True

    def close(self) -> None:
        """Close the connection."""
        for one in (self._listener, *self._ends):
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()

    def _accept(self) -> None:
        near, _ = self._listener.accept()
        far = socket.create_connection(("127.0.0.1", self._target))
        self._ends = [near, far]
        for one in self._ends:
            one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        threading.Thread(target=self._forward, args=(near, far), daemon=True).start()
        self._forward(far, near)

    def _forward(self, source: socket.socket, target: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(65_536):
                if not self._is_cut:
                    target.sendall(data)


class Opened(NamedTuple):
    """A driver host with its session, driver, and the port at which its session listens."""

    session: Session
    host: DriverHost
    driver: TimedDriver
    port: int


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("words", nargs="*", metavar="WORD", choices=[[], *MEASUREMENTS])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--times", type=int, default=20)
    parser.add_argument("--realtime", choices=["none", "fifo", "spin"], default="fifo")
    parser.add_argument("--role", choices=list(ROLES), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.role:
        ROLES[options.role]()
        return
    print(f"zstate {zstate.__version__} ({zstate.kernel}), Python {platform.python_version()}, ", end="")
    print(f"{platform.machine()}, {os.cpu_count()} processors; {ROBOT} at {RATE_HZ:g} Hz")
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_STATE_HOME"] = folder  # stops are kept there
        for word in options.words or MEASUREMENTS:
            MEASUREMENTS[word](options)


def measure_lateness(options: argparse.Namespace) -> None:
    """Lateness, sigma of the rate and own work, with each kind of scheduling."""
    for realtime in (None, "fifo", "spin"):
        with opened_host(realtime) as (_, host, driver, port), other_process("mover", port):
            report = host.run(seconds=options.seconds)
        assert report.rate is not None
        late = report.lateness_us
        sigma_hz = float(np.std(1e9 / np.diff(driver.reads)))
        print(
            f"lateness  {realtime or 'none':<5} p50 {late.p50:7.1f} us  p99 {late.p99:7.1f} us  "
            f"p99.9 {late.p999:7.1f} us  max {late.max:7.1f} us; sigma {sigma_hz:6.1f} Hz; "
            f"{report.rate.ticks} ticks, {report.rate.skipped} skipped, {report.written} written"
        )
        p50, p99 = np.percentile(driver.own_us, (50, 99))
        all_us = "" if realtime == "spin" else f" ({p50 + np.median(driver.outside_us):.1f} us)"
        print(
            f"own work  {realtime or 'none':<5} p50 {p50:7.1f} us{all_us}  p99 {p99:7.1f} us; driver: read "
            f"p50 {report.read_us.p50:.1f} us, write p50 {report.write_us.p50:.1f} us",
            flush=True,
        )


def measure_commands(options: argparse.Namespace) -> None:
    """From ``send`` to ``write``."""
    with running_host(options.realtime) as (_, _, driver, port), other_process("sender", port) as sender:
        sent = sender.wait_for_event("sent", WITHIN_S + 3.0 * COMMANDS * COMMAND_EVERY_S)["sent"]
    found_ms: list[float] = []
    for at, towards in sent:
        for row in range(bisect_left(driver.writes, at), len(driver.writes)):
            if (driver.velocities[row] - driver.velocities[row - 1]) * towards > 0.0:
                found_ms.append((driver.writes[row] - at) * 1e-6)
                break
    p50, p99 = np.percentile(found_ms, (50, 99))
    print(
        f"commands  {len(found_ms)} of {len(sent)}: send to write p50 {p50:.3f} ms  p99 {p99:.3f} ms  max "
        f"{max(found_ms):.3f} ms; p50 without the wait for a tick {p50 - 0.5 * PERIOD_MS:.3f} ms",
        flush=True,
    )


def measure_stops(options: argparse.Namespace) -> None:
    """From ``stop`` to the driver's ``stop`` on a full link."""
    with running_host(options.realtime) as (session, _, driver, port):
        # A ring takes the samples without the interpreter, for which the loop would have to wait.
        subscriber = session.zenoh.declare_subscriber(FLOOD_KEY, zenoh.handlers.RingChannel(1))
        with other_process("stopper", port) as stopper:
            message = stopper.wait_for_event("stopped", WITHIN_S + 1.0 * STOPS)
        subscriber.undeclare()
    sent, flooded, span_s = message["sent"], message["flooded"], message["span_s"]
    delays_ms = [(driver.stops[bisect_left(driver.stops, at)] - at) * 1e-6 for at in sent]
    p50, p99 = np.percentile(delays_ms, (50, 99))
    print(
        f"stops     {len(sent)}: stop to driver p50 {p50:.3f} ms  p99 {p99:.3f} ms  max {max(delays_ms):.3f} "
        f"ms; flood of {flooded * FLOOD_BYTES / span_s * 1e-6:.0f} MB/s in {flooded / span_s:.0f} samples/s",
        flush=True,
    )


def measure_ends(options: argparse.Namespace) -> None:
    """How long joints move after their commander has ended."""
    with running_host(options.realtime, "mirror", None) as (_, host, driver, port):
        for how in ("SIGKILL", "SIGSTOP", "link cut"):
            after_ms = [moved_after_ms(how, host, driver, port) for _ in range(options.times)]
            longest_ms = TTL_S * 1e3 + PERIOD_MS
            held = sum(one <= longest_ms for one in after_ms)
            print(
                f"ends      {how:<8} {held} of {len(after_ms)} within {longest_ms:g} ms: p50 "
                f"{np.median(after_ms):.3f} ms, max {max(after_ms):.3f} ms",
                flush=True,
            )


def moved_after_ms(how: str, host: DriverHost, driver: TimedDriver, port: int) -> float:
    """For how long joints move after the end of a commander."""
    link = Link(port)
    try:
        with other_process("mover", link.port) as mover:
            wait_for(lambda: host.state == "active")
            time.sleep(random.uniform(0.2, 0.25))
            # Not at rest at the end of its range, where it would seem to be held at once.
            wait_for(lambda: time.monotonic_ns() - driver.moved_at < 3e6 * PERIOD_MS)
            ended_at = time.monotonic_ns()
            if how == "link cut":
                link.cut()
            else:
                os.kill(mover.pid, signal.Signals[how])
            wait_for(lambda: host.state == "holding")
            time.sleep(2.0 * TTL_S)
            moved_at = driver.moved_at
            os.kill(mover.pid, signal.SIGKILL)
    finally:
        link.close()
    return (moved_at - ended_at) * 1e-6


@contextmanager
def opened_host(
    realtime: Realtime | None, plant: Plant = "dynamics", acceleration: float | None = ACCELERATION
) -> Iterator[Opened]:
    """A host whose loop does not run yet."""
    model = load_model(ROBOT)
    limits = Limits.of(model, acceleration=acceleration or math.inf)
    driver = TimedDriver(model, limits, plant)
    (port,) = free_ports(1)
    with (
        connect(listen=f"tcp/127.0.0.1:{port}") as session,
        DriverHost(
            session,
            driver,
            model,
            rate_hz=RATE_HZ,
            ttl_s=TTL_S,
            limits=limits,
            realtime=realtime,
        ) as host,
    ):
        yield Opened(session, host, driver, port)


@contextmanager
def running_host(
    realtime: str, plant: Plant = "dynamics", acceleration: float | None = ACCELERATION
) -> Iterator[Opened]:
    """A host whose loop runs in a thread."""
    with opened_host(None if realtime == "none" else realtime, plant, acceleration) as opened:
        thread = threading.Thread(target=opened.host.run)
        thread.start()
        try:
            yield opened
        finally:
            opened.host.close()
            thread.join()


@contextmanager
def other_process(role: str, port: int) -> Iterator[Process]:
    """A process with that role, connected to ``port``, inside the block."""
    command = [sys.executable, "-m", "bench.micro.driving", "--role", role]
    process = Process(role, command, {"ZSTATE_MODE": "peer", "ZSTATE_CONNECT": f"tcp/127.0.0.1:{port}"})
    try:
        process.wait_for_event("ready", WITHIN_S)
        yield process
    finally:
        process.stop()


def wait_for(condition: Callable[[], bool]) -> None:
    """Wait until ``condition()``; raises TimeoutError after some time."""
    deadline = time.monotonic() + WITHIN_S
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f"not so within {WITHIN_S:g} s")
        time.sleep(0.002)


# What other processes do


@contextmanager
def commander() -> Iterator[tuple[Session, Commander]]:
    """A commander whose driver is known."""
    with connect() as session, Commander(session, ROBOT, program="bench") as arm:
        arm.wait_for_driver(WITHIN_S)
        send_event("ready")
        yield session, arm


def move() -> None:
    """Command every 10 ms a joint that never rests, until the input is closed."""
    threading.Thread(target=end_with_input, daemon=True).start()
    with commander() as (_, arm):
        while True:
            arm.send({JOINT: direction(int(2.0 * time.monotonic()))})
            time.sleep(0.01)


def send() -> None:
    """Send commands at random instants, in alternating directions."""
    sent: list[tuple[int, float]] = []
    with commander() as (_, arm):
        for number in range(COMMANDS):
            sent.append((time.monotonic_ns(), direction(number)))
            arm.send({JOINT: direction(number)})
            time.sleep(random.uniform(0.5, 1.5) * COMMAND_EVERY_S)
        send_event("sent", sent=sent[COMMANDS // 10 :])


def stop_often() -> None:
    """Stop the moving robot again and again, on a link that is full."""
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

    with commander() as (session, arm):
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
        send_event("stopped", sent=sent, flooded=flooded, span_s=time.monotonic() - begin)


def direction(number: int) -> float:
    """A far position, on the other side for each ``number``."""
    return REACH if number % 2 else -REACH


def send_event(event: str, **facts: object) -> None:
    """Write a message for the measuring process."""
    print(dumps({"event": event, **facts}), flush=True)


def end_with_input() -> None:
    """End this process when its input is closed."""
    sys.stdin.read()
    os._exit(0)


MEASUREMENTS = {
    "lateness": measure_lateness,
    "commands": measure_commands,
    "stops": measure_stops,
    "ends": measure_ends,
}
ROLES = {"mover": move, "sender": send, "stopper": stop_often}

if __name__ == "__main__":
    main()
