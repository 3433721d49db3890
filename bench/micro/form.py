"""The one form of micro benchmarks: rows, times of calls, and processes that run a role of the module."""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from bench.process import START_WITHIN_S, Process, free_ports, running

Call: TypeAlias = Callable[[], object]


class Row(NamedTuple):
    """A line of a table: the median, p99 and largest of ``values``, and the median in times ``than``'s."""

    what: str
    unit: str
    values: Sequence[float]
    than: Sequence[float] | None = None

    def facts(self) -> dict[str, Any]:
        """What is kept of it."""
        median, p99 = np.percentile(self.values, (50, 99)).tolist()
        times = None if self.than is None else median / float(np.median(self.than))
        count, most = len(self.values), float(max(self.values))
        return {
            "what": self.what,
            "unit": self.unit,
            "median": median,
            "p99": p99,
            "most": most,
            "count": count,
            "times": times,
        }


def compared(title: str, unit: str, cases: Mapping[str, Sequence[float]]) -> Iterator[Row]:
    """A row for each case; all are compared with the first."""
    first = next(iter(cases.values()))
    for name, values in cases.items():
        yield Row(f"{title}: {name}", unit, values, None if values is first else first)


def call_times_us(
    cases: Mapping[str, Call], rounds: int, calls: int, *, pause_s: float = 0.0
) -> dict[str, list[float]]:
    """Thread CPU time of each call [us] in ``rounds`` of ``calls``, after one round that warms up.

    Cases are interleaved, so that a slow moment of the machine affects all of them. Each call follows a pause
    of ``pause_s`` [s], as in a control loop; the pause is not counted.
    """
    times: dict[str, list[float]] = {name: [] for name in cases}
    for number in range(-1, rounds):
        for name, call in cases.items():
            for _ in range(calls):
                begin = time.thread_time_ns()
                call()
                if number >= 0:
                    times[name].append((time.thread_time_ns() - begin) * 1e-3)
                if pause_s:
                    time.sleep(pause_s)
    return times


def mean_times_us(cases: Mapping[str, Call], rounds: int, calls: int) -> dict[str, list[float]]:
    """The mean time of a call [us] in each round, without the cost of the clock; one more round warms up."""
    times: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(rounds + 1):
        for name, call in cases.items():
            begin = time.thread_time_ns()
            for _ in range(calls):
                call()
            times[name].append((time.thread_time_ns() - begin) / calls * 1e-3)
    return {name: values[1:] for name, values in times.items()}


@contextmanager
def running_role(role: Callable[..., object], **arguments: object) -> Iterator[Process]:
    """A process that runs ``role``, a function of a module here, inside the block; it has sent ``ready``."""
    module, name = role.__module__.rpartition(".")[2], role.__name__
    command = (sys.executable, "-m", "bench.micro", module, "--role", name, json.dumps(arguments))
    with running(name, *command) as process:
        process.wait_for_event("ready", START_WITHIN_S)
        yield process


def result_of(process: Process, within_s: float) -> Any:
    """What the role of a process returns."""
    return process.wait_for_event("result", within_s)["value"]


def send_event(event: str, **facts: object) -> None:
    """Writes a message for the measuring process."""
    print(json.dumps({"event": event, **facts}), flush=True)


def end_of_input() -> threading.Event:
    """An event that is set when standard input ends: the block that runs this role is left."""
    ended = threading.Event()

    def read_input() -> None:
        sys.stdin.read()
        ended.set()

    threading.Thread(target=read_input, daemon=True).start()
    return ended


def use_own_rendezvous() -> None:
    """Sets a private rendezvous address for this process and its children."""
    os.environ["ZSTATE_RENDEZVOUS"] = f"127.0.0.1:{free_ports(1)[0]}"


def chain_urdf(joints: int, link: str = "", origin: str = "") -> str:
    """The URDF of a chain of revolute joints; ``link`` and ``origin`` are elements of each."""
    links = "".join(f'<link name="link{n}">{link}</link>' for n in range(joints + 1))
    revolute = "".join(
        f'<joint name="joint{n + 1}" type="revolute"><parent link="link{n}"/>'
        f'<child link="link{n + 1}"/>{origin}<axis xyz="{n % 2} {1 - n % 2} 0"/>'
        f'<limit lower="-2" upper="2" velocity="9" effort="9"/></joint>'
        for n in range(joints)
    )
    return f'<robot name="chain">{links}{revolute}</robot>'
