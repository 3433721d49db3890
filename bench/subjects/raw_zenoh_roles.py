"""A writer and a reader of raw Zenoh."""

from __future__ import annotations

import json
import struct

import zenoh

from bench.job import Job
from bench.subjects.subject import Answered

# What zstate's joint states have besides their numbers: stamp, seq, session, digest and the heads of these.
OVERHEAD = 34
STAMP = struct.Struct("<q")


def settings(job: Job, *, listens: bool) -> dict[str, object]:
    """Of the session: a peer that listens at the job's first port, or one that connects to it."""
    endpoint = f"tcp/127.0.0.1:{job.ports[0]}"
    return {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "connect/endpoints": [] if listens else [endpoint],
        "listen/endpoints": [endpoint] if listens else ["tcp/127.0.0.1:0"],
    }


def through_router(job: Job) -> dict[str, object]:
    """Of the session: a client of the router at the job's first port."""
    return {"mode": "client", "connect/endpoints": [f"tcp/127.0.0.1:{job.ports[0]}"]}


def open_session(told: dict[str, object]) -> zenoh.Session:
    """A session with these settings and no others."""
    config = zenoh.Config()
    for path, value in told.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


class Writer:
    """Puts bytes."""

    def __init__(self, job: Job, told: dict[str, object] | None = None) -> None:
        self._session = open_session(settings(job, listens=True) if told is None else told)
        self._publisher = self._session.declare_publisher(f"bench/{job.robot}/joint_states")
        numbers = [struct.pack(f"<{len(row)}d", *row) for row in job.rows]
        self._tails = [bytes(OVERHEAD - STAMP.size) + block for block in numbers]

    def send(self, row: int, stamp: int) -> None:
        """A stamp and the rest."""
        self._publisher.put(STAMP.pack(stamp) + self._tails[row])

    def close(self) -> None:
        """Close the session."""
        self._session.close()


class Reader:
    """Takes the stamp out of the bytes."""

    def __init__(self, job: Job, answered: Answered, told: dict[str, object] | None = None) -> None:
        self._session = open_session(settings(job, listens=False) if told is None else told)
        self._answered = answered
        self._heard: set[int] = set()
        self._wanted = len(job.robots)
        self._subscribers = [
            self._session.declare_subscriber(f"bench/{robot}/joint_states", self._on_sample(number))
            for number, robot in enumerate(job.robots)
        ]

    def _on_sample(self, number: int) -> zenoh.handlers.Callback[zenoh.Sample]:
        def take(sample: zenoh.Sample) -> None:
            self._heard.add(number)
            self._answered(STAMP.unpack_from(sample.payload.to_bytes())[0], number)

        return zenoh.handlers.Callback(take)

    def pose(self, stamp: int, robot: int = 0) -> None:
        """It has no answers."""

    def has_tree(self) -> bool:
        """It has no tree: whether a sample of each robot has come."""
        return len(self._heard) == self._wanted

    def close(self) -> None:
        """Close the session."""
        self._session.close()
