"""The processes of a soak test: each prints ``ready``, and a report when its standard input ends."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, TypeAlias

from bench.soak.fleet_monitor import FleetMonitor, all_available, count_missing_marks, frame_names
from bench.soak.task import Task, epoch
from zstate import (
    SineSource,
    StatePublisher,
    StaticPublisher,
    TransformListener,
    connect,
    load_model,
)
from zstate.clock import SystemClock
from zstate.rate import Rate
from zstate.transform import Transform

Report: TypeAlias = "dict[str, Any]"


def stop_at_end_of_input() -> threading.Event:
    """An event that is set when standard input ends."""
    stop = threading.Event()

    def read_input() -> None:
        sys.stdin.read()
        stop.set()

    threading.Thread(target=read_input, daemon=True).start()
    return stop


def route(task: Task) -> Report:
    """Runs the router."""
    with connect(mode="router", listen=task.endpoint):
        print("ready", flush=True)
        stop_at_end_of_input().wait()
    return {}


def publish(task: Task) -> Report:
    """Publishes a share of the robots, each with its own session."""
    model = load_model(task.model)
    source = SineSource(model)
    with ExitStack() as opened:
        robots: list[tuple[StatePublisher, StaticPublisher]] = []
        for name in task.names[task.share :: task.processes]:
            session = opened.enter_context(connect(mode="client", endpoints=task.endpoint))
            publisher = opened.enter_context(StatePublisher(session, model, name))
            robots.append((publisher, opened.enter_context(StaticPublisher(session, name, "mark"))))

        def publish_samples(stamp: int) -> None:
            reading = source.read(stamp)
            for publisher, _ in robots:
                publisher.publish(reading.positions, reading.velocities, stamp=stamp)

        def publish_mark(number: int) -> None:
            mark = Transform.from_rpy(model.root, "mark", (float(number), 0.0, 0.0), (0.0, 0.0, 0.0))
            for _, statics in robots:
                statics.set(mark)

        return publish_at_rate(task, len(robots), publish_samples, publish_mark)


def publish_at_rate(
    task: Task, robots: int, publish_samples: Callable[[int], None], publish_mark: Callable[[int], None]
) -> Report:
    """Calls ``publish_samples(stamp)`` each tick and ``publish_mark(number)`` each half minute."""
    stop = stop_at_end_of_input()
    print("ready", flush=True)
    rate = Rate(task.rate, SystemClock(), stop)
    published = 0
    for stamp in rate:
        publish_samples(stamp)
        if epoch() != published:
            published = epoch()
            publish_mark(published)
    report = rate.report()
    return {"sent": report.ticks * robots, "achieved_hz": report.rate_hz, "skipped": report.skipped}


def read(task: Task) -> Report:
    """Listens to all robots and monitors them twice a second."""
    stop = stop_at_end_of_input()
    with (
        connect(mode="client", endpoints=task.endpoint) as session,
        TransformListener(session) as listener,
    ):
        monitor = FleetMonitor(listener.buffer, frame_names(task))
        print("ready", flush=True)
        for _ in Rate(2.0, SystemClock(), stop):
            monitor.sample()
        stats = listener.stats
    return {
        "received": stats.received,
        "missed": stats.missed,
        "dropped": stats.dropped,
        "late": stats.late,
        "refused": stats.refused,
        **monitor.report(),
    }


def join_fresh(task: Task) -> Report:
    """A reader that joins: time until it has every model and every current static edge."""
    ends, began = frame_names(task), time.monotonic()
    with (
        connect(mode="client", endpoints=task.endpoint) as session,
        TransformListener(session) as listener,
    ):
        buffer = listener.buffer
        complete = becomes_true(
            10.0, lambda: not count_missing_marks(buffer, ends) and all_available(buffer, ends)
        )
        return {"complete": complete, "seconds": round(time.monotonic() - began, 3)}


def becomes_true(timeout_s: float, condition: Callable[[], bool]) -> bool:
    """Whether ``condition()`` becomes true in time; checked every 10 ms."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.01)
    return False
