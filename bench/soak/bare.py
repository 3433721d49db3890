"""The control: the same processes with the same traffic, of Zenoh and nothing else."""

# zenoh's classes have no types to speak of
# pyright: basic

from __future__ import annotations

import threading
import time
from contextlib import ExitStack, suppress
from typing import Any

import zenoh

from bench.soak.roles import Report, paced, until_told
from bench.soak.task import Task
from zstate import connect, load_model
from zstate.net.streams import WILDCARD_CAPACITY


def publish(task: Task) -> Report:
    """A share of the robots: payloads as large as samples, and one latched value each."""
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

        def say(_: int) -> None:
            for samples, _mark in robots:
                samples.put(payload)

        def tell(number: int) -> None:
            for _samples, mark in robots:
                mark.put(str(number))

        return paced(task, len(robots), say, tell)


def read(task: Task) -> Report:
    """The reader of all: counts what comes."""
    stop = until_told()
    received = 0
    with connect(mode="client", endpoints=task.endpoint) as session:
        handlers = _subscribe(session.zenoh)

        def take() -> None:
            nonlocal received
            with suppress(zenoh.ZError):  # closed
                while handlers[0].handler.recv():
                    received += 1

        threading.Thread(target=take, daemon=True).start()
        print("ready", flush=True)
        stop.wait()
    return {"received": received}


def join_fresh(task: Task) -> Report:
    """A reader that joins now, hears the first sample, and leaves."""
    began = time.monotonic()
    with connect(mode="client", endpoints=task.endpoint) as session:
        handlers = _subscribe(session.zenoh)
        handlers[0].handler.recv()
        time.sleep(1.0)  # as long as a listener of ours is there, more or less
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
