"""Soak test of a fleet through one router: growth of resources and lost samples.

    python -m bench.soak [--robots 100] [--rate 50] [--minutes 10] [--processes 4] [--model panda]
                         [--fresh-s 60] [--warm-up-s 120] [--bare]

One router process; publisher processes that share the robots, each robot with its own session; one reader
of all. Every robot also has a static edge, whose value is the number of the current half minute: within it
the reader must receive each robot's new value, and so must a fresh reader that joins every minute.

Sampled every 5 s from /proc: resident memory, threads, file descriptors and CPU of each process. The result
is written to bench/results as JSON, with a table in Markdown.

With --bare publishers and readers use Zenoh alone with the same traffic: growth is then Zenoh's own. Its
routers keep some kilobytes of each reader that has left (eclipse-zenoh 1.10.2); without fresh readers,
--fresh-s 0, they keep nothing.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from bench.process import free_ports
from bench.soak import roles, zenoh_control
from bench.soak.report import build_result, write
from bench.soak.roles import Report
from bench.soak.task import Task
from bench.soak.usage import usage

SAMPLE_S = 5.0
FIRST_FRESH_S = 30.0
RESULTS = Path(__file__).parents[1] / "results"


def main() -> None:
    """Run one role of the soak, or the whole of it."""
    task = Task.parse(str(__doc__))
    parts = zenoh_control if task.bare else roles
    run = {"router": roles.route, "publisher": parts.publish, "reader": parts.read}
    if task.role:
        print(json.dumps(run[task.role](task)))
    else:
        soak(task)


def soak(task: Task) -> None:
    """Starts all processes, samples them for ``task.minutes`` and writes the result."""
    running = replace(task, endpoint=f"tcp/127.0.0.1:{free_ports(1)[0]}")
    parts = zenoh_control if task.bare else roles
    named = {"router": ("router", 0), "reader": ("reader", 0)}
    named |= {f"publisher {share}": ("publisher", share) for share in range(task.processes)}
    processes: dict[str, subprocess.Popen[str]] = {}
    samples: dict[str, list[list[float]]] = {name: [] for name in named}
    joins: list[Report] = []
    ended: dict[str, Report] = {}
    began = time.monotonic()
    try:
        for name, (role, share) in named.items():
            processes[name] = _start(replace(running, role=role, share=share))
        began, next_join_s = time.monotonic(), FIRST_FRESH_S
        for elapsed_s in _every(SAMPLE_S, task.minutes * 60):
            for name, process in processes.items():
                samples[name].append([round(elapsed_s, 1), *usage(process.pid)])
            if task.fresh_s and elapsed_s >= next_join_s:
                next_join_s += task.fresh_s
                joins.append(parts.join_fresh(running))
    finally:
        for name, process in reversed(processes.items()):
            ended[name] = _stop(process)
    result = build_result(task, time.monotonic() - began, ended, samples, joins)
    what = "soak-bare" if task.bare else "soak"
    write(result, RESULTS / f"{what}-{time.strftime('%Y-%m-%d')}")


def _start(task: Task) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "bench.soak", *task.options]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout and process.stdout.readline() == "ready\n", f"the {task.role} did not start"
    return process


def _stop(process: subprocess.Popen[str]) -> Report:
    output, _ = process.communicate(timeout=30.0)
    return json.loads(output)


def _every(period_s: float, seconds: float) -> Iterator[float]:
    began = time.monotonic()
    tick = 0
    while (elapsed_s := time.monotonic() - began) < seconds:
        yield elapsed_s
        tick += 1
        time.sleep(max(0.0, began + tick * period_s - time.monotonic()))


if __name__ == "__main__":
    main()
