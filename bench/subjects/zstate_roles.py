"""A writer and a reader of zstate, for any connection and wire format."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from bench.job import Job
from bench.subjects.subject import Answered, Roles
from zstate import StatePublisher, Transform, TransformBuffer, TransformListener, load_model
from zstate._util.closeable import Closeable
from zstate.errors import LookupFailed
from zstate.net.session import Session

Connect = Callable[[Job, str], Session]
"""``connect(job, role)``: the session of a "writer" or a "reader"."""


def roles(connect: Connect, wire: str = "native") -> Roles:
    """Writer and Reader that open their session with ``connect``."""
    return partial(Writer, connect, wire), partial(Reader, connect, wire)


_SHARED: list[Session] = []
"""The session of the writers of this process, if they share one."""


def _writer_session(connect: Connect, job: Job) -> Session:
    """A session of its own, or the one of all writers of this process."""
    if not job.one_link:
        return connect(job, "writer")
    if not _SHARED:
        _SHARED.append(connect(job, "writer"))
    return _SHARED[0]


class Writer(Closeable):
    """Publishes positions and a stamp with a ``StatePublisher``."""

    def __init__(self, connect: Connect, wire: str, job: Job) -> None:
        model = load_model(Path(job.urdf))
        columns = [job.joints.index(name) for name in model.joint_names]
        self._rows = list(np.array(job.rows)[:, columns])
        self._session = _writer_session(connect, job)
        self._publisher = StatePublisher(self._session, model, job.robot, wires=(wire,))

    def send(self, row: int, stamp: int) -> None:
        self._publisher.publish(self._rows[row], stamp=stamp)

    def close(self) -> None:
        self._publisher.close()
        self._session.close()


class Reader(Closeable):
    """A ``TransformListener``; its buffer's ``watch`` calls it, and it looks up that stamp.

    The watch already delivers the answer; the lookup is repeated for comparability with other systems.
    """

    def __init__(self, connect: Connect, wire: str, job: Job, answered: Answered) -> None:
        self._job = job
        self._answered = answered
        self._session = connect(job, "reader")
        self._buffer = TransformBuffer()
        robots = job.followed if job.follows or len(job.robots) == 1 else "*"
        self._listener = TransformListener(self._session, robots, self._buffer, wire=wire)
        self._ends = [(f"{robot}/{job.base}", f"{robot}/{job.tip}") for robot in job.followed]
        self._closed = threading.Event()
        if job.load == "slow":
            threading.Thread(target=self._loop, daemon=True).start()
        else:
            self._watches = [
                self._buffer.watch(*ends, partial(self._answer, ends, number))
                for number, ends in enumerate(self._ends)
            ]

    def _answer(self, ends: tuple[str, str], robot: int, newest: Transform) -> None:
        self._buffer.lookup(*ends, newest.stamp)
        self._answered(newest.stamp, robot)

    def _loop(self) -> None:
        """The loop of a slow user: waits for a newer sample, then looks up the newest."""
        ends, newest = self._ends[0], None
        while not self._closed.is_set():
            try:
                self._buffer.wait(*ends, newest, timeout_s=0.5)
            except LookupFailed:
                continue
            stamp = self._buffer.latest(*ends)
            self._buffer.lookup(*ends, stamp)
            self._answered(stamp)
            newest = stamp + 1

    def pose(self, stamp: int, robot: int = 0) -> list[float]:
        return self._buffer.lookup(*self._ends[robot], stamp).pose7.tolist()

    def has_tree(self) -> bool:
        can_lookup, job = self._buffer.can_lookup, self._job
        return all(
            can_lookup(f"{robot}/{job.base}", f"{robot}/{link}")
            for robot in reversed(job.followed)
            for link in reversed(job.links)
        )

    def close(self) -> None:
        self._closed.set()
        self._listener.close()
        self._session.close()
