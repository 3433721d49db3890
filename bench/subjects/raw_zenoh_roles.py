"""A writer and a reader of raw Zenoh."""

from __future__ import annotations

import json
import struct

import zenoh

from bench.job import Job
from bench.subjects.subject import Answered

# Bytes of zstate's joint states besides the numbers: stamp, seq, session, digest and their headers.
OVERHEAD = 34
STAMP = struct.Struct("<q")


def settings(job: Job, *, listens: bool) -> dict[str, object]:
    """Settings of a peer that listens at the job's first port, or connects to it."""
    endpoint = f"tcp/127.0.0.1:{job.ports[0]}"
    return {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "connect/endpoints": [] if listens else [endpoint],
        "listen/endpoints": [endpoint] if listens else ["tcp/127.0.0.1:0"],
    }


def through_router(job: Job, role: str) -> dict[str, object]:
    """Settings of a client of the router for a "writer" or a "reader"."""
    return {"mode": "client", "connect/endpoints": [f"tcp/127.0.0.1:{job.router_port(role)}"]}


_SHARED: list[zenoh.Session] = []
"""The session of the writers of this process, if they share one."""


def writer_session(job: Job, config: dict[str, object]) -> zenoh.Session:
    """A session of its own, or the one of all writers of this process."""
    if not job.one_link:
        return open_session(config)
    if not _SHARED:
        _SHARED.append(open_session(config))
    return _SHARED[0]


def open_session(config: dict[str, object]) -> zenoh.Session:
    """A session with exactly these settings."""
    zenoh_config = zenoh.Config()
    for path, value in config.items():
        zenoh_config.insert_json5(path, json.dumps(value))
    return zenoh.open(zenoh_config)


class Writer:
    """Publishes bytes."""

    def __init__(self, job: Job, config: dict[str, object] | None = None) -> None:
        self._session = writer_session(job, settings(job, listens=True) if config is None else config)
        self._publisher = self._session.declare_publisher(f"bench/{job.robot}/joint_states")
        numbers = [struct.pack(f"<{len(row)}d", *row) for row in job.rows]
        self._tails = [bytes(OVERHEAD - STAMP.size) + block for block in numbers]

    def send(self, row: int, stamp: int) -> None:
        """Publishes the stamp and the prepared bytes."""
        self._publisher.put(STAMP.pack(stamp) + self._tails[row])

    def close(self) -> None:
        """Close the session."""
        self._session.close()


class Reader:
    """Reads the stamp from the bytes."""

    def __init__(self, job: Job, answered: Answered, config: dict[str, object] | None = None) -> None:
        self._session = open_session(settings(job, listens=False) if config is None else config)
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

    def close(self) -> None:
        """Close the session."""
        self._session.close()
