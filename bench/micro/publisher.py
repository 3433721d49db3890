"""One publisher tick: positions to bytes passed to Zenoh, with a reader on loopback.

Thread CPU time of ``StatePublisher.publish`` without and with velocities, and with a reader of the stream tf;
the put of ready bytes on a plain Zenoh publisher is the floor. Each call follows a pause, as in a control
loop: back to back they cost less.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

from bench.micro.form import Row, call_times_us, compared
from bench.micro.kinematics import ROBOTS
from zstate import RobotModel, SineSource, StatePublisher, TransformListener, connect, load_model

PAUSE_S = 0.0005


def measure(robots: tuple[str, ...] = ROBOTS, rounds: int = 30) -> Iterator[Row]:
    """Rows of each robot, compared with the floor."""
    for name in robots:
        model = load_model(name)
        what = f"a tick of {name}, {len(model.joint_names)} joints"
        yield from compared(what, "us", tick_times_us(model, name, rounds))


def tick_times_us(model: RobotModel, name: str, rounds: int) -> dict[str, list[float]]:
    """Times of each case."""
    reading = SineSource(model).read(time.time_ns())
    payload = bytes(54 + 8 * model.position_count)
    with connect() as session, connect() as other, StatePublisher(session, model, name) as publisher:
        bare = session.zenoh.declare_publisher("bench/floor")
        floor = other.zenoh.declare_subscriber("bench/floor", lambda _: None)
        cases = {
            "bare put": lambda: bare.put(payload),
            "positions": lambda: publisher.publish(reading.positions),
            "and velocities": lambda: publisher.publish(reading.positions, reading.velocities),
        }
        with TransformListener(other, name):
            times = call_times_us(cases, rounds, 100, pause_s=PAUSE_S)
        with TransformListener(other, name, follow="tf"):
            cases = {"positions, tf is read": cases["positions"]}
            times |= call_times_us(cases, rounds, 100, pause_s=PAUSE_S)
        floor.undeclare()
    return times
