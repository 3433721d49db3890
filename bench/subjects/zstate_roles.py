"""A writer and a reader of zstate, for any connection and wire format."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from bench.job import Job
from bench.subjects.subject import Answered, Roles
from zstate import StatePublisher, StaticPublisher, Transform, TransformBuffer, TransformListener, load_model
from zstate.errors import ZStateError
from zstate.net.session import Session

Connect = Callable[[Job, str], Session]
"""``connect(job, role)``: the session of a "writer" or a "reader"."""

_SHARED: list[Session] = []
"""The session of the writers of this process, if they share one."""


def roles(connect: Connect, wire: str = "native") -> Roles:
    """Writer and Reader that open their session with ``connect``."""
    return partial(Writer, connect, wire), partial(Reader, connect, wire)


class Writer:
    """Publishes positions and a stamp with a ``StatePublisher``."""

    def __init__(self, connect: Connect, wire: str, job: Job) -> None:
        self._model = load_model(Path(job.urdf))
        columns = [job.joints.index(name) for name in self._model.joint_names]
        self._rows = list(np.array(job.rows)[:, columns])
        if job.one_link and not _SHARED:
            _SHARED.append(connect(job, "writer"))
        self._session = _SHARED[0] if job.one_link else connect(job, "writer")
        self._publisher = StatePublisher(self._session, self._model, job.robot, wires=(wire,))
        self._marks = StaticPublisher(self._session, job.robot, "mark") if job.soaks else None

    def send(self, row: int, stamp: int) -> None:
        self._publisher.publish(self._rows[row], stamp=stamp)

    def latch(self, number: int) -> None:
        """Sets a static edge whose length is ``number``."""
        assert self._marks is not None
        self._marks.set(
            Transform.from_rpy(self._model.root, "mark", (float(number), 0.0, 0.0), (0.0, 0.0, 0.0))
        )

    def close(self) -> None:
        if self._marks is not None:
            self._marks.close()
        self._publisher.close()
        self._session.close()


class Reader:
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
        self._watches = [
            self._buffer.watch(*ends, partial(self._answer, ends, number))
            for number, ends in enumerate(self._ends)
        ]

    def _answer(self, ends: tuple[str, str], robot: int, newest: Transform) -> None:
        self._buffer.lookup(*ends, newest.stamp)
        self._answered(newest.stamp, robot)

    def pose(self, stamp: int, robot: int = 0) -> list[float]:
        return self._buffer.lookup(*self._ends[robot], stamp).pose7.tolist()

    def has_tree(self) -> bool:
        can_lookup, job = self._buffer.can_lookup, self._job
        return all(
            can_lookup(f"{robot}/{job.base}", f"{robot}/{link}")
            for robot in reversed(job.followed)
            for link in reversed(job.links)
        )

    def latched(self, number: int) -> int:
        """How many robots have the static edge of ``number``."""
        return sum(self._mark(base) == number for base, _ in self._ends)

    def _mark(self, base: str) -> float | None:
        try:
            return float(self._buffer.lookup(base, f"{base.partition('/')[0]}/mark").translation[0])
        except ZStateError:  # not received yet
            return None

    def close(self) -> None:
        self._listener.close()
        self._session.close()
