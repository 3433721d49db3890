"""A writer and a reader of raw Zenoh."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from functools import partial

import zenoh

from bench.job import Job
from bench.subjects.subject import Answered, Roles

# Bytes of zstate's joint states besides the numbers: stamp, seq, session, digest and their headers.
OVERHEAD = 34
STAMP = struct.Struct("<q")

Settings = Callable[[Job, str], dict[str, object]]
"""The settings of the session of a "writer" or a "reader"."""

_SHARED: list[zenoh.Session] = []
"""The session of the writers of this process, if they share one."""


def as_peer(job: Job, role: str) -> dict[str, object]:
    """Settings of a writer that listens at the job's first port, and of readers that connect to it."""
    endpoint = f"tcp/127.0.0.1:{job.ports[0]}"
    return {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "connect/endpoints": [] if role == "writer" else [endpoint],
        "listen/endpoints": [endpoint] if role == "writer" else ["tcp/127.0.0.1:0"],
    }


def through_router(job: Job, role: str) -> dict[str, object]:
    """Settings of a client of the router for a "writer" or a "reader"."""
    return {"mode": "client", "connect/endpoints": [f"tcp/127.0.0.1:{job.router_port(role)}"]}


def roles(settings: Settings) -> Roles:
    """Writer and Reader whose sessions have ``settings``."""
    return partial(Writer, settings), partial(Reader, settings)


def open_session(settings: dict[str, object]) -> zenoh.Session:
    """A session with exactly these settings."""
    config = zenoh.Config()
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


class Writer:
    """Publishes bytes."""

    def __init__(self, settings: Settings, job: Job) -> None:
        if job.one_link and not _SHARED:
            _SHARED.append(open_session(settings(job, "writer")))
        self._session = _SHARED[0] if job.one_link else open_session(settings(job, "writer"))
        self._publisher = self._session.declare_publisher(f"bench/{job.robot}/joint_states")
        numbers = [struct.pack(f"<{len(row)}d", *row) for row in job.rows]
        self._tails = [bytes(OVERHEAD - STAMP.size) + block for block in numbers]

    def send(self, row: int, stamp: int) -> None:
        """Publishes the stamp and the prepared bytes."""
        self._publisher.put(STAMP.pack(stamp) + self._tails[row])

    def latch(self, number: int) -> None:
        """Nothing: it has no latched values."""

    def close(self) -> None:
        """Closes the session."""
        self._session.close()


class Reader:
    """Reads the stamp from the bytes."""

    def __init__(self, settings: Settings, job: Job, answered: Answered) -> None:
        self._session = open_session(settings(job, "reader"))
        self._answered = answered
        self._received: set[int] = set()
        self._robot_count = len(job.followed)
        self._subscribers = [
            self._session.declare_subscriber(f"bench/{robot}/joint_states", self._on_sample(number))
            for number, robot in enumerate(job.followed)
        ]

    def _on_sample(self, number: int) -> zenoh.handlers.Callback[zenoh.Sample]:
        def on_sample(sample: zenoh.Sample) -> None:
            self._received.add(number)
            self._answered(STAMP.unpack_from(sample.payload.to_bytes())[0], number)

        return zenoh.handlers.Callback(on_sample)

    def pose(self, stamp: int, robot: int = 0) -> None:
        """None: it computes no poses."""

    def has_tree(self) -> bool:
        """Whether a sample of each robot has been received; it has no tree."""
        return len(self._received) == self._robot_count

    def latched(self, number: int) -> int:
        """The number of robots: there is nothing that could be missing."""
        return self._robot_count

    def close(self) -> None:
        """Closes the session."""
        self._session.close()
