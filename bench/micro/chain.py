"""The whole chain, two processes over loopback: rate, CPU and latency.

    python -m bench.micro.chain [--robot panda] [--rates 50 100 500 1000] [--seconds 10]

For each rate a fresh publisher process runs ``StatePublisher.run`` with a sine, and a fresh reader
process listens in one of two ways:

- ``awake``: woken by every sample, it looks up the tip at that instant. Latency is measured from the stamp of
  the sample to the return of the lookup;
- ``idle``: it looks up the tip once a second, as most programs do.

CPU is the process's own (all threads) over the measured window, in % of one core; the window starts
with the first answer of the reader.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from typing import Any

import numpy as np

from bench.process import free_ports
from zstate import SineSource, StatePublisher, TransformListener, connect, load_model

SETTLE_S = 1.0


def main() -> None:
    """Run one role of the chain, or the whole table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--robot", default="panda")
    parser.add_argument("--rates", type=float, nargs="+", default=[50.0, 100.0, 500.0, 1000.0])
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--role", choices=("publisher", "awake", "idle"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.role:
        report = _publish(options) if options.role == "publisher" else _read(options)
        print(json.dumps(report))
    else:
        _table(options)


def _table(options: argparse.Namespace) -> None:
    print(f"{options.robot}, {options.seconds:g} s each; CPU in % of a core, latency in us")
    head = ("rate Hz", "reader", "achieved Hz", "error %", "publisher", "reader CPU", "p50", "p99", "lost")
    print("".join(f"{title:>12}" for title in head))
    for rate in options.rates:
        for role in ("awake", "idle"):
            row = _run(options, rate, role)
            print("".join(f"{cell:>12}" for cell in row), flush=True)


def _run(options: argparse.Namespace, rate: float, role: str) -> list[str]:
    environment = {**os.environ, "ZSTATE_RENDEZVOUS": f"127.0.0.1:{free_ports(1)[0]}"}
    command = [sys.executable, "-m", "bench.micro.chain", "--robot", options.robot]
    command += ["--rates", str(rate), "--seconds", str(options.seconds), "--role"]
    reader = subprocess.Popen([*command, role], env=environment, stdout=subprocess.PIPE, text=True)
    publisher = subprocess.Popen([*command, "publisher"], env=environment, stdout=subprocess.PIPE, text=True)
    sent, received = (json.loads(process.communicate()[0]) for process in (publisher, reader))
    error = 100.0 * (sent["rate_hz"] / rate - 1.0)
    row = [f"{rate:g}", role, f"{sent['rate_hz']:.3f}", f"{error:+.4f}", f"{sent['cpu']:.1f}"]
    row += [f"{received['cpu']:.1f}", _or_dash(received["p50_us"]), _or_dash(received["p99_us"])]
    return [*row, str(received["lost"])]


def _or_dash(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f}"


def _publish(options: argparse.Namespace) -> dict[str, Any]:
    model = load_model(options.robot)
    with connect() as session, StatePublisher(session, model, options.robot) as publisher:
        source = SineSource(model)
        publisher.run(source, options.rates[0], seconds=SETTLE_S)
        start, cpu = time.monotonic(), _cpu_s()
        report = publisher.run(source, options.rates[0], seconds=options.seconds)
        cpu_percent = 100.0 * (_cpu_s() - cpu) / (time.monotonic() - start)
        publisher.run(source, options.rates[0], seconds=SETTLE_S)
    return {"rate_hz": report.rate_hz, "skipped": report.skipped, "cpu": cpu_percent}


def _read(options: argparse.Namespace) -> dict[str, Any]:
    model = load_model(options.robot)
    root, tip = model.root, model.links[-1]
    latencies: list[int] = []
    with connect() as session, TransformListener(session, options.robot) as listener:
        buffer = listener.buffer
        buffer.wait(root, tip, timeout_s=30.0)
        deadline = time.monotonic() + options.seconds
        start, cpu = time.monotonic(), _cpu_s()
        newest = buffer.latest(root, tip)
        while time.monotonic() < deadline:
            if options.role == "idle":
                time.sleep(1.0)
                buffer.lookup(root, tip)
            else:
                buffer.wait(root, tip, newest + 1, timeout_s=1.0)
                newest = buffer.latest(root, tip)
                buffer.lookup(root, tip, newest)
                latencies.append(time.time_ns() - newest)
        cpu_percent = 100.0 * (_cpu_s() - cpu) / (time.monotonic() - start)
        stats = listener.stats
    p50, p99 = np.percentile(latencies, (50, 99)) * 1e-3 if latencies else (None, None)
    lost = stats.missed + stats.dropped + sum(stats.refused.values())
    return {"cpu": cpu_percent, "p50_us": p50, "p99_us": p99, "lost": lost, "received": stats.received}


def _cpu_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


if __name__ == "__main__":
    main()
