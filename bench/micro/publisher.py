"""Cost of one publisher tick: positions to bytes passed to Zenoh.

    python -m bench.micro.publisher

Thread CPU time of ``StatePublisher.publish`` for robots of several sizes, in interleaved rounds, with a
reader on loopback: without and with velocities, and with a reader of the ``tf`` stream.
Medians and 99th percentiles in us. The put of ready bytes on a plain Zenoh publisher is the floor.
Each call follows a pause, as in a control loop: back to back they cost less.
"""

from __future__ import annotations

import time

import numpy as np

from bench.micro.kinematics import ROBOTS
from bench.micro.timing import Call, call_times_us
from zstate import RobotModel, SineSource, StatePublisher, TransformListener, connect, load_model

ROUNDS = 30
TICKS = 100
PAUSE_S = 0.0005


def main() -> None:
    """Print the table."""
    print(f"{'robot':<16}{'joints':>7}  {'what':<26}{'median us':>10}{'p99 us':>10}")
    for name in ROBOTS:
        model = load_model(name)
        for what, values in measure(model, name).items():
            median, p99 = np.percentile(values, (50, 99))
            print(f"{name:<16}{len(model.joint_names):>7}  {what:<26}{median:>10.1f}{p99:>10.1f}", flush=True)


def measure(model: RobotModel, name: str) -> dict[str, list[float]]:
    """Thread CPU times [us] of each case."""
    reading = SineSource(model).read(time.time_ns())
    payload = bytes(54 + 8 * model.position_count)
    with connect() as session, connect() as other, StatePublisher(session, model, name) as publisher:
        bare = session.zenoh.declare_publisher("bench/floor")
        floor = other.zenoh.declare_subscriber("bench/floor", lambda _: None)
        with TransformListener(other, name):
            times = tick_times_us(
                {
                    "bare put": lambda: bare.put(payload),
                    "positions": lambda: publisher.publish(reading.positions),
                    "and velocities": lambda: publisher.publish(reading.positions, reading.velocities),
                }
            )
        with TransformListener(other, name, follow="tf"):
            times |= tick_times_us({"positions, tf is read": lambda: publisher.publish(reading.positions)})
        floor.undeclare()
    return times


def tick_times_us(cases: dict[str, Call]) -> dict[str, list[float]]:
    """Times [us] of each tick, the first ones included."""
    return call_times_us(cases, ROUNDS, TICKS, pause_s=PAUSE_S, warm_up=0)


if __name__ == "__main__":
    main()
