"""The processes of a soak: each says a line when it is ready, and reports when its standard input ends."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, TypeAlias

from bench.soak.task import Task, epoch
from bench.soak.watching import Watching, all_answer, ends_of, missing
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


def until_told() -> threading.Event:
    """What is set when standard input ends."""
    told = threading.Event()

    def listen() -> None:
        sys.stdin.read()
        told.set()

    threading.Thread(target=listen, daemon=True).start()
    return told


def route(task: Task) -> Report:
    """The router."""
    with connect(mode="router", listen=task.endpoint):
        print("ready", flush=True)
        until_told().wait()
    return {}


def publish(task: Task) -> Report:
    """A share of the robots, each with a session of its own."""
    model = load_model(task.model)
    source = SineSource(model)
    with ExitStack() as opened:
        robots: list[tuple[StatePublisher, StaticPublisher]] = []
        for name in task.names[task.share :: task.processes]:
            session = opened.enter_context(connect(mode="client", endpoints=task.endpoint))
            publisher = opened.enter_context(StatePublisher(session, model, name))
            robots.append((publisher, opened.enter_context(StaticPublisher(session, name, "mark"))))

        def say(stamp: int) -> None:
            reading = source.read(stamp)
            for publisher, _ in robots:
                publisher.publish(reading.positions, reading.velocities, stamp=stamp)

        def tell(number: int) -> None:
            mark = Transform.from_rpy(model.root, "mark", (float(number), 0.0, 0.0), (0.0, 0.0, 0.0))
            for _, statics in robots:
                statics.set(mark)

        return paced(task, len(robots), say, tell)


def paced(task: Task, robots: int, say: Callable[[int], None], tell: Callable[[int], None]) -> Report:
    """``say(stamp)`` at each tick, and ``tell(number)`` in each half minute, until told to end."""
    stop = until_told()
    print("ready", flush=True)
    rate = Rate(task.rate, SystemClock(), stop)
    told = 0
    for stamp in rate:
        say(stamp)
        if epoch() != told:
            told = epoch()
            tell(told)
    report = rate.report()
    return {"sent": report.ticks * robots, "achieved_hz": report.rate_hz, "skipped": report.skipped}


def read(task: Task) -> Report:
    """The reader of all."""
    stop = until_told()
    with (
        connect(mode="client", endpoints=task.endpoint) as session,
        TransformListener(session) as listener,
    ):
        watching = Watching(listener.buffer, ends_of(task))
        print("ready", flush=True)
        for _ in Rate(2.0, SystemClock(), stop):
            watching.look()
        stats = listener.stats
    return {
        "received": stats.received,
        "missed": stats.missed,
        "dropped": stats.dropped,
        "late": stats.late,
        "refused": stats.refused,
        **watching.report(),
    }


def join_fresh(task: Task) -> Report:
    """A reader that joins now: after how long it has every model and every present static edge."""
    ends, began = ends_of(task), time.monotonic()
    with (
        connect(mode="client", endpoints=task.endpoint) as session,
        TransformListener(session) as listener,
    ):
        buffer = listener.buffer
        complete = within(10.0, lambda: not missing(buffer, ends) and all_answer(buffer, ends))
        return {"complete": complete, "seconds": round(time.monotonic() - began, 3)}


def within(timeout_s: float, condition: Callable[[], bool]) -> bool:
    """Whether ``condition`` comes to hold."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.01)
    return False
