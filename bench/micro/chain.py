"""The whole chain, two processes over loopback: rate, CPU and latency.

For each rate a new process runs ``StatePublisher.run`` with a sine, and another listens in one of two ways:

- ``woken``: by every sample, it looks up the tip at that instant. Latency is measured from the stamp of the
  sample to the return of the lookup;
- ``idle``: it looks up the tip once a second, as most programs do.

CPU is the process's own (all threads) over the measured window, which starts with the reader's first answer.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

from bench.micro.form import Row, result_of, running_role, send_event, use_own_rendezvous
from zstate import SineSource, StatePublisher, TransformListener, connect, load_model

SETTLE_S = 1.0


def measure(
    robot: str = "panda", rates: tuple[float, ...] = (50.0, 100.0, 500.0, 1000.0), seconds: float = 10.0
) -> Iterator[Row]:
    """Rows of each rate and reader."""
    use_own_rendezvous()
    for rate in rates:
        for how in ("woken", "idle"):
            yield from run_chain(f"{robot} at {rate:g} Hz, {how} reader", robot, rate, seconds, how)


def run_chain(title: str, robot: str, rate: float, seconds: float, how: str) -> Iterator[Row]:
    """The rows of one publisher and one reader."""
    with running_role(read, robot=robot, seconds=seconds, how=how) as reader:
        with running_role(publish, robot=robot, rate=rate, seconds=seconds) as publisher:
            sent = result_of(publisher, seconds + 60.0)
        received = result_of(reader, seconds + 60.0)
    yield Row(f"{title}: deviation of the rate", "%", [100.0 * (sent["rate_hz"] / rate - 1.0)])
    yield Row(f"{title}: lost samples", "", [received["lost"]])
    yield Row(f"{title}: CPU of the publisher", "% of a core", [sent["cpu_percent"]])
    yield Row(f"{title}: CPU of the reader", "% of a core", [received["cpu_percent"]])
    if received["latency_us"]:
        yield Row(f"{title}: stamp to result", "us", received["latency_us"])


def publish(robot: str, rate: float, seconds: float) -> dict[str, Any]:
    """Publishes a sine."""
    model = load_model(robot)
    with connect() as session, StatePublisher(session, model, robot) as publisher:
        send_event("ready")
        source = SineSource(model)
        publisher.run(source, rate, seconds=SETTLE_S)
        begin, cpu_s = time.monotonic(), time.process_time()
        report = publisher.run(source, rate, seconds=seconds)
        cpu_percent = 100.0 * (time.process_time() - cpu_s) / (time.monotonic() - begin)
        publisher.run(source, rate, seconds=SETTLE_S)
    return {"rate_hz": report.rate_hz, "cpu_percent": cpu_percent}


def read(robot: str, seconds: float, how: str) -> dict[str, Any]:
    """Listens from the first sample on."""
    model = load_model(robot)
    ends = model.root, model.links[-1]
    latency_us: list[float] = []
    with connect() as session, TransformListener(session, robot) as listener:
        send_event("ready")
        buffer = listener.buffer
        buffer.wait(*ends, timeout_s=30.0)
        begin, cpu_s = time.monotonic(), time.process_time()
        newest = buffer.latest(*ends)
        while time.monotonic() < begin + seconds:
            if how == "idle":
                time.sleep(1.0)
                buffer.lookup(*ends)
            else:
                buffer.wait(*ends, newest + 1, timeout_s=1.0)
                newest = buffer.latest(*ends)
                buffer.lookup(*ends, newest)
                latency_us.append((time.time_ns() - newest) * 1e-3)
        cpu_percent = 100.0 * (time.process_time() - cpu_s) / (time.monotonic() - begin)
        stats = listener.stats
    lost = stats.missed + stats.dropped + sum(stats.refused.values())
    return {"cpu_percent": cpu_percent, "latency_us": latency_us, "lost": lost}
