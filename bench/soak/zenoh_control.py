"""Control run: the same processes and traffic with Zenoh alone."""

# zenoh's classes have few type annotations
# pyright: basic

from __future__ import annotations

import threading
import time
from contextlib import ExitStack, suppress
from typing import Any

import zenoh

from bench.soak.roles import Report, publish_at_rate, stop_at_end_of_input
from bench.soak.task import Task
from zstate import connect, load_model
from zstate.net.streams import WILDCARD_CAPACITY


def publish(task: Task) -> Report:
    """Publishes a share of the robots: payloads as large as samples, and one latched value each."""
    model = load_model(task.model)
    payload = bytes(54 + 8 * (model.position_count + model.velocity_count))
    with ExitStack() as opened:
        robots = []
        for name in task.names[task.share :: task.processes]:
            session = opened.enter_context(connect(mode="client", endpoints=task.endpoint)).zenoh
            samples = session.declare_publisher(f"zstate/{name}/joint_states")
            mark = zenoh.ext.declare_advanced_publisher(
                session,
                f"zstate/{name}/tf_static/mark",
                cache=zenoh.ext.CacheConfig(1),
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
                publisher_detection=True,
            )
            robots.append((samples, mark))

        def publish_samples(_: int) -> None:
            for samples, _mark in robots:
                samples.put(payload)

        def publish_mark(number: int) -> None:
            for _samples, mark in robots:
                mark.put(str(number))

        return publish_at_rate(task, len(robots), publish_samples, publish_mark)


def read(task: Task) -> Report:
    """Counts the samples of all robots."""
    stop = stop_at_end_of_input()
    received = 0
    with connect(mode="client", endpoints=task.endpoint) as session:
        handlers = _subscribe(session.zenoh)

        def count() -> None:
            nonlocal received
            with suppress(zenoh.ZError):  # closed
                while handlers[0].handler.recv():
                    received += 1

        threading.Thread(target=count, daemon=True).start()
        print("ready", flush=True)
        stop.wait()
    return {"received": received}


def join_fresh(task: Task) -> Report:
    """A reader that joins, receives the first sample and leaves."""
    began = time.monotonic()
    with connect(mode="client", endpoints=task.endpoint) as session:
        handlers = _subscribe(session.zenoh)
        handlers[0].handler.recv()
        time.sleep(1.0)  # about as long as a TransformListener stays
    return {"complete": True, "seconds": round(time.monotonic() - began, 3)}


def _subscribe(session: zenoh.Session) -> list[Any]:
    samples = session.declare_subscriber(
        "zstate/*/joint_states", zenoh.handlers.RingChannel(WILDCARD_CAPACITY)
    )
    marks = zenoh.ext.declare_advanced_subscriber(
        session,
        "zstate/*/tf_static/*",
        zenoh.handlers.RingChannel(WILDCARD_CAPACITY),
        history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
        recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
    )
    return [samples, marks]
